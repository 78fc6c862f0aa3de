"""Surface that frames agree on and the field has not: leaves, slats, whatever is thinner than an SDF can hold.

A signed distance has an inside; a sheet seen from both sides has none, and the zero level closes over it. The readings
themselves say where it is, so faces are laid through them, pixel by pixel, as in meshes from range images (Turk and
Levoy 1994), each cell of space from the frame that saw it from nearest.
"""

from collections.abc import Sequence

import numpy as np

from active3d_pipe.export import kernels_sheets as kernels
from active3d_pipe.export.config import MeshSettings
from active3d_pipe.export.view_fusion import frame_arrays
from active3d_pipe.geometry.threads import on_threads
from active3d_pipe.structures import Frame, TriangleMesh, VoxelGrid

CELL = 1.25  # edge of a cell, in marching-cubes cells: a reading is explained within one to two of them from a face
HIDDEN = 4.0  # cells before a point up to which a reading is taken for scatter, not for something that hides it
FAR_M = 3.0  # up to there pixels are so dense that no cell is skipped when some are
FOOTPRINTS = 3.0  # neighbouring pixels belong to one sheet when their depths differ by less than so many pixels ...
SLANTED = 20.0  # ... or than so many, if the sheet goes on as evenly beside them


def with_sheets(
    mesh: TriangleMesh, frames: Sequence[Frame], low: np.ndarray, high: np.ndarray, settings: MeshSettings
) -> TriangleMesh:
    """The mesh, and faces through readings in the box [low, high] off it, where `sheet_frames` frames have some.

    A cell is covered when, of the frames that nothing hides it from, at least the share `sheet_agreement` reads surface
    there: readings that a sensor's noise scatters around a wall are few where they are off it. The new faces share no
    vertices with the others.
    """
    if settings.sheet_frames == 0 or not len(frames):
        return mesh
    grid = VoxelGrid.from_bounds(low, high, CELL * settings.voxel_size_m)
    marks = np.zeros(grid.shape, np.uint8)
    kernels.mark_faces(
        np.ascontiguousarray(mesh.vertices), mesh.faces, *_lattice(grid), marks,
    )
    cells, owners = _wanted(frames, grid, marks, settings)
    if not len(cells):
        return mesh
    vertices, faces = [mesh.vertices], [mesh.faces]
    count = len(mesh.vertices)
    for new_vertices, new_faces in on_threads(
        lambda index: _lay(frames[index], grid, marks, cells[owners == index]), np.unique(owners)
    ):
        vertices.append(new_vertices)
        faces.append(new_faces + np.int32(count))
        count += len(new_vertices)
    return TriangleMesh(np.concatenate(vertices), np.concatenate(faces))


def _wanted(
    frames: Sequence[Frame], grid: VoxelGrid, marks: np.ndarray, settings: MeshSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Flat cells to be covered, ascending, and for each the index of the frame that covers it."""
    def nearest(index: int) -> tuple[np.ndarray, ...]:
        """Of one frame the nearest reading of every cell that has some: flat cells, the frame, depths and points."""
        frame = frames[index]
        stride = min(max(int(grid.voxel_size * frame.camera.fx / FAR_M), 1), 2)
        cells, pixels = _open_pixels(frame, grid, marks, stride)
        d = frame.depth.reshape(-1)[pixels]
        order = np.lexsort((d, cells))
        cells, first = np.unique(cells[order], return_index=True)
        chosen = order[first]
        rows, columns = np.divmod(pixels[chosen], frame.depth.shape[1])
        return cells, np.full(len(cells), index), d[chosen], _points(frame, rows, columns)

    found = on_threads(nearest, range(len(frames)))
    cells, owners, depths, points = (np.concatenate(part) for part in zip(*found, strict=True))
    order = np.lexsort((owners, depths, cells))
    cells, first, counts = np.unique(cells[order], return_index=True, return_counts=True)
    owners, points = owners[order][first], points[order][first]
    keep = counts >= settings.sheet_frames
    cells, owners, points = cells[keep], owners[keep], np.ascontiguousarray(points[keep])
    agree, other = np.zeros(len(cells), np.int32), np.zeros(len(cells), np.int32)
    for frame in frames:
        # Asked about the reading itself, not the middle of its cell: what is thin may pass beside that.
        kernels.vote(
            points, *frame_arrays(frame), frame.depth, np.float32(frame.camera.near), np.float32(grid.voxel_size),
            np.float32(HIDDEN * grid.voxel_size), agree, other,
        )
    keep = agree >= np.maximum(settings.sheet_agreement * (agree + other), 1)
    return cells[keep], owners[keep]


def _open_pixels(frame: Frame, grid: VoxelGrid, marks: np.ndarray, stride: int) -> tuple[np.ndarray, np.ndarray]:
    """Of every `stride`-th pixel those with an unexplained reading: flat cells and flat pixels."""
    most = -(-frame.depth.shape[0] // stride) * -(-frame.depth.shape[1] // stride)
    cells, pixels = np.empty(most, np.int64), np.empty(most, np.int32)
    count = kernels.open_pixels(
        *frame_arrays(frame), frame.depth, stride, np.float32(frame.camera.near), *_lattice(grid), marks, cells, pixels
    )
    return cells[:count], pixels[:count]


def _lattice(grid: VoxelGrid) -> tuple[np.ndarray, np.floating]:
    """Lowest corner and inverse cell size of a grid: float32, for the kernels."""
    return grid.origin.astype(np.float32), np.float32(1 / grid.voxel_size)


def _lay(frame: Frame, grid: VoxelGrid, marks: np.ndarray, owned: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Faces over the pixels of one frame whose readings lie in the cells `owned`: vertices (world, m) and faces."""
    cells, depth = np.empty(frame.depth.shape, np.int64), frame.depth
    kernels.reading_cells(*frame_arrays(frame), depth, np.float32(frame.camera.near), *_lattice(grid), marks, cells)
    own = np.zeros(cells.shape, bool)
    at = cells >= 0
    own[at] = np.isin(cells[at], owned)
    numbers, faces = np.empty(cells.shape, np.int32), np.empty((2 * int(own.sum()), 3), np.int32)
    step, longest = (np.float32(n / min(frame.camera.fx, frame.camera.fy)) for n in (FOOTPRINTS, SLANTED))
    num_faces = kernels.sheet_faces(cells, own, depth, step, longest, numbers, faces)
    rows, columns = np.nonzero(numbers >= 0)
    order = np.argsort(numbers[rows, columns])
    return _points(frame, rows[order], columns[order]), faces[:num_faces].copy()


def _points(frame: Frame, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """(N, 3) float32 readings of some pixels, world, m."""
    rotation, centre, (fx, fy, cx, cy) = frame_arrays(frame)
    d = frame.depth[rows, columns]
    points = np.stack([(columns + np.float32(0.5) - cx) / fx * d, (rows + np.float32(0.5) - cy) / fy * d, d], axis=-1)
    return (points @ rotation.T + centre).astype(np.float32)
