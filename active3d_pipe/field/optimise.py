"""One iteration of the implicit branch."""

from collections.abc import Callable
from time import perf_counter

import numpy as np
import torch

from active3d_pipe.errors import ArtifactError, NumericalError
from active3d_pipe.field import losses
from active3d_pipe.field.config import FieldSettings
from active3d_pipe.field.rays import RayBatch, points_on_rays, sample_depths
from active3d_pipe.field.sdf_field import SdfField

TABLES = ("planes", "color_planes", "grid")


class FieldOptimiser:
    """Adam over the field's tables and decoders, with its state as arrays."""

    def __init__(self, field: SdfField, settings: FieldSettings) -> None:
        self._names = [name for name, _ in field.named_parameters()]
        parameters = dict(field.named_parameters())
        self._parameters = parameters
        tables = [p for n, p in parameters.items() if n in TABLES]
        decoders = [p for n, p in parameters.items() if n not in TABLES]
        self._rates = (settings.rate_tables, settings.rate_decoders)
        self._adam = torch.optim.Adam(
            [{"params": tables, "lr": settings.rate_tables}, {"params": decoders, "lr": settings.rate_decoders}],
            betas=(settings.beta1, settings.beta2), eps=settings.adam_eps, fused=True,
        )

    def step(self, loss: torch.Tensor, rate: float = 1.0) -> None:
        """Back-propagate `loss` and update; `rate` scales both learning rates."""
        self._adam.zero_grad(set_to_none=True)
        loss.backward()
        for group, base in zip(self._adam.param_groups, self._rates, strict=True):
            group["lr"] = base * rate
        self._adam.step()

    def state(self) -> dict[str, np.ndarray]:
        """Moments and step counts as arrays (copies); empty before the first step."""
        out = {}
        for name, p in self._parameters.items():
            for key, value in self._adam.state.get(p, {}).items():
                out[f"{name}.{key}"] = value.detach().numpy().copy()
        return out

    def load_state(self, arrays: dict[str, np.ndarray]) -> None:
        """Inverse of `state`; ArtifactError when arrays are missing or have another form."""
        self._adam.state.clear()
        if not arrays:
            return
        for name, p in self._parameters.items():
            state = {}
            for key, shape in (("step", ()), ("exp_avg", p.shape), ("exp_avg_sq", p.shape)):
                value = arrays.get(f"{name}.{key}")
                if value is None or value.shape != tuple(shape) or value.dtype != np.float32:
                    got = "missing" if value is None else f"{value.shape} {value.dtype}"
                    raise ArtifactError(
                        f"field optimiser state: {name}.{key} is {got}, expected {tuple(shape)} float32"
                    )
                state[key] = torch.from_numpy(value.copy())
            self._adam.state[p] = state


def field_step(
    field: SdfField,
    optimiser: FieldOptimiser,
    batch: RayBatch,
    settings: FieldSettings,
    rng: np.random.Generator,
    rate: float = 1.0,
    timings: Callable[[str, float], None] | None = None,
    surface: np.ndarray | None = None,
) -> dict[str, float]:
    """One iteration on a batch of rays; changes `field` and `optimiser` in place.

    Args:
        field, optimiser: what is trained.
        batch: rays with observations (`rays.sample_rays`).
        settings: the field's settings.
        rng: draws sample depths and prior points.
        rate: factor on the learning rates (annealing).
        timings: called with (part, seconds) for the parts sample, forward, backward.
        surface: (N, 3) float32 points on the surface (`rays.surface_points`), world, m: the SDF is zero there.

    Returns:
        The unweighted losses by name and `total`; NumericalError when the total is not finite.
    """
    start = perf_counter()
    z_free, z_near = sample_depths(batch, settings, rng)
    prior = _prior_points(field, settings, rng)
    points_free, points_near = points_on_rays(batch, z_free), points_on_rays(batch, z_near)
    surface = np.zeros((0, 3), np.float32) if surface is None else surface
    points = np.concatenate([points_free, points_near, *prior, surface])
    inside = np.repeat(batch.valid, z_free.shape[1]), np.repeat(batch.valid, z_near.shape[1])
    field.count_visits(np.concatenate([points_free[inside[0]], points_near[inside[1]], surface]))
    sampled = perf_counter()

    terms = _losses(field, batch, settings, z_free, z_near, points, points_near, prior[0])
    weights = {
        "rgb": settings.weight_rgb, "depth": settings.weight_depth, "sdf": settings.weight_sdf,
        "surface": settings.weight_surface, "free": settings.weight_free,
        "uncertainty": settings.weight_uncertainty, "prior": settings.weight_prior,
        "smoothness": settings.weight_smoothness,
    }
    total = torch.stack([terms[name] * weight for name, weight in weights.items()]).sum()
    values = {name: term.item() for name, term in terms.items()} | {"total": total.item()}
    if not np.isfinite(values["total"]):
        raise NumericalError(f"field: the loss is not finite ({values}); lower the learning rates")
    forward = perf_counter()
    optimiser.step(total, rate)
    if timings is not None:
        timings("sample", sampled - start)
        timings("forward", forward - sampled)
        timings("backward", perf_counter() - forward)
    return values


