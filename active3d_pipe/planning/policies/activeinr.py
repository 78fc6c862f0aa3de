"""ActiveINR (ANM): go and look at the surface whose SDF changes most when the network's weights are perturbed.

Source: Yan, Yang and Zha, "Active Neural Mapping", ICCV 2023, with the constants of its public code: u(x) = 1/20
sum_i |f(x; theta + eps_i) - f(x; theta)| with random normal eps_i over all parameters scaled to unit norm, at the
vertices of the zero crossing; the most uncertain `TOP` of the vertices stay; connected triangles form clusters, those
below 5 % of the triangles are dropped; goal = mean(vertex + 0.5 m grad f), view along -mean(grad f); not closer than
1 m; the cluster with the most triangles first; a new decision within 0.8 m of the goal or after 100 steps.

Adaptations: the network is our field (decoders and feature tables) instead of a multi-layer perceptron, so the unit
norm is shared by many more parameters: only the order of u(x) matters. The surface is extracted from the SDF on the
planning grid. A camera with six degrees of freedom looks along the full direction (pitch limited), so that the check
of the column below the goal becomes the arena's clearance, and the goal is the reachable voxel nearest to it within
`SNAP_M`. The learned local policy (DD-PPO) that walks there becomes the arena's planner. Goals looked at in vain
before are skipped; when nothing else is left the distance of 1 m is dropped.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from skimage.measure import marching_cubes

from active3d_pipe.planning.free_space import FreeSpace
from active3d_pipe.planning.policies.base import ViewPolicy, Views, looking_at, nearest_reachable, places
from active3d_pipe.planning.policies.context import PolicyContext
from active3d_pipe.planning.policies.frontier import already_seen
from active3d_pipe.structures import Decision

SAMPLES, TOP, LEAST_SHARE, STANDOFF_M, NEAREST_M = 20, 0.2, 0.05, 0.5, 1.0
ARRIVED_M, SNAP_M = 0.8, 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Cluster:
    """Uncertain surface: vertices (N, 3) world, SDF gradients (N, 3), number of triangles, mean uncertainty."""

    vertices: np.ndarray
    normals: np.ndarray
    triangles: int
    uncertainty: float


def surface(context: PolicyContext) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (N, 3) world, m, and triangles (F, 3) of the SDF's zero crossing on the planning grid."""
    sdf, grid = context.volume["sdf"], context.volume.grid
    if not (sdf.min() < 0 < sdf.max()) or min(sdf.shape) < 2:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    vertices, faces, _, _ = marching_cubes(sdf, 0.0)
    return grid.origin + (vertices + 0.5) * grid.voxel_size, faces.astype(np.int64)


def perturbation(context: PolicyContext, points: np.ndarray, *, decoder_only: bool) -> np.ndarray:
    """u(x) at world points (N, 3), m."""
    view = context.the_map
    points = points.astype(np.float32)
    base = view.query_sdf(points)
    moved = view.perturbed_sdf(points, SAMPLES, context.rng, decoder_only=decoder_only)
    return np.abs(moved - base).mean(axis=0, dtype=np.float64)


def uncertain_clusters(context: PolicyContext, *, decoder_only: bool) -> list[Cluster]:
    """Connected surface of the most uncertain vertices, most triangles first."""
    vertices, faces = surface(context)
    if not len(faces):
        return []
    u = perturbation(context, vertices, decoder_only=decoder_only)
    high = u >= np.quantile(u, 1 - TOP)
    chosen = faces[high[faces].all(axis=1)]
    if not len(chosen):
        return []
    n = len(vertices)
    links = np.concatenate([chosen[:, [0, 1]], chosen[:, [1, 2]]])
    _, part = connected_components(coo_array((np.ones(len(links)), links.T), shape=(n, n)), directed=False)
    of_face = part[chosen[:, 0]]
    names, counts = np.unique(of_face, return_counts=True)
    normals = context.the_map.normals(vertices.astype(np.float32))
    out = []
    for i in np.argsort(-counts, kind="stable"):
        if counts[i] >= LEAST_SHARE * len(chosen):
            mine = np.unique(chosen[of_face == names[i]])
            out.append(Cluster(vertices[mine], normals[mine], int(counts[i]), float(u[mine].mean())))
    return out


class ActiveInr(ViewPolicy):
    """See the module."""

    needs_map = True

    def propose(self, context: PolicyContext, space: FreeSpace) -> Views:
        """One view for every cluster, most triangles first."""
        clusters = uncertain_clusters(context, decoder_only=False)
        if not clusters:
            return Views.none()
        means = np.array([c.vertices.mean(axis=0) for c in clusters])
        goals = np.array([(c.vertices + STANDOFF_M * c.normals).mean(axis=0) for c in clusters])
        voxels, found = nearest_reachable(space, goals, SNAP_M)
        positions = places(context, space, voxels)
        gradient = np.array([c.normals.mean(axis=0) for c in clusters])
        flat = np.linalg.norm(gradient, axis=1) < 1e-3
        targets = np.where(flat[:, None], means, positions - gradient)
        size = np.array([float(c.triangles) for c in clusters])
        return Views.at(
            context, space, voxels[found], looking_at(positions, targets)[found], gain=size[found]
        )

    def score(self, context: PolicyContext, space: FreeSpace, views: Views) -> np.ndarray:
        """Triangles of the cluster; those too near only when there is nothing else."""
        assert views.gain is not None
        away = np.linalg.norm(views.poses[:, :3, 3] - context.T_world_camera[:3, 3], axis=1)
        fresh = np.where(already_seen(context, views.poses), -np.inf, views.gain)
        far = np.where(away >= NEAREST_M, fresh, -np.inf)
        return far if np.isfinite(far).any() else fresh

    def _go_on(self, context: PolicyContext, space: FreeSpace) -> Decision | None:
        """Within 0.8 m of the goal a new one is chosen."""
        before = context.previous
        if before is not None and before.chosen >= 0:
            goal = before.ranking[before.chosen].T_world_camera[:3, 3]
            if np.linalg.norm(goal - context.T_world_camera[:3, 3]) <= ARRIVED_M:
                return None
        return super()._go_on(context, space)
