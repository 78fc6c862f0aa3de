"""Candidate views: positions over all reachable free space, coarse to fine, times view directions."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from active3d_pipe.geometry import se3
from active3d_pipe.planning.config import PlanningSettings
from active3d_pipe.planning.free_space import FreeSpace
from active3d_pipe.planning.kernels_candidates import best_of_blocks
from active3d_pipe.structures.camera import Camera

# Rays of the sphere: rows of elevation 7.5 degrees apart, and as far apart within each row; closer together where the
# image would hold fewer than four rows of them, but never more rows than the most.
NUM_ELEVATIONS, ROWS_A_VIEW, MOST_ELEVATIONS = 24, 4, 192


@dataclass(frozen=True, slots=True, eq=False)
class Directions:
    """A sphere of rays and the views that are made of them.

    Attributes:
        rays: (M, 3) float32 unit directions, world. solid_angles: (M,) float32, sr.
        rotations: (V, 3, 3) R_world_camera of the views.
        members: (V, M) float32, 1 where a ray lies in the image of a view.
        angles: (V, V) rad, rotation between two views.
    """

    rays: np.ndarray
    solid_angles: np.ndarray
    rotations: np.ndarray
    members: np.ndarray
    angles: np.ndarray


@lru_cache(maxsize=4)
def view_directions(
    camera: Camera, num_yaws: int, pitches_deg: tuple[float, ...], num_elevations: int = NUM_ELEVATIONS
) -> Directions:
    """Level views: `num_yaws` evenly spread times `pitches_deg` (up > 0), on a sphere of rays. Pure, so cached.

    `num_elevations`: rows of the sphere for a usual camera; a narrow one has more.
    """
    narrow = 2 * math.atan(min(camera.width / camera.fx, camera.height / camera.fy) / 2)
    least = min(math.ceil(ROWS_A_VIEW * math.pi / narrow), MOST_ELEVATIONS)
    num_elevations = max(num_elevations, math.ceil(num_elevations / NUM_ELEVATIONS * least))
    rays, solid_angles = _sphere(num_elevations)
    yaw_steps = np.arange(num_yaws) * (2 * math.pi / num_yaws) - math.pi
    yaws, pitches = (a.ravel() for a in np.meshgrid(yaw_steps, np.radians(pitches_deg), indexing="ij"))
    rotations = np.stack([
        se3.pose_from_yaw_pitch(np.zeros(3), y, p)[:3, :3] for y, p in zip(yaws, pitches, strict=True)
    ])
    local = np.tensordot(rays, rotations, axes=(1, 1)).transpose(1, 0, 2)
    flat = rotations.reshape(len(rotations), 9)
    angles = np.arccos(np.clip((flat @ flat.T - 1) / 2, -1, 1))
    z = np.maximum(local[..., 2], 1e-9)
    u, v = camera.fx * local[..., 0] / z + camera.cx, camera.fy * local[..., 1] / z + camera.cy
    members = (local[..., 2] > 1e-6) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    return Directions(
        rays.astype(np.float32), solid_angles.astype(np.float32), rotations, members.astype(np.float32), angles,
    )


def _sphere(num_elevations: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions (M, 3) that are spread evenly over a sphere in rows of elevation, and their solid angles (M,)."""
    edges = np.linspace(-math.pi / 2, math.pi / 2, num_elevations + 1)
    elevation = 0.5 * (edges[1:] + edges[:-1])
    counts = np.ceil(2 * num_elevations * np.cos(elevation)).astype(np.int64)
    azimuth = np.concatenate([(np.arange(n) + 0.5) * (2 * math.pi / n) - math.pi for n in counts])
    el = np.repeat(elevation, counts)
    rays = np.stack([np.cos(el) * np.cos(azimuth), np.cos(el) * np.sin(azimuth), np.sin(el)], axis=-1)
    return rays, np.repeat(2 * math.pi * np.diff(np.sin(edges)) / counts, counts)


def coarse_positions(space: FreeSpace, settings: PlanningSettings) -> np.ndarray:
    """(P, 3) int64 voxels: in every block of reachable space the voxel with the most clearance.

    Blocks have the coarse spacing, or the smallest multiple of it at which there are at most `max_positions`.
    """
    spacing, reachable = settings.coarse_spacing_m, space.reachable
    count = int(np.count_nonzero(reachable))
    while True:
        # Full blocks are the fewest that so many voxels can lie in.
        if count <= settings.max_positions * _block(space, spacing) ** 3:
            found = _thin(reachable, space, spacing)
            if len(found) <= settings.max_positions:
                return found
        spacing *= 1.2


def fine_positions(space: FreeSpace, around: np.ndarray, settings: PlanningSettings) -> np.ndarray:
    """(P, 3) int64 reachable voxels within one coarse spacing of the voxels `around` (K, 3), finely spaced."""
    if len(around) == 0:
        return np.zeros((0, 3), np.int64)
    reach = max(1, round(settings.coarse_spacing_m / space.grid.voxel_size))
    near = np.zeros(space.grid.shape, bool)
    for v in around:
        low = np.maximum(v - reach, 0)
        near[tuple(slice(a, b) for a, b in zip(low, v + reach + 1, strict=True))] = True
    return _thin(near & space.reachable, space, settings.fine_spacing_m)


def _thin(allowed: np.ndarray, space: FreeSpace, spacing_m: float) -> np.ndarray:
    """(P, 3) int64, one allowed voxel of every cubic block (`best_of_blocks`)."""
    return best_of_blocks(allowed.view(np.uint8), space.risk.clearance_m, _block(space, spacing_m))


def _block(space: FreeSpace, spacing_m: float) -> int:
    """Edge of a block in voxels."""
    return max(1, round(spacing_m / space.grid.voxel_size))
