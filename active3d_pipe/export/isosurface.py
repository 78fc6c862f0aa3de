"""The zero level of the SDF as a triangle mesh: blocked, coarse to fine, only where surface was observed."""

from collections.abc import Callable, Iterable

import numpy as np
from scipy.ndimage import binary_dilation
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from skimage.measure import marching_cubes

from active3d_pipe.errors import ConfigError, InputError
from active3d_pipe.export.config import MeshSettings
from active3d_pipe.export.kernels_culling import mark_seen
from active3d_pipe.structures import Frame, TriangleMesh, VoxelGrid

QuerySdf = Callable[[np.ndarray], np.ndarray]
QueryColor = Callable[[np.ndarray], np.ndarray]


def near_surface(hit_evidence: np.ndarray, dilate_voxels: int) -> np.ndarray:
    """(X, Y, Z) bool, voxels that a depth ray ended in and their neighbours up to `dilate_voxels` (26-connected)."""
    hit = np.asarray(hit_evidence) > 0
    if dilate_voxels == 0:
        return hit
    return binary_dilation(hit, structure=np.ones((3, 3, 3), bool), iterations=dilate_voxels)


def extract_mesh(
    query_sdf: QuerySdf,
    low: np.ndarray,
    high: np.ndarray,
    settings: MeshSettings,
    *,
    grid: VoxelGrid | None = None,
    observed: np.ndarray | None = None,
) -> TriangleMesh:
    """Marching cubes over the box [low, high].

    Args:
        query_sdf: (N, 3) float32 world points -> (N,) SDF, m, positive in free space.
        low, high: (3,) corners of the box, world, m.
        settings: cell size and block size; see `MeshSettings`.
        grid, observed: a voxel grid and a bool volume on it (`near_surface`); outside of it no surface is
            extracted. Without them the whole box counts as observed.

    Returns:
        Mesh without colours; the faces' normals (right-hand rule) point into free space. Blocks are welded, small
        loose pieces are dropped.

    A cell of two by two by two is refined when a corner is nearer to the surface than its half diagonal: no
    surface can pass through it otherwise, if the SDF is a distance (`refine_margin` allows for the rest).
    """
    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    if not (high > low).all():
        raise ConfigError(f"mesh bounds {low.tolist()} .. {high.tolist()}: expected low < high on every axis")
    if (grid is None) != (observed is None) or (grid is not None and observed is not None
                                                and observed.shape != grid.shape):
        raise InputError("mesh: `grid` and `observed` must be given together and have one shape")
    size, block = settings.voxel_size_m, settings.block_cells
    cells = np.maximum(np.ceil((high - low) / size - 1e-9).astype(int), 2)
    vertices, faces, count = [], [], 0
    for start in np.ndindex(*(-(-int(n) // block) for n in cells)):
        base = np.array(start) * block
        shape = np.minimum(base + block, cells + cells % 2) - base
        piece = _block(query_sdf, low, base, shape, settings, grid, observed)
        if piece is not None:
            vertices.append(piece[0])
            faces.append(piece[1] + count)
            count += len(piece[0])
    if not vertices:
        return TriangleMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    index, triangles = _weld(np.concatenate(vertices), np.concatenate(faces), block)
    mesh = TriangleMesh((low + index * size).astype(np.float32), triangles.astype(np.int32))
    return drop_small_components(mesh, settings.min_component_m2)


def _observed_at(points: np.ndarray, grid: VoxelGrid, observed: np.ndarray) -> np.ndarray:
    ijk = grid.index_of(points)
    inside = grid.contains_index(ijk)
    out = np.zeros(points.shape[:-1], bool)
    out[inside] = observed[tuple(ijk[inside].T)]
    return out


def _block(
    query_sdf: QuerySdf, low: np.ndarray, base: np.ndarray, shape: np.ndarray, settings: MeshSettings,
    grid: VoxelGrid | None, observed: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Vertices (V, 3) float64 in cells from `low`, and faces, of the cells base .. base + shape; None if empty."""
    size = settings.voxel_size_m
    coarse = np.ones(tuple(shape // 2), bool)
    if grid is not None and observed is not None:
        centres = np.stack(np.meshgrid(*((b + 2 * np.arange(n) + 1) * size + o for b, n, o in
                                         zip(base, coarse.shape, low, strict=True)), indexing="ij"), axis=-1)
        coarse = _observed_at(centres, grid, observed)
        if not coarse.any():
            return None
    sdf = _evaluate(query_sdf, low, base, _nodes_of(coarse), 2, size)
    nearest = np.full(coarse.shape, np.inf, np.float32)
    for corner in np.ndindex(2, 2, 2):
        part = sdf[tuple(slice(c, c + n) for c, n in zip(corner, coarse.shape, strict=True))]
        np.minimum(nearest, np.abs(part), out=nearest)
    coarse &= nearest <= settings.refine_margin * np.sqrt(3) * size
    if not coarse.any():
        return None
    fine = coarse.repeat(2, 0).repeat(2, 1).repeat(2, 2)
    nodes = _nodes_of(fine)
    sdf = _evaluate(query_sdf, low, base, nodes, 1, size)
    values = sdf[nodes]
    if values.min() > 0 or values.max() < 0:
        return None
    # skimage processes the cell whose *highest* corner is marked.
    mask = np.zeros(nodes.shape, bool)
    mask[1:, 1:, 1:] = fine
    try:
        local, faces, _, _ = marching_cubes(sdf, 0.0, mask=mask, allow_degenerate=False)
    except RuntimeError:  # both signs occur, but in no common cell
        return None
    return local.astype(np.float64) + base, faces.astype(np.int64)


def _nodes_of(cells: np.ndarray) -> np.ndarray:
    """Corners (X + 1, Y + 1, Z + 1) bool of the marked cells (X, Y, Z)."""
    nodes = np.zeros(tuple(n + 1 for n in cells.shape), bool)
    for corner in np.ndindex(2, 2, 2):
        nodes[tuple(slice(c, c + n) for c, n in zip(corner, cells.shape, strict=True))] |= cells
    return nodes


def _evaluate(
    query_sdf: QuerySdf, low: np.ndarray, base: np.ndarray, nodes: np.ndarray, step: int, size: float
) -> np.ndarray:
    """SDF on the marked nodes (spacing step * size), +inf-like elsewhere."""
    ijk = np.argwhere(nodes)
    points = low + (base + step * ijk) * size
    sdf = np.full(nodes.shape, 1e3, np.float32)
    sdf[nodes] = query_sdf(points.astype(np.float32))
    return sdf


def _weld(vertices: np.ndarray, faces: np.ndarray, block: int) -> tuple[np.ndarray, np.ndarray]:
    """Merge the vertices that neighbouring blocks share on their common plane.

    A vertex lies on a lattice edge, so (lower node, axis) names it exactly; only vertices with a
    coordinate on a block border are looked at.
    """
    nearest = np.rint(vertices)
    on_node = np.abs(vertices - nearest) < 1e-4
    border = (on_node & (nearest.astype(np.int64) % block == 0)).any(axis=1)
    picked = np.flatnonzero(border)
    lower = np.where(on_node[picked], nearest[picked], np.floor(vertices[picked])).astype(np.int64)
    axis = np.where(on_node[picked].all(axis=1), 3, np.argmin(on_node[picked], axis=1))
    _, first, inverse = np.unique(np.column_stack([lower, axis]), axis=0, return_index=True, return_inverse=True)
    target = np.arange(len(vertices))
    target[picked] = picked[first[inverse.reshape(-1)]]
    faces = target[faces]
    proper = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])
    return _compact(vertices, faces[proper])


def _compact(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Drop vertices that no face uses."""
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    renumber = np.cumsum(used) - 1
    return vertices[used], renumber[faces]


def keep_faces(mesh: TriangleMesh, keep: np.ndarray) -> TriangleMesh:
    """The mesh of the faces with `keep` (F,) bool, without unused vertices."""
    used = np.zeros(len(mesh.vertices), bool)
    faces = mesh.faces[keep]
    used[faces] = True
    renumber = (np.cumsum(used) - 1).astype(np.int32)
    colors = None if mesh.colors is None else mesh.colors[used]
    return TriangleMesh(mesh.vertices[used], renumber[faces].reshape(-1, 3), colors)


def drop_small_components(mesh: TriangleMesh, min_area_m2: float) -> TriangleMesh:
    """Drop the connected pieces (by shared vertices) of less than `min_area_m2`."""
    if min_area_m2 <= 0 or len(mesh.faces) == 0:
        return mesh
    f = mesh.faces
    rows, columns = f[:, [0, 1]].reshape(-1), f[:, [1, 2]].reshape(-1)
    n = len(mesh.vertices)
    _, label = connected_components(coo_matrix((np.ones(len(rows), bool), (rows, columns)), (n, n)), directed=False)
    of_face = label[f[:, 0]]
    area = np.bincount(of_face, weights=np.linalg.norm(_face_normals(mesh), axis=1))
    return keep_faces(mesh, (area >= min_area_m2)[of_face])


def _face_normals(mesh: TriangleMesh) -> np.ndarray:
    """(F, 3) float64 normals whose length is the area, m2."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(np.float64) for i in range(3))
    return 0.5 * np.cross(b - a, c - a)


def colour_mesh(mesh: TriangleMesh, query_color: QueryColor) -> TriangleMesh:
    """The mesh with the colour of `query_color` ((N, 3) world points -> (N, 3) in 0..1) at every vertex."""
    color = np.clip(np.asarray(query_color(mesh.vertices)), 0, 1)
    return TriangleMesh(mesh.vertices, mesh.faces, np.rint(color * 255).astype(np.uint8).reshape(-1, 3))


def cull_unseen(mesh: TriangleMesh, frames: Iterable[Frame], settings: MeshSettings) -> TriangleMesh:
    """Drop the faces that no frame saw.

    A frame sees a face when the face's centroid projects onto a pixel with a depth reading, lies at most
    `cull_tolerance_m` behind that depth, and the face is turned towards the camera (`cull_facing_cosine`): the
    field also has a zero level where it returns to free behind a surface, and that sheet looks away.
    """
    if len(mesh.faces) == 0:
        return mesh
    centroids = mesh.vertices[mesh.faces].mean(axis=1, dtype=np.float64).astype(np.float32)
    normals = _face_normals(mesh)
    normals = (normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)).astype(np.float32)
    seen = np.zeros(len(mesh.faces), bool)
    pending = np.arange(len(mesh.faces))
    for frame in frames:
        T, c = frame.T_world_camera.astype(np.float32), frame.camera
        mark_seen(
            pending, centroids, normals, np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3]),
            np.array([c.fx, c.fy, c.cx, c.cy], np.float32), frame.depth, np.float32(c.near),
            np.float32(settings.cull_tolerance_m), np.float32(settings.cull_facing_cosine), seen,
        )
        pending = pending[~seen[pending]]
        if len(pending) == 0:
            break
    return keep_faces(mesh, seen)
