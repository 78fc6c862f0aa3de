"""ActiveSplat: nodes of a Voronoi graph, scored by what is transparent around them; look around on arrival.

Source: Li et al., "ActiveSplat: High-Fidelity Scene Reconstruction through Active Gaussian Splatting", RA-L 2025,
with the constants of its public code. Score of a node: 20 while it was not arrived at, 10 in the agent's subregion, 2
x the opacity term and 1 x the hole term, each scaled to 0..10, -60 where going failed; when every node was arrived at
10, 10 and -1. Opacity term: pixels with 1 - alpha > 0.8, clustered (DBSCAN, 5 px, 25), the clusters grown by 15 px,
the sum of 1 - alpha times the volume of the hull of what is rendered there (at least 1). The present subregion
(average linkage, cut at 2 m) is finished first: until its largest opacity term is below 250 or all its nodes are
arrived at. On arrival (within 1.5 steps) the camera turns, decoupled from the motion, to at most 5 clusters of 1 -
alpha > 0.3 (10 pixels, sum above 25; total above 100), not to those within 15 degrees of where it looks, and to the
place in sight where the rendered depth is too far by 0.3 m under opacity above 0.8.

Adaptations: a ground robot with a tilting camera becomes a camera that moves at the height of the start pose between
nodes, its path planned in three dimensions by the arena; renderings cover the whole sphere at `DEGREES_PER_PX`, pixel
counts are converted from 1 px per degree; holes are unobserved cells of the level within `HOLE_M` in line of sight
(its top-down map does not exist here); arrival is judged within `ARRIVED_M`, because the graph is built anew for
every decision; at most `MOST_NODES` nearest nodes are rendered. The depth check uses the newest keyframe from this
place.
"""

from typing import Any

import numpy as np
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError

from active3d_pipe.geometry import se3
from active3d_pipe.planning.free_space import FreeSpace
from active3d_pipe.planning.policies.base import Looks, ViewPolicy, Views, explain, facing
from active3d_pipe.planning.policies.context import PolicyContext
from active3d_pipe.planning.policies.panorama import Panorama, panorama, pixel_clusters
from active3d_pipe.planning.policies.space import level_slice, line_of_sight
from active3d_pipe.planning.policies.voronoi import Topology, topology
from active3d_pipe.structures import Decision, Reason

DEGREES_PER_PX, MOST_NODES = 3.0, 16
UNARRIVED, HORIZON, OPACITY, HOLE, FAIL = 20.0, 10.0, 2.0, 1.0, -60.0
ALL_OPACITY, ALL_HOLE, ALL_HORIZON = 10.0, 10.0, -1.0
SUBREGION_DONE, HOLE_M, ARRIVED_M = 250.0, 2.0, 0.4
LOOKS, LOOK_SUM, LOOK_TOTAL, LOOK_NEAR_DEG = 5, 25.0, 100.0, 15.0
PX = 1 / DEGREES_PER_PX  # pixels of the panorama per degree


class ActiveSplat(ViewPolicy):
    """See the module."""

    needs_map = True
    turns_first = True

    def decide(self, context: PolicyContext) -> Decision:
        """After arriving at a node: look around there; else go to the next node."""
        before = context.previous
        if before is None or before.chosen < 0 or before.terms.get("turns_left") or before.terms.get("looked"):
            return super().decide(context)
        goal = before.ranking[before.chosen].T_world_camera[:3, 3]
        arrived = np.linalg.norm(goal - context.T_world_camera[:3, 3]) < 1e-6
        looks = _look_around(context) if arrived else ()
        if not looks:
            return super().decide(context)
        space = context.free_space()
        steps = self.path(context, space, space.start, looks)
        views = Views.at(context, space, space.start[None], looks[0][None])
        ranking = explain(context, space, views.poses, views.voxels, np.zeros(1), 0)
        notes = {"looked": True, "failed": before.terms.get("failed", [])}
        return self._decision(context, Reason.BEST_GAIN, steps, ranking, 0, len(looks), notes)

    def propose(self, context: PolicyContext, space: FreeSpace) -> Views:
        """The nodes of the graph with their scores."""
        graph = topology(context, space)
        travel = space.cost[tuple(graph.voxels.T)]
        near = np.argsort(travel, kind="stable")[:MOST_NODES]
        graph = Topology(graph.voxels[near], graph.positions[near], graph.distance_m[np.ix_(near, near)])
        opacity = np.array([_invisibility(_look(context, p)) for p in graph.positions])
        return _node_views(context, space, graph, opacity)

    def score(self, context: PolicyContext, space: FreeSpace, views: Views) -> np.ndarray:
        """Sum of the weighted flags; ties go to the nearest node."""
        assert views.gain is not None
        return views.gain - 1e-3 * space.cost[tuple(views.voxels.T)]


