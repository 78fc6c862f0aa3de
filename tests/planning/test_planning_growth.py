"""A grid that grew brings unseen voxels; what a decision brought is not judged by them."""

import numpy as np
import pytest

from active3d_pipe.planning.outcome import account_terms
from active3d_pipe.structures import VOLUMES, Decision, UncertaintyVolume, VoxelGrid
from active3d_pipe.structures.decision import Reason
from active3d_pipe.uncertainty.growth import grown_grid, on_grid


def test_growth_is_not_counted_as_entropy_that_came_back():
    grid, rng = VoxelGrid.from_bounds([0, 0, 0], [2, 2, 1], 0.1), np.random.default_rng(0)
    arrays = {name: rng.random(grid.shape, np.float32) for name in VOLUMES}
    before = UncertaintyVolume(grid, 0, arrays)
    terms = account_terms(before, (30.0, 40.0), None)
    decision = Decision(
        round=0, reason=Reason.BEST_GAIN, stop=False, path=np.eye(4)[None], ranking=(), chosen=-1, terms=terms
    )
    after = UncertaintyVolume(grid, 1, {**arrays, "entropy_imp": 0.5 * arrays["entropy_imp"]})
    grown = on_grid(after, grown_grid(grid, grid.low - 0.4, grid.high + 0.8))
    plain = account_terms(after, (1.0, 1.0), decision)["previous"]
    same = account_terms(grown, (1.0, 1.0), decision)["previous"]
    assert plain["realised_imp"] == pytest.approx(0.5 * arrays["entropy_imp"].sum(), rel=1e-4)
    assert same["realised_imp"] == pytest.approx(plain["realised_imp"], abs=1e-2)
    assert same["realised_exp"] == pytest.approx(plain["realised_exp"], abs=1e-2)
