"""The paper's own policy: next best view by hybrid information gain (eq. nbv_eig), path by eq. risk_path."""

from active3d_pipe.planning.decide import decide
from active3d_pipe.planning.policies.context import PolicyContext
from active3d_pipe.structures import Decision


class Active3D:
    """`planning.decide.decide`, unchanged."""

    needs_map = False

    def decide(self, context: PolicyContext) -> Decision:
        """See `planning.decide.decide`."""
        return decide(
            context.volume, context.T_world_camera, context.walked_poses, context.camera, context.motion,
            context.settings, context.rng, previous=context.previous,
        )
