"""Volumes on a grid that grows."""

import numpy as np
import pytest

from active3d_pipe.errors import InputError
from active3d_pipe.structures import VOLUMES, UncertaintyVolume, VoxelGrid
from active3d_pipe.uncertainty.growth import grown_grid, on_grid


@pytest.fixture
def volume():
    grid, rng = VoxelGrid.from_bounds([-1.03, 0, 0], [1, 2, 1.5], 0.1), np.random.default_rng(0)
    return UncertaintyVolume(grid, 4, {n: rng.random(grid.shape, np.float32) for n in VOLUMES}, {"alphas": [1, 0, 0]})


def test_the_grid_grows_by_whole_voxels_and_only_where_it_must(volume):
    grid = volume.grid
    assert grown_grid(grid, grid.low + 0.3, grid.high) is grid
    grown = grown_grid(grid, grid.low - [0.4, 0, 0.05], grid.high + np.array([0, 0.8, 0]))
    assert grown.shape == (grid.shape[0] + 4, grid.shape[1] + 8, grid.shape[2] + 1)
    np.testing.assert_allclose(grown.centre_of([4, 0, 1]), grid.centre_of([0, 0, 0]), atol=1e-12)


def test_what_was_known_stays_in_its_place_and_the_rest_is_unseen(volume):
    grid = volume.grid
    grown = on_grid(volume, grown_grid(grid, grid.low - [0.4, 0, 0.1], grid.high + np.array([0, 0.8, 0])))
    inside = np.s_[4:, : grid.shape[1], 1:]
    for name in VOLUMES:
        np.testing.assert_array_equal(grown[name][inside], volume[name])
    new = np.ones(grown.grid.shape, bool)
    new[inside] = False
    assert not grown.observed[new].any()
    assert (grown["u_imp"][new] == 1).all()
    assert (grown["u_exp"][new] == 0).all()
    np.testing.assert_array_equal(grown["sdf"][0, : grid.shape[1], 1:], volume["sdf"][0])
    assert grown.fusion == volume.fusion
    assert grown.round == 4


def test_another_grid_is_refused(volume):
    grid = volume.grid
    for other in (
        VoxelGrid(grid.origin + 0.03, 0.1, tuple(np.add(grid.shape, 4))), VoxelGrid(grid.origin, 0.1, (5, 5, 5)),
        VoxelGrid(grid.origin, 0.2, grid.shape),
    ):
        with pytest.raises(InputError, match="voxel by voxel"):
            on_grid(volume, other)
