"""Rays of posed RGB-D frames, and the depths at which they are sampled.

Directions have z = 1 in the camera frame, so that a parameter along a ray *is* a depth in metres and
origin + depth * direction is the surface point.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from active3d_pipe.errors import InputError
from active3d_pipe.field.config import FieldSettings
from active3d_pipe.geometry.sensor_noise import noise_at
from active3d_pipe.structures import Frame

MIN_SLOPE = 0.1  # rays that graze a surface by less than about 6 degrees are taken at this slope
REDRAWS = 3
GROUP = 16  # rays are drawn in groups of one frame: gathering costs by the frame
SURFACE_GROUP = 64  # likewise readings, of which no neighbours are asked
TILT = 0.2  # slopes are taken from neighbours so far away that noise tilts them by about this much
FARTHEST = 16  # px
SPARE = 2  # pixels drawn for each, so that some may be without a reading
NEIGHBOURS = ((0, 1), (0, -1), (1, 0), (-1, 0))


@dataclass(frozen=True, slots=True, eq=False)
class RayBatch:
    """R rays.

    Attributes (float32 unless said):
        origins: (R, 3) camera centres, world, m.
        directions: (R, 3) world, camera z = 1 (not unit length).
        depth: (R,) observed depth along the optical axis, m, 0 = none.
        color: (R, 3) observed colour, 0..1.
        valid: (R,) bool, whether the depth is a reading.
        slope: (R,) |normal . direction|, the rate at which the distance to the surface's tangent plane
            shrinks with depth; 1 for a wall parallel to the image.
    """

    origins: np.ndarray
    directions: np.ndarray
    depth: np.ndarray
    color: np.ndarray
    valid: np.ndarray
    slope: np.ndarray

    def __len__(self) -> int:
        return len(self.depth)


def sample_rays(
    frames: Sequence[Frame], count: int, rng: np.random.Generator, weights: np.ndarray | None = None,
    noise: np.ndarray | None = None,
) -> RayBatch:
    """Draw `count` pixels from `frames`.

    Args:
        frames: key frames, not empty; they may differ in camera.
        count: number of rays.
        rng: source of randomness.
        weights: (len(frames),) relative probabilities of the frames; uniform when None.
        noise: (D,) standard deviation of readings, m, by metre of depth (`geometry.sensor_noise`): the noisier, the
            farther away are the neighbours that slopes are taken from. None: exact readings.

    Pixels without a depth reading are drawn anew up to `REDRAWS` times; what is still without one stays in the
    batch with `valid` False. Frames are drawn for groups of `GROUP` rays; the rays come sorted by frame.
    """
    if not frames:
        raise InputError("field: no frames to draw rays from; expected at least one key frame")
    p = None if weights is None else np.asarray(weights, dtype=np.float64) / np.sum(weights)
    groups = rng.choice(len(frames), size=-(-count // GROUP), p=p)
    of_ray = np.sort(np.repeat(groups, GROUP)[:count])
    draws = rng.random((count, 1 + REDRAWS), dtype=np.float32)
    taken, first, per_frame = np.unique(of_ray, return_index=True, return_counts=True)
    # Only the gathering runs frame by frame; the arithmetic is done once for the whole batch.
    parts = [_gather(frames[k], draws[i : i + n], noise) for k, i, n in zip(taken, first, per_frame, strict=True)]
    pixel, z, apart, rgb = (np.concatenate(column) for column in zip(*parts, strict=True))
    camera = np.repeat([_intrinsics(frames[k]) for k in taken], per_frame, axis=0).astype(np.float32)
    poses = np.repeat([frames[k].T_world_camera for k in taken], per_frame, axis=0)
    u = (pixel + np.float32(0.5) - camera[:, 2:4]) / camera[:, :2]
    local = np.column_stack([u, np.ones(count, np.float32)])
    valid = (z[:, 0] > 0) & (z[:, 0] <= camera[:, 4])
    return RayBatch(
        origins=poses[:, :3, 3].astype(np.float32),
        directions=np.einsum("rij,rj->ri", poses[:, :3, :3], local).astype(np.float32),
        depth=np.where(valid, z[:, 0], 0).astype(np.float32),
        color=rgb.astype(np.float32) / np.float32(255),
        valid=valid,
        slope=_slope(z, local, camera[:, :2] / apart[:, None]),
    )


def surface_points(
    frames: Sequence[Frame], count: int, rng: np.random.Generator, weights: np.ndarray | None = None
) -> np.ndarray:
    """(N, 3) float32 world points at `count` readings, or fewer where there are none; arguments as of `sample_rays`."""
    p = None if weights is None else np.asarray(weights, dtype=np.float64) / np.sum(weights)
    groups = rng.choice(len(frames), size=-(-count // SURFACE_GROUP), p=p)
    parts = [np.zeros((0, 3), np.float32)]
    for k, n in zip(*np.unique(groups, return_counts=True), strict=True):
        frame, wanted = frames[k], n * SURFACE_GROUP
        camera, T = frame.camera, frame.T_world_camera.astype(np.float32)
        flat = rng.integers(0, frame.depth.size, SPARE * wanted)
        depth = frame.depth.reshape(-1)[flat]
        valid = np.flatnonzero((depth > 0) & (depth <= np.float32(camera.far)))[:wanted]
        z, (i, j) = depth[valid], np.divmod(flat[valid], camera.width)
        local = np.stack([(j + 0.5 - camera.cx) / camera.fx * z, (i + 0.5 - camera.cy) / camera.fy * z, z], axis=1)
        parts.append(local.astype(np.float32) @ T[:3, :3].T + T[:3, 3])
    return np.concatenate(parts)[:count]


def _intrinsics(frame: Frame) -> tuple[float, float, float, float, float]:
    c = frame.camera
    return c.fx, c.fy, c.cx, c.cy, c.far


def _gather(
    frame: Frame, draws: np.ndarray, noise: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """What the frame shows at random pixels, for n rays with draws (n, D) in 0..1.

    Returns pixels (n, 2) float32 (column, row), depths (n, 5) of the pixel and its neighbours right, left,
    below, above (0 outside the image), how many pixels these are away (n,) float32, and colours (n, 3) uint8. The first
    of the D pixels with a reading counts.
    """
    height, width = frame.depth.shape
    flat = np.minimum((draws * np.float64(frame.depth.size)).astype(np.int64), frame.depth.size - 1)
    d = frame.depth.reshape(-1)[flat]
    choice = ((d > 0) & (d <= np.float32(frame.camera.far))).argmax(axis=1)
    rows = np.arange(len(flat))
    flat = flat[rows, choice]
    i, j = np.divmod(flat, width)
    z = np.zeros((len(flat), 5), np.float32)
    z[:, 0] = d[rows, choice]
    apart = np.ones(len(flat), np.int64)
    if noise is not None:
        pixels = noise_at(noise, z[:, 0]) * frame.camera.fx / np.maximum(z[:, 0], np.float32(1e-3))
        apart = np.clip(np.ceil(pixels / TILT), 1, FARTHEST).astype(np.int64)
    for k, (di, dj) in enumerate(NEIGHBOURS, start=1):
        ni, nj = i + di * apart, j + dj * apart
        ok = (ni >= 0) & (ni < height) & (nj >= 0) & (nj < width)
        z[ok, k] = frame.depth[ni[ok], nj[ok]]
    return np.column_stack([j, i]).astype(np.float32), z, apart.astype(np.float32), frame.rgb.reshape(-1, 3)[flat]


def _slope(z: np.ndarray, local: np.ndarray, focal: np.ndarray) -> np.ndarray:
    """(R,) |normal . direction| from depths (R, 5), directions in the camera frame (R, 3), focal lengths (R, 2)
    in units of the neighbours' distance.

    Along each image axis the neighbour nearer in depth is taken, so that an edge does not tilt the normal; 1 where
    an axis has no neighbour with a reading.
    """

    def tangent(first: int, axis: int) -> tuple[np.ndarray, np.ndarray]:
        gap = np.where(z[:, first : first + 2] > 0, np.abs(z[:, first : first + 2] - z[:, :1]), np.inf)
        pick = gap.argmin(axis=1)
        side = np.where(pick == 0, np.float32(1), np.float32(-1))
        direction = local.copy()
        direction[:, axis] += side / focal[:, axis]
        other = direction * z[np.arange(len(z)), first + pick][:, None]
        return side[:, None] * (other - local * z[:, :1]), np.isfinite(gap.min(axis=1))

    (along_u, ok_u), (along_v, ok_v) = tangent(1, 0), tangent(3, 1)
    normal = np.cross(along_u, along_v)
    norm = np.linalg.norm(normal, axis=1)
    ok = ok_u & ok_v & (norm > 0)
    slope = np.abs((normal * local).sum(axis=1)) / np.where(ok, norm, 1)
    return np.where(ok, np.maximum(slope, MIN_SLOPE), 1).astype(np.float32)


def sample_depths(
    batch: RayBatch, settings: FieldSettings, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Depths along every ray: (R, F) in free space and (R, S) around the surface, m, each ascending.

    Both are stratified: one draw in each of F equal parts of [0, depth - truncation] and of S equal parts of
    [depth - truncation, depth + behind_fraction * truncation]. Nothing lies farther behind the surface: there
    nobody has looked. Rays without a reading get zeros (their losses are masked).
    """
    band = np.float32(settings.truncation_m)
    d = batch.depth[:, None]
    start = np.maximum(d - band, 0)
    free, near = settings.free_samples, settings.surface_samples
    u = rng.random((len(batch), free), dtype=np.float32)
    z_free = start * (np.arange(free, dtype=np.float32) + u) / np.float32(max(free, 1))
    u = rng.random((len(batch), near), dtype=np.float32)
    stop = d + band * np.float32(settings.behind_fraction)
    z_near = start + (stop - start) * (np.arange(near, dtype=np.float32) + u) / np.float32(near)
    mask = batch.valid[:, None]
    return np.where(mask, z_free, 0).astype(np.float32), np.where(mask, z_near, 0).astype(np.float32)


def points_on_rays(batch: RayBatch, depths: np.ndarray) -> np.ndarray:
    """(R * S, 3) float32 world points of depths (R, S), ray by ray."""
    points = batch.origins[:, None] + depths[..., None] * batch.directions[:, None]
    return np.ascontiguousarray(points.reshape(-1, 3), dtype=np.float32)
