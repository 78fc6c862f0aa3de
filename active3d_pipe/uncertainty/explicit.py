"""View-dependent local uncertainty: residuals of the Gaussian branch, back-projected (eq. view_uncertainty)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from active3d_pipe.errors import InputError
from active3d_pipe.geometry import projection
from active3d_pipe.structures import Camera, Frame, VoxelGrid
from active3d_pipe.structures.frame import check_pose
from active3d_pipe.uncertainty import kernels
from active3d_pipe.uncertainty.carving import by_image_size, intrinsics
from active3d_pipe.uncertainty.config import UncertaintySettings

QuerySdf = Callable[[np.ndarray], np.ndarray]

# A voxel counts as seen by a view from this much of one pixel's trilinear weight; less is a splash at its border.
MIN_WEIGHT = 0.25
# A neighbourhood counts as seen from this many views (a view beside the voxel counts by the blur's weight).
MIN_VIEWS = 0.01
# How far the blur of residuals reaches, standard deviations.
BLUR_REACH = 2.0
# px between the depth samples that tell where a frame looks
CHOICE_STRIDE = 24


@dataclass(frozen=True, slots=True, eq=False)
class ViewResidual:
    """The error of one rendering against what was observed.

    Attributes:
        camera: intrinsics of the images below (a reduced resolution is fine).
        T_world_camera: (4, 4) camera to world.
        depth: (H, W) float32 observed depth, m, 0 where the pixel is invalid (mask M_t).
        depth_error: (H, W) float32, m (E_t^depth); 0 where invalid.
        color_error: (H, W) float32, sum over R, G, B in 0..1 (E_t^rgb); 0 where invalid.
        sdf_error: (H, W) float32, |SDF| of the field at the observed points, m; None when the explicit branch alone
            is judged. With it, the depth part is the mean of both branches' errors.
    """

    camera: Camera
    T_world_camera: np.ndarray
    depth: np.ndarray
    depth_error: np.ndarray
    color_error: np.ndarray
    sdf_error: np.ndarray | None = None

    def __post_init__(self) -> None:
        check_pose(self.T_world_camera, "view residual")
        shape = (self.camera.height, self.camera.width)
        for name in ("depth", "depth_error", "color_error", "sdf_error"):
            a = getattr(self, name)
            if a is None:
                continue
            if a.shape != shape or a.dtype != np.float32:
                raise InputError(f"view residual: {name} is {a.shape} {a.dtype}, expected {shape} float32")

    def normalised(self, settings: UncertaintySettings, thinned: slice = slice(None)) -> np.ndarray:
        """(h, w) float32 joint residual in 0..1: each error saturates as 1 - exp(-error / scale)."""
        per_m = np.float32(-1 / settings.depth_residual_scale_m)
        depth_part = -np.expm1(self.depth_error[thinned, thinned] * per_m)
        if self.sdf_error is not None:
            depth_part = (depth_part - np.expm1(self.sdf_error[thinned, thinned] * per_m)) / 2
        color_part = -np.expm1(self.color_error[thinned, thinned] * np.float32(-1 / settings.color_residual_scale))
        share = np.float32(settings.depth_residual_weight)
        return share * depth_part + (1 - share) * color_part


def view_residuals(
    rendered_rgb: np.ndarray, rendered_depth: np.ndarray, rendered_alpha: np.ndarray, rgb: np.ndarray,
    depth: np.ndarray, camera: Camera, T_world_camera: np.ndarray, query_sdf: QuerySdf | None = None,
) -> ViewResidual:
    """E_t^depth and E_t^rgb of one rendering.

    Args:
        rendered_rgb: (H, W, 3) float 0..1 as rendered.
        rendered_depth: (H, W) m, depth of what is there (already divided by alpha); any value where alpha is 0.
        rendered_alpha: (H, W) 0..1. Where the map is transparent it predicts nothing, and the missing share of the
            observed depth counts as depth error: a hole is as wrong as can be, not invisible.
        rgb: (H, W, 3) uint8 or float 0..1, observed. depth: (H, W) m, observed, 0 = invalid.
        camera, T_world_camera: of these images.
        query_sdf: the field, (N, 3) world points -> (N,) m; given, its error at the observed points is kept too.
    """
    depth = np.where(np.isfinite(depth) & (depth >= camera.near) & (depth <= camera.far), depth, 0)
    depth = depth.astype(np.float32)
    valid = depth > 0
    if rgb.dtype == np.uint8:
        rgb = rgb.astype(np.float32) * np.float32(1 / 255)
    alpha = np.clip(rendered_alpha, 0, 1)
    there = np.where(alpha > 0, np.abs(rendered_depth - depth), 0)
    depth_error = np.where(valid, alpha * there + (1 - alpha) * depth, 0).astype(np.float32)
    color_error = np.where(valid, np.abs(rendered_rgb - rgb).sum(axis=-1), 0).astype(np.float32)
    if not (np.isfinite(depth_error).all() and np.isfinite(color_error).all()):
        raise InputError("view residual: the rendering holds NaN or infinite values where depth is valid")
    sdf_error = None
    if query_sdf is not None:
        sdf_error = np.zeros(depth.shape, np.float32)
        points = projection.unproject(depth, T_world_camera, camera)[valid]
        sdf_error[valid] = np.abs(query_sdf(points.astype(np.float32)))
    return ViewResidual(camera, np.asarray(T_world_camera, np.float64), depth, depth_error, color_error, sdf_error)


def most_uncertain(
    grid: VoxelGrid, frames: Sequence[Frame], u_exp: np.ndarray, settings: UncertaintySettings
) -> list[int]:
    """Indices of C_high: the `top_k_views` frames that look at the largest mean u_exp, worst first; ties by order.

    The volume of the last round decides, so that only the chosen views have to be rendered.
    """
    means = []
    for frame in frames:
        c, pose = frame.camera, np.ascontiguousarray(frame.T_world_camera[:3], dtype=np.float64)
        means.append(kernels.mean_at_readings(
            frame.depth, (c.fx, c.fy, c.cx, c.cy), pose, CHOICE_STRIDE // 2, CHOICE_STRIDE, grid.origin,
            grid.voxel_size, u_exp,
        ))
    order = np.argsort(-np.asarray(means), kind="stable")
    return [int(i) for i in order[: settings.top_k_views]]


def backproject(
    grid: VoxelGrid, views: Sequence[ViewResidual], settings: UncertaintySettings
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals of `views` as a volume: P(E^depth, E^rgb; v), averaged over views (eq. view_uncertainty).

    Every valid pixel is lifted to its observed point and shared among the eight voxels around it with trilinear
    weights; a view's value in a voxel is the weighted mean. The mean over views takes those that saw the voxel:
    dividing by |C_high| instead would call a bad surface good because few views look at it. The paper's form is
    residual x coverage.

    Returns:
        residual: float32 [X, Y, Z] in 0..1, 0 where no view looked.
        coverage: float32 [X, Y, Z], share of the views that saw the voxel.
    """
    total, seen = _summed(grid, views, settings)
    count = seen.sum(0).astype(np.float32)
    residual = total.sum(0) / np.maximum(count, 1)
    return residual, count / np.float32(max(len(views), 1))


