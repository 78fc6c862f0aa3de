"""Greedy unknown volume: the view with the most unknown voxels in sight per step that it takes to get there.

Source: the classical next best view of volumetric exploration (Connolly, "The determination of next best views", ICRA
1985; the gain of receding-horizon planners such as Bircher et al., ICRA 2016). Own choices: the fixed cost of a view
is the arena's `planning.view_steps`; positions as coarse as the arena's, `YAWS` directions times its pitches; lines
of sight end in solid voxels, pass unknown ones. It stops when no view sees more than `LEAST` unknown voxels.
"""

import numpy as np

from active3d_pipe.geometry import se3
from active3d_pipe.planning.choice import view_cost_steps
from active3d_pipe.planning.free_space import FreeSpace
from active3d_pipe.planning.policies.base import ViewPolicy, Views
from active3d_pipe.planning.policies.context import PolicyContext
from active3d_pipe.planning.policies.frontier import already_seen
from active3d_pipe.planning.policies.space import in_view, spread_positions

YAWS, MOST_POSITIONS, EXACT, LEAST = 12, 80, 24, 10


class UnknownVolume(ViewPolicy):
    """See the module."""

    def propose(self, context: PolicyContext, space: FreeSpace) -> Views:
        """Spread positions times directions, thinned to the `EXACT` best by a rough count."""
        settings = context.settings
        voxels = spread_positions(context, space, settings.coarse_spacing_m, MOST_POSITIONS)
        rotations = np.array([
            se3.pose_from_yaw_pitch(np.zeros(3), yaw, np.radians(pitch))[:3, :3]
            for yaw in np.arange(YAWS) * (2 * np.pi / YAWS) for pitch in settings.pitches_deg
        ])
        views = Views.at(
            context, space, np.repeat(voxels, len(rotations), axis=0), np.tile(rotations, (len(voxels), 1, 1))
        )
        rough = self._rate(context, space, views, coarser=4)
        best = np.argsort(-rough, kind="stable")[:EXACT]
        return Views(views.poses[best], views.voxels[best])

    def score(self, context: PolicyContext, space: FreeSpace, views: Views) -> np.ndarray:
        """Unknown voxels in sight per step."""
        rate = self._rate(context, space, views, coarser=1)
        return np.where((rate <= 0) | already_seen(context, views.poses, 0.1, 5.0), -np.inf, rate)

    def _rate(self, context: PolicyContext, space: FreeSpace, views: Views, coarser: int) -> np.ndarray:
        unknown = in_view(context, views.poses, ~context.volume.observed, coarser)[:, 0]
        travel = space.cost[tuple(views.voxels.T)]
        cost = view_cost_steps(travel, context.T_world_camera[:3, :3], views.poses[:, :3, :3], context.motion)
        return np.where(unknown > LEAST, unknown / (cost + context.settings.view_steps), 0.0)
