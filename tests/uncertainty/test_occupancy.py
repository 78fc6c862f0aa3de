"""The field's and the observed occupancy, opacity mass, and the bounds they keep."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.special import ndtr
from uncertainty_room import field, gaussians_on, room_grid

from active3d_pipe.geometry import se3
from active3d_pipe.information.entropy import bernoulli_entropy
from active3d_pipe.structures import GaussianModel, VoxelGrid
from active3d_pipe.uncertainty import implicit, occupancy
from active3d_pipe.uncertainty.carving import RayEvidence
from active3d_pipe.uncertainty.config import UncertaintySettings

S = UncertaintySettings()
SHAPE = (2, 3, 2)
COUNTS = arrays(np.float32, SHAPE, elements=st.integers(0, 100_000).map(float))


def evidence(free, hit):
    free, hit = np.broadcast_arrays(np.asarray(free, np.float32), np.asarray(hit, np.float32))
    cells = np.zeros(free.shape, np.uint8)
    return RayEvidence(free, hit, np.zeros_like(free), cells, cells)


@settings(max_examples=60, deadline=None)
@given(
    COUNTS, COUNTS, arrays(np.float32, SHAPE, elements=st.floats(-2, 2, width=32)),
    arrays(np.float32, SHAPE, elements=st.floats(0, 8, width=32)),
    arrays(np.float32, SHAPE, elements=st.floats(0, 50, width=32)),
)
def test_probabilities_and_entropies_stay_in_range(free, hit, sdf, sigma, mass):
    e = evidence(free, hit)
    seen = occupancy.observation(e, S)
    p_imp = implicit.implicit_occupancy(sdf, sigma, seen, implicit.cube_support(sdf, 0.1), S)
    h_imp = implicit.implicit_entropy(sdf, sigma, seen, implicit.cube_support(sdf, 0.1), S)
    log_odds = occupancy.explicit_log_odds(e, mass, S)
    o = occupancy.hybrid_occupancy(log_odds, p_imp, e, S)
    u = implicit.implicit_uncertainty(sigma, seen, S)
    a = occupancy.attention(e, S)
    for volume in (seen, p_imp, h_imp, o, u, a, bernoulli_entropy(occupancy.expit(log_odds))):
        assert np.isfinite(volume).all()
        assert volume.min() >= 0
        assert volume.max() <= 1
    unseen = (free + hit) == 0
    assert (o[unseen] == 0.5).all()
    assert (p_imp[unseen] == 0.5).all()
    assert (u[unseen] == 1).all()
    assert (h_imp[unseen] == 1).all()
    assert (a[unseen] == 1).all()


@settings(max_examples=60, deadline=None)
@given(COUNTS, COUNTS, st.integers(1, 50))
def test_more_evidence_never_turns_round(free, hit, more):
    before = occupancy.ray_log_odds(evidence(free, hit), S)
    assert (occupancy.ray_log_odds(evidence(free + more, hit), S) <= before).all()
    assert (occupancy.ray_log_odds(evidence(free, hit + more), S) >= before).all()
    assert (occupancy.observation(evidence(free + more, hit), S) >= occupancy.observation(evidence(free, hit), S)).all()


@pytest.mark.parametrize(
    ("free", "hit", "low", "high"),
    [
        (10, 0, 0, 0.01), (1000, 0, 0, 0.001), (0, 10, 0.99, 1), (5000, 3, 0.5, 1), (5000, 40, 0.8, 1),
        (5000, 1, 0, 0.02),
    ],
)
def test_what_rays_say(free, hit, low, high):
    """Several passes make free, several hits occupied; a pole among many passes stays; one stray return does not."""
    p = occupancy.expit(occupancy.ray_log_odds(evidence([free], [hit]), S))
    assert low <= p[0] <= high


def test_the_field_fills_gaps_but_invents_nothing():
    solid = np.full(SHAPE, 0.999, np.float32)
    weak, firm = evidence(np.full(SHAPE, 1), 0), evidence(np.full(SHAPE, 50), 0)
    filled = occupancy.hybrid_occupancy(occupancy.ray_log_odds(weak, S), solid, weak, S)
    phantom = occupancy.hybrid_occupancy(occupancy.ray_log_odds(firm, S), solid, firm, S)
    assert (filled > 0.6).all()
    assert (phantom < 0.01).all()


def test_cube_support_is_the_cubes_own():
    """SDF of a plane: the support along its normal is the largest corner projection of the voxel."""
    grid = VoxelGrid(np.zeros(3), 0.1, (6, 6, 6))
    corners = 0.05 * np.array(list(np.ndindex(2, 2, 2))) * 2 - 0.05
    for n in ((1, 0, 0), (0, -1, 0), (1, 1, 0), (1, -2, 3)):
        n = np.array(n) / np.linalg.norm(n)
        sdf = (grid.centres() @ n - 0.1).astype(np.float32)
        np.testing.assert_allclose(implicit.cube_support(sdf, 0.1), (corners @ n).max(), rtol=1e-3)
    np.testing.assert_allclose(implicit.cube_support(np.full((4, 4, 4), 0.1, np.float32), 0.1), 0.05)


def test_a_well_known_field_is_sure():
    grid = room_grid()
    sdf, sigma = (a.reshape(grid.shape) for a in field(grid.centres().reshape(-1, 3), sigma=0.005))
    support, seen = implicit.cube_support(sdf, 0.1), np.ones_like(sdf)
    p = implicit.implicit_occupancy(sdf, sigma, seen, support, S)
    assert (p[sdf < 0] > 0.99).all()
    assert (p[sdf >= 0.0999] < 0.1).all()
    assert np.median(p[sdf >= 0.0999]) < 0.01
    assert implicit.implicit_entropy(sdf, sigma, seen, support, S).max() < 0.3
    assert implicit.implicit_entropy(sdf, sigma + np.float32(0.3), seen, support, S).min() > 0.8


@settings(max_examples=40, deadline=None)
@given(st.floats(-0.2, 0.2), st.floats(0.01, 1.0), st.floats(0.05, 0.087))
def test_field_entropy_is_the_mean_over_the_voxel(sdf, sigma, support):
    x = sdf + support * np.linspace(-1, 1, 4001)
    h = bernoulli_entropy(ndtr(-x / sigma)).mean()
    one = [np.array([v]) for v in (sdf, sigma, 1.0, support)]
    assert implicit.implicit_entropy(*one, S)[0] == pytest.approx(h, abs=2e-3)


def test_field_entropy_does_not_depend_on_where_the_grid_cuts_a_wall():
    """A wall in the middle of a voxel, or on the border of two: the doubt in the row of voxels is the same."""
    totals = []
    for offset in np.linspace(0, 0.05, 6):
        sdf = np.arange(-0.4, 0.45, 0.1) + offset
        ones = np.ones_like(sdf)
        totals.append(implicit.implicit_entropy(sdf, 0.02 * ones, ones, 0.05 * ones, S).sum())
    np.testing.assert_allclose(totals, totals[0], rtol=1e-3)


def slow_mass(grid, g):
    mass = np.zeros(grid.shape)
    for mean, log_scale, quat, opacity in zip(g.means, g.log_scales, g.quats, g.opacities):
        R, s = se3.matrix_from_quat(quat.astype(np.float64)), np.exp(log_scale.astype(np.float64))
        wide = [a for a in range(3) if a != int(np.argmin(s))]
        m = 2 * math.pi * opacity * s[wide[0]] * s[wide[1]] / grid.voxel_size**2
        points = [(mean.astype(np.float64), m / 3)]
        for a in wide:
            points += [(mean + sign * math.sqrt(3) * s[a] * R[:, a], m / 6) for sign in (1, -1)]
        for point, share in points:
            ijk = grid.index_of(point)
            if grid.contains_index(ijk):
                mass[tuple(ijk)] += share
    return mass


def test_opacity_mass_equals_slow_reference():
    rng = np.random.default_rng(3)
    n, a = 301, np.float32
    grid = VoxelGrid(np.array([-0.5, 0.0, 0.2]), 0.1, (10, 12, 8))
    g = GaussianModel(
        rng.uniform(-0.7, 1.3, (n, 3)).astype(a), rng.uniform(-5, -1.5, (n, 3)).astype(a),
        rng.normal(size=(n, 4)).astype(a), rng.normal(0, 2, n).astype(a), np.zeros((n, 3), a),
    )
    got = occupancy.opacity_mass(grid, g)
    np.testing.assert_allclose(got, slow_mass(grid, g), rtol=1e-4, atol=1e-5)
    assert got.tobytes() == occupancy.opacity_mass(grid, g).tobytes()
    assert not occupancy.opacity_mass(grid, GaussianModel.empty()).any()


def test_an_opaque_sheet_has_about_unit_mass():
    grid = VoxelGrid(np.zeros(3), 0.1, (10, 10, 3))
    step = 0.02
    xy = np.stack(np.meshgrid(np.arange(step / 2, 1, step), np.arange(step / 2, 1, step)), -1).reshape(-1, 2)
    sheet = gaussians_on(np.c_[xy, np.full(len(xy), 0.15)], scale=step / math.sqrt(2 * math.pi), opacity_logit=8)
    mass = occupancy.opacity_mass(grid, sheet)
    np.testing.assert_allclose(mass[1:-1, 1:-1, 1], 1, atol=0.01)
    assert not mass[:, :, [0, 2]].any()


def test_entropy_of_the_field_equals_numerical_integration():
    from scipy.special import ndtr

    from active3d_pipe.information.entropy import bernoulli_entropy
    from active3d_pipe.uncertainty.implicit import implicit_entropy

    rng = np.random.default_rng(5)
    n, s = 64, UncertaintySettings()
    sdf, sigma = rng.uniform(-0.1, 0.1, n).astype(np.float32), rng.uniform(0.001, 0.5, n).astype(np.float32)
    support = rng.uniform(0.05, 0.087, n).astype(np.float32)
    got = implicit_entropy(sdf, sigma, np.ones(n, np.float32), support, s)
    along = sdf + support * np.linspace(-1, 1, 4001)[:, None]
    expected = bernoulli_entropy(ndtr(along / np.maximum(sigma, s.sigma_floor_m))).mean(axis=0)
    np.testing.assert_allclose(got, expected, atol=2e-3)