def _prior_points(
    field: SdfField, settings: FieldSettings, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Uniform points of the box and, for each, a neighbour at the smoothness step along a random direction."""
    n = settings.prior_points
    a = (field.low + rng.random((n, 3), dtype=np.float32) * (field.high - field.low)).astype(np.float32)
    direction = rng.standard_normal((n, 3), dtype=np.float32)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True) + 1e-9
    return a, (a + np.float32(settings.smoothness_step_m) * direction).astype(np.float32)


def _losses(
    field: SdfField, batch: RayBatch, settings: FieldSettings, z_free: np.ndarray, z_near: np.ndarray,
    points: np.ndarray, points_near: np.ndarray, prior_points: np.ndarray,
) -> dict[str, torch.Tensor]:
    rays, free, near = len(batch), z_free.shape[1], z_near.shape[1]
    n_free, n_near, n_prior = rays * free, rays * near, len(prior_points)
    start = n_free + n_near
    band = settings.truncation_m
    g = field.geometry(points)
    on_surface, its_sigma = g.sdf[start + 2 * n_prior :], g.sigma[start + 2 * n_prior :]
    at = slice(n_free, n_free + n_near)
    color = field.color(points_near, g.oneblob[at], g.features[at]).view(rays, near, 3)

    def per_ray(values: torch.Tensor) -> torch.Tensor:
        return torch.cat([values[:n_free].view(rays, free), values[at].view(rays, near)], dim=1)

    sdf, sigma = per_ray(g.sdf), per_ray(g.sigma)
    depths = torch.from_numpy(np.concatenate([z_free, z_near], axis=1))
    observed, valid = torch.from_numpy(batch.depth), torch.from_numpy(batch.valid)
    gap = observed[:, None] - depths
    target = (gap * torch.from_numpy(batch.slope)[:, None] / band).clamp(-1, 1)
    mask = valid[:, None].expand_as(sdf)
    is_free = torch.zeros_like(mask)
    is_free[:, :free] = mask[:, :free]
    is_near = mask & ~is_free

    weights = losses.render_weights(sdf, depths, settings.bell_width_m / band, band)
    depth = (weights * depths).sum(dim=1)
    rendered = (weights[:, free:, None] * color).sum(dim=1)
    variance = (weights.detach().square() * sigma.square()).sum(dim=1) + (settings.sigma_floor_m / band) ** 2
    return {
        "rgb": losses.rgb_loss(rendered, torch.from_numpy(batch.color), valid),
        "depth": losses.depth_loss(depth, observed, valid),
        "sdf": losses.sdf_loss(sdf, target, is_near, band),
        "surface": losses.surface_loss(on_surface, band),
        "free": losses.free_space_loss(sdf, target, is_free),
        # The paper's term on rendered depth, and the same likelihood on the samples themselves: a ray
        # gives weight to the surface only, so that known free space would otherwise stay at its prior. And on the
        # readings, or sigma would not know how well they are met.
        "uncertainty": losses.uncertainty_loss((depth - observed) / band, variance, valid)
        + losses.uncertainty_loss(sdf - target, sigma.square(), mask)
        + losses.uncertainty_loss(on_surface, its_sigma.square(), torch.ones_like(on_surface, dtype=torch.bool)),
        "prior": losses.prior_loss(
            g.sigma[start : start + n_prior], settings.sigma_prior_m / band,
            torch.from_numpy(~field.visited(prior_points)),
        ),
        "smoothness": losses.smoothness_loss(
            g.sdf[start : start + n_prior], g.sdf[start + n_prior : start + 2 * n_prior]
        ),
    }
