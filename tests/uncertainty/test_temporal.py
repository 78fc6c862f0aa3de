"""u_time against the equation, voxel by voxel."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from active3d_pipe.uncertainty.config import UncertaintySettings
from active3d_pipe.uncertainty.temporal import temporal_uncertainty

S = UncertaintySettings()


def slow_u_time(s_now, s_before, u_before, relevant):
    s_now, s_before = (max(-S.sdf_range_m, min(S.sdf_range_m, float(s))) for s in (s_now, s_before))
    change = s_now - s_before
    new = 0 <= s_now <= S.tau_s_m and change > S.tau_n_m
    changed = abs(change) > S.tau_c_m
    freed = s_now > S.tau_f_m and s_before < -S.tau_f_m
    u = S.beta_1 * min(abs(change) / S.sdf_range_m, 1) + S.beta_2 * (new or changed or freed)
    return max(relevant * u, S.temporal_decay * u_before)


def one(now, before, u=0.0, relevant=1.0):
    return float(temporal_uncertainty(*(np.array([x], np.float32) for x in (now, before, u, relevant)), S)[0])


@settings(max_examples=100, deadline=None)
@given(*(arrays(np.float32, 9, elements=st.floats(*r, width=32)) for r in ((-1, 1), (-1, 1), (0, 1), (0, 1))))
def test_equals_the_equation(now, before, u_before, relevant):
    got = temporal_uncertainty(now, before, u_before, relevant, S)
    edge = np.zeros(9, bool)  # rounding decides exactly on a threshold
    c = np.clip(now, -0.1, 0.1).astype(float) - np.clip(before, -0.1, 0.1).astype(float)
    for value, tau in ((now, 0.05), (now, 0.03), (-before, 0.03), (c, 0.03), (abs(c), 0.05)):
        edge |= np.abs(value - tau) < 1e-6
    slow = [slow_u_time(*v) for v in zip(now, before, u_before, relevant)]
    np.testing.assert_allclose(got[~edge], np.array(slow)[~edge], atol=1e-5)
    assert got.min() >= 0
    assert got.max() <= 1


@pytest.mark.parametrize(
    ("now", "before", "flagged"),
    [
        (0.02, -0.02, True),  # a surface emerges: M_new
        (0.0, 0.09, True),  # something was put here: M_change
        (0.04, -0.04, True),  # solid turned out to be free: M_free
        (0.09, 0.08, False),
        (0.9, 0.4, False),  # both far from any surface: the field's saturated values differ, nothing changed
    ],
)
def test_changes_that_matter(now, before, flagged):
    assert (one(now, before) >= S.beta_2) == flagged


def test_decays_when_nothing_changes_and_irrelevant_changes_are_ignored():
    values = [one(0.0, 0.09)]
    for _ in range(20):
        values.append(one(0.0, 0.0, values[-1]))
    assert values[0] > 0.8
    assert values[-1] < 0.02
    assert all(b < a for a, b in pairwise(values))
    assert one(0.0, 0.09, relevant=0.0) == 0
