"""The refinement's order of visits: rare surface weighs more, and every frame comes as often as its weight says."""

from dataclasses import replace

import numpy as np
import pytest
from room_with_ball import render

from active3d_pipe.geometry import se3
from active3d_pipe.mapping.frame_order import LEAST, MOST, rarity, visiting_order
from active3d_pipe.structures import Camera

CAMERA = Camera.from_fov(96, 64, 80.0)
EYE = np.array([-0.5, 0.6, 0.9])


def view(yaw_deg: float):
    yaw = np.radians(yaw_deg)
    return render(CAMERA, se3.look_at(EYE, EYE + np.array([np.cos(yaw), np.sin(yaw), -0.1])), step=0)


def test_a_frame_counts_by_how_few_frames_show_what_it_shows() -> None:
    same, other = view(0), view(180)
    np.testing.assert_allclose(rarity([same, same, same, other]), [2 / 3, 2 / 3, 2 / 3, 2])


def test_partly_shared_views_lie_between() -> None:
    weights = rarity([view(0), view(0), view(40), view(180)])
    assert weights[0] == weights[1] < weights[2] < weights[3]


def test_frames_without_a_reading_count_as_the_mean() -> None:
    blind = replace(view(0), depth=np.zeros((64, 96), np.float32))
    np.testing.assert_allclose(rarity([view(0), view(180), blind]), 1)
    np.testing.assert_allclose(rarity([blind, blind]), 1)


def test_rarity_does_not_ask_where_the_origin_is() -> None:
    # Whole cells away, to both sides of every axis.
    def moved(frame, by: float):
        pose = frame.T_world_camera.copy()
        pose[:3, 3] += by
        return replace(frame, T_world_camera=pose)

    frames = [view(yaw) for yaw in (0, 20, 40, 180)]
    expected = rarity([moved(f, 64.0) for f in frames])
    np.testing.assert_allclose(rarity([moved(f, -64.0) for f in frames]), expected, rtol=0.02)


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
