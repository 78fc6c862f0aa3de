"""What a decision brought: entropy lost where looks showed something new, not by growth of the grid, not by drift."""

from dataclasses import replace

import numpy as np
import pytest

from active3d_pipe.information.gain import entropy_drop
from active3d_pipe.planning.outcome import account_terms
from active3d_pipe.structures import VOLUMES, Decision, UncertaintyVolume, VoxelGrid
from active3d_pipe.structures.decision import Reason
from active3d_pipe.uncertainty.growth import grown_grid, on_grid


@pytest.fixture
def volumes():
    """Before and after a round that reached a quarter of the voxels, and of which of them it showed something new."""
    grid, rng = VoxelGrid.from_bounds([0, 0, 0], [2, 2, 1], 0.1), np.random.default_rng(0)
    arrays = {name: rng.random(grid.shape, np.float32) for name in VOLUMES}
    reached = rng.random(grid.shape) < 0.25
    changed = {
        "entropy_imp": 0.5 * arrays["entropy_imp"],
        "entropy_exp": np.where(reached, 0, 1).astype(np.float32),
        "free_evidence": arrays["free_evidence"] + (reached & (rng.random(grid.shape) < 0.5)),
    }
    # Looks at what was settled that show it no better than before.
    nothing_new = reached & (rng.random(grid.shape) < 0.3)
    arrays["hit_evidence"] = np.where(nothing_new, 5, arrays["hit_evidence"]).astype(np.float32)
    better = nothing_new & (rng.random(grid.shape) < 0.5)
    changed["view_quality"] = arrays["view_quality"] + np.where(better, 0.1, 0)
    changed["hit_evidence"] = arrays["hit_evidence"] + (
        reached & (changed["free_evidence"] == arrays["free_evidence"])
    )
    changed = {name: a.astype(np.float32) for name, a in changed.items()}
    anew = reached & ~(nothing_new & ~better)
    return UncertaintyVolume(grid, 0, arrays), UncertaintyVolume(grid, 1, {**arrays, **changed}), anew


def test_drift_where_looks_showed_nothing_new_is_no_outcome(volumes):
    before, after, anew = volumes
    imp, exp = entropy_drop(before.arrays, after.arrays)
    assert imp == pytest.approx(0.5 * before["entropy_imp"][anew].sum(), rel=1e-4)
    assert exp == pytest.approx(before["entropy_exp"][anew].sum(), rel=1e-4)


def test_growth_is_not_counted_as_entropy_that_came_back(volumes):
    before, after, _ = volumes
    low, high = before.grid.low - 0.4, before.grid.high + 0.8
    grown = [on_grid(v, grown_grid(v.grid, low, high)) for v in (before, after)]
    want, got = entropy_drop(before.arrays, after.arrays), entropy_drop(*(v.arrays for v in grown))
    assert got == pytest.approx(want, rel=1e-5)


def test_the_next_decision_accounts_for_the_last(volumes):
    before, after, _ = volumes
    terms = account_terms(before, (30.0, 40.0), None)
    assert "previous" not in terms
    decision = Decision(
        round=0, reason=Reason.BEST_GAIN, stop=False, path=np.eye(4)[None], ranking=(), chosen=-1, terms=terms
    )
    drop = entropy_drop(before.arrays, after.arrays)
    outcome = account_terms(replace(after, drop_bits=drop), (1.0, 1.0), decision)["previous"]
    assert outcome == {"predicted_imp": 30.0, "predicted_exp": 40.0, "realised_imp": drop[0], "realised_exp": drop[1]}
    assert "previous" not in account_terms(after, (1.0, 1.0), decision)
