import numpy as np
import pytest

from active3d_pipe.information import reference
from active3d_pipe.information.config import InformationSettings
from active3d_pipe.information.gain import (
    FREE,
    OPEN,
    SURFACE,
    classify,
    information_volumes,
    normalised_uncertainty,
    view_quality,
)
from active3d_pipe.structures import VOLUMES, Camera

CAMERA = Camera.from_fov(600, 340, 90)
ENOUGH = InformationSettings().enough_quality(CAMERA.fx)


def volumes(n=4):
    """n voxels in a row, all never observed."""
    arrays = {name: np.zeros((n, 1, 1), np.float32) for name in VOLUMES}
    for name in ("occupancy",):
        arrays[name][:] = 0.5
    for name in ("entropy", "entropy_imp", "entropy_exp", "u_final"):
        arrays[name][:] = 1
    return arrays


def observe(arrays, i, *, free=0, hit=0, occupancy, quality=0.0):
    arrays["free_evidence"][i] = free
    arrays["hit_evidence"][i] = hit
    arrays["occupancy"][i] = occupancy
    arrays["view_quality"][i] = quality


def test_kinds():
    a = volumes(6)
    observe(a, 1, free=50, occupancy=0.02)
    observe(a, 2, hit=9, occupancy=0.98)
    observe(a, 3, free=1, occupancy=0.4)
    observe(a, 4, free=20, hit=4, occupancy=0.3)  # thin structure: a fifth of the rays ends here
    observe(a, 5, free=50, occupancy=0.9)  # the field believes in something that rays passed through
    kinds = classify(a, InformationSettings()).ravel().tolist()
    assert kinds == [OPEN, FREE, SURFACE, OPEN, SURFACE, FREE]


def test_an_unseen_voxel_is_worth_its_weight_times_one_minus_occupancy():
    s = InformationSettings(alpha=0.7, beta=0.2)
    v = information_volumes(volumes(), s, ENOUGH)
    np.testing.assert_allclose(v.value, (0.7 * 1 + 0.2 * 1) * 0.5, rtol=1e-6)


def test_seen_free_space_is_worth_nothing_even_when_uncertain():
    a = volumes()
    observe(a, 0, free=30, occupancy=0.5)
    a["u_final"][0] = 5
    v = information_volumes(a, InformationSettings(), ENOUGH)
    assert v.value[0, 0, 0] == 0
    assert v.surface_value[0, 0, 0] == 0
    assert v.gain_imp[0, 0, 0] == 0


def test_surface_is_worth_a_look_until_it_was_seen_well():
    s = InformationSettings()
    gains = []
    for quality in (0.0, 0.5 * ENOUGH, ENOUGH, 1.0):
        a = volumes()
        observe(a, 0, hit=9, occupancy=0.99, quality=quality)
        seen = information_volumes(a, s, ENOUGH)
        assert seen.surface_value[0, 0, 0] > 0 and seen.value[0, 0, 0] == 0
        gains.append(seen.gain_imp[0, 0, 0])
    assert gains[0] > 0
    assert gains[1] == pytest.approx(0.5 * gains[0])
    assert gains[2] == gains[3] == 0


def test_expected_entropy_reduction_leaves_the_residual():
    a = volumes()
    a["entropy_exp"][:] = 0.1
    expected = information_volumes(a, InformationSettings(residual_bits=0.25), ENOUGH)
    np.testing.assert_allclose(expected.gain_imp, 0.75)
    np.testing.assert_array_equal(expected.gain_exp, 0)


def test_credit_scales_everything_expected():
    a = volumes()
    observe(a, 1, hit=9, occupancy=0.99)
    s = InformationSettings()
    full, half = information_volumes(a, s, ENOUGH), information_volumes(a, s, ENOUGH, np.full((4, 1, 1), 0.5))
    for name in ("value", "surface_value", "gain_imp", "gain_exp"):
        np.testing.assert_allclose(getattr(half, name), 0.5 * getattr(full, name), rtol=1e-6)


def test_uncertainty_is_measured_by_its_level_in_unseen_space():
    u = np.array([2.0, 2.0, 2.0, 1.0, 9.0, -1.0], np.float32)
    observed = np.array([False, False, False, True, True, True])
    np.testing.assert_allclose(normalised_uncertainty(u, observed), [1, 1, 1, 0.5, 2, 0])
    np.testing.assert_array_equal(normalised_uncertainty(np.zeros(6, np.float32), observed), 0)


def test_without_the_fields_term_uncertainty_is_measured_by_what_was_observed():
    u = np.concatenate([np.zeros(500), np.full(40, 0.3), np.linspace(0.01, 1.0, 100)]).astype(np.float32)
    observed = np.arange(640) >= 540
    found = normalised_uncertainty(u, observed)
    assert (found[:500] == 0).all() and found[-1] == pytest.approx(1 / 0.95, rel=0.02)
    np.testing.assert_allclose(found[540:] / found[-1], u[540:], rtol=1e-5)


def test_view_quality_prefers_close_and_frontal():
    assert view_quality(1.0, 0.5, 1.0) == 1
    assert view_quality(-1.0, 2.0, 1.0) == pytest.approx(0.5)
    assert view_quality(0.5, 1.0, 1.0) == pytest.approx(0.5)


def test_enough_is_the_same_place_whatever_the_resolution():
    s = InformationSettings(reference_footprint_m=0.005, enough_distance_m=3.0)
    for width in (160, 600):
        camera = Camera.from_fov(width, 90, 90)
        at_three_metres = view_quality(1.0, 3.0, s.quality_range_m(camera.fx))
        assert at_three_metres == pytest.approx(s.enough_quality(camera.fx))


def random_volumes(seed):
    """Volumes of which a part was never seen, a part is free, and a part holds surface or few rays."""
    rng = np.random.default_rng(seed)
    shape = (9, 8, 7)
    a = {name: rng.random(shape, np.float32) for name in VOLUMES}
    for name in ("free_evidence", "hit_evidence"):
        a[name] = np.round(a[name] * 12) * (rng.random(shape) < 0.5)
    return {name: np.ascontiguousarray(x, np.float32) for name, x in a.items()}, rng


@pytest.mark.parametrize("seed", range(4))
def test_kernels_equal_the_formulas_over_whole_volumes(seed):
    a, rng = random_volumes(seed)
    s = InformationSettings(alpha=0.6, beta=0.3, residual_bits=0.2)
    if seed == 3:
        a["u_final"][:] = 0
    kind = classify(a, s)
    np.testing.assert_array_equal(kind, reference.classify(a, s))
    assert set(np.unique(kind)) == {FREE, OPEN, SURFACE}
    credit = rng.random(kind.shape, np.float32)
    got = information_volumes(a, s, ENOUGH, credit, kind)
    want = reference.information_volumes(a, s, ENOUGH, credit, kind)
    for name in ("value", "surface_value", "gain_imp", "gain_exp"):
        # Differences of float32 numbers near 1.
        np.testing.assert_allclose(getattr(got, name), getattr(want, name), rtol=1e-5, atol=1e-7)
        assert getattr(got, name).any()
