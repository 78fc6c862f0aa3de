"""The pass over all voxels against its slow twin."""

import numpy as np
import pytest

from active3d_pipe.structures import VOLUMES, UncertaintyVolume, VoxelGrid
from active3d_pipe.uncertainty import reference_terms, terms
from active3d_pipe.uncertainty.carving import RayEvidence
from active3d_pipe.uncertainty.config import UncertaintySettings

NAMES = ("attention", "u_imp", "u_time", "occupancy", "entropy_imp", "entropy_exp")


def state(shape, seed):
    """Evidence, that of this round, vain, mass, (sdf, sigma), volume of the last round: seen, unseen, free, thin."""
    rng = np.random.default_rng(seed)

    def volume(a):
        return np.ascontiguousarray(a, np.float32)

    def counts(most, share):
        return volume(rng.integers(0, most, shape) * (rng.random(shape) < share))

    before, fresh = (
        RayEvidence(counts(40, a), counts(6, b), *(np.zeros(shape, t) for t in (np.float32, np.uint8, np.uint8)))
        for a, b in ((0.5, 0.3), (0.3, 0.1))
    )
    vain, mass = counts(4, 0.2), volume(rng.exponential(0.7, shape) * (rng.random(shape) < 0.4))
    sdf, sigma = volume(rng.normal(0, 0.06, shape).clip(-0.1, 0.1)), volume(rng.exponential(0.1, shape))
    grid = VoxelGrid(np.zeros(3), 0.1, shape)
    arrays = {name: np.zeros(shape, np.float32) for name in VOLUMES}
    arrays |= {"sdf": sdf + volume(rng.normal(0, 0.03, shape)), "u_time": volume(rng.random(shape) * 0.3)}
    return before.joined(fresh), fresh, vain, mass, (sdf, sigma), UncertaintyVolume(grid, 0, arrays)


@pytest.mark.parametrize("shape", [(13, 9, 7), (1, 6, 5), (2, 2, 2), (30, 1, 4)])
@pytest.mark.parametrize("settings", [
    UncertaintySettings(),
    UncertaintySettings(
        vain_keep=0, sigma_floor_m=0.05, gaussian_log_odds=0, beta_1=0.2, temporal_decay=0, tau_f_m=0.01
    ),
])
def test_the_pass_agrees_with_the_formulas(shape, settings):
    for seed in range(3):
        *inputs, previous = state(shape, seed)
        for last in (previous, None):
            got, expected = (f.voxel_terms(*inputs, last, settings, 0.1) for f in (terms, reference_terms))
            for name in NAMES:
                assert getattr(got, name).dtype == np.float32
                np.testing.assert_allclose(getattr(got, name), getattr(expected, name), atol=2e-5, err_msg=name)


@pytest.mark.parametrize("shape", [(25, 19, 14), (1, 8, 6), (3, 1, 9)])
def test_the_field_is_asked_where_the_formula_says(shape):
    rng = np.random.default_rng(5)
    seen = np.zeros(shape, bool)
    seen[:, :, : shape[2] // 2] = True
    free = np.where(seen, rng.integers(0, 60, shape) * (rng.random(shape) < 0.9), 0).astype(np.float32)
    hit = (seen & (rng.random(shape) < 0.02)).astype(np.float32) * 3
    zero = np.zeros(shape, np.uint8)
    evidence, s = RayEvidence(free, hit, hit, zero, zero), UncertaintySettings()
    got = terms.open_to_the_field(evidence, s)
    np.testing.assert_array_equal(got, reference_terms.open_to_the_field(evidence, s))
    assert got.any()


@pytest.mark.parametrize("shape", [(25, 19, 14), (1, 8, 6), (40, 3, 9)])
def test_the_field_is_asked_again_where_the_formula_says_and_everywhere_within_its_turns(shape):
    rng = np.random.default_rng(6)
    asked = rng.random(shape) < 0.7
    late = asked & (rng.random(shape) < 0.02)
    free, hit = ((rng.random(shape) < 0.005).astype(np.float32) for _ in range(2))
    zero, s = np.zeros(shape, np.uint8), UncertaintySettings(field_turns=3)
    fresh = RayEvidence(free, hit, hit, zero, zero)
    rounds = [terms.due_to_the_field(asked, late, fresh, k, s) for k in (4, 5, 6)]
    for k, got in zip((4, 5, 6), rounds, strict=True):
        np.testing.assert_array_equal(got, reference_terms.due_to_the_field(asked, late, fresh, k, s))
    np.testing.assert_array_equal(np.logical_or.reduce(rounds), asked)
    every = terms.due_to_the_field(asked, late, fresh, 4, UncertaintySettings(field_turns=1))
    np.testing.assert_array_equal(every, asked)


def test_the_same_bytes_with_one_thread():
    import numba

    *inputs, previous = state((40, 20, 12), 1)
    many = terms.voxel_terms(*inputs, previous, UncertaintySettings(), 0.1)
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        one = terms.voxel_terms(*inputs, previous, UncertaintySettings(), 0.1)
    finally:
        numba.set_num_threads(threads)
    for name in NAMES:
        assert getattr(many, name).tobytes() == getattr(one, name).tobytes(), name
