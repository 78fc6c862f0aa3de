"""What several policies ask of known space: frontiers, unknown volume in view, spread positions."""

import numpy as np
from scipy import ndimage

from active3d_pipe.geometry import kernels_traversal
from active3d_pipe.geometry.voxel_traversal import fan_stride, ray_fan, to_voxel_units
from active3d_pipe.planning.candidates import coarse_positions
from active3d_pipe.planning.free_space import FreeSpace
from active3d_pipe.planning.policies.base import places
from active3d_pipe.planning.policies.context import PolicyContext

FACES = ndimage.generate_binary_structure(3, 1)
NEIGHBOURS = ndimage.generate_binary_structure(3, 3)


def solid(context: PolicyContext) -> np.ndarray:
    """(X, Y, Z) bool, voxels that stop a line of sight: rays ended in them and they are probably solid."""
    volume = context.volume
    return (volume["hit_evidence"] > 0) & (volume["occupancy"] > 0.5)


def frontier_clusters(context: PolicyContext, space: FreeSpace, min_voxels: int) -> list[np.ndarray]:
    """Connected groups (26 neighbours) of known-free voxels that touch unobserved ones by a face, largest first.

    Voxels on the border of the grid do not count: nothing lies behind them.
    """
    unknown = ~context.volume.observed
    edge = space.free & ndimage.binary_dilation(unknown, FACES)
    labels, _ = ndimage.label(edge, NEIGHBOURS)
    flat = np.flatnonzero(labels)
    of = labels.ravel()[flat]
    order = np.argsort(of, kind="stable")
    groups = np.split(flat[order], np.cumsum(np.bincount(of)[1:])[:-1]) if len(flat) else []
    groups = sorted((g for g in groups if len(g) >= min_voxels), key=lambda g: (-len(g), int(g[0])))
    return [np.stack(np.unravel_index(g, edge.shape), axis=-1) for g in groups]


def in_view(context: PolicyContext, poses: np.ndarray, wanted: np.ndarray, coarser: int = 1) -> np.ndarray:
    """(C, 2) float64: how many voxels of `wanted` (X, Y, Z) bool each view sees, and how many voxels at all.

    Lines of sight end in solid voxels and pass unknown ones. `coarser` thins the rays for a faster, rougher count.
    """
    grid, reach = context.volume.grid, context.reach_m
    opaque = solid(context).view(np.uint8).ravel()
    stride = coarser * fan_stride(context.camera, grid.voxel_size, reach)
    fan = ray_fan(context.camera, stride)[2]
    flat, seen = np.ascontiguousarray(wanted).ravel(), np.zeros(grid.size, np.uint8)
    out = np.zeros((len(poses), 2))
    for i, T in enumerate(poses):
        seen.fill(0)
        origin, directions = to_voxel_units(grid, T, fan)
        kernels_traversal.mark_visible(opaque, origin, directions, np.float32(reach), grid.shape, seen)
        ids = np.flatnonzero(seen)
        out[i] = flat[ids].sum(), len(ids)
    return out


def line_of_sight(context: PolicyContext, start_world: np.ndarray, ends_world: np.ndarray) -> np.ndarray:
    """(N,) bool, whether the way from one point to each of `ends_world` (N, 3) meets no solid voxel."""
    d = np.asarray(ends_world, dtype=np.float64) - start_world
    length = np.maximum(np.linalg.norm(d, axis=1), 1e-9)
    grid = context.volume.grid
    origin = ((np.asarray(start_world) - grid.origin) / grid.voxel_size).astype(np.float32)
    rays = np.ascontiguousarray(d / length[:, None] / grid.voxel_size, dtype=np.float32)
    met = np.zeros(len(d), np.float32)
    opaque = solid(context).view(np.uint8).ravel()
    kernels_traversal.first_hits(opaque, origin, rays, np.float32(length.max(initial=0)), grid.shape, met)
    # The end itself may lie on a surface.
    return (met <= 0) | (met > length - 1.5 * grid.voxel_size)


def spread_positions(context: PolicyContext, space: FreeSpace, spacing_m: float, most: int) -> np.ndarray:
    """(P, 3) int64 reachable voxels about `spacing_m` apart, at most `most`, the agent's own voxel first."""
    settings = context.settings.model_copy(update={"coarse_spacing_m": spacing_m, "max_positions": most})
    voxels = coarse_positions(space, settings) if space.reachable.any() else np.zeros((0, 3), np.int64)
    other = voxels[~(voxels == space.start).all(axis=1)]
    return np.concatenate([space.start[None], other])[:most]


def level_slice(space: FreeSpace, height_world: float) -> int:
    """Index of the layer of voxels at a height, inside the grid."""
    k = int(np.floor((height_world - space.grid.origin[2]) / space.grid.voxel_size))
    return min(max(k, 0), space.grid.shape[2] - 1)


def fibonacci_directions(count: int) -> np.ndarray:
    """(count, 3) unit vectors evenly spread over the sphere."""
    k = np.arange(count) + 0.5
    polar, azimuth = np.arccos(1 - 2 * k / count), np.pi * (1 + 5**0.5) * k
    return np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)], axis=-1)


def all_views(
    context: PolicyContext, space: FreeSpace, voxels: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Every position with every direction (V, 3): voxels (P V, 3), positions (P V, 3), target points (P V, 3)."""
    v = np.repeat(voxels, len(directions), axis=0)
    p = places(context, space, v)
    return v, p, p + np.tile(directions, (len(voxels), 1))