def _node_views(context: PolicyContext, space: FreeSpace, graph: Topology, opacity: np.ndarray) -> Views:
    walked = context.walked_poses[:, :3, 3]
    visited = (np.linalg.norm(graph.positions[:, None] - walked[None], axis=-1) <= ARRIVED_M).any(axis=1)
    hole = np.array([_holes(context, space, p) for p in graph.positions])
    here = np.linalg.norm(graph.positions - context.T_world_camera[:3, 3], axis=1)
    region = graph.subregions()
    horizon = region == region[int(here.argmin())]
    done = visited[horizon].all() or opacity[horizon].max() < SUBREGION_DONE
    if visited.all():
        flags = ALL_OPACITY * _scaled(opacity) + ALL_HOLE * _scaled(hole) + ALL_HORIZON * horizon
    else:
        flags = UNARRIVED * ~visited + HORIZON * horizon + OPACITY * _scaled(opacity) + HOLE * _scaled(hole)
    before = {} if context.previous is None else context.previous.terms
    failed: list[Any] = list(before.get("failed", []))
    if before.get("turns_left") and context.previous is not None:  # it was on its way and could not go on
        goal = context.previous.ranking[context.previous.chosen].T_world_camera[:3, 3]
        failed = [*failed, [float(c) for c in goal]]
    if failed:
        away = np.linalg.norm(graph.positions[:, None] - np.array(failed)[None], axis=-1).min(axis=1)
        flags = flags + FAIL * (away <= ARRIVED_M)
    if not done:
        flags = np.where(horizon & ~visited, flags, -np.inf)
    elif not visited.all():
        # The next subregion is the one with the best node.
        best = region[int(np.where(visited, -np.inf, flags).argmax())]
        flags = np.where((region == best) & ~visited, flags, -np.inf)
    # Where the agent stands and looked around already there is nothing to go to.
    flags = np.where(here < 1e-6, -np.inf, flags)
    R = np.array([facing(p - context.T_world_camera[:3, 3], context.T_world_camera[:3, :3]) for p in graph.positions])
    notes = {"nodes": len(graph.voxels), "subregions": len(set(region.tolist())), "failed": failed}
    return Views.at(context, space, graph.voxels, R, notes=notes, gain=flags)


def _scaled(values: np.ndarray) -> np.ndarray:
    """Values over their maximum as whole tenths, 0..10."""
    top = float(values.max(initial=0.0))
    return np.ceil(10 * values / top) if top > 0 else np.zeros_like(values, dtype=np.float64)


def _look(context: PolicyContext, position: np.ndarray) -> Panorama:
    return panorama(context.the_map, position, DEGREES_PER_PX, context.camera)


def _invisibility(image: Panorama) -> float:
    """Sum over the transparent clusters of 1 - alpha (in square degrees) times the volume of the hull around them."""
    inverse = 1 - image.alpha
    labels, n = pixel_clusters(inverse > 0.8, 5 * PX, max(1, round(25 * PX * PX)))
    grow = np.ones((2 * round(15 * PX) + 1,) * 2, bool)
    square_degrees = image.solid_angle * (180 / np.pi) ** 2
    total = 0.0
    for i in range(1, n + 1):
        around = ndimage.binary_dilation(labels == i, grow) & (image.distance_m > 0)
        total += float((inverse * square_degrees)[labels == i].sum()) * _hull_m3(
            image.rays[around] * image.distance_m[around][:, None]
        )
    return total


