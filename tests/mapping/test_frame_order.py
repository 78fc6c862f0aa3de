"""The refinement's order of visits: what is seen much and shown little weighs more, and weights set how often."""

from dataclasses import replace

import numpy as np
import pytest
from room_with_ball import render

from active3d_pipe.geometry import se3
from active3d_pipe.mapping import frame_order
from active3d_pipe.mapping.frame_order import LEAST, MOST, exposure, visiting_order
from active3d_pipe.structures import Camera

CAMERA = Camera.from_fov(96, 64, 80.0)
EYE = np.array([0.0, 0.7, 0.8])


def view(yaw_deg: float, pitch_deg: float = 0.0, eye=EYE):
    yaw, pitch = np.radians(yaw_deg), np.radians(pitch_deg)
    ahead = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    return render(CAMERA, se3.look_at(eye, eye + ahead), step=0)


def all_around():
    """Views of the whole room, from either side of the ball."""
    eyes = (EYE, EYE * [1, -1, 1])
    return [view(yaw, pitch, eye) for eye in eyes for yaw in range(0, 360, 45) for pitch in (-55, 0, 55)]


def weights_of(frames, seed: int = 0):
    return exposure(frames, np.random.default_rng(seed))


def test_what_many_frames_show_counts_less() -> None:
    around, shown_often = all_around(), 4
    before, after = weights_of(around), weights_of([*around, *[around[shown_often]] * 20])
    assert (after[len(around) :] == after[shown_often]).all()
    assert after[shown_often] == after.min()
    assert after[shown_often] < 0.3 * before[shown_often]
    assert after.argmax() < len(around)


def test_partly_shared_views_lie_between() -> None:
    weights = weights_of([*all_around(), *[view(90)] * 20, view(60), view(270)])
    assert weights[-3] < weights[-2] < weights[-1]


def test_a_close_look_at_little_counts_less_than_a_wide_one() -> None:
    weights = weights_of([*all_around(), view(180, eye=EYE - [0.8, 0, 0]), view(180)])
    assert weights[-2] < 0.7 * weights[-1]


def test_a_frame_without_depth_shows_what_lies_ahead_of_it() -> None:
    blind = replace(view(45), depth=np.zeros((64, 96), np.float32))
    weights = weights_of([*all_around(), view(45), blind])
    assert weights[-1] == weights[-2]


def test_without_any_depth_all_count_alike() -> None:
    blind = replace(view(0), depth=np.zeros((64, 96), np.float32))
    np.testing.assert_array_equal(weights_of([blind, blind]), 1)


def test_without_room_to_look_from_all_count_alike() -> None:
    near = [replace(view(yaw), depth=np.full((64, 96), 0.2, np.float32)) for yaw in (0, 10)]
    np.testing.assert_array_equal(weights_of(near), 1)


def test_a_frame_that_shows_nothing_known_counts_as_the_mean() -> None:
    # Its rays run through the unknown outside the room and meet nothing.
    outside = replace(view(0, eye=np.array([30.0, 0, 0.8])), depth=np.zeros((64, 96), np.float32))
    around = all_around()
    assert weights_of([*around, outside])[-1] == pytest.approx(1)


def test_the_same_seed_gives_the_same_and_another_about_the_same() -> None:
    frames = all_around()
    np.testing.assert_array_equal(weights_of(frames), weights_of(frames))
    np.testing.assert_allclose(weights_of(frames, 1), weights_of(frames), rtol=0.25)


def test_cells_grow_where_the_scene_is_large(monkeypatch) -> None:
    frames = all_around()
    fine = weights_of(frames)
    monkeypatch.setattr(frame_order, "MOST_CELLS", 3000)
    assert frame_order._grid_around(frames).size < 2 * 3000
    assert np.corrcoef(weights_of(frames), fine)[0, 1] > 0.8


@pytest.mark.parametrize("visits", [7, 100, 1001])
def test_visits_follow_the_weights(visits: int) -> None:
    weights = np.random.default_rng(0).uniform(0.3, 3, 40)
    order = visiting_order(weights, visits, np.random.default_rng(1))
    assert len(order) == visits
    counts = np.bincount(order, minlength=40)
    expected = visits * weights / weights.sum()
    assert np.abs(counts - expected).max() < 2
    np.testing.assert_array_equal(order, visiting_order(weights, visits, np.random.default_rng(1)))


def test_visits_of_a_frame_are_evenly_spread() -> None:
    order = visiting_order(np.array([4.0, 1.0, 1.0, 1.0, 1.0]), 800, np.random.default_rng(0))
    gaps = np.diff(np.flatnonzero(order == 0))
    assert gaps.min() >= 1
    assert gaps.max() <= 3


def test_equal_weights_visit_each_frame_once_before_any_twice() -> None:
    order = visiting_order(np.ones(10), 35, np.random.default_rng(0))
    for first in (0, 10, 20):
        assert sorted(order[first : first + 10]) == list(range(10))
    assert list(order[:10]) != list(range(10))


def test_extreme_weights_are_bounded() -> None:
    counts = np.bincount(visiting_order(np.array([1e-6, 1.0, 1.0, 1e6]), 10_000, np.random.default_rng(0)), minlength=4)
    assert counts[0] == pytest.approx(10_000 * LEAST / (LEAST + 2 + MOST), abs=1)


def test_no_visits_are_no_order() -> None:
    assert len(visiting_order(np.ones(3), 0, np.random.default_rng(0))) == 0
