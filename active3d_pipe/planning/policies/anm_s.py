"""ANM-S: nodes of a Voronoi graph, scored by the perturbation of the SDF decoder around them.

Source: the public code of "Active Neural Mapping at Scale" (Kuang et al., 2024): weight perturbation as in
`activeinr.py`, of the SDF decoder only; the top 20 % of the surface's vertices; nodes of a Voronoi graph of the free
space with the flags UNARRIVED 3, IN_HORIZON 2, GEOMETRY_UNCERTAINTY 1 and FAIL -6.

Adaptations: those of `voronoi.py` (the graph) and `activeinr.py` (field, surface). A node has the uncertainty flag
when a cluster of uncertain surface has its middle within `NODE_M` of it in line of sight; it then looks at that
cluster, otherwise it looks ahead. The semantic flag (3) needs labels and is left out. When every node was arrived at,
the node nearest to the largest cluster is visited again.
"""

import numpy as np

from active3d_pipe.planning.free_space import FreeSpace
from active3d_pipe.planning.policies.activeinr import uncertain_clusters
from active3d_pipe.planning.policies.base import ViewPolicy, Views, facing, looking_at
from active3d_pipe.planning.policies.context import PolicyContext
from active3d_pipe.planning.policies.space import line_of_sight
from active3d_pipe.planning.policies.voronoi import topology

UNARRIVED, HORIZON, GEOMETRY, FAIL = 3.0, 2.0, 1.0, -6.0
NODE_M, ARRIVED_M, HORIZON_M = 2.0, 0.4, 2.5


class AnmS(ViewPolicy):
    """See the module."""

    needs_map = True
    turns_first = True

    def propose(self, context: PolicyContext, space: FreeSpace) -> Views:
        """The nodes of the graph, each looking at the uncertain surface in sight, if any."""
        graph = topology(context, space)
        here, walked = context.T_world_camera[:3, 3], context.walked_poses[:, :3, 3]
        clusters = uncertain_clusters(context, decoder_only=True)
        middles = np.array([c.vertices.mean(axis=0) for c in clusters]).reshape(-1, 3)
        visited = (np.linalg.norm(graph.positions[:, None] - walked[None], axis=-1) <= ARRIVED_M).any(axis=1)
        horizon = space.cost[tuple(graph.voxels.T)] <= HORIZON_M
        rotations, seen, size = [], np.zeros(len(graph.voxels)), np.zeros(len(graph.voxels))
        for n, p in enumerate(graph.positions):
            R = facing(p - here, context.T_world_camera[:3, :3])
            away = np.linalg.norm(middles - p, axis=1)
            near = np.flatnonzero((away <= NODE_M) & (away > 0.1))
            near = near[line_of_sight(context, p, middles[near])] if len(near) else near
            if len(near):  # clusters are in order of size
                R, seen[n], size[n] = looking_at(p[None], middles[near[:1]])[0], 1, clusters[near[0]].triangles
            rotations.append(R)
        before = context.previous
        failed: list[list[float]] = [] if before is None else list(before.terms.get("failed", []))
        if before is not None and before.chosen >= 0 and before.terms.get("turns_left"):
            failed = [*failed, [float(c) for c in before.ranking[before.chosen].T_world_camera[:3, 3]]]
        flags = UNARRIVED * ~visited + HORIZON * horizon + GEOMETRY * seen
        if failed:
            away = np.linalg.norm(graph.positions[:, None] - np.array(failed)[None], axis=-1).min(axis=1)
            flags = flags + FAIL * (away <= ARRIVED_M)
        if visited.all():
            flags = np.where(seen > 0, size / max(float(size.max()), 1.0), -np.inf)
        else:
            flags = np.where(visited, -np.inf, flags)
        notes = {"nodes": len(graph.voxels), "clusters": len(clusters), "failed": failed}
        return Views.at(context, space, graph.voxels, np.array(rotations), notes=notes, gain=flags)

    def score(self, context: PolicyContext, space: FreeSpace, views: Views) -> np.ndarray:
        """Sum of the flags; ties go to the nearest node."""
        assert views.gain is not None
        return views.gain - 1e-3 * space.cost[tuple(views.voxels.T)]
