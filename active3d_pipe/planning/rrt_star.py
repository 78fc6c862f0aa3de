"""The path to a goal: RRT* on the continuous cost of eq. risk_path.

    p* = argmin over p of the integral over p of (C_travel - eta R + lambda C_risk) dx

with C_travel = 1 (m per m), C_risk from the risk field and R in [0, 1] the reward of the best view at x relative to
the best anywhere. eta < 1 keeps the rate positive, so a path never gains by lingering.

The tree (Karaman and Frazzoli, "Sampling-based algorithms for optimal motion planning", 2011) starts with the
geodesic path of the grid in it. A solution therefore always exists when the goal is reachable, sampling only improves
it, and samples that cannot lie on a better path are dropped (Gammell et al., "Informed RRT*", 2014).
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from active3d_pipe.planning import kernels_rrt as kernels
from active3d_pipe.planning.config import PlanningSettings
from active3d_pipe.planning.free_space import FreeSpace

# Pieces of an edge at whose middles cost and clearance are looked up, voxels.
SAMPLE_SPACING = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class PlannedPath:
    """A collision-checked polyline.

    Attributes:
        points: (M, 3) float64 world, m; the first is the start, the last the goal.
        cost: integral of eq. risk_path, in equivalent metres. grid_cost: the same for the grid path it began with.
        num_checks: places along edges at which the tree looked up cost and clearance.
        length_m: its length. max_risk: the highest C_risk on it. min_clearance_m: the least clearance on it.
    """

    points: np.ndarray
    cost: float
    grid_cost: float
    num_checks: int
    length_m: float
    max_risk: float
    min_clearance_m: float


def cost_rate(space: FreeSpace, reward: np.ndarray | None, settings: PlanningSettings) -> np.ndarray:
    """Integrand of eq. risk_path, float32 [X, Y, Z] >= 1 - eta; `reward` [X, Y, Z] in [0, 1] or None."""
    rate = 1 + np.float32(settings.lambda_risk) * space.risk.risk
    if reward is not None:
        rate = rate - np.float32(settings.eta) * np.clip(reward, 0, 1)
    return rate.astype(np.float32)


def plan_path(
    space: FreeSpace,
    start_world: np.ndarray,
    goal: np.ndarray,
    reward: np.ndarray | None,
    settings: PlanningSettings,
    rng: np.random.Generator,
) -> PlannedPath:
    """Path from the current position (3,) to the centre of the reachable voxel `goal` (3,).

    `reward` is R(x) in [0, 1] on the grid, see the module. On the ground the height of the start is kept.
    """
    grid = space.grid
    start = ((np.asarray(start_world) - grid.origin) / grid.voxel_size).astype(np.float32)
    voxels = space.grid_path(goal).astype(np.float32) + np.float32(0.5)
    if space.planar:
        voxels[:, 2] = start[2]
    seed = np.concatenate([start[None], voxels[1:]]) if len(voxels) > 1 else np.stack([start, voxels[0]])
    rate = cost_rate(space, reward, settings)
    check = (
        rate, space.checked_m, np.float32(space.required_m), np.float32(space.escape_m), start,
        np.float32(settings.escape_m / grid.voxel_size), np.float32(SAMPLE_SPACING),
    )
    edges = _trusted_costs(seed, check)
    step = np.float32(settings.rrt_step_m / grid.voxel_size)
    tree, _, num_checks = kernels.rrt_star(
        seed, edges, _samples(space, start, settings, rng), *check[:4], check[5], step, np.float32(1.5) * step,
        rate.min(), check[6],
    )
    path = _shortcut(tree, check)
    points = path.astype(np.float64) * grid.voxel_size + grid.origin
    points[0] = start_world
    if space.planar:
        points[:, 2] = start_world[2]
    risk, clearance = space.risk.at(_dense(points, SAMPLE_SPACING * grid.voxel_size))
    return PlannedPath(
        points,
        cost=float(_trusted_costs(path, check).sum(dtype=np.float64)) * grid.voxel_size,
        grid_cost=float(edges.sum(dtype=np.float64)) * grid.voxel_size,
        num_checks=num_checks,
        length_m=float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum()),
        max_risk=float(risk.max()),
        min_clearance_m=float(clearance.min()),
    )


def _trusted_costs(path: np.ndarray, check: tuple) -> np.ndarray:
    """Cost of every edge of a path (voxels), also of those near a tight start that the check would refuse."""
    out = np.empty(max(len(path) - 1, 0), np.float32)
    for i in range(len(out)):
        out[i] = kernels.segment_cost(path[i], path[i + 1], *check)
        if out[i] >= kernels.FAR:
            out[i] = kernels.segment_cost(
                path[i], path[i + 1], check[0], check[1], np.float32(-1), np.float32(-1), *check[4:]
            )
    return out


def _samples(
    space: FreeSpace, start: np.ndarray, settings: PlanningSettings, rng: np.random.Generator
) -> np.ndarray:
    """(N, 3) float32 points drawn uniformly from the reachable voxels."""
    ids = np.flatnonzero(space.reachable)
    drawn = ids[rng.integers(0, len(ids), settings.rrt_iterations)]
    points = np.stack(np.unravel_index(drawn, space.grid.shape), axis=-1) + rng.random((len(drawn), 3))
    if space.planar:
        points[:, 2] = start[2]
    return points.astype(np.float32)


def _shortcut(path: np.ndarray, check: tuple) -> np.ndarray:
    """Replace stretches of a path by straight edges wherever these are clear and cost no more."""
    prefix = np.concatenate([[0], np.cumsum(_trusted_costs(path, check), dtype=np.float64)])
    keep = [0]
    while keep[-1] < len(path) - 1:
        i = keep[-1]
        for j in range(len(path) - 1, i, -1):
            if j == i + 1:
                break
            if kernels.segment_cost(path[i], path[j], *check) <= prefix[j] - prefix[i] + 1e-3:
                break
        keep.append(j)
    return path[keep]


def _dense(points: np.ndarray, spacing: float) -> np.ndarray:
    """Points along a polyline, at most `spacing` apart, ends included."""
    out = [points[:1]]
    for a, b in pairwise(points):
        n = max(1, int(np.ceil(np.linalg.norm(b - a) / spacing)))
        out.append(a + (b - a) * (np.arange(1, n + 1) / n)[:, None])
    return np.concatenate(out)
