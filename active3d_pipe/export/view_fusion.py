"""What the logged frames contribute to the mesh: where surface was read, which faces were seen, their colours."""

from collections.abc import Callable, Sequence

import numpy as np

from active3d_pipe.export import kernels_views as kernels
from active3d_pipe.export.config import MeshSettings
from active3d_pipe.export.isosurface import keep_faces
from active3d_pipe.geometry.sampling import spread
from active3d_pipe.geometry.threads import on_threads
from active3d_pipe.structures import Frame, TriangleMesh, VoxelGrid

QueryColor = Callable[[np.ndarray], np.ndarray]
READING_STRIDE = 4  # of the pixels, every how many mark their cell; the lines between them close the gaps
JOIN = 0.1  # neighbouring readings belong to one surface when they differ by less than this share of the depth
MIN_COSINE = 0.15  # colours are taken from views that see the surface at this cosine or better
COLOUR_FOOTPRINT = 0.5  # of a vertex's spacing: what its colour is a mean over
MAX_COLOUR_FRAMES = 100  # evenly spread; neighbouring frames of a walk see nearly the same
COLOUR_NOISE = 12.0  # difference, of 255, from which on a view counts as an outlier (occluder, highlight)


def near_readings(
    frames: Sequence[Frame], low: np.ndarray, high: np.ndarray, cell_m: float, dilate: int
) -> tuple[VoxelGrid, np.ndarray]:
    """Cells of `cell_m` over the box [low, high] that depth readings lie in, grown by `dilate` cells.

    Returns the grid and (X, Y, Z) bool on it. A surface that is further from any reading than that is the field's
    own invention.
    """
    grid = VoxelGrid.from_bounds(low, high, cell_m)
    marks = np.zeros(grid.shape, bool)
    origin = grid.origin.astype(np.float32)

    def mark(frame: Frame) -> None:
        kernels.mark_readings(
            *frame_arrays(frame), frame.depth, READING_STRIDE, np.float32(JOIN), origin, np.float32(1 / cell_m), marks
        )

    on_threads(mark, frames)
    return grid, dilated(marks, dilate)


def dilated(marks: np.ndarray, reach: int) -> np.ndarray:
    """(X, Y, Z) bool, whether a mark lies at most `reach` places away along every axis."""
    if reach:  # a box separates into its three axes
        x, y, z = marks.shape
        for shape in ((1, x, y * z), (x, y, z), (x * y, z, 1)):
            grown = np.empty(shape, bool)
            kernels.widen(marks.reshape(shape), reach, grown)
            marks = grown.reshape(x, y, z)
    return marks


def cull_unseen(mesh: TriangleMesh, frames: Sequence[Frame], settings: MeshSettings) -> TriangleMesh:
    """Drop the faces that no frame saw, but for a margin of `cull_margin_m` around what was seen.

    A frame sees a face when the face's centroid projects onto a pixel with a depth reading, lies within
    `cull_tolerance_m` of that depth (a reading far behind says that there is nothing), and the face is turned towards
    the camera (`cull_facing_cosine`): the field also has a zero level where it returns to free behind a surface, and
    that sheet looks away. The margin, in whole rings of faces, is where the field continues seen surface into small
    gaps and behind the rims of occluders.
    """
    if len(mesh.faces) == 0:
        return mesh
    centroids, normals = np.empty(mesh.faces.shape, np.float32), np.empty(mesh.faces.shape, np.float32)
    kernels.face_centres(mesh.vertices, mesh.faces, centroids, normals)
    seen = np.zeros(len(mesh.faces), bool)
    spheres = _spheres(centroids)
    done = np.zeros(len(spheres), bool)

    def mark(frame: Frame) -> None:
        kernels.mark_seen(
            spheres, centroids, normals, *frame_arrays(frame), frame.depth, np.float32(frame.camera.near),
            np.float32(frame.depth.max()), np.float32(settings.cull_tolerance_m),
            np.float32(settings.cull_facing_cosine), done, seen,
        )

    on_threads(mark, frames)
    kernels.grow_faces(mesh.faces, round(settings.cull_margin_m / settings.voxel_size_m), len(mesh.vertices), seen)
    return keep_faces(mesh, seen)


def colour_mesh(mesh: TriangleMesh, query_color: QueryColor) -> TriangleMesh:
    """The mesh with the colour of `query_color` ((N, 3) world points -> (N, 3) in 0..1) at every vertex."""
    color = np.clip(np.asarray(query_color(mesh.vertices)), 0, 1)
    return TriangleMesh(mesh.vertices, mesh.faces, np.rint(color * 255).astype(np.uint8).reshape(-1, 3))


def colour_from_views(
    mesh: TriangleMesh, frames: Sequence[Frame], settings: MeshSettings, query_color: QueryColor
) -> TriangleMesh:
    """The mesh with every vertex coloured from the frames that see it; `query_color` where none does.

    Close and frontal views count most; a second pass gives little weight to views that differ from the mean.
    """
    if len(mesh.faces) == 0:
        return colour_mesh(mesh, query_color)
    vertices = np.ascontiguousarray(mesh.vertices)
    normals = vertex_normals(mesh)
    spheres = _spheres(vertices)
    mean: np.ndarray = np.zeros((len(vertices), 3), np.float32)
    for inv_variance in (0.0, 1 / COLOUR_NOISE**2):
        sums = np.zeros((len(vertices), 4), np.float32)
        for frame in spread(frames, MAX_COLOUR_FRAMES):
            kernels.add_colours(
                spheres, vertices, normals, *frame_arrays(frame), frame.depth, frame.rgb, np.float32(frame.camera.near),
                np.float32(frame.depth.max()), np.float32(settings.colour_tolerance_m), np.float32(MIN_COSINE),
                np.float32(COLOUR_FOOTPRINT * settings.voxel_size_m), mean, np.float32(inv_variance), sums,
            )
        mean = sums[:, :3] / np.maximum(sums[:, 3:], np.float32(1e-12))
    colors = np.rint(np.clip(mean, 0, 255)).astype(np.uint8)
    unseen = sums[:, 3] <= 0
    if unseen.any():
        rest = np.clip(np.asarray(query_color(vertices[unseen])), 0, 1)
        colors[unseen] = np.rint(rest * 255).astype(np.uint8)
    return TriangleMesh(mesh.vertices, mesh.faces, colors)


def vertex_normals(mesh: TriangleMesh) -> np.ndarray:
    """(V, 3) float32 unit normals, means over the faces weighted by area; zero for a vertex without faces."""
    sums = np.zeros(mesh.vertices.shape, np.float32)
    kernels.sum_normals(mesh.vertices, mesh.faces, sums)
    return sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), np.float32(1e-30))


def _spheres(points: np.ndarray) -> np.ndarray:
    spheres = np.empty((-(-len(points) // kernels.CHUNK), 4), np.float32)
    kernels.bounding_spheres(points, spheres)
    return spheres


def frame_arrays(frame: Frame) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotation camera -> world (3, 3), centre (3,) m, intrinsics (fx, fy, cx, cy): float32, for the kernels."""
    T, c = frame.T_world_camera.astype(np.float32), frame.camera
    intrinsics = np.array([c.fx, c.fy, c.cx, c.cy], np.float32)
    return np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3]), intrinsics
