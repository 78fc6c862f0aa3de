"""Random free poses: the least that any policy must beat.

A reachable voxel drawn uniformly, a yaw drawn uniformly, a pitch among the arena's. It never stops by itself.
"""

import numpy as np

from active3d_pipe.geometry import se3
from active3d_pipe.planning.free_space import FreeSpace
from active3d_pipe.planning.policies.base import ViewPolicy, Views
from active3d_pipe.planning.policies.context import PolicyContext

DRAWN = 8


class RandomViews(ViewPolicy):
    """See the module."""

    def propose(self, context: PolicyContext, space: FreeSpace) -> Views:
        """A few random views, in the order in which they were drawn."""
        ijk = np.argwhere(space.reachable)
        drawn = ijk[context.rng.integers(0, len(ijk), DRAWN)]
        yaws = context.rng.uniform(-np.pi, np.pi, DRAWN)
        pitches = np.radians(context.rng.choice(context.settings.pitches_deg, DRAWN))
        made = [se3.pose_from_yaw_pitch(np.zeros(3), y, p)[:3, :3] for y, p in zip(yaws, pitches, strict=True)]
        return Views.at(context, space, drawn, np.array(made))

    def score(self, context: PolicyContext, space: FreeSpace, views: Views) -> np.ndarray:
        """The first one drawn is as good as any."""
        return -np.arange(len(views), dtype=np.float64)
