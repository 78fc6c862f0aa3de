"""The window of keyframes that are optimised together, and the older ones that are replayed."""

import numpy as np
import pytest

from active3d_pipe.geometry import se3
from active3d_pipe.mapping.config import WindowSettings
from active3d_pipe.mapping.keyframes import Keyframe
from active3d_pipe.mapping.window import choose_window, draw_keyframe, draw_older
from active3d_pipe.structures import Camera, Frame

CAMERA = Camera.from_fov(12, 12, 90)


def keyframes(*yaws_deg):
    """Keyframes without a reading: their distance is their angle."""
    poses = [se3.pose_from_yaw_pitch(np.zeros(3), np.radians(yaw), 0.0) for yaw in yaws_deg]
    blank = np.zeros((12, 12, 3), np.uint8), np.zeros((12, 12), np.float32)
    frames = [Frame(i, i, CAMERA, T, *blank) for i, T in enumerate(poses)]
    return [Keyframe(f, 0, "viewpoint", 1.0, 0.0, 0.0) for f in frames]


def window(known, num_new, size, policy="viewpoint", frames=()):
    settings = WindowSettings(size=size, policy=policy)
    return choose_window(known, known[len(known) - num_new :], frames, settings)


def test_the_temporal_window_holds_the_last_keyframes():
    known = keyframes(0, 100, 20, 200, 40, 60)
    for num_new in (0, 1, 4):
        assert window(known, num_new, 3, "temporal") == [3, 4, 5]
    assert window(known, 1, 6, "temporal") == window(known, 1, 9, "temporal") == [0, 1, 2, 3, 4, 5]
    assert window([], 0, 3, "temporal") == []


def test_the_viewpoint_window_holds_the_newest_and_what_is_nearest_to_them():
    known = keyframes(0, 100, 20, 200, 40, 60)
    assert window(known, 1, 3) == [2, 4, 5]
    assert window(known, 1, 1) == [5]
    assert window(known, 1, 9) == [0, 1, 2, 3, 4, 5]
    assert window(known, 4, 3) == [3, 4, 5]  # more new ones than it holds: the last of them


def test_near_is_near_to_the_first_the_middle_or_the_last_new_one():
    known = keyframes(45, 175, 95, 5, 0, 90, 180)
    assert window(known, 3, 6) == [1, 2, 3, 4, 5, 6]


def test_a_round_without_keyframes_has_the_neighbours_of_its_frames():
    known = keyframes(0, 100, 20, 200, 40, 60)
    frames = [k.frame for k in keyframes(210, 195, 170)]
    assert window(known, 0, 2, frames=frames) == [1, 3]
    assert window(known, 0, 2) == [4, 5]  # nothing new at all


@pytest.mark.parametrize(("count", "expected"), [(12, 3), (7, 2), (5, 0)])
def test_as_many_older_ones_as_their_share_of_the_window(count, expected):
    """0.5 of 5 keyframes are 3 of those outside, or as many as there are."""
    settings = WindowSettings(size=5, replay=0.5)
    inside = range(count - 5, count)
    drawn = [draw_older(np.random.default_rng(i), inside, count, settings) for i in range(20)]
    for older in drawn:
        assert len(older) == expected and older == sorted(set(older) - set(inside))
    assert len({tuple(older) for older in drawn}) > 1 or expected == count - 5
    assert draw_older(np.random.default_rng(0), inside, count, WindowSettings(size=5, replay=0)) == []


def test_a_keyframe_comes_from_the_window_or_as_often_as_asked_from_the_older_ones():
    rng = np.random.default_rng(0)
    drawn = np.array([draw_keyframe(rng, [7, 8], [1, 2, 3], 0.3) for _ in range(4000)])
    share = [(drawn == i).mean() for i in (7, 8, 1, 2, 3)]
    np.testing.assert_allclose(share, [0.35, 0.35, 0.1, 0.1, 0.1], atol=0.025)
    assert {draw_keyframe(rng, [7], [1], 0.0) for _ in range(50)} == {7}
    assert {draw_keyframe(rng, [7], [1], 1.0) for _ in range(50)} == {1}
    assert draw_keyframe(rng, [7], [], 1.0) == 7