def _summed(
    grid: VoxelGrid, views: Sequence[ViewResidual], settings: UncertaintySettings
) -> tuple[np.ndarray, np.ndarray]:
    """Sums over views of residuals, float32, and of the views that saw a voxel, int32; (CHUNKS, X, Y, Z)."""
    total = np.zeros((kernels.CHUNKS, *grid.shape), np.float32)
    seen = np.zeros((kernels.CHUNKS, *grid.shape), np.int32)
    s = settings.residual_stride
    thinned = slice(s // 2, None, s)
    for group in by_image_size(views):
        kernels.backproject_views(
            np.stack([v.normalised(settings, thinned) for v in group]),
            np.stack([v.depth[thinned, thinned] for v in group]), intrinsics([v.camera for v in group]),
            np.stack([v.T_world_camera for v in group])[:, :3].astype(np.float64), s // 2, s,
            grid.origin, 1 / grid.voxel_size, np.float32(MIN_WEIGHT), total, seen,
        )
    return total, seen


def explicit_uncertainty(
    grid: VoxelGrid, views: Sequence[ViewResidual], previous: np.ndarray | None, settings: UncertaintySettings
) -> np.ndarray:
    """u_exp before masking: a running mean over the views that saw a voxel, float32 [X, Y, Z] in 0..1.

    One view's residual in a voxel is noisy (few pixels, one angle), so the mean is taken over the neighbourhood
    (`residual_blur_voxels`) and over rounds: `residual_memory` is the number of views that the last value counts for.
    Where no view looked, the value of the last round stays; it is 0 where no view ever looked.

    Args:
        views: renderings of this round's map at observed poses. previous: u_exp of the last round, or None.
    """
    before = np.zeros(grid.shape, np.float32) if previous is None else previous
    if not views:
        return before.copy()
    out = np.empty(grid.shape, np.float32)
    kernels.running_mean(
        *_summed(grid, views, settings), blur_taps(settings.residual_blur_voxels), np.float32(MIN_VIEWS),
        np.float32(settings.residual_memory), before, out,
    )
    return out


def blur_taps(sigma: float) -> np.ndarray:
    """(2 r + 1,) float32 weights of a Gaussian blur along one axis; sigma in voxels, 0: none."""
    r = int(BLUR_REACH * sigma + 0.5)
    weights = np.exp(-0.5 * (np.arange(-r, r + 1) / max(sigma, 1e-6)) ** 2)
    return (weights / weights.sum()).astype(np.float32)
