import numpy as np
import pytest

from active3d_pipe.errors import ConfigError
from active3d_pipe.geometry.lattice import LatticePoints

AXES = (np.array([0.0, 0.1, 0.3]), np.array([-1.0, 2.0]), np.array([5.0, 6.0, 7.0, 9.0]))


def test_points_are_those_of_the_nodes_in_c_order():
    grid = np.stack(np.meshgrid(*AXES, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)
    every = LatticePoints(AXES, np.arange(24))
    assert np.array_equal(np.asarray(every), grid)
    assert np.asarray(every, dtype=np.float64).dtype == np.float64
    some = np.array([23, 0, 7])
    assert np.array_equal(np.asarray(every[some]), grid[some])
    assert np.array_equal(np.asarray(every[np.arange(24) % 5 == 0]), grid[::5])
    assert len(every[some]) == 3


def test_a_lattice_beyond_32_bits_is_refused():
    axis = np.zeros(2000)
    with pytest.raises(ConfigError, match="2000 x 2000 x 2000"):
        LatticePoints((axis, axis, axis), np.zeros(1, int))
