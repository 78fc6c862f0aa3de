import box_world
import numpy as np
import pytest

from active3d_pipe.geometry import se3
from active3d_pipe.information.gain import SURFACE
from active3d_pipe.planning.config import PlanningSettings
from active3d_pipe.planning.exposure import spread_field
from active3d_pipe.planning.free_space import begin_free_space
from active3d_pipe.planning.reward import build_reward_field, exact_terms
from active3d_pipe.structures.motion import MotionSettings

SETTINGS = PlanningSettings()


@pytest.fixture(scope="module")
def room():
    """An empty room that a turn on the spot has seen: (world, volume, reward field, free space)."""
    world = box_world.build((3.0, 2.6, 2.2), [])
    walked = np.stack([
        se3.pose_from_yaw_pitch(np.array([1.5, 1.3, 1.1]), yaw, pitch)
        for yaw in np.arange(0, 2 * np.pi, 0.4) for pitch in (-0.9, 0.0, 0.9)
    ])
    for T in walked:
        world.capture(T)
    volume = world.volume()
    space = begin_free_space(volume, walked[-1], walked[:, :3, 3], MotionSettings(), SETTINGS)()
    return world, volume, build_reward_field(volume, walked, world.camera, SETTINGS), space


def spread(room, had, seed=0):
    world, _, field, space = room
    return spread_field(field, had, space, world.camera, 0.3, np.random.default_rng(seed))


def test_a_walk_that_looked_at_one_wall_only_is_short_of_all_the_others(room):
    world, volume, field, _ = room
    x = world.grid.centres()[..., 0]
    had = np.where(x > 2.8, volume["hit_evidence"] * 100, 0)
    left, shortfall = spread(room, had)
    worth = left.surface_value.reshape(world.grid.shape)
    surface = field.kind.reshape(world.grid.shape) == SURFACE
    assert not worth[surface & (x > 2.9)].any() and (worth[surface & (x < 2.4)] > 0).mean() > 0.9
    assert not worth[~surface].any()
    assert 0.7 < shortfall < 1
    towards, away = (se3.pose_from_yaw_pitch(np.array([1.5, 1.3, 1.1]), yaw, 0.0) for yaw in (0.0, np.pi))
    rewards = [t.reward for t in exact_terms(left, np.stack([towards, away]), world.camera)]
    assert rewards[1] > 3 * rewards[0]
    assert not left.value.any() and not left.gain_imp.any() and not left.gain_exp.any()


def test_looks_as_random_views_give_them_are_short_of_nothing(room):
    """A second draw of random looks stands for the walk: what is left is chance."""
    world, _, field, space = room
    from active3d_pipe.geometry.random_looks import random_looks

    opaque = (field.kind != 0).view(np.uint8)
    ends = random_looks(
        world.grid, opaque, np.argwhere(space.reachable), 2000, 400, world.camera.far, np.random.default_rng(5)
    )
    had = np.bincount(ends, minlength=world.grid.size).reshape(world.grid.shape)
    _, shortfall = spread(room, had)
    assert shortfall < 0.03
    assert spread(room, 7 * had)[1] == pytest.approx(shortfall)  # proportions count, not numbers


def test_without_a_reading_there_is_nothing_to_compare(room):
    world, _, field, _ = room
    left, shortfall = spread(room, np.zeros(world.grid.shape))
    assert shortfall == 0 and left is field
