"""The rasteriser, slow and obvious: every Gaussian at every pixel, torch float64 with autograd.

The kernels are tested against it for values and gradients.
"""

import numpy as np
import torch
from torch import Tensor

from active3d_pipe.geometry import se3
from active3d_pipe.structures import Camera

ALPHA_MAX = 0.99
ALPHA_MIN = 1 / 255
SIGHT_LIMIT_M = 0.3


def rotation_matrices(quats: Tensor) -> Tensor:
    """(N, 3, 3) rotation matrices of quaternions (N, 4) wxyz, normalised first."""
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(r, 1) for r in rows], 1)


def render_reference(
    values: Tensor,
    camera: Camera,
    T_world_camera: np.ndarray,
    *,
    dilation_px2: float = 0.1,
    compensate: bool = True,
    near_m: float = 0.05,
    frustum_clamp: float = 1.3,
    seen: np.ndarray | None = None,
) -> tuple[Tensor, Tensor]:
    """Blend all Gaussians `values` (N, 14) (columns as in kernels_projection) front to back.

    Returns:
        (5, H, W) r, g, b, sum w z, alpha, with an observed depth `seen` (H, W) also a sixth plane, sum w
        min(|z - seen|, SIGHT_LIMIT_M); and (H, W) bool, the pixels near a discontinuity of the model (a
        primitive's alpha about 1/255 or 0.99, two depths about equal), where float32 may fall on the other side.
    """
    T = torch.as_tensor(se3.inverse(T_world_camera), dtype=values.dtype)
    points = values[:, :3] @ T[:3, :3].T + T[:3, 3]
    front = torch.argsort(points[:, 2].detach(), stable=True)
    front = front[points[front, 2] > near_m]
    values, points = values[front], points[front]
    x, y, z = points.unbind(1)
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy

    lim_x = frustum_clamp * max(camera.cx, camera.width - camera.cx) / camera.fx
    lim_y = frustum_clamp * max(camera.cy, camera.height - camera.cy) / camera.fy
    xc, yc = (x / z).clamp(-lim_x, lim_x), (y / z).clamp(-lim_y, lim_y)
    zero = torch.zeros_like(z)
    J = torch.stack([
        torch.stack([camera.fx / z, zero, -camera.fx * xc / z], 1),
        torch.stack([zero, camera.fy / z, -camera.fy * yc / z], 1),
    ], 1)
    V = J @ T[:3, :3] @ rotation_matrices(values[:, 6:10]) @ torch.diag_embed(values[:, 3:6].exp())
    S0 = V @ V.mT
    S = S0 + dilation_px2 * torch.eye(2, dtype=values.dtype)
    opacity = values[:, 10].sigmoid()
    if compensate:
        opacity = opacity * (torch.linalg.det(S0).clamp_min(1e-300) / torch.linalg.det(S)).sqrt()
    K = torch.linalg.inv(S)

    rows, columns = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    dx = columns.to(values) + 0.5 - u[:, None, None]
    dy = rows.to(values) + 0.5 - v[:, None, None]
    a, b, c = K[:, 0, 0, None, None], K[:, 0, 1, None, None], K[:, 1, 1, None, None]
    raw = opacity[:, None, None] * torch.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))
    alpha = torch.where(raw >= ALPHA_MIN, raw.clamp_max(ALPHA_MAX), torch.zeros_like(raw))
    behind = torch.cumprod(torch.cat([torch.ones_like(alpha[:1]), 1 - alpha]), 0)
    weight = alpha * behind[:-1]
    channels = torch.cat([values[:, 11:14], z[:, None], torch.ones_like(z)[:, None]], 1)
    image = torch.einsum("nhw,nc->chw", weight, channels)
    if seen is not None:
        off = (z[:, None, None] - torch.as_tensor(seen, dtype=values.dtype)).abs().clamp_max(SIGHT_LIMIT_M)
        image = torch.cat([image, (weight * off).sum(0, keepdim=True)])

    near_step = ((raw / ALPHA_MIN - 1).abs() < 1e-3) | ((raw / ALPHA_MAX - 1).abs() < 1e-4)
    doubtful = near_step.any(0)
    if len(z) > 1:
        tie = (z[1:] - z[:-1]) < 1e-6 * z[1:]
        doubtful |= ((raw[1:] > 0.5 * ALPHA_MIN) & (raw[:-1] > 0.5 * ALPHA_MIN) & tie[:, None, None]).any(0)
    return image, doubtful.detach()
