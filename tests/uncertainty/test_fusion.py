"""Evidence maximisation against the marginal likelihood of the raw rows."""

import json

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

from active3d_pipe.errors import InputError
from active3d_pipe.uncertainty.config import UncertaintySettings
from active3d_pipe.uncertainty.fusion import FusionStatistics, fuse, log_evidence, maximise_evidence

S = UncertaintySettings()
EQUAL = np.full(3, 1 / 3)


def rows_of(weights, n=600, noise=0.05, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.uniform(0, 1, (n, 3)) ** np.array([1, 2, 3])
    return x, x @ np.asarray(weights) + rng.normal(0, noise, n)


def statistics_of(x, y):
    return FusionStatistics.empty().updated(x, y, 1.0)


def slow_evidence(x, y, g, b):
    """log N(y | 0, I / b + X diag(1 / g) X^T)."""
    return multivariate_normal(np.zeros(len(y)), np.eye(len(y)) / b + (x / g) @ x.T).logpdf(y)


def test_evidence_equals_the_marginal_likelihood_of_the_rows():
    x, y = rows_of((0.5, 0.3, 0.1), n=40)
    for g, b in (((1.0, 1.0, 1.0), 10.0), ((0.1, 5.0, 300.0), 400.0)):
        got, mean, covariance = log_evidence(statistics_of(x, y), np.array(g), b)
        assert got == pytest.approx(slow_evidence(x, y, np.array(g), b), abs=1e-6)
        precision = np.diag(g) + b * x.T @ x
        np.testing.assert_allclose(covariance @ precision, np.eye(3), atol=1e-9)
        np.testing.assert_allclose(mean, np.linalg.solve(precision, b * x.T @ y), rtol=1e-9)


def test_fixed_point_is_the_maximum():
    x, y = rows_of((0.6, 0.4, 0.2), n=60)
    value, _, _ = maximise_evidence(statistics_of(x, y))

    def negative(theta):
        return -slow_evidence(x, y, np.exp(theta[:3]), np.exp(theta[3]))

    options = {"maxiter": 4000, "xatol": 1e-7, "fatol": 1e-9}
    best = minimize(negative, np.zeros(4), method="Nelder-Mead", options=options)
    assert value == pytest.approx(-best.fun, abs=1e-3)


@pytest.mark.parametrize("weights", [(0.5, 0.3, 0.1), (0.9, 0.05, 0.4), (0.2, 0.2, 0.2)])
def test_recovers_known_weights_and_noise(weights):
    fused = fuse(statistics_of(*rows_of(weights, n=3000)), S)
    np.testing.assert_allclose(fused.alphas, weights, atol=0.02)
    assert fused.noise == pytest.approx(0.05, rel=0.05)
    assert fused.source == "evidence"


@pytest.mark.parametrize("irrelevant", [0, 1, 2])
def test_an_irrelevant_term_goes_to_zero(irrelevant):
    weights = np.array([0.5, 0.4, 0.3])
    weights[irrelevant] = 0
    zeros = 0
    for seed in range(8):
        alphas = fuse(statistics_of(*rows_of(weights, n=2000, seed=seed)), S).alphas
        assert alphas[irrelevant] < 0.02
        zeros += alphas[irrelevant] == 0
    assert zeros >= 4


@pytest.mark.parametrize("weights", [(0.5, -0.4, 0.2), (-0.2, 0.5, -0.3), (0.9, -0.9, 0.0)])
def test_weights_are_never_negative(weights):
    fused = fuse(statistics_of(*rows_of(weights)), S)
    assert (fused.alphas >= 0).all()
    assert (fused.alphas[np.array(weights) < 0] == 0).all()


def test_evidence_prefers_the_true_model_to_equal_weights():
    x, y = rows_of((0.7, 0.0, 0.2), n=1500)
    test_x, test_y = rows_of((0.7, 0.0, 0.2), n=1500, seed=1)
    alphas = fuse(statistics_of(x, y), S).alphas
    assert np.square(test_x @ alphas - test_y).mean() < 0.5 * np.square(test_x @ EQUAL - test_y).mean()


def test_equal_weights_before_there_is_data_and_in_the_ablations():
    few = statistics_of(*rows_of((0.9, 0, 0), n=S.fusion_min_rows - 1))
    many = statistics_of(*rows_of((0.5, 0.3, 0.2)))
    silent = statistics_of(np.zeros((500, 3)), np.zeros(500))
    for statistics in (FusionStatistics.empty(), few, silent):
        np.testing.assert_array_equal(fuse(statistics, S).alphas, EQUAL)
    np.testing.assert_array_equal(fuse(many, UncertaintySettings(fusion="equal")).alphas, EQUAL)
    np.testing.assert_array_equal(fuse(few, UncertaintySettings(terms=("imp", "time"))).alphas, [0.5, 0, 0.5])
    assert fuse(many, UncertaintySettings(terms=("exp", "time"))).alphas[0] == 0
    assert fuse(statistics_of(*rows_of((-1, -1, -1))), S).source == "equal"


def test_degenerate_rows_stay_finite():
    x, y = rows_of((0.5, 0.3, 0.2), n=500)
    constant = np.c_[np.ones(500), x[:, 1], np.zeros(500)]
    copied = np.c_[x[:, 0], x[:, 0], x[:, 0]]
    for rows, targets in ((constant, y), (copied, y), (x, x @ [0.5, 0.3, 0.2]), (x, np.full(500, 0.5))):
        fused = fuse(statistics_of(rows, targets), S)
        assert np.isfinite(fused.alphas).all()
        assert np.isfinite([fused.evidence, fused.noise]).all()
        assert np.abs(rows @ fused.alphas - targets).mean() < 0.25


def test_running_statistics_forget_and_survive_json():
    (x1, y1), (x2, y2) = rows_of((0.9, 0.0, 0.0), 400, seed=1), rows_of((0.1, 0.8, 0.0), 400, seed=2)
    whole = statistics_of(np.r_[x1, x2], np.r_[y1, y2])
    parts = statistics_of(x1, y1).updated(x2, y2, 1.0)
    np.testing.assert_allclose(parts.xtx, whole.xtx)
    assert parts.n == 800
    assert statistics_of(x1, y1).updated(x2, y2, 0.5).n == 600
    old = statistics_of(x1, y1)
    for _ in range(30):
        old = old.updated(x2, y2, 0.7)
    np.testing.assert_allclose(fuse(old, S).alphas, [0.1, 0.8, 0], atol=0.03)
    fused = fuse(whole, S)
    doc = json.loads(json.dumps(fused.to_json(whole, 800)))
    again = FusionStatistics.from_json(doc["statistics"])
    np.testing.assert_array_equal(again.xtx, whole.xtx)
    np.testing.assert_array_equal(fuse(again, S).alphas, fused.alphas)


def test_malformed_rows_and_documents_are_refused():
    with pytest.raises(InputError, match="rows"):
        FusionStatistics.empty().updated(np.zeros((4, 2)), np.zeros(4), 1.0)
    for doc in ({}, {"xtx": [[1]], "xty": [1], "yty": 1, "n": 1}, {"xtx": "no", "xty": [1], "yty": 1, "n": 1}):
        with pytest.raises(InputError, match="fusion statistics"):
            FusionStatistics.from_json(doc)
