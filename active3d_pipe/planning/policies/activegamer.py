"""ActiveGAMER: the view with the most pixels that render nothing, coarse candidates first, then fine ones.

Source: Chen et al., "ActiveGAMER: Active Gaussian Mapping through Efficient Rendering", CVPR 2025, with the constants
of its public code: candidates are free voxels 1.0 m apart with 5 directions of a Fibonacci sphere (stage 0), then 0.5
m apart with 15 (stage 1); IG = number of pixels with rendered depth 0; views below 0.5 % of the pixels are dropped;
score = (1 - softmax(distance)) softmax(log IG); no candidate left: the next stage, then the end of the exploration.

Adaptations: its code looks up the true depth at candidates to tell real holes apart; here no candidate is ever
rendered by the simulator, and holes that were looked at in vain (same place, same direction) are dropped instead. The
renderings of all directions from one place are taken from one panorama of `DEGREES_PER_PX`, pixels are counted in
solid angle. At most `MOST` places (the spacing grows). Levels of height are the lattice's own. The phase of
post-refinement is the arena's (`mapping.refinement_iterations`), the same for every policy.
"""

import numpy as np
from scipy.special import softmax

from active3d_pipe.planning.free_space import FreeSpace
from active3d_pipe.planning.policies.base import ViewPolicy, Views, looking_at
from active3d_pipe.planning.policies.context import PolicyContext
from active3d_pipe.planning.policies.frontier import already_seen
from active3d_pipe.planning.policies.panorama import members, panorama
from active3d_pipe.planning.policies.space import all_views, fibonacci_directions, spread_positions

STAGES = ((1.0, 5), (0.5, 15))  # spacing of candidates, m; directions
LEAST_SHARE, DEGREES_PER_PX, MOST = 0.005, 4.0, 48


class ActiveGamer(ViewPolicy):
    """See the module."""

    needs_map = True

    def propose(self, context: PolicyContext, space: FreeSpace) -> Views:
        """Views that render nothing in enough pixels, of the present stage or the next."""
        before = context.previous
        first = 0 if before is None else int(before.terms.get("stage", 0))
        for stage in range(first, len(STAGES)):
            views = self._stage(context, space, stage)
            if len(views):
                return views
        return Views.none({"stage": len(STAGES) - 1})

    def _stage(self, context: PolicyContext, space: FreeSpace, stage: int) -> Views:
        spacing, count = STAGES[stage]
        places = spread_positions(context, space, spacing, MOST)
        voxels, positions, targets = all_views(context, space, places, fibonacci_directions(count))
        rotations = looking_at(positions, targets)
        share = np.zeros(len(voxels))
        for n in range(len(places)):
            mine = slice(n * count, (n + 1) * count)
            image = panorama(context.the_map, positions[n * count], DEGREES_PER_PX, context.camera)
            angle = image.solid_angle.ravel()
            inside = members(image.rays.reshape(-1, 3), rotations[mine], context.camera) * angle
            share[mine] = (inside @ (image.distance_m.ravel() == 0)) / inside.sum(axis=1)
        views = Views.at(context, space, voxels, rotations)
        keep = np.flatnonzero((share > LEAST_SHARE) & ~already_seen(context, views.poses, 0.15, 12.0))
        return Views(views.poses[keep], views.voxels[keep], notes={"stage": stage}, gain=share[keep])

    def score(self, context: PolicyContext, space: FreeSpace, views: Views) -> np.ndarray:
        """(1 - softmax(distance)) softmax(log IG)."""
        assert views.gain is not None
        travel = space.cost[tuple(views.voxels.T)].astype(np.float64)
        pixels = views.gain * context.camera.width * context.camera.height
        return (1 - softmax(travel)) * softmax(np.log(pixels))
