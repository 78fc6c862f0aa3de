"""Sparsification, AUSE, rank correlation, reliability."""

import numpy as np
import pytest
from scipy.stats import spearmanr

from active3d_pipe.errors import InputError
from active3d_pipe.uncertainty.metrics import ause, rank_correlation, reliability, sparsification


def slow_curve(u, e, fractions):
    order = np.argsort(-u)
    return np.array([e[order[int(f * len(e)) :]].mean() for f in fractions]) / e.mean()


def test_curve_equals_removal_one_by_one():
    rng = np.random.default_rng(0)
    e = rng.exponential(size=333)
    u = e + rng.normal(0, 0.5, 333)
    fractions, curve, oracle = sparsification(u, e)
    np.testing.assert_allclose(curve, slow_curve(u, e, fractions), atol=1e-9)
    np.testing.assert_allclose(oracle, slow_curve(e, e, fractions), atol=1e-9)
    assert (np.diff(oracle) <= 1e-12).all()
    assert (oracle <= curve + 1e-12).all()
    assert curve[0] == pytest.approx(1)


def test_ause_ranks_predictors():
    rng = np.random.default_rng(1)
    e = rng.exponential(size=2000)
    perfect, good, useless, inverted = e**3, e + rng.normal(0, 0.7, 2000), rng.uniform(size=2000), -e
    scores = [ause(u, e) for u in (perfect, good, useless, inverted)]
    assert scores[0] == pytest.approx(0, abs=1e-12)
    assert scores == sorted(scores)
    assert scores[1] < 0.6 * scores[2]


def test_ties_do_not_depend_on_order():
    rng = np.random.default_rng(2)
    u, e = rng.integers(0, 3, 100).astype(float), rng.exponential(size=100)
    p = rng.permutation(100)
    np.testing.assert_allclose(sparsification(u, e)[1], sparsification(u[p], e[p])[1])
    np.testing.assert_allclose(sparsification(np.ones(100), e)[1], 1)


def test_rank_correlation_is_spearmans():
    rng = np.random.default_rng(3)
    e = rng.exponential(size=200).round(1)
    u = (e + rng.normal(0, 1, 200)).round(1)
    assert rank_correlation(u, e) == pytest.approx(spearmanr(u, e).statistic)
    assert rank_correlation(e, np.exp(e)) == pytest.approx(1)
    assert rank_correlation(np.ones(5), np.arange(5.0)) == 0


def test_reliability_bins():
    rng = np.random.default_rng(4)
    u = rng.uniform(size=5000)
    e = np.abs(u + rng.normal(0, 0.05, 5000))
    r = reliability(u, e, 10)
    assert len(r.count) == 10
    assert r.count.sum() == 5000
    assert r.count.min() > 450
    np.testing.assert_allclose(r.uncertainty, r.error, atol=0.02)
    assert r.calibration_error < 0.02
    assert reliability(u, e + 0.3).calibration_error == pytest.approx(0.3, abs=0.02)
    few = reliability(np.array([0.0, 0, 0, 1]), np.array([1.0, 1, 1, 2]), 10)
    np.testing.assert_array_equal(few.count, [3, 1])
    np.testing.assert_array_equal(few.error, [1, 2])


def test_no_error_at_all_and_bad_input():
    assert ause(np.arange(4.0), np.zeros(4)) == 0
    one = np.ones(2)
    for u, e in ((np.ones(3), np.ones(4)), (np.ones(0), np.ones(0)), (one, -one), (np.nan * one, one)):
        with pytest.raises(InputError, match="calibration"):
            ause(u, e)
    with pytest.raises(InputError, match="fractions"):
        sparsification(np.ones(3), np.ones(3), np.array([1.0]))
