"""A box room with a box of furniture, seen by an ideal depth camera: everything about it is known in closed form."""

import numpy as np

from active3d_pipe.geometry import projection, se3
from active3d_pipe.structures import Camera, Frame, GaussianModel, VoxelGrid
from active3d_pipe.uncertainty.explicit import ViewResidual, view_residuals

SIZE = np.array([3.05, 2.45, 2.05])
BOX_LOW, BOX_HIGH = np.array([1.85, 0.85, 0.0]), np.array([2.45, 1.45, 0.95])
CAMERA = Camera.from_fov(80, 60, 90, far=10)


def room_grid(voxel_size=0.1):
    """Half a voxel of wall around the room, so that walls lie inside voxels and not between them."""
    return VoxelGrid.from_bounds(np.full(3, -0.15), SIZE + 0.15, voxel_size)


def trace(T, camera=CAMERA, box=True):
    """(H, W) float32 z-depth by ray / box intersection."""
    d = projection.pixel_rays(camera).astype(np.float64) @ T[:3, :3].T
    o = T[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(d > 0, (SIZE - o) / d, np.where(d < 0, -o / d, np.inf)).min(-1)
        if box:
            a, b = (BOX_LOW - o) / d, (BOX_HIGH - o) / d
            enter, leave = np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)
            t = np.where((enter <= leave) & (enter > 0), np.minimum(t, enter), t)
    return t.astype(np.float32)


def room_sdf(points, box=True):
    """Signed distance to the nearest surface, m, positive in free space."""
    inside = np.minimum(points, SIZE - points).min(-1)
    if not box:
        return inside.astype(np.float32)
    q = np.maximum(BOX_LOW - points, points - BOX_HIGH)
    outside = np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0)
    return np.minimum(inside, outside).astype(np.float32)


def field(points, sigma=0.02, box=True):
    """A field that knows the room: SDF saturates at the truncation distance."""
    sdf = np.clip(room_sdf(points, box), -0.1, 0.1)
    return sdf, np.full(len(points), sigma, np.float32)


def colour_image(T, camera=CAMERA):
    """A texture that depends on the surface point alone."""
    p = projection.unproject(trace(T, camera), T, camera)
    return (127 + 100 * np.sin(3 * p)).astype(np.uint8)


def pose(yaw_deg, position=(0.9, 1.1, 1.2), pitch_deg=-10.0):
    return se3.pose_from_yaw_pitch(np.asarray(position), np.radians(yaw_deg), np.radians(pitch_deg))


def frame(step, T, camera=CAMERA, box=True):
    return Frame(step, step * 100_000_000, camera, T, colour_image(T, camera), trace(T, camera, box))


def frames(yaws=(-30, 0, 30), first_step=0, box=True, **where):
    return [frame(first_step + i, pose(y, **where), box=box) for i, y in enumerate(yaws)]


def residual(f, depth_error=0.0, color_error=0.0, alpha=1.0) -> ViewResidual:
    """What a rendering that is off by the given amounts leaves behind."""
    rgb = f.rgb.astype(np.float32) / 255 + np.float32(color_error / 3)
    alpha = np.broadcast_to(np.float32(alpha), f.depth.shape)
    return view_residuals(rgb, f.depth + depth_error, alpha, f.rgb, f.depth, f.camera, f.T_world_camera)


def gaussians_on(points, scale=0.02, opacity_logit=4.0):
    n = len(points)
    a = np.float32
    return GaussianModel(
        np.asarray(points, a), np.full((n, 3), np.log(scale), a), np.tile(np.array([1, 0, 0, 0], a), (n, 1)),
        np.full(n, opacity_logit, a), np.zeros((n, 3), a),
    )
