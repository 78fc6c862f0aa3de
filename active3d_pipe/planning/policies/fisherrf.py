"""FisherRF: the path whose views carry the most Fisher information that the training views do not.

Source: Jiang, Lei and Daniilidis, "FisherRF: Active View Selection and Uncertainty Quantification for Radiance Fields
using Fisher Information", ECCV 2024, and the constants of its public active-mapping code. H(c) = diag of J^T J, J =
derivative of the rendered colours with respect to the parameters (means and opacity logits, scaled by 1e-3); gain of
a view = log sum_i H_c,i / (H_train,i + lambda) with lambda = 1e-6, H_train the sum over the training views;
candidates are frontiers while there are any, else views from 0.5 to 1 m on a ring around members of the best cluster
of the 20 % of the primitives with the highest score; at most 20 paths; score of a path = sum over every 5th step of
the gain, with H_train += H of the view, over the number of steps, + 30 x the gain of its last view.

The diagonal: rasterisers give J^T v, not squares. With v of independent random signs, E[(J^T v)^2] is exactly the
diagonal (Hutchinson, 1990); `PROBES` of them a view, on images reduced to about `WIDTH` px.

Adaptations: poses are true here, so the pose term (0.2 logdet H_pose) is left out. H_train is that of `TRAINING`
spread keyframes, scaled to all of them. Gains along the way are evaluated for the `ALONG` paths with the best last
view, at most `STOPS` views each.
"""

import numpy as np
from scipy.spatial import cKDTree

from active3d_pipe.gaussians.parameters import GaussianParameters
from active3d_pipe.gaussians.raster_pass import RasterPass
from active3d_pipe.gaussians.rasteriser import new_pass
from active3d_pipe.planning.free_space import FreeSpace
from active3d_pipe.planning.path import step_path
from active3d_pipe.planning.policies.base import ViewPolicy, Views, looking_at, nearest_reachable, places
from active3d_pipe.planning.policies.context import MapView, PolicyContext
from active3d_pipe.planning.policies.frontier import MIN_VOXELS, already_seen, frontier_views
from active3d_pipe.planning.policies.space import frontier_clusters
from active3d_pipe.planning.reward import spread_poses
from active3d_pipe.structures import Camera

COLUMNS = (0, 1, 2, 10)  # means and opacity logit
SCALE, LAMBDA, END_WEIGHT, EVERY, PATHS = 1e-3, 1e-6, 30.0, 5, 20
TOP, CLUSTER_M, CLUSTER_LEAST, RING_M = 0.2, 0.1, 5, (0.5, 1.0)
PROBES, WIDTH, TRAINING, ALONG, STOPS = 2, 100, 24, 5, 3
WORST_M = 0.35  # how far a ring place may be from the free voxel that stands for it


class Fisher:
    """Diagonal Fisher information of views of one map."""

    def __init__(self, view: MapView, camera: Camera, rng: np.random.Generator) -> None:
        self.values = GaussianParameters.from_model(view.gaussians).values.numpy()
        self.camera = camera.scaled(min(1.0, WIDTH / camera.width))
        self.rng = rng
        self._pass: RasterPass = new_pass(view.gaussian_settings)

    def diagonal(self, T_world_camera: np.ndarray, probes: int = PROBES) -> np.ndarray:
        """(N, 4) float64 estimate of sum over pixels and channels of (dC / dtheta)^2, scaled."""
        out = np.zeros((len(self.values), len(COLUMNS)))
        if not len(self.values):
            return out
        image = self._pass.forward(self.values, self.camera, T_world_camera)
        signs = np.zeros(image.shape, np.float32)
        for _ in range(probes):
            signs[:3] = 2 * self.rng.integers(0, 2, signs[:3].shape, dtype=np.int8) - 1
            out += self._pass.backward(signs)[:, COLUMNS].astype(np.float64) ** 2
        return out * (SCALE * SCALE / probes)

    def training(self, poses: np.ndarray) -> np.ndarray:
        """(N, 4) information of all training views (K, 4, 4), from some that are spread, scaled to their number."""
        out = np.zeros((len(self.values), len(COLUMNS)))
        chosen = spread_poses(poses, TRAINING) if len(poses) else np.zeros(0, np.int64)
        for i in chosen:
            out += self.diagonal(poses[i], 1)
        return out * (len(poses) / max(len(chosen), 1))


