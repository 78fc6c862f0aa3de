"""ActiveGS: unexplored voxels in view first, then primitives of low confidence.

Source: Jin et al., "ActiveGS: Active Scene Reconstruction Using Gaussian Splatting", RA-L 2025, with the constants of
its public code. Confidence of a primitive with the unit directions v_i to the views that see it, at distances d_i and
incidence theta_i: kappa = clamp(exp(1 - |mean v_i|) sum_i (1 - d_i / d_max) cos theta_i, 0, 1). 100 candidates: at
most 30 around regions of interest (frontiers; primitives with kappa < 0.3 and opacity > 0.7), from 0.3 to 2.0 m away
under at most 60 degrees, the others at random within 0.5 m. U = 1000 x (share of unexplored voxels in view) + mean of
(1 - kappa) d / d_max over the rendered image; score = U / sum U - 0.5 L / sum L with the length L of the path.

Adaptations: surfels are our flat Gaussians, their normal the shortest axis; visibility in a keyframe is judged by its
depth; at most `KEYFRAMES` spread keyframes, the sum scaled to all. Its voxel map of 0.2 m is the planning grid.
Renderings are reduced to `WIDTH` px. Depth noise and the mask of missing surface are not part of this arena by
default.
"""

import numpy as np

from active3d_pipe.gaussians.rasteriser import render_view
from active3d_pipe.geometry import projection, se3
from active3d_pipe.planning.free_space import FreeSpace
from active3d_pipe.planning.policies.base import ViewPolicy, Views, looking_at, nearest_reachable, places
from active3d_pipe.planning.policies.context import MapView, PolicyContext
from active3d_pipe.planning.policies.space import frontier_clusters, in_view
from active3d_pipe.planning.reward import spread_poses
from active3d_pipe.structures import GaussianModel

CANDIDATES, AROUND_ROI, ROI_CONFIDENCE, ROI_OPACITY = 100, 30, 0.3, 0.7
ROI_NEAR_M, ROI_FAR_M, ROI_COS, RANDOM_M = 0.3, 2.0, 0.5, 0.5
UNEXPLORED_WEIGHT, PATH_WEIGHT, MAX_DISTANCE_M = 1000.0, 0.5, 5.0
KEYFRAMES, WIDTH, MAX_PITCH_DEG, FRONTIER_VOXELS = 32, 120, 40.0, 4


def normals(model: GaussianModel) -> np.ndarray:
    """(N, 3) shortest axis of every primitive, world."""
    R = se3.matrix_from_quat(model.quats.astype(np.float64)) if len(model) else np.zeros((0, 3, 3))
    axis = np.argmin(model.log_scales, axis=1) if len(model) else np.zeros(0, np.int64)
    return R[np.arange(len(model)), :, axis]


def confidence(view: MapView) -> np.ndarray:
    """(N,) kappa of every primitive of the map."""
    model, frames = view.gaussians, view.keyframes
    means, normal = model.means.astype(np.float64), normals(model)
    direction, weight, count = np.zeros((len(means), 3)), np.zeros(len(means)), np.zeros(len(means))
    chosen = spread_poses(view.keyframe_poses, KEYFRAMES) if frames else np.zeros(0, np.int64)
    for i in chosen:
        frame = frames[int(i)]
        uv, z = projection.project(means, frame.T_world_camera, frame.camera)
        seen = np.flatnonzero(projection.in_image(uv, z, frame.camera))
        ij = np.floor(uv[seen]).astype(int)
        observed = frame.depth[ij[:, 1], ij[:, 0]]
        seen = seen[(observed > 0) & (np.abs(z[seen] - observed) < 0.05 + 0.02 * observed)]
        v = frame.T_world_camera[:3, 3] - means[seen]
        d = np.linalg.norm(v, axis=1)
        v /= np.maximum(d, 1e-6)[:, None]
        direction[seen] += v
        count[seen] += 1
        weight[seen] += np.maximum(0, 1 - d / MAX_DISTANCE_M) * np.abs((v * normal[seen]).sum(axis=1))
    mean = np.linalg.norm(direction, axis=1) / np.maximum(count, 1)
    weight *= len(frames) / max(len(chosen), 1)
    return np.clip(np.exp(1 - mean) * weight, 0, 1)


