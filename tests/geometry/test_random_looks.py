import numpy as np

from active3d_pipe.geometry.random_looks import random_looks
from active3d_pipe.structures import VoxelGrid

GRID = VoxelGrid(np.array([-1.0, 2.0, 0.5]), 0.1, (21, 21, 21))
MIDDLE = np.array([[10, 10, 10]])


def walls():
    """A closed cube."""
    opaque = np.ones(GRID.shape, np.uint8)
    opaque[1:-1, 1:-1, 1:-1] = 0
    return opaque


def test_from_the_middle_of_a_cube_each_wall_gets_a_sixth_of_the_looks():
    looks = random_looks(GRID, walls().ravel(), MIDDLE, 60, 500, 5.0, np.random.default_rng(0))
    assert len(looks) == 60 * 500
    ijk = np.stack(np.unravel_index(looks, GRID.shape), -1)
    assert ((ijk == 0) | (ijk == 20)).any(1).all()
    for axis in range(3):
        for wall in (0, 20):
            share = np.mean(ijk[:, axis] == wall)
            assert abs(share - 1 / 6) < 0.015  # seven standard deviations


def test_what_lies_behind_something_or_too_far_away_is_not_looked_at():
    opaque = walls()
    opaque[15, 1:-1, 1:-1] = 1
    ends = random_looks(GRID, opaque.ravel(), MIDDLE, 20, 500, 5.0, np.random.default_rng(0))
    assert np.unravel_index(ends, GRID.shape)[0].max() == 15
    assert len(random_looks(GRID, walls().ravel(), MIDDLE, 20, 500, 0.8, np.random.default_rng(0))) == 0
    assert len(random_looks(GRID, walls().ravel(), MIDDLE[:0], 20, 500, 5.0, np.random.default_rng(0))) == 0


def test_the_same_seed_gives_the_same_looks():
    a, b, other = (random_looks(GRID, walls().ravel(), MIDDLE, 5, 40, 5.0, np.random.default_rng(s)) for s in (1, 1, 2))
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a, other)
