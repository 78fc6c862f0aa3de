"""How well an uncertainty predicts realised error: sparsification, AUSE, rank correlation, reliability."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import rankdata

from active3d_pipe.errors import InputError


def _pair(uncertainty: np.ndarray, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    u, e = np.asarray(uncertainty, np.float64).ravel(), np.asarray(error, np.float64).ravel()
    if u.shape != e.shape or u.size == 0:
        raise InputError(f"calibration: {u.size} uncertainties and {e.size} errors, expected as many, at least one")
    if not (np.isfinite(u).all() and np.isfinite(e).all() and (e >= 0).all()):
        raise InputError("calibration: expected finite uncertainties and finite errors that are not negative")
    return u, e


def _removed_order(key: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Errors sorted by falling key; items with equal keys share their mean error, so their order does not matter."""
    _, group = np.unique(key, return_inverse=True)
    mean = np.bincount(group, weights=error) / np.bincount(group)
    return mean[np.sort(group)[::-1]]


def sparsification(
    uncertainty: np.ndarray, error: np.ndarray, fractions: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean error of what is left when the most uncertain share is removed (Ilg et al. 2018).

    Args:
        uncertainty, error: same number of items; error >= 0.
        fractions: shares to remove, in [0, 1); 0, 0.01 ... 0.99 by default.

    Returns:
        fractions; the curve; the oracle's curve (removal by the error itself). Both curves are divided by the mean
        error, so they start at 1; all 0 when there is no error at all.
    """
    u, e = _pair(uncertainty, error)
    fractions = np.arange(100) / 100 if fractions is None else np.asarray(fractions, np.float64)
    if ((fractions < 0) | (fractions >= 1)).any():
        raise InputError("sparsification: expected fractions in [0, 1)")
    kept_from = np.minimum((fractions * len(e)).astype(np.int64), len(e) - 1)
    curves = []
    for key in (u, e):
        tail = np.cumsum(_removed_order(key, e)[::-1])[::-1]
        curve = tail[kept_from] / (len(e) - kept_from)
        curves.append(curve / e.mean() if e.mean() > 0 else np.zeros_like(curve))
    return fractions, curves[0], curves[1]


def ause(uncertainty: np.ndarray, error: np.ndarray) -> float:
    """Area under the sparsification error: curve minus oracle, >= 0, 0 = the order of the errors is predicted."""
    fractions, curve, oracle = sparsification(uncertainty, error)
    return float(np.trapezoid(np.maximum(curve - oracle, 0), fractions))


def rank_correlation(uncertainty: np.ndarray, error: np.ndarray) -> float:
    """Spearman's rank correlation in [-1, 1], ties by mean rank; 0 when either side is constant."""
    u, e = _pair(uncertainty, error)
    ru, re = rankdata(u), rankdata(e)
    ru, re = ru - ru.mean(), re - re.mean()
    norm = np.sqrt((ru * ru).sum() * (re * re).sum())
    return float((ru * re).sum() / norm) if norm > 0 else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Reliability:
    """Bins of equal count along the uncertainty; all arrays (B,).

    Attributes:
        uncertainty, error: mean of each within the bin.
        spread: standard deviation of the error within the bin.
        count: number of items.
    """

    uncertainty: np.ndarray
    error: np.ndarray
    spread: np.ndarray
    count: np.ndarray

    @property
    def calibration_error(self) -> float:
        """Mean |predicted - realised| over bins, weighted by count (expected calibration error)."""
        return float((np.abs(self.uncertainty - self.error) * self.count).sum() / self.count.sum())


def reliability(uncertainty: np.ndarray, error: np.ndarray, bins: int = 10) -> Reliability:
    """Predicted against realised error in bins of (nearly) equal count; equal uncertainties stay in one bin."""
    u, e = _pair(uncertainty, error)
    edges = np.unique(np.quantile(u, np.linspace(0, 1, bins + 1)[1:-1]))
    _, group = np.unique(np.searchsorted(edges, u, side="left"), return_inverse=True)
    count = np.bincount(group)
    mean_u, mean_e = np.bincount(group, weights=u) / count, np.bincount(group, weights=e) / count
    variance = np.bincount(group, weights=(e - mean_e[group]) ** 2) / count
    return Reliability(mean_u, mean_e, np.sqrt(variance), count)