def gain(information: np.ndarray, training: np.ndarray) -> float:
    """log of the trace of H_c (H_train + lambda)^-1; an empty view has the gain of one lambda."""
    return float(np.log(max((information / (training + LAMBDA)).sum(), LAMBDA)))


class FisherRF(ViewPolicy):
    """See the module."""

    needs_map = True

    def propose(self, context: PolicyContext, space: FreeSpace) -> Views:
        """Frontiers while there are any, else views of the most informative primitives, at most 20."""
        clusters = frontier_clusters(context, space, MIN_VOXELS)[: 2 * PATHS]
        views = frontier_views(context, space, clusters)
        fresh = np.flatnonzero(~already_seen(context, views.poses))[:PATHS]
        if len(fresh):
            return Views(views.poses[fresh], views.voxels[fresh], notes={"candidates": "frontiers"})
        return self._around_primitives(context, space)

    def score(self, context: PolicyContext, space: FreeSpace, views: Views) -> np.ndarray:
        """Score of the path to every view."""
        fisher = Fisher(context.the_map, context.camera, context.rng)
        training = fisher.training(context.the_map.keyframe_poses)
        last = np.array([gain(fisher.diagonal(T), training) for T in views.poses])
        out = END_WEIGHT * last
        for i in np.argsort(-last, kind="stable")[:ALONG]:
            points = places(context, space, space.grid_path(views.voxels[i]))
            points[0] = context.T_world_camera[:3, 3]
            length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
            steps = step_path(context.T_world_camera, points, [(length, views.poses[i, :3, :3])], context.motion)
            # Every 5th step, or fewer evenly spread: the mean over the way is what counts.
            stops = steps[EVERY - 1 :: EVERY]
            spread = np.linspace(0, len(stops) - 1, STOPS).astype(int)
            chosen = stops[spread] if len(stops) > STOPS else stops
            path, total = training.copy(), 0.0
            for T in chosen:
                information = fisher.diagonal(T)
                total += gain(information, path)
                path += information
            if len(chosen):
                out[i] += total / len(chosen) * len(stops) / max(len(steps), 1)
        unvisited = np.argsort(-last, kind="stable")[ALONG:]
        # Paths that were not looked at closely stay behind those that were.
        worst = min((out[i] for i in np.argsort(-last, kind="stable")[:ALONG]), default=0.0)
        out[unvisited] = np.minimum(out[unvisited], worst)
        return out

    def _around_primitives(self, context: PolicyContext, space: FreeSpace) -> Views:
        fisher = Fisher(context.the_map, context.camera, context.rng)
        means = context.the_map.gaussians.means.astype(np.float64)
        if not len(means):
            return Views.none({"candidates": "primitives"})
        training = fisher.training(context.the_map.keyframe_poses)
        score = 1 / (training + LAMBDA).sum(axis=1)
        top = np.argsort(-score, kind="stable")[: max(1, int(TOP * len(score)))]
        tree = cKDTree(means[top])
        best = means[top[0]]
        # The cluster that holds the best one with enough neighbours, grown link by link.
        for i in range(min(len(top), 200)):
            if len(tree.query_ball_point(means[top[i]], CLUSTER_M)) >= CLUSTER_LEAST:
                best = means[top[i]]
                break
        near = means[top[np.sort(tree.query_ball_point(best, 5 * CLUSTER_M))]]
        rng, n = context.rng, 8 * PATHS
        centres = near[rng.integers(0, len(near), n)]
        angle, radius = rng.uniform(-np.pi, np.pi, n), rng.uniform(*RING_M, n)
        around = centres + np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(n)], axis=-1)
        around[:, 2] += rng.uniform(-0.5, 0.5, n)
        voxels, found = nearest_reachable(space, around, WORST_M)
        positions = places(context, space, voxels)
        keep = np.flatnonzero(found & (np.linalg.norm(positions - centres, axis=1) > 0.2))
        _, first = np.unique(voxels[keep], axis=0, return_index=True)
        keep = keep[np.sort(first)][:PATHS]
        notes = {"candidates": "primitives"}
        return Views.at(context, space, voxels[keep], looking_at(positions, centres)[keep], notes=notes)