def _hull_m3(points: np.ndarray) -> float:
    """Volume of the convex hull, at least 1 m3: a hole without a rim is not less of a hole."""
    if len(points) < 5:
        return 1.0
    try:
        return max(1.0, float(ConvexHull(points).volume))
    except QhullError:
        return 1.0


def _holes(context: PolicyContext, space: FreeSpace, position: np.ndarray) -> float:
    """Unobserved cells of the level around a node in its line of sight, m2."""
    grid = space.grid
    k = level_slice(space, float(position[2]))
    ij = np.argwhere(~context.volume.observed[:, :, k])
    centres = grid.centre_of(np.column_stack([ij, np.full(len(ij), k)]))
    centres = centres[np.linalg.norm(centres - position, axis=1) <= HOLE_M]
    return float(line_of_sight(context, position, centres).sum()) * grid.voxel_size**2 if len(centres) else 0.0


def _look_around(context: PolicyContext) -> Looks:
    """Rotations towards transparent clusters around the agent, the largest first, then to a wrong depth."""
    T = context.T_world_camera
    image = _look(context, T[:3, 3])
    weight = (1 - image.alpha) * image.solid_angle * (180 / np.pi) ** 2
    labels, n = pixel_clusters(1 - image.alpha > 0.3, 5 * PX, max(1, round(10 * PX * PX)))
    sums = np.array([weight[labels == i].sum() for i in range(1, n + 1)])
    out: list[np.ndarray] = []
    if sums.sum() > LOOK_TOTAL:
        for i in np.argsort(-sums, kind="stable")[:LOOKS]:
            if sums[i] <= LOOK_SUM:
                break
            mean = (image.rays[labels == i + 1] * weight[labels == i + 1][:, None]).sum(axis=0)
            out.append(_towards(mean))
    wrong = _wrong_depth(context)
    if wrong is not None:
        out.append(_towards(wrong - T[:3, 3]))
    kept: list[np.ndarray] = []
    last = T[:3, :3]
    for R in out:
        if se3.rotation_angle(last, R) > np.radians(LOOK_NEAR_DEG):
            kept.append(R)
            last = R
    return tuple(kept[:LOOKS])


def _towards(direction: np.ndarray) -> np.ndarray:
    yaw = float(np.arctan2(direction[1], direction[0]))
    pitch = float(np.clip(np.arctan2(direction[2], np.hypot(direction[0], direction[1])), -np.pi / 3, np.pi / 3))
    return se3.pose_from_yaw_pitch(np.zeros(3), yaw, pitch)[:3, :3]


def _wrong_depth(context: PolicyContext) -> np.ndarray | None:
    """World point in the middle of where the newest keyframe nearby is rendered too far, or None."""
    frames = context.the_map.keyframes
    here = context.T_world_camera[:3, 3]
    near = [f for f in frames if np.linalg.norm(f.T_world_camera[:3, 3] - here) <= 1.0]
    if not near:
        return None
    frame = near[-1]
    stride = max(1, frame.camera.width // 100)
    image = context.the_map.render(frame.camera, frame.T_world_camera)
    observed, rendered = frame.depth[::stride, ::stride], image.depth[::stride, ::stride]
    bad = (observed > 0) & (rendered - observed > 0.3) & (image.alpha[::stride, ::stride] > 0.8)
    if bad.sum() < 10:
        return None
    rows, columns = (a.mean() * stride for a in np.nonzero(bad))
    z = float(np.median(observed[bad]))
    c = frame.camera
    local = np.array([(columns + 0.5 - c.cx) / c.fx * z, (rows + 0.5 - c.cy) / c.fy * z, z])
    return np.asarray(se3.transform_points(frame.T_world_camera, local))
