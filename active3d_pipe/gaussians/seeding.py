"""New Gaussians from RGB-D frames: an octree per frame for new surface, single discs where the error is large."""

from dataclasses import dataclass

import numpy as np

from active3d_pipe.errors import InputError
from active3d_pipe.gaussians import kernels_seeding
from active3d_pipe.gaussians.config import GaussianSettings
from active3d_pipe.gaussians.rasteriser import RenderedView
from active3d_pipe.structures import Camera, GaussianModel, check_pose


@dataclass(frozen=True, slots=True, eq=False)
class FrameSurface:
    """The surface that a depth image shows.

    Attributes:
        points, normals: (H, W, 3) float32 world, m; normals towards the camera.
        footprint: (H, W) float32 m, side of the square that a pixel covers on the surface; 0 = no depth.
        edge: (H, W) bool, depth edges and creases.
    """

    points: np.ndarray
    normals: np.ndarray
    footprint: np.ndarray
    edge: np.ndarray


def frame_surface(
    depth: np.ndarray, camera: Camera, T_world_camera: np.ndarray, depth_edge_ratio: float = 0.03
) -> FrameSurface:
    """Points, normals, footprints and depth edges of a z-depth image (H, W) float32, m, 0 = invalid."""
    if depth.shape != (camera.height, camera.width) or depth.dtype != np.float32:
        raise InputError(
            f"frame surface: depth is {depth.shape} {depth.dtype}, expected {(camera.height, camera.width)} float32"
        )
    T = check_pose(T_world_camera, "frame surface: T_world_camera").astype(np.float32)
    shape = depth.shape
    points, normals = np.zeros((*shape, 3), np.float32), np.zeros((*shape, 3), np.float32)
    footprint, edge = np.zeros(shape, np.float32), np.zeros(shape, bool)
    fx, fy, cx, cy = (np.float32(v) for v in (camera.fx, camera.fy, camera.cx, camera.cy))
    kernels_seeding.surface(
        np.ascontiguousarray(depth), fx, fy, cx, cy,
        np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3]), np.float32(depth_edge_ratio),
        points, normals, footprint, edge,
    )
    return FrameSurface(points, normals, footprint, edge)


def seed_frame(
    rgb: np.ndarray,
    depth: np.ndarray,
    camera: Camera,
    T_world_camera: np.ndarray,
    rendered: RenderedView | None,
    settings: GaussianSettings,
    max_new: int,
    rng: np.random.Generator,
) -> GaussianModel:
    """Discs for the surface of a frame that the model does not show yet.

    Pixels count where the rendered alpha is thin, or where the observed surface lies in front of the rendered
    one (`seed_front_*`, or SplaTAM's rule with `seed_depth_error_factor`). World-aligned octree cells split where
    colour, normals or a depth edge demand it, not below the pixel footprint; every leaf becomes one disc with the mean
    position, normal and colour of its pixels. With `seed_method` "pixels" every n-th pixel becomes a disc instead.

    Args:
        rgb, depth: (H, W, 3) float32 0..1, (H, W) float32 m, 0 = invalid.
        camera, T_world_camera: of the frame.
        rendered: what the model shows from there; None = nothing.
        settings: `seed_*`.
        max_new: most discs to return. When there are more leaves the colour and normal criteria are relaxed;
            if that does not suffice, `rng` chooses among the leaves.
        rng: generator.
    """
    scene = frame_surface(depth, camera, T_world_camera, settings.depth_edge_ratio)
    wanted = depth > 0
    if rendered is not None:
        wanted &= (rendered.alpha < settings.seed_alpha) | _in_front(depth, rendered, settings)
    if max_new < 1 or not wanted.any():
        return GaussianModel.empty()
    if settings.seed_method == "pixels":
        return _pixel_seeds(rgb, depth, camera, scene, wanted, settings, max_new, rng)
    points = scene.points[wanted]
    keys = np.empty(len(points), np.uint64)
    kernels_seeding.morton_keys(points, settings.seed_cell_m / 2 ** (settings.seed_levels - 1), keys)
    order = np.argsort(keys, kind="stable")
    leaves = np.empty((len(points), kernels_seeding.LEAF_WIDTH), np.float32)
    for relax in (1, 2, 4, 8):
        found = kernels_seeding.octree_leaves(
            keys, order, points, scene.normals[wanted], np.ascontiguousarray(rgb[wanted], dtype=np.float32),
            scene.footprint[wanted], scene.edge[wanted], settings.seed_levels, settings.seed_cell_m,
            settings.seed_color_spread * relax, 1 - (1 - settings.seed_normal_cos) * relax, leaves,
        )
        if found <= max_new:
            break
    leaves = leaves[:found]
    if found > max_new:
        leaves = leaves[np.sort(rng.choice(found, max_new, replace=False))]
    sigma = settings.seed_sigma_factor * np.maximum(leaves[:, 9], leaves[:, 10])
    return discs(leaves[:, :3], leaves[:, 3:6], leaves[:, 6:9], sigma, flatness(settings), settings.seed_opacity)


