"""Reference of the field benchmark: one iteration of the implicit branch in plain torch.

Same tables, decoders, samples and losses as `active3d_pipe.field`, but interpolation by `grid_sample`, gradients by
autograd throughout, Adam as torch has it.
"""

import math

import numpy as np
import torch
import torch.nn.functional as F

from active3d_pipe.field import losses
from active3d_pipe.field.config import FieldSettings
from active3d_pipe.field.rays import RayBatch, points_on_rays, sample_depths


class PlainField(torch.nn.Module):
    """Tri-planes, dense grid, OneBlob, three small decoders."""

    def __init__(self, low: np.ndarray, high: np.ndarray, s: FieldSettings) -> None:
        super().__init__()
        self.s = s
        self.low, self.extent = torch.from_numpy(low).float(), torch.from_numpy(high - low).float()

        def nodes(resolution: float) -> list[int]:
            return [max(math.ceil(float(e) / resolution - 1e-6) + 1, 2) for e in self.extent]

        def planes(resolutions: tuple[float, ...]) -> torch.nn.ParameterList:
            pairs = [(nodes(r)[a], nodes(r)[b]) for r in resolutions for a, b in ((0, 1), (0, 2), (1, 2))]
            return torch.nn.ParameterList([torch.randn(1, s.plane_channels, n, m) * 0.01 for n, m in pairs])

        self.planes, self.color_planes = planes(s.plane_resolutions_m), planes(s.color_plane_resolutions_m)
        self.grid = torch.nn.Parameter(torch.zeros(1, s.grid_channels, *nodes(s.grid_voxel_m)))
        blob, features = 3 * s.oneblob_bins, len(s.plane_resolutions_m) * s.plane_channels + s.grid_channels
        color = blob + s.geometry_features + len(s.color_plane_resolutions_m) * s.plane_channels

        def decoder(n: int, m: int) -> torch.nn.Sequential:
            return torch.nn.Sequential(torch.nn.Linear(n, s.hidden), torch.nn.ReLU(), torch.nn.Linear(s.hidden, m))

        self.geometry = decoder(blob + features, 1 + s.geometry_features)
        self.uncertainty, self.color = decoder(features, 1), decoder(color, 3)

    def _planes(self, tables: torch.nn.ParameterList, at: torch.Tensor) -> torch.Tensor:
        levels = []
        for first in range(0, len(tables), 3):
            total = 0
            for table, (a, b) in zip(tables[first : first + 3], ((0, 1), (0, 2), (1, 2))):
                # grid_sample takes (x, y) = (last, first) axis.
                total = total + F.grid_sample(table, at[None, None, :, [b, a]], align_corners=True)[0, :, 0].T
            levels.append(total)
        return torch.cat(levels, 1)

    def _blob(self, at: torch.Tensor) -> torch.Tensor:
        """Integral of a quartic kernel of one bin's width around the point over every bin."""
        n = self.s.oneblob_bins
        edges = torch.arange(n + 1) / n
        x = ((edges - (at[:, :, None] + 1) / 2) * n).clamp(-1, 1)
        cdf = 15 / 16 * (x - 2 / 3 * x**3 + x**5 / 5) + 0.5
        return (cdf[..., 1:] - cdf[..., :-1]).flatten(1)

    def forward(self, points: torch.Tensor, with_color: torch.Tensor | slice):
        """SDF, sigma (truncation units), and the colour of the chosen points."""
        at = (points - self.low) / self.extent * 2 - 1
        blob = self._blob(at)
        grid = F.grid_sample(self.grid, at[None, None, None][..., [2, 1, 0]], align_corners=True)[0, :, 0, 0].T
        features = torch.cat([self._planes(self.planes, at), grid], 1)
        decoded = self.geometry(torch.cat([blob, features], 1))
        sigma = F.softplus(self.uncertainty(features)[:, 0]) + self.s.sigma_floor_m / self.s.truncation_m
        planes = self._planes(self.color_planes, at[with_color])
        color = self.color(torch.cat([blob[with_color], decoded[with_color, 1:], planes], 1))
        return decoded[:, 0], sigma, torch.sigmoid(color)


def plain_step(
    field: PlainField, adam: torch.optim.Optimizer, batch: RayBatch, s: FieldSettings, rng: np.random.Generator
) -> float:
    """One iteration; returns the loss."""
    z_free, z_near = sample_depths(batch, s, rng)
    near_points = points_on_rays(batch, z_near)
    n_free, n_near, rays = z_free.size, z_near.size, len(batch)
    low, extent = field.low.numpy(), field.extent.numpy()
    prior = (low + rng.random((s.prior_points, 3), dtype=np.float32) * extent).astype(np.float32)
    step = rng.standard_normal(prior.shape, dtype=np.float32)
    pair = prior + np.float32(s.smoothness_step_m) * step / np.linalg.norm(step, axis=1, keepdims=True)
    every = np.concatenate([points_on_rays(batch, z_free), near_points, prior, pair])
    points = torch.from_numpy(every.astype(np.float32))
    at = slice(n_free, n_free + n_near)
    sdf_all, sigma_all, color = field(points, at)

    def per_ray(x: torch.Tensor) -> torch.Tensor:
        return torch.cat([x[:n_free].view(rays, -1), x[at].view(rays, -1)], 1)

    sdf, sigma = per_ray(sdf_all), per_ray(sigma_all)
    depths = torch.from_numpy(np.concatenate([z_free, z_near], 1))
    observed, valid = torch.from_numpy(batch.depth), torch.from_numpy(batch.valid)
    band = s.truncation_m
    target = ((observed[:, None] - depths) * torch.from_numpy(batch.slope)[:, None] / band).clamp(-1, 1)
    mask = valid[:, None].expand_as(sdf)
    is_free = mask & (torch.arange(sdf.shape[1]) < z_free.shape[1])
    weights = losses.render_weights(sdf, depths, s.bell_width_m / band, band)
    depth = (weights * depths).sum(1)
    rendered = (weights[:, z_free.shape[1] :, None] * color.view(rays, -1, 3)).sum(1)
    variance = (weights.detach() ** 2 * sigma**2).sum(1) + (s.sigma_floor_m / band) ** 2
    ends = n_free + n_near, n_free + n_near + s.prior_points
    loss = (
        s.weight_rgb * losses.rgb_loss(rendered, torch.from_numpy(batch.color), valid)
        + s.weight_depth * losses.depth_loss(depth, observed, valid)
        + s.weight_sdf * losses.sdf_loss(sdf, target, mask & ~is_free, band)
        + s.weight_free * losses.free_space_loss(sdf, target, is_free)
        + s.weight_uncertainty * losses.uncertainty_loss((depth - observed) / band, variance, valid)
        + s.weight_uncertainty * losses.uncertainty_loss(sdf - target, sigma**2, mask)
        + s.weight_prior * losses.prior_loss(
            sigma_all[ends[0] : ends[1]], s.sigma_prior_m / band, torch.ones(s.prior_points, dtype=torch.bool))
        + s.weight_smoothness * losses.smoothness_loss(sdf_all[ends[0] : ends[1]], sdf_all[ends[1] :])
    )
    adam.zero_grad(set_to_none=True)
    loss.backward()
    adam.step()
    return loss.item()
