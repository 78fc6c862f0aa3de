"""Nearest frontier: go to the nearest border between free and unknown space, look into the unknown.

Source: Yamauchi, "A frontier-based approach for autonomous exploration", CIRA 1997: regions of open cells beside
unknown ones, the nearest accessible one next. Adaptation: three dimensions instead of a plane; a region counts from
`MIN_VOXELS` voxels (the robot's width in the paper); where the region itself keeps no clearance, the reachable voxel
nearest to it (within `WITHIN_M`, in line of sight) is walked to. When no region is left it stops.
"""

import numpy as np

from active3d_pipe.planning.free_space import FreeSpace
from active3d_pipe.planning.policies.base import ViewPolicy, Views, looking_at, nearest_reachable, places
from active3d_pipe.planning.policies.context import PolicyContext
from active3d_pipe.planning.policies.space import frontier_clusters, line_of_sight

MIN_VOXELS, WITHIN_M, FURTHER = 8, 1.5, 1.0


class Frontier(ViewPolicy):
    """See the module."""

    def propose(self, context: PolicyContext, space: FreeSpace) -> Views:
        """One view for every frontier region, from the reachable place nearest to its middle."""
        clusters = frontier_clusters(context, space, MIN_VOXELS)
        return frontier_views(context, space, clusters)

    def score(self, context: PolicyContext, space: FreeSpace, views: Views) -> np.ndarray:
        """Minus the travel. What was looked at in vain from (nearly) the same pose is no frontier any more."""
        travel = space.cost[tuple(views.voxels.T)].astype(np.float64)
        return np.where(already_seen(context, views.poses), -np.inf, -travel)


def frontier_views(context: PolicyContext, space: FreeSpace, clusters: list[np.ndarray]) -> Views:
    """A view of the middle of every cluster (lists of voxels) from the nearest reachable place that sees it."""
    if not clusters:
        return Views.none()
    centres = [space.grid.centre_of(c) for c in clusters]
    # The member nearest to the mean: the mean of a ring lies nowhere.
    middles = np.array([p[((p - p.mean(axis=0)) ** 2).sum(axis=1).argmin()] for p in centres])
    voxels, found = nearest_reachable(space, middles, WITHIN_M)
    views = places(context, space, voxels)
    for i in np.flatnonzero(found):
        found[i] = line_of_sight(context, views[i], middles[i : i + 1])[0]
    # A frontier voxel under the agent's feet is looked at by looking beyond it, into the unknown.
    beyond = middles + FURTHER * np.array([_outwards(context, c) for c in clusters])
    return Views.at(context, space, voxels[found], looking_at(views, beyond)[found])


def already_seen(
    context: PolicyContext, poses: np.ndarray, within_m: float = 0.3, within_deg: float = 20.0
) -> np.ndarray:
    """(C,) bool, whether a pose was walked (nearly) with (nearly) the same viewing direction."""
    walked = context.walked_poses
    near = np.linalg.norm(poses[:, None, :3, 3] - walked[None, :, :3, 3], axis=-1) <= within_m
    same = np.einsum("ci,wi->cw", poses[:, :3, 2], walked[:, :3, 2]) >= np.cos(np.radians(within_deg))
    return (near & same).any(axis=1)


def _outwards(context: PolicyContext, cluster: np.ndarray) -> np.ndarray:
    """Unit direction from free into unknown space, the mean over the faces of a cluster; zero when they cancel."""
    total, shape = np.zeros(3), np.asarray(context.volume.grid.shape)
    unknown = ~context.volume.observed
    for axis in range(3):
        for sign in (-1, 1):
            step = np.zeros(3, np.int64)
            step[axis] = sign
            beside = cluster + step
            inside = ((beside >= 0) & (beside < shape)).all(axis=1)
            total[axis] += sign * int(unknown[tuple(beside[inside].T)].sum())
    norm = float(np.linalg.norm(total))
    return total / norm if norm > 0 else total
