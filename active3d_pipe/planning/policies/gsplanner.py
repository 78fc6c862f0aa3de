"""GS-Planner: unobserved volume in front of what the Gaussians render, and their errors, per way.

Source: Jin et al., "GS-Planner: A Gaussian-Splatting-based Planning Framework for Active High-Fidelity
Reconstruction", IROS 2024. No code is public; from its description: the gain of a view joins completeness (unobserved
volume, met along the rays before the rendered surface, weighted with the transmittance up to there) and quality
(reconstruction loss of what the view shows), and an aerial robot weighs it against its way.

Own reading, since constants are not published: completeness = unobserved voxels in view, m3, times the share of the
view that the Gaussians leave transparent or that lies beyond the rendered depth; quality = mean over the rendered
surface in view of the view-dependent error of the Gaussians (`u_exp` of the voxel); gain = completeness / the volume
of the view + `QUALITY` x quality; utility = gain exp(-`PER_M` x travel), the exponential discount of receding-horizon
planners (Bircher et al., 2016). Candidates: places `SPACING_M` apart, `DIRECTIONS` directions. It stops when no view
has a gain above `LEAST`.
"""

import numpy as np

from active3d_pipe.geometry import projection, se3
from active3d_pipe.planning.free_space import FreeSpace
from active3d_pipe.planning.policies.base import ViewPolicy, Views, looking_at
from active3d_pipe.planning.policies.context import PolicyContext
from active3d_pipe.planning.policies.frontier import already_seen
from active3d_pipe.planning.policies.space import all_views, fibonacci_directions, in_view, spread_positions

SPACING_M, MOST, DIRECTIONS, RENDERED, WIDTH = 0.8, 40, 12, 32, 60
QUALITY, PER_M, LEAST = 0.2, 0.3, 0.005


class GSPlanner(ViewPolicy):
    """See the module."""

    needs_map = True

    def propose(self, context: PolicyContext, space: FreeSpace) -> Views:
        """Spread views; the Gaussians are rendered in those with the most unobserved space by a rough count."""
        voxels, positions, targets = all_views(
            context, space, spread_positions(context, space, SPACING_M, MOST), fibonacci_directions(DIRECTIONS)
        )
        views = Views.at(context, space, voxels, looking_at(positions, targets, 45.0))
        rough = in_view(context, views.poses, ~context.volume.observed, coarser=4)[:, 0]
        rough *= np.exp(-PER_M * space.cost[tuple(voxels.T)])
        best = np.argsort(-rough, kind="stable")[:RENDERED]
        return Views(views.poses[best], views.voxels[best])

    def score(self, context: PolicyContext, space: FreeSpace, views: Views) -> np.ndarray:
        """Discounted gain."""
        counts = in_view(context, views.poses, ~context.volume.observed)
        share = counts[:, 0] / np.maximum(counts[:, 1], 1)
        seen = [self._rendered(context, T) for T in views.poses]
        gain = share * np.array([open_ for open_, _ in seen]) + QUALITY * np.array([error for _, error in seen])
        travel = space.cost[tuple(views.voxels.T)].astype(np.float64)
        drop = (gain <= LEAST) | already_seen(context, views.poses, 0.15, 10.0)
        return np.where(drop, -np.inf, gain * np.exp(-PER_M * travel))

    def _rendered(self, context: PolicyContext, T: np.ndarray) -> tuple[float, float]:
        """(mean share of a ray's reach that is not behind rendered surface, mean error of the surface in view)."""
        camera = context.camera.scaled(min(1.0, WIDTH / context.camera.width))
        image = context.the_map.render(camera, T)
        rays = projection.pixel_rays(camera).astype(np.float64)
        distance = image.depth * np.linalg.norm(rays, axis=-1)
        within = np.where(image.depth > 0, np.minimum(distance / context.reach_m, 1), 1)
        open_share = float((image.alpha * within + (1 - image.alpha)).mean(dtype=np.float64))
        hit = image.depth > 0
        points = se3.transform_points(T, rays[hit] * image.depth[hit][:, None])
        grid = context.volume.grid
        ijk = grid.index_of(points)
        ijk = ijk[grid.contains_index(ijk)]
        error = float(context.volume["u_exp"][tuple(ijk.T)].mean(dtype=np.float64)) if len(ijk) else 0.0
        return open_share, error
