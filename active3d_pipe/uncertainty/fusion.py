"""Fusion weights by evidence maximisation (eq. final_uncertainty).

Each surface voxel that new frames reveal gives a row x = (u_imp, u_exp, u_time) of the volume *before* the frames,
and a target y: the residual of the previous map's prediction of those frames. Bayesian linear regression with
automatic relevance determination (MacKay 1992; Tipping 2001) on running sufficient statistics:
y = x . alpha + noise, noise ~ N(0, 1/b), alpha_i ~ N(0, 1/g_i); g and b maximise the evidence p(y | g, b).
Weights must not be negative, so the model is chosen among all subsets of terms whose posterior means are
non-negative, by its evidence: with three terms all seven are tried, and relevance 1/g_i = 0 is an exact zero.
"""

import math
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from active3d_pipe.errors import InputError
from active3d_pipe.uncertainty.config import UncertaintySettings

TERMS = ("imp", "exp", "time")


@dataclass(frozen=True, slots=True, eq=False)
class FusionStatistics:
    """Sufficient statistics of the rows so far: X^T X (3, 3), X^T y (3,), y^T y, number of rows (all discounted)."""

    xtx: np.ndarray
    xty: np.ndarray
    yty: float
    n: float

    @classmethod
    def empty(cls) -> "FusionStatistics":
        """No rows so far."""
        return cls(np.zeros((3, 3)), np.zeros(3), 0.0, 0.0)

    def updated(self, rows: np.ndarray, targets: np.ndarray, forgetting: float) -> "FusionStatistics":
        """Statistics after one round: the old ones count `forgetting` times as much; rows (N, 3), targets (N,)."""
        x, y = np.asarray(rows, np.float64), np.asarray(targets, np.float64)
        if x.ndim != 2 or x.shape[1] != 3 or y.shape != (len(x),):
            raise InputError(f"fusion: rows {x.shape} and targets {y.shape}, expected (N, 3) and (N,)")
        xtx = np.array([[(x[:, i] * x[:, j]).sum() for j in range(3)] for i in range(3)])
        xty = np.array([(x[:, i] * y).sum() for i in range(3)])
        f = forgetting
        return FusionStatistics(
            f * self.xtx + xtx, f * self.xty + xty, f * self.yty + float((y * y).sum()), f * self.n + len(x)
        )

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values; inverse of `from_json`."""
        return {"xtx": self.xtx.tolist(), "xty": self.xty.tolist(), "yty": self.yty, "n": self.n}

    @classmethod
    def from_json(cls, doc: dict[str, Any]) -> "FusionStatistics":
        """Inverse of `to_json`; raises InputError on a document of another form."""
        try:
            xtx, xty = np.array(doc["xtx"], np.float64), np.array(doc["xty"], np.float64)
            statistics = cls(xtx, xty, float(doc["yty"]), float(doc["n"]))
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"fusion statistics: {error!r}; expected xtx (3, 3), xty (3,), yty, n") from error
        if xtx.shape != (3, 3) or xty.shape != (3,):
            raise InputError(f"fusion statistics: xtx {xtx.shape}, xty {xty.shape}; expected (3, 3) and (3,)")
        return statistics


@dataclass(frozen=True, slots=True, eq=False)
class Fusion:
    """Weights of the three terms and what the regression found.

    Attributes:
        alphas: (3,) non-negative weights of u_imp, u_exp, u_time.
        evidence: log marginal likelihood of all rows so far; 0 before there are enough.
        noise: standard deviation of the residual around the fused prediction; 1 before there are enough rows.
        source: "evidence", or "equal" when the weights are the default ones.
    """

    alphas: np.ndarray
    evidence: float
    noise: float
    source: str

    def to_json(self, statistics: FusionStatistics, rows: int) -> dict[str, Any]:
        """The `fusion` entry of an UncertaintyVolume, plain JSON values."""
        return {
            "terms": list(TERMS), "alphas": self.alphas.tolist(), "evidence": self.evidence, "noise": self.noise,
            "source": self.source, "rows": rows, "statistics": statistics.to_json(),
        }


def log_evidence(s: FusionStatistics, g: np.ndarray, b: float) -> tuple[float, np.ndarray, np.ndarray]:
    """Log marginal likelihood of y under prior precisions g (d,) and noise precision b; posterior mean, covariance."""
    covariance = np.linalg.inv(np.diag(g) + b * s.xtx)
    mean = b * covariance @ s.xty
    error = max(s.yty - 2 * mean @ s.xty + mean @ s.xtx @ mean, 0.0)
    value = 0.5 * (
        np.log(g).sum() + s.n * math.log(b) - b * error - (g * mean * mean).sum()
        + np.linalg.slogdet(covariance)[1] - s.n * math.log(2 * math.pi)
    )
    return float(value), mean, covariance


def maximise_evidence(
    s: FusionStatistics, iterations: int = 200, tolerance: float = 1e-7
) -> tuple[float, np.ndarray, float]:
    """(log evidence, posterior mean (d,), noise precision) at the fixed point of MacKay's updates."""
    d = len(s.xty)
    g, b = np.ones(d), s.n / max(s.yty, 1e-12)
    value, mean, covariance = log_evidence(s, g, b)
    for _ in range(iterations):
        determined = np.clip(1 - g * np.diag(covariance), 1e-9, 1)
        g = np.clip(determined / np.maximum(mean * mean, 1e-12), 1e-6, 1e9)
        error = s.yty - 2 * mean @ s.xty + mean @ s.xtx @ mean
        # The floor keeps a noiseless fit finite: residuals live in 0..1, and 1e-4 of that is beyond measurement.
        b = max(s.n - determined.sum(), 1e-3) / max(error, 1e-8 * max(s.n, 1))
        last = value
        value, mean, covariance = log_evidence(s, g, b)
        if abs(value - last) <= tolerance * (1 + abs(last)):
            break
    return value, mean, b


def fuse(statistics: FusionStatistics, settings: UncertaintySettings) -> Fusion:
    """The weights alpha_1..3 that the statistics support best; equal weights while there are too few rows.

    Terms that carry no variation, or whose weight would be negative, get exactly 0.
    """
    active = [i for i, name in enumerate(TERMS) if name in settings.terms]
    equal = np.zeros(3)
    equal[active] = 1 / len(active)
    if settings.fusion == "equal" or statistics.n < settings.fusion_min_rows or statistics.yty <= 0:
        return Fusion(equal, 0.0, 1.0, "equal")
    best: Fusion | None = None
    # A term that never left zero tells nothing.
    useful = [i for i in active if statistics.xtx[i, i] > 1e-9 * statistics.n]
    for size in range(1, len(useful) + 1):
        for subset in combinations(useful, size):
            idx = list(subset)
            part = replace(statistics, xtx=statistics.xtx[np.ix_(idx, idx)], xty=statistics.xty[idx])
            value, mean, b = maximise_evidence(part)
            # Of two models with the same evidence the smaller one stays: it came first.
            if (mean > 0).all() and (best is None or value > best.evidence + 1e-6):
                alphas = np.zeros(3)
                alphas[idx] = mean
                best = Fusion(alphas, value, float(1 / math.sqrt(b)), "evidence")
    return best if best is not None else Fusion(equal, 0.0, 1.0, "equal")
