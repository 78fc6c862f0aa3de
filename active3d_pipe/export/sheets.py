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
        np.ascontiguousarray(mesh.vertices), mesh.faces, grid.origin.astype(np.float32),
        np.float32(1 / grid.voxel_size), marks,
    )
    cells, owners = _wanted(frames, grid, marks, settings)
    if not len(cells):
        return mesh
    vertices, faces = [mesh.vertices], [mesh.faces]
    count = len(mesh.vertices)
    for index in np.unique(owners):
        new_vertices, new_faces = _lay(frames[index], grid, marks, cells[owners == index])
        vertices.append(new_vertices)
        faces.append(new_faces + np.int32(count))
        count += len(new_vertices)
    return TriangleMesh(np.concatenate(vertices), np.concatenate(faces))


def _wanted(
    frames: Sequence[Frame], grid: VoxelGrid, marks: np.ndarray, settings: MeshSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Flat cells to be covered, ascending, and for each the index of the frame that covers it."""
    found = []
    for index, frame in enumerate(frames):
        stride = min(max(int(grid.voxel_size * frame.camera.fx / FAR_M), 1), 2)
        all_cells, depth = _reading_cells(frame, grid, marks, stride)
        rows, columns = np.nonzero(all_cells >= 0)
        inside, d = all_cells[rows, columns], depth[rows, columns]
        order = np.lexsort((d, inside))  # the nearest reading of every cell
        inside, first = np.unique(inside[order], return_index=True)
        nearest = order[first]
        points = _points(frame, rows[nearest] * stride, columns[nearest] * stride)
        found.append((inside, np.full(len(inside), index), d[nearest], points))
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


def _reading_cells(
    frame: Frame, grid: VoxelGrid, marks: np.ndarray, stride: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Flat cells (h, w) of the unexplained among every `stride`-th reading, -1 elsewhere, and those readings."""
    rotation, centre, intrinsics = frame_arrays(frame)
    depth = np.ascontiguousarray(frame.depth[::stride, ::stride])
    thin = intrinsics / np.float32(stride)
    thin[2:] += np.float32(0.5 - 0.5 / stride)  # centres of the pixels taken
    cells = np.empty(depth.shape, np.int64)
    kernels.reading_cells(
        rotation, centre, thin, depth, np.float32(frame.camera.near), grid.origin.astype(np.float32),
        np.float32(1 / grid.voxel_size), marks, cells,
    )
    return cells, depth


def _lay(frame: Frame, grid: VoxelGrid, marks: np.ndarray, owned: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Faces over the pixels of one frame whose readings lie in the cells `owned`: vertices (world, m) and faces."""
    cells, depth = _reading_cells(frame, grid, marks)
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
