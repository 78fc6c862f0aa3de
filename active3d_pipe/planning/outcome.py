"""What a decision promised and what came of it: predicted against realised entropy drop, branch by branch.

The prediction is Delta I of eq. nbv_eig over everything that the poses of the executed path will see, each voxel
once, at the best of the looks that it gets. The outcome is the drop of each branch's entropy from the volume of
the decision to the next one, over the voxels of which rays showed something new meanwhile. The ratio of both over the
past decisions corrects the next prediction.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from active3d_pipe.geometry.voxel_traversal import fan_stride, ray_fan
from active3d_pipe.planning import kernels_reward as kernels
from active3d_pipe.planning.reward import RewardField
from active3d_pipe.structures.camera import Camera
from active3d_pipe.structures.decision import Decision
from active3d_pipe.structures.uncertainty_volume import UncertaintyVolume

BRANCHES = ("imp", "exp")
# Share of the past that a decision keeps when the correction is formed: some ten decisions count.
MEMORY = 0.9
# Correction factors stay within these; a branch that forgets (negative drop) does not turn the sign of a prediction.
CORRECTION_RANGE = (0.05, 20.0)


@dataclass(frozen=True, slots=True)
class Account:
    """Running sums of raw predictions and of outcomes, bits, one pair for every branch; JSON-able through `terms`."""

    predicted: tuple[float, float] = (0.0, 0.0)
    realised: tuple[float, float] = (0.0, 0.0)

    def with_outcome(self, predicted: tuple[float, float], realised: tuple[float, float]) -> "Account":
        """After one more decision."""
        p = tuple(MEMORY * old + new for old, new in zip(self.predicted, predicted, strict=True))
        r = tuple(MEMORY * old + new for old, new in zip(self.realised, realised, strict=True))
        return Account((p[0], p[1]), (r[0], r[1]))

    def correction(self, raw: tuple[float, float]) -> tuple[float, float]:
        """Factor on the raw prediction of each branch; one decision like the present one is the prior for 1."""
        low, high = CORRECTION_RANGE
        out = [
            float(np.clip((r + now) / (p + now), low, high)) if p + now > 0 else 1.0
            for p, r, now in zip(self.predicted, self.realised, raw, strict=True)
        ]
        return out[0], out[1]


def expected_along(field: RewardField, poses: np.ndarray, camera: Camera) -> tuple[float, float]:
    """(field's, Gaussians') expected entropy drop, bits, of seeing everything that poses (N, 4, 4) see."""
    if len(poses) == 0:
        return 0.0, 0.0
    grid = field.grid
    # Twice the spacing of scoring: neighbouring poses fill each other's gaps.
    stride = 2 * fan_stride(camera, grid.voxel_size, field.max_range_m)
    sums = kernels.path_gain(
        np.ascontiguousarray((poses[:, :3, 3] - grid.origin) / grid.voxel_size, dtype=np.float32),
        np.ascontiguousarray(poses[:, :3, :3], dtype=np.float32), ray_fan(camera, stride)[2].astype(np.float32),
        field.opaque, field.skip, field.kind, field.log_through, field.quality,
        field.normal, field.clear, field.gain_imp, field.gain_exp, grid.shape, np.float32(grid.voxel_size),
        np.float32(field.max_range_m), np.float32(field.enough_quality), np.float32(field.quality_range_m),
    )
    return float(sums[0]), float(sums[1])


def account_terms(
    volume: UncertaintyVolume, raw: tuple[float, float], previous: Decision | None
) -> dict[str, Any]:
    """Entries of `Decision.terms`: this decision's prediction, the last one's outcome, the sums carried on.

    `predicted_imp`, `predicted_exp`: corrected prediction, bits; `raw_imp`, `raw_exp` before the correction;
    `account`: running sums; `previous`: prediction and outcome of the decision before, absent when it made none.
    """
    account, outcome = Account(), None
    before = {} if previous is None else previous.terms
    if "account" in before:
        account = Account(tuple(before["account"]["predicted"]), tuple(before["account"]["realised"]))
    realised = volume.drop_bits
    if "raw_imp" in before and realised is not None and previous is not None and len(previous.path):
        account = account.with_outcome((before["raw_imp"], before["raw_exp"]), realised)
        outcome = {f"predicted_{b}": before[f"predicted_{b}"] for b in BRANCHES}
        outcome |= {f"realised_{b}": r for b, r in zip(BRANCHES, realised, strict=True)}
    factors = account.correction(raw)
    terms: dict[str, Any] = {
        "account": {"predicted": list(account.predicted), "realised": list(account.realised)},
    }
    for b, r, f in zip(BRANCHES, raw, factors, strict=True):
        terms |= {f"raw_{b}": r, f"predicted_{b}": r * f}
    if outcome is not None:
        terms["previous"] = outcome
    return terms
