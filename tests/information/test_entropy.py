import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from active3d_pipe.information.entropy import bernoulli_entropy


def test_known_values():
    assert bernoulli_entropy(0.5) == pytest.approx(1.0)
    assert bernoulli_entropy(0.11) == pytest.approx(0.4999158, abs=1e-6)
    np.testing.assert_array_equal(bernoulli_entropy(np.array([0.0, 1.0, -0.2, 1.2], np.float32)), 0)


def test_keeps_single_precision():
    assert bernoulli_entropy(np.full(3, 0.3, np.float32)).dtype == np.float32


@given(st.floats(1e-9, 1 - 1e-9))
def test_symmetric_and_bounded_and_equal_to_the_definition(p):
    h = float(bernoulli_entropy(p))
    assert 0 <= h <= 1
    assert h == pytest.approx(float(bernoulli_entropy(1 - p)), abs=1e-9)
    assert h == pytest.approx(-p * math.log2(p) - (1 - p) * math.log2(1 - p), abs=1e-9)