class ActiveGS(ViewPolicy):
    """See the module."""

    needs_map = True

    def propose(self, context: PolicyContext, space: FreeSpace) -> Views:
        """Views of regions of interest, and random ones nearby."""
        kappa = confidence(context.the_map)
        around = self._around_roi(context, space, kappa)
        near = self._nearby(context, space, CANDIDATES - len(around))
        poses, voxels = (np.concatenate([getattr(a, n) for a in (around, near)]) for n in ("poses", "voxels"))
        return Views(poses, voxels, gain=self._utility(context, poses, kappa))

    def score(self, context: PolicyContext, space: FreeSpace, views: Views) -> np.ndarray:
        """U / sum U - 0.5 L / sum L."""
        assert views.gain is not None
        travel = space.cost[tuple(views.voxels.T)].astype(np.float64)
        still = (travel < 1e-6) & (np.abs(views.poses - context.T_world_camera).max(axis=(1, 2)) < 1e-6)
        score = views.gain / max(views.gain.sum(), 1e-12) - PATH_WEIGHT * travel / max(travel.sum(), 1e-12)
        return np.where(still, -np.inf, score)

    def _utility(self, context: PolicyContext, poses: np.ndarray, kappa: np.ndarray) -> np.ndarray:
        model = context.the_map.gaussians
        doubt = np.repeat((1 - kappa).astype(np.float32)[:, None], 3, axis=1)
        painted = GaussianModel(model.means, model.log_scales, model.quats, model.opacity_logits, doubt)
        camera = context.camera.scaled(min(1.0, WIDTH / context.camera.width))
        counts = in_view(context, poses, ~context.volume.observed, coarser=2)
        out = UNEXPLORED_WEIGHT * counts[:, 0] / np.maximum(counts[:, 1], 1)
        for i, T in enumerate(poses):
            image = render_view(painted, camera, T, context.the_map.gaussian_settings)
            out[i] += float((image.rgb[..., 0] * np.minimum(image.depth / MAX_DISTANCE_M, 1)).mean(dtype=np.float64))
        return out

    def _around_roi(self, context: PolicyContext, space: FreeSpace, kappa: np.ndarray) -> Views:
        rng, model = context.rng, context.the_map.gaussians
        doubtful = np.flatnonzero((kappa < ROI_CONFIDENCE) & (model.opacities > ROI_OPACITY))
        targets = [model.means[doubtful].astype(np.float64)]
        axes = [normals(model)[doubtful]]
        for cluster in frontier_clusters(context, space, FRONTIER_VOXELS):
            points = space.grid.centre_of(cluster)
            targets.append(points)
            axes.append(np.zeros_like(points))
        target, axis = np.concatenate(targets), np.concatenate(axes)
        if not len(target):
            return Views.none()
        drawn = rng.integers(0, len(target), 4 * AROUND_ROI)
        d = rng.standard_normal((len(drawn), 3))
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        towards = np.abs((d * axis[drawn]).sum(axis=1))
        ok = (towards >= ROI_COS) | (np.abs(axis[drawn]).max(axis=1) == 0)
        wanted = target[drawn] + d * rng.uniform(ROI_NEAR_M, ROI_FAR_M, len(drawn))[:, None]
        voxels, found = nearest_reachable(space, wanted, 0.5)
        positions = places(context, space, voxels)
        away = np.linalg.norm(positions - target[drawn], axis=1)
        keep = np.flatnonzero(ok & found & (away >= ROI_NEAR_M) & (away <= ROI_FAR_M))[:AROUND_ROI]
        return Views.at(context, space, voxels[keep], looking_at(positions, target[drawn], MAX_PITCH_DEG)[keep])

    def _nearby(self, context: PolicyContext, space: FreeSpace, count: int) -> Views:
        rng, here = context.rng, context.T_world_camera[:3, 3]
        ijk = np.argwhere(space.reachable)
        near = ijk[np.linalg.norm(space.grid.centre_of(ijk) - here, axis=1) <= RANDOM_M]
        near = near if len(near) else space.start[None]
        voxels = near[rng.integers(0, len(near), count)]
        yaw, pitch = rng.uniform(-np.pi, np.pi, count), np.radians(rng.uniform(-MAX_PITCH_DEG, MAX_PITCH_DEG, count))
        made = [se3.pose_from_yaw_pitch(np.zeros(3), y, p)[:3, :3] for y, p in zip(yaw, pitch, strict=True)]
        return Views.at(context, space, voxels, np.array(made).reshape(-1, 3, 3))
