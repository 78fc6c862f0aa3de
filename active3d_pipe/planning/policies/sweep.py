"""A fixed sweep: boustrophedon over a lattice, whatever was seen.

Lattice points `SPACING_M` apart over the whole box, at the height of the start, rows alternating in direction
(Choset, "Coverage of known spaces: the boustrophedon cellular decomposition", 2000, on an unknown floor plan). At
every point the camera looks both ways across the row, a little down and up by turns. Points that are not reachable
yet are skipped and taken up again when they are; a point counts as done when the agent came within `DONE_M` of it. It
stops when no reachable point is left.
"""

import numpy as np

from active3d_pipe.geometry import se3
from active3d_pipe.planning.free_space import FreeSpace
from active3d_pipe.planning.policies.base import ViewPolicy, Views, nearest_reachable
from active3d_pipe.planning.policies.context import PolicyContext

SPACING_M, SNAP_M, DONE_M, PITCH_DEG = 1.0, 0.35, 0.45, 20.0


class Sweep(ViewPolicy):
    """See the module."""

    def propose(self, context: PolicyContext, space: FreeSpace) -> Views:
        """The points of the lattice that are left and reachable, in the fixed order."""
        grid, height = context.volume.grid, context.walked_poses[0, 2, 3]
        xs, ys = (np.arange(grid.low[i] + SPACING_M / 2, grid.high[i], SPACING_M) for i in range(2))
        points = np.array([(x, y, height) for n, x in enumerate(xs) for y in (ys if n % 2 == 0 else ys[::-1])])
        walked = context.walked_poses[:, :3, 3]
        # The bootstrap turn at the start is no visit of the sweep: only where the agent walked counts.
        done = (np.linalg.norm(points[:, None] - walked[None], axis=-1) <= DONE_M).any(axis=1)
        left = np.flatnonzero(~done)
        voxels, found = nearest_reachable(space, points[left], SNAP_M)
        left, voxels = left[found], voxels[found]
        first, looks = [], []
        for n in left:
            pitch = np.radians(PITCH_DEG if n % 2 else -PITCH_DEG)
            first.append(se3.pose_from_yaw_pitch(np.zeros(3), 0.0, pitch)[:3, :3])
            looks.append((se3.pose_from_yaw_pitch(np.zeros(3), np.pi, -pitch)[:3, :3],))
        # A snapped voxel may lie out of reach of "done": once stood on, it counts.
        centres = grid.centre_of(voxels)
        stood = (np.linalg.norm(centres[:, None] - walked[None], axis=-1) < 0.75 * grid.voxel_size).any(axis=1)
        keep = np.flatnonzero(~stood)
        return Views.at(
            context, space, voxels[keep], np.array(first).reshape(-1, 3, 3)[keep], [looks[i] for i in keep]
        )

    def score(self, context: PolicyContext, space: FreeSpace, views: Views) -> np.ndarray:
        """The order of the sweep."""
        return -np.arange(len(views), dtype=np.float64)
