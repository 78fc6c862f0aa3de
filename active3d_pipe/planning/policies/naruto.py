"""NARUTO: the goal from which the most learned uncertainty of the surface is visible; rotate, go, rotate.

Source: Feng et al., "NARUTO: Neural Active Reconstruction from Uncertain Target Observations", CVPR 2024, and the
constants of its public configuration: goals on a lattice of every 2nd voxel in x and y and every 1 m in height;
targets = `TARGETS` drawn from the `TOP` most uncertain voxels with 0 <= SDF < half the truncation distance; a target
counts for a goal at a distance of 0.5 to 2.0 m with 30 free samples (SDF > 0) between them; score = sum of the
uncertainty of the visible targets; at the goal the `LOOKS` most uncertain visible targets are looked at in turn.

Adaptations: the learned uncertainty is that of our field's uncertainty head (`u_imp`), not a grid of parameters;
goals keep the arena's clearance instead of SDF >= 8 cm at the goal and its six neighbours; its RRT is the arena's
RRT* without a reward on the way. The heights of the lattice are counted from the start's. Pitch is limited to 60
degrees.
"""

import numpy as np

from active3d_pipe.planning.free_space import FreeSpace
from active3d_pipe.planning.policies.base import ViewPolicy, Views, looking_at, places
from active3d_pipe.planning.policies.context import PolicyContext

TOP, TARGETS, LOOKS = 4000, 300, 10
NEAREST_M, FARTHEST_M, SAMPLES = 0.5, 2.0, 30
LATTICE_VOXELS, LEVELS_M = 2, 1.0
TRUNCATION_M, BAND = 0.1, 0.5


class Naruto(ViewPolicy):
    """See the module."""

    turns_first = True

    def uncertainty(self, context: PolicyContext) -> np.ndarray:
        """(X, Y, Z) what is summed: the field's own uncertainty near its surface."""
        volume = context.volume
        near = (volume["sdf"] >= 0) & (volume["sdf"] < BAND * TRUNCATION_M)
        return np.where(near, volume["u_imp"], 0)

    def propose(self, context: PolicyContext, space: FreeSpace) -> Views:
        """Every goal of the lattice that sees a target, looking at its most uncertain targets."""
        voxels = _lattice(context, space)
        positions = places(context, space, voxels)
        u = self.uncertainty(context).ravel()
        top = np.argpartition(-u, min(TOP, u.size - 1))[:TOP]
        top = np.sort(top[u[top] > 0])
        drawn = np.sort(context.rng.choice(top, min(TARGETS, len(top)), replace=False)) if len(top) else top
        targets = space.grid.centre_of(np.stack(np.unravel_index(drawn, space.grid.shape), axis=-1))
        visible = _visible(context, positions, targets)
        total = visible @ u[drawn].astype(np.float64)
        keep = np.flatnonzero(total > 0)
        first, looks = [], []
        for g in keep:
            best = np.flatnonzero(visible[g])
            best = best[np.argsort(-u[drawn][best], kind="stable")][:LOOKS]
            R = looking_at(np.tile(positions[g], (len(best), 1)), targets[best])
            first.append(R[0])
            looks.append(tuple(R[1:]))
        return Views.at(context, space, voxels[keep], np.array(first).reshape(-1, 3, 3), looks, gain=total[keep])

    def score(self, context: PolicyContext, space: FreeSpace, views: Views) -> np.ndarray:
        """Summed uncertainty of the visible targets."""
        assert views.gain is not None
        return views.gain


def _lattice(context: PolicyContext, space: FreeSpace) -> np.ndarray:
    """(G, 3) reachable voxels of the goal lattice; the agent's own voxel when it holds none."""
    ijk = np.argwhere(space.reachable)
    level = max(1, round(LEVELS_M / space.grid.voxel_size))
    first = space.grid.index_of(context.walked_poses[0, :3, 3])
    on = (ijk[:, :2] % LATTICE_VOXELS == 0).all(axis=1) & ((ijk[:, 2] - first[2]) % level == 0)
    return ijk[on] if on.any() else space.start[None]


def _visible(context: PolicyContext, goals: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """(G, N) bool: the distance fits and all samples between goal and target have SDF > 0."""
    grid, sdf = context.volume.grid, context.volume["sdf"]
    d = np.linalg.norm(goals[:, None] - targets[None], axis=-1)
    g, t = np.nonzero((d > NEAREST_M) & (d < FARTHEST_M))
    clear = np.ones(len(g), bool)
    # The last samples lie within the target's own voxel.
    for s in np.linspace(0, 1, SAMPLES):
        here = clear & ((1 - s) * d[g, t] > grid.voxel_size)
        ijk = grid.index_of(goals[g[here]] + s * (targets[t[here]] - goals[g[here]]))
        inside = grid.contains_index(ijk)
        value = np.full(len(ijk), 1.0)
        value[inside] = sdf[tuple(ijk[inside].T)]
        clear[here] = value > 0
    out = np.zeros(d.shape, bool)
    out[g[clear], t[clear]] = True
    return out