def flatness(settings: GaussianSettings) -> float:
    """Sigma of a new disc along its normal, relative to that in its plane."""
    return 1.0 if settings.isotropic else settings.seed_flatness


def _in_front(depth: np.ndarray, rendered: RenderedView, settings: GaussianSettings) -> np.ndarray:
    """(H, W) bool, pixels whose observed surface lies in front of the rendered one."""
    shown = (rendered.depth > 0) & (depth > 0)
    if settings.seed_depth_error_factor > 0:
        error = np.abs(rendered.depth - depth)
        median = np.median(error[shown]) if shown.any() else 0.0
        return shown & (rendered.depth > depth) & (error > settings.seed_depth_error_factor * median)
    gap = settings.seed_front_m + settings.seed_front_ratio * depth
    return shown & (depth < rendered.depth - gap)


def _pixel_seeds(
    rgb: np.ndarray, depth: np.ndarray, camera: Camera, scene: FrameSurface, wanted: np.ndarray,
    settings: GaussianSettings, max_new: int, rng: np.random.Generator,
) -> GaussianModel:
    """One disc for every `seed_stride`-th wanted pixel in x and y, as wide as the pixel spacing at its depth."""
    stride = settings.seed_stride
    lattice = np.zeros_like(wanted)
    lattice[stride // 2 :: stride, stride // 2 :: stride] = True
    chosen = np.flatnonzero(wanted & lattice)
    if len(chosen) > max_new:
        chosen = np.sort(rng.choice(chosen, max_new, replace=False))
    sigma = settings.seed_sigma_factor * stride * depth.ravel()[chosen] / camera.fx
    points, normals, colors = (a.reshape(-1, 3)[chosen] for a in (scene.points, scene.normals, rgb))
    return discs(points, normals, colors, sigma, flatness(settings), settings.seed_opacity)


def error_driven(
    rgb: np.ndarray,
    depth: np.ndarray,
    camera: Camera,
    T_world_camera: np.ndarray,
    rendered: RenderedView,
    settings: GaussianSettings,
    max_new: int,
    rng: np.random.Generator,
) -> GaussianModel:
    """Up to `max_new` pixel-sized discs on the observed surface, drawn where the rendered frame is wrong.

    Candidates have a mean colour error above `add_color_error` or a depth error above `add_depth_error_m`; they
    are drawn without replacement with probability proportional to their error (Efraimidis & Spirakis 2006).
    Arguments as in `seed_frame`.
    """
    color_error = np.abs(rendered.rgb - rgb).mean(axis=2)
    depth_error = np.abs(rendered.depth - depth)
    wanted = (depth > 0) & (
        (color_error > settings.add_color_error) | (depth_error > settings.add_depth_error_m)
    )
    candidates = np.flatnonzero(wanted)
    if max_new < 1 or len(candidates) == 0:
        return GaussianModel.empty()
    if len(candidates) > max_new:
        weight = color_error.ravel()[candidates] / settings.add_color_error
        weight += np.minimum(depth_error.ravel()[candidates] / settings.add_depth_error_m, 2.0)
        ticket = np.log(1 - rng.random(len(candidates))) / weight
        candidates = np.sort(candidates[np.argpartition(-ticket, max_new)[:max_new]])
    scene = frame_surface(depth, camera, T_world_camera, settings.depth_edge_ratio)
    sigma = settings.add_sigma_px * scene.footprint.ravel()[candidates]
    return discs(
        scene.points.reshape(-1, 3)[candidates], scene.normals.reshape(-1, 3)[candidates],
        rgb.reshape(-1, 3)[candidates], sigma, flatness(settings), settings.add_opacity,
    )


def discs(
    means: np.ndarray, normals: np.ndarray, colors: np.ndarray, sigma: np.ndarray, flatness: float, opacity: float
) -> GaussianModel:
    """Flat Gaussians: means, normals, colors (N, 3), in-plane `sigma` (N,) m, sigma * flatness along the normal.

    Normals need not have unit length; a zero normal gives a disc facing up.
    """
    n = len(means)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    unit = np.where(length > 1e-6, normals / np.maximum(length, 1e-6), [0.0, 0.0, 1.0])
    # Shortest rotation that takes the local z axis to the normal; half a turn about x when they are opposite.
    quats = np.stack([1 + unit[:, 2], -unit[:, 1], unit[:, 0], np.zeros(n)], axis=1)
    size = np.linalg.norm(quats, axis=1, keepdims=True)
    quats = np.where(size > 1e-3, quats / np.maximum(size, 1e-3), [0.0, 1.0, 0.0, 0.0])
    log_scales = np.log(np.maximum(sigma, 1e-5))[:, None] + np.log([1.0, 1.0, flatness])
    logits = np.full(n, np.log(opacity / (1 - opacity)))
    arrays = (means, log_scales, quats, logits, colors)
    return GaussianModel(*(np.ascontiguousarray(a, dtype=np.float32) for a in arrays))
