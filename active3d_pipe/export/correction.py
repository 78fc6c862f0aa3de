"""The field's SDF, replaced by fused depth readings where these contradict it: thin parts that the field washes out."""

from collections.abc import Sequence

import numpy as np

from active3d_pipe.export import kernels_correction as kernels
from active3d_pipe.export.config import MeshSettings
from active3d_pipe.export.view_fusion import dilated, frame_arrays
from active3d_pipe.geometry.lattice import Points, SdfQuery
from active3d_pipe.geometry.sampling import spread
from active3d_pipe.geometry.sensor_noise import noise_at, sensor_noise, typical_noise
from active3d_pipe.geometry.threads import on_threads
from active3d_pipe.structures import Frame, VoxelGrid

STRIDE = 4  # of the pixels, every how many are compared with the field
MOST_FRAMES = 700  # evenly spread, that are compared with the field
MOST_FUSED = 256  # frames that are fused: those with the most readings that contradict
LEAST_READINGS = 3  # in a cell, for their mean to count
SURE = 3.0  # standard errors that it must lie off the surface
SCATTER_M = 0.12  # within which noise shows on both sides of a surface
BY_NOISE = 5.0  # standard deviations of the sensor's noise up to which it may explain a contradiction
OTHER_SIDE = 0.2  # share of such a contradiction that may lie on the other side of the surface
MOST_READINGS, EXACT_READINGS = 16, 8  # in a cell, after which further frames are not asked about it
EXACT_M = 0.001  # standard deviation of a sensor's noise under which EXACT_READINGS say as much as more


def corrected_sdf(
    query_sdf: SdfQuery, low: np.ndarray, high: np.ndarray, frames: Sequence[Frame], settings: MeshSettings
) -> SdfQuery:
    """`query_sdf`, but around readings where it is wrong the truncated signed distance of the readings.

    Args:
        query_sdf: the SDF to be corrected.
        low, high: (3,) corners of the box, world, m.
        frames: logged frames with depth.
        settings: `dispute_m`, the mean SDF at the readings of a cell of two marching-cubes cells from which they are
            believed, not the field, if it is more than chance; 0 = never.

    The SDF at a reading should be zero, noise aside, which the mean over the cell takes out. Where a sheet is thinner
    than the field resolves, it stays positive on both sides and the surface is lost.
    """
    if settings.dispute_m <= 0 or not frames:
        return query_sdf
    grid, marks, fused = _disputed(query_sdf, low, high, frames, settings)
    if not marks.any():
        return query_sdf
    origin, inv_cell = grid.origin.astype(np.float32), np.float32(1 / grid.voxel_size)
    poses = np.stack([f.T_world_camera for f in fused]).astype(np.float32)
    lenses = np.array([[f.camera.fx, f.camera.fy, f.camera.cx, f.camera.cy] for f in fused], np.float32)
    depths = np.empty((len(fused), *fused[0].depth.shape), np.float32)
    # A tenth of a gigabyte, whose fresh pages cost more than the copying.
    on_threads(lambda pair: np.copyto(*pair), zip(depths, (f.depth for f in fused), strict=True))
    views = (
        depths, np.ascontiguousarray(poses[:, :3, :3]),
        np.ascontiguousarray(poses[:, :3, 3]), lenses, np.array([f.depth.max() for f in fused], np.float32),
    )
    near = np.float32(min(f.camera.near for f in fused))
    truncation = np.float32(settings.fusion_truncation_cells * settings.voxel_size_m)

    def query(points: Points) -> np.ndarray:
        sdf, points = query_sdf(points), np.asarray(points)
        chosen = np.empty(len(points), np.int64)
        chosen = chosen[: kernels.points_in(points, origin, inv_cell, marks, chosen)]
        if len(chosen):
            measured = np.empty(len(chosen), np.float32)
            kernels.projective_sdf(np.ascontiguousarray(points[chosen]), *views, near, truncation, measured)
            known = ~np.isnan(measured)
            sdf = sdf.copy()
            sdf[chosen[known]] = measured[known]
        return sdf

    return query


def _disputed(
    query_sdf: SdfQuery, low: np.ndarray, high: np.ndarray, frames: Sequence[Frame], settings: MeshSettings
) -> tuple[VoxelGrid, np.ndarray, list[Frame]]:
    """Grid, the cells (X, Y, Z) bool in and beside which readings contradict, and the frames that do so most."""
    grid = VoxelGrid.from_bounds(low, high, 2 * settings.voxel_size_m)
    origin, inv_cell = grid.origin.astype(np.float32), np.float32(1 / grid.voxel_size)
    sums, below, squares, noises = (np.zeros(grid.shape, np.float32) for _ in range(4))
    counts = np.zeros(grid.shape, np.int32)
    compared = spread(frames, MOST_FRAMES)
    sensor = sensor_noise(compared)
    most = EXACT_READINGS if typical_noise(sensor, compared) < EXACT_M else MOST_READINGS
    against = np.zeros(len(compared), np.int64)
    for index in _scattered(len(compared)):
        frame = compared[index]
        points = np.empty((frame.depth[::STRIDE, ::STRIDE].size, 3), np.float32)
        reach = np.array([frame.camera.near, frame.camera.far], np.float32)
        points = points[: kernels.open_readings(
            *frame_arrays(frame), frame.depth, STRIDE, reach, origin, inv_cell, counts, most, points
        )]
        if len(points):
            values = query_sdf(points)
            depth = (points - frame.T_world_camera[:3, 3].astype(np.float32)) @ frame.T_world_camera[:3, 2]
            noise = noise_at(sensor, depth)
            kernels.add_readings(points, values, noise, origin, inv_cell, sums, below, squares, noises, counts)
            against[index] = (np.abs(values) > settings.dispute_m).sum()
    marks = np.zeros(grid.shape, bool)
    cells = np.nonzero(counts >= LEAST_READINGS)
    n = counts[cells]
    mean = sums[cells] / n
    # Its standard error: a sensor's noise alone must not outvote the field.
    error = np.sqrt(np.maximum(squares[cells] / n - mean**2, 0) / (n - 1))
    off = np.abs(mean) > np.maximum(settings.dispute_m, SURE * error)
    # Nor may what noise scatters before a surface, and behind it: in a cell off it, all readings are off.
    doubtful = off & (np.abs(mean) < BY_NOISE * noises[cells] / n)
    keep, where = np.zeros(int(doubtful.sum()), bool), np.stack(cells, axis=-1)
    kernels.one_sided(sums, below, where[doubtful], round(SCATTER_M / grid.voxel_size), OTHER_SIDE, keep)
    off[doubtful] = keep
    marks[tuple(where[off].T)] = True
    order = np.argsort(-against, kind="stable")[:MOST_FUSED]
    return grid, dilated(marks, 1), [compared[int(i)] for i in np.sort(order)]


def _scattered(count: int) -> list[int]:
    """0 .. count - 1 in an order whose beginnings are spread evenly: by their bits, from the last to the first."""
    bits = max(count - 1, 1).bit_length()
    return sorted(range(count), key=lambda i: f"{i:0{bits}b}"[::-1])
