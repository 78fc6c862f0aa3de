"""Reference of the rasteriser benchmark: Gaussians in plain torch, packed.

Every (primitive, pixel) pair that counts is one entry of flat lists, sorted by pixel and depth; projection, alphas and
blending are vectorised torch with autograd. Building the index of pairs needs no gradient and is left out of its time.
"""

import numpy as np
import torch
from numba import njit
from torch import Tensor

from active3d_pipe.gaussians.reference import ALPHA_MAX, ALPHA_MIN, rotation_matrices
from active3d_pipe.geometry import se3
from active3d_pipe.structures import Camera


def project(values: Tensor, camera: Camera, T_world_camera: np.ndarray, dilation: float, clamp: float = 1.3):
    """u, v, depth, conic (a, b, c) and compensated opacity of values (N, 14), differentiable."""
    T = torch.as_tensor(se3.inverse(T_world_camera), dtype=values.dtype)
    x, y, z = (values[:, :3] @ T[:3, :3].T + T[:3, 3]).unbind(1)
    lim_x = clamp * max(camera.cx, camera.width - camera.cx) / camera.fx
    lim_y = clamp * max(camera.cy, camera.height - camera.cy) / camera.fy
    xc, yc = (x / z).clamp(-lim_x, lim_x), (y / z).clamp(-lim_y, lim_y)
    zero = torch.zeros_like(z)
    J = torch.stack([
        torch.stack([camera.fx / z, zero, -camera.fx * xc / z], 1),
        torch.stack([zero, camera.fy / z, -camera.fy * yc / z], 1),
    ], 1)
    V = (J @ T[:3, :3] @ rotation_matrices(values[:, 6:10])) * values[:, 3:6].exp()[:, None]
    a0, b0, c0 = (V[:, 0] ** 2).sum(1), (V[:, 0] * V[:, 1]).sum(1), (V[:, 1] ** 2).sum(1)
    a, c = a0 + dilation, c0 + dilation
    det = a * c - b0 * b0
    opacity = values[:, 10].sigmoid() * ((a0 * c0 - b0 * b0).clamp_min(1e-20) / det).sqrt()
    return camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy, z, (c / det, -b0 / det, a / det), opacity


@njit(cache=True)
def _pairs(order, u, v, a, b, c, o, hx, hy, width, height, fill, starts, primitive, pixel):
    """Pairs in order of depth, until the pixel is opaque; counted, or filled in from `starts` on."""
    through = np.ones(width * height)
    count = np.zeros(width * height, np.int64)
    for k in order:
        for i in range(max(int(v[k] - hy[k]), 0), min(int(v[k] + hy[k]) + 1, height)):
            for j in range(max(int(u[k] - hx[k]), 0), min(int(u[k] + hx[k]) + 1, width)):
                at = i * width + j
                dx, dy = j + 0.5 - u[k], i + 0.5 - v[k]
                alpha = o[k] * np.exp(-0.5 * (a[k] * dx * dx + c[k] * dy * dy) - b[k] * dx * dy)
                if alpha < ALPHA_MIN or through[at] < 1e-4:
                    continue
                if fill:
                    primitive[starts[at] + count[at]] = k
                    pixel[starts[at] + count[at]] = at
                count[at] += 1
                through[at] *= 1 - min(alpha, ALPHA_MAX)
    return count


class PackedSplats:
    """One view of one model: the index of pairs, and the differentiable pass over it."""

    def __init__(self, values: Tensor, camera: Camera, T: np.ndarray, dilation: float = 0.1) -> None:
        self.camera, self.T, self.dilation = camera, T, dilation
        with torch.no_grad():
            u, v, z, (a, b, c), o = (
                tuple(y.numpy() for y in x) if isinstance(x, tuple) else x.numpy()
                for x in project(values, camera, T, dilation)
            )
        reach = np.sqrt(2 * np.log(np.maximum(o / ALPHA_MIN, 1)))
        det = a * c - b * b
        hx, hy = reach * np.sqrt(c / det), reach * np.sqrt(a / det)
        order = np.argsort(z, kind="stable")
        order = order[(z[order] > 0.05) & (o[order] > ALPHA_MIN)]
        none = np.zeros(0, np.int64)
        size = (camera.width, camera.height)
        counts = _pairs(order, u, v, a, b, c, o, hx, hy, *size, False, none, none, none)
        starts = np.concatenate([[0], np.cumsum(counts)])
        primitive, pixel = np.empty(starts[-1], np.int64), np.empty(starts[-1], np.int64)
        _pairs(order, u, v, a, b, c, o, hx, hy, *size, True, starts, primitive, pixel)
        used, local = np.unique(primitive, return_inverse=True)  # only what is visible is projected again
        self.used, self.primitive = torch.from_numpy(used), torch.from_numpy(local)
        self.pixel, self.first = torch.from_numpy(pixel), torch.from_numpy(starts[:-1])

    @property
    def pairs(self) -> int:
        """Number of (primitive, pixel) pairs."""
        return len(self.primitive)

    def __call__(self, values: Tensor) -> Tensor:
        """(5, H, W): r, g, b, sum w z, alpha."""
        visible = values[self.used]
        u, v, z, conic, o = project(visible, self.camera, self.T, self.dilation)
        width = self.camera.width
        table = torch.stack([u, v, *conic, o], 1)[self.primitive]
        dx = (self.pixel % width) + 0.5 - table[:, 0]
        dy = torch.div(self.pixel, width, rounding_mode="floor") + 0.5 - table[:, 1]
        power = -0.5 * (table[:, 2] * dx * dx + table[:, 4] * dy * dy) - table[:, 3] * dx * dy
        alpha = (table[:, 5] * power.exp()).clamp_max(ALPHA_MAX)
        log_through = torch.log1p(-alpha)
        # The running sum over all pixels needs more digits than one pixel's; its start is taken off again.
        running = torch.cumsum(log_through.double(), 0) - log_through
        weight = alpha * (running - running[self.first.clamp_max(self.pairs - 1)][self.pixel]).to(alpha.dtype).exp()
        channels = torch.cat([visible[:, 11:14], z[:, None], torch.ones_like(z)[:, None]], 1)
        image = torch.zeros(self.camera.width * self.camera.height, 5, dtype=values.dtype)
        image = image.index_add(0, self.pixel, weight[:, None] * channels[self.primitive])
        return image.T.reshape(5, self.camera.height, width)
