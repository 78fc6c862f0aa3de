"""Rays of posed RGB-D frames, and the depths at which they are sampled.

Directions have z = 1 in the camera frame, so that a parameter along a ray *is* a depth in metres and
origin + depth * direction is the surface point.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from active3d_pipe.errors import InputError
from active3d_pipe.field.config import FieldSettings
from active3d_pipe.structures import Frame

MIN_SLOPE = 0.1  # rays that graze a surface by less than about 6 degrees are taken at this slope


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
    frames: Sequence[Frame], count: int, rng: np.random.Generator, weights: np.ndarray | None = None
) -> RayBatch:
    """Draw `count` pixels from `frames`.

    Args:
        frames: key frames, not empty; they may differ in camera.
        count: number of rays.
        rng: source of randomness.
        weights: (len(frames),) relative probabilities of the frames; uniform when None.

    Pixels without a depth reading are drawn anew up to three times; what is still without one stays in the
    batch with `valid` False. Rays come grouped by frame.
    """
    if not frames:
        raise InputError("field: no frames to draw rays from; expected at least one key frame")
    p = None if weights is None else np.asarray(weights, dtype=np.float64) / np.sum(weights)
    per_frame = np.bincount(rng.choice(len(frames), size=count, p=p), minlength=len(frames))
    parts = [_rays_of(frames[i], int(n), rng) for i, n in enumerate(per_frame) if n]
    return RayBatch(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _rays_of(frame: Frame, count: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    camera, depth = frame.camera, frame.depth
    flat = rng.integers(0, depth.size, size=count)
    far = np.float32(camera.far)
    for _ in range(3):
        d = depth.reshape(-1)[flat]
        bad = (d <= 0) | (d > far)
        if not bad.any():
            break
        flat[bad] = rng.integers(0, depth.size, size=int(bad.sum()))
    i, j = np.divmod(flat, camera.width)
    d = depth[i, j]
    valid = (d > 0) & (d <= far)
    T = frame.T_world_camera
    local = np.stack([(j + 0.5 - camera.cx) / camera.fx, (i + 0.5 - camera.cy) / camera.fy, np.ones(count)], axis=1)
    directions = (local @ T[:3, :3].T).astype(np.float32)
    origins = np.broadcast_to(T[:3, 3].astype(np.float32), (count, 3))
    slope = _slope(frame, i, j, local.astype(np.float32))
    color = frame.rgb[i, j].astype(np.float32) / np.float32(255)
    return origins, directions, np.where(valid, d, 0).astype(np.float32), color, valid, slope


def _slope(frame: Frame, i: np.ndarray, j: np.ndarray, local: np.ndarray) -> np.ndarray:
    """(N,) |normal . direction| at pixels (i, j), from depth differences to the nearer neighbours in depth."""
    camera, depth = frame.camera, frame.depth
    z = depth[i, j]

    def tangent(di: int, dj: int) -> tuple[np.ndarray, np.ndarray]:
        best, out = np.full(len(z), np.inf, np.float32), np.zeros((len(z), 3), np.float32)
        for s in (1, -1):
            ni, nj = i + s * di, j + s * dj
            ok = (ni >= 0) & (ni < camera.height) & (nj >= 0) & (nj < camera.width)
            nz = depth[np.clip(ni, 0, camera.height - 1), np.clip(nj, 0, camera.width - 1)]
            ok &= nz > 0
            gap = np.where(ok, np.abs(nz - z), np.inf).astype(np.float32)
            take = gap < best
            u = local[:, 0] + np.float32(s * dj / camera.fx)
            v = local[:, 1] + np.float32(s * di / camera.fy)
            point = np.stack([u * nz, v * nz, nz], axis=1)
            out[take] = (np.float32(s) * (point - local * z[:, None]))[take]
            best = np.minimum(best, gap)
        return out, np.isfinite(best)

    (along_i, ok_i), (along_j, ok_j) = tangent(1, 0), tangent(0, 1)
    normal = np.cross(along_i, along_j)
    norm = np.linalg.norm(normal, axis=1)
    ok = ok_i & ok_j & (norm > 0)
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
