"""Rendering of the field and the losses of the implicit branch (paper, appendix).

SDF values and sigmas are in truncation units unless said otherwise; depths are in metres. Means run over what
a mask selects; an empty selection gives zero.
"""

import torch


def masked_mean(values: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """Mean of `values` where `mask`; 0 when it selects nothing. Shapes are equal."""
    weight = mask.to(values.dtype)
    return (values * weight).sum() / weight.sum().clamp(min=1)


def render_weights(sdf: torch.Tensor, depths: torch.Tensor, bell: float, truncation_m: float) -> torch.Tensor:
    """(R, S) weights of the samples of a ray: w ~ sigmoid(s / bell) sigmoid(-s / bell), summing to 1.

    Everything deeper than the truncation behind the first change of sign is cut, so that surfaces behind
    the first one have no weight; a ray without a change of sign keeps all samples.

    Args:
        sdf: (R, S) truncation units, samples in the order of depth.
        depths: (R, S) m, ascending.
        bell: width of the bell, truncation units.
        truncation_m: truncation, m.
    """
    x = sdf / bell
    weights = torch.sigmoid(x) * torch.sigmoid(-x)
    with torch.no_grad():
        change = (sdf[:, 1:] * sdf[:, :-1]) < 0
        has_change = change.any(dim=1, keepdim=True)
        first = change.to(torch.uint8).argmax(dim=1, keepdim=True)
        limit = depths.gather(1, first) + truncation_m
        keep = (depths < limit) | ~has_change
    weights = weights * keep
    return weights / (weights.sum(dim=1, keepdim=True) + 1e-8)


def rgb_loss(rendered: torch.Tensor, observed: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """Mean squared colour error over valid rays; (R, 3), (R, 3), (R,) bool."""
    return masked_mean((rendered - observed).square().mean(dim=1), valid)


def depth_loss(rendered: torch.Tensor, observed: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """Mean squared error of rendered depth, m2; all (R,)."""
    return masked_mean((rendered - observed).square(), valid)


def sdf_loss(
    sdf: torch.Tensor, target: torch.Tensor, mask: torch.Tensor, truncation_m: float
) -> torch.Tensor:
    """Mean squared SDF error within the truncation band, m2; (R, S) each, targets d* - z in truncation units."""
    return masked_mean((sdf - target).square(), mask) * truncation_m**2


def surface_loss(sdf: torch.Tensor, truncation_m: float) -> torch.Tensor:
    """Mean squared SDF of points on the surface, m2; (N,). Zero without any."""
    return sdf.square().mean() * truncation_m**2 if len(sdf) else sdf.sum()


def free_space_loss(sdf: torch.Tensor, target: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """Mean squared difference to the truncated distance in front of the band; (R, F) each."""
    return masked_mean((sdf - target).square(), mask)


def uncertainty_loss(residual: torch.Tensor, variance: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """Negative log-likelihood e^2 / (2 var) + 1/2 log var of residuals under the predicted variance.

    Residuals and standard deviations in truncation units; residuals are cut at one. The residual is a constant
    here: it teaches the variance, and the variance does not reweight the geometry. Every term is weighted by its
    own standard deviation, taken as a constant (beta-NLL with beta = 1/2, Seitzer et al. 2022). The minimum stays where
    it was, but an outlier under a small variance no longer moves the shared decoder hundreds of times
    farther than all other samples, which kept sigma high in space that had long been seen.
    """
    squared = residual.detach().clamp(-1, 1).square()
    likelihood = squared / (2 * variance) + 0.5 * variance.log()
    return masked_mean(variance.detach().sqrt() * likelihood, mask)


def prior_loss(sigma: torch.Tensor, prior: float, unseen: torch.Tensor) -> torch.Tensor:
    """Holds sigma (N,) at its prior where `unseen` (N,): mean squared logarithm of the ratio."""
    return masked_mean((sigma / prior).log().square(), unseen)


def smoothness_loss(sdf_a: torch.Tensor, sdf_b: torch.Tensor) -> torch.Tensor:
    """Mean squared SDF difference of neighbouring points; (N,) each."""
    return (sdf_a - sdf_b).square().mean() if len(sdf_a) else sdf_a.sum()
