"""The criteria of keyframe choice (eq. kf_selection), one by one, where the answer is known by hand."""

import numpy as np
import pytest

from active3d_pipe.geometry import se3
from active3d_pipe.mapping.config import KeyframeSettings
from active3d_pipe.mapping.keyframes import (
    Information,
    Keyframe,
    depth_samples,
    divergence,
    select_keyframes,
    view_distance,
)
from active3d_pipe.structures import VOLUMES, Camera, Frame, UncertaintyVolume, VoxelGrid

# So few pixels that a frame has four samples for its voxels and none for the overlap: the angle alone diverges.
CAMERA = Camera.from_fov(12, 12, 90)
GRID = VoxelGrid(np.full(3, -3.0), 1.0, (6, 6, 6))
SEEN = np.array([[4, 2, 2], [4, 2, 3], [4, 3, 2], [4, 3, 3]])  # what a look along x meets in 1.3 m
BITS, U_IMP, U_EXP = [1.0, 0.5, 0.25, 0.01], [0.2, 0.2, 0.1, 0.2], [0.2, 0.1, 0.2, 0.15]


def look(yaw_deg=0.0, *, roll_deg=0.0, step=0, depth=1.3, camera=CAMERA):
    T = se3.pose_from_yaw_pitch(np.zeros(3), np.radians(yaw_deg), 0.0)
    c, s = np.cos(np.radians(roll_deg)), np.sin(np.radians(roll_deg))
    T[:3, :3] = T[:3, :3] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    shape = (camera.height, camera.width)
    return Frame(step, step, camera, T, np.zeros((*shape, 3), np.uint8), np.full(shape, depth, np.float32))


def keyframe(*args, **kwargs):
    return Keyframe(look(*args, **kwargs), 0, "viewpoint", 1.0, 0.0, 0.0)


def volume():
    """Four voxels that hold something: 1.75 bits above the floor, one of them uncertain in both branches."""
    arrays = {name: np.zeros(GRID.shape, np.float32) for name in VOLUMES}
    for name, values in (("entropy", BITS), ("u_imp", U_IMP), ("u_exp", U_EXP)):
        arrays[name][tuple(SEEN.T)] = values
    return UncertaintyVolume(GRID, 0, arrays)


def flat(voxels):
    return np.ravel_multi_index(tuple(np.asarray(voxels).T), GRID.shape)


def test_a_frame_sees_the_voxels_of_its_readings_each_once():
    information = Information(volume(), KeyframeSettings())
    assert sorted(information.visible(look())) == sorted(flat(SEEN))
    assert sorted(information.visible(look(depth=0.3))) == sorted(flat(SEEN - [1, 0, 0]))
    assert len(information.visible(look(depth=9.0))) == 0  # beyond the grid
    assert len(information.visible(look(depth=0.0))) == 0  # no reading
    fine = Camera.from_fov(60, 60, 90)
    assert len(information.visible(look(depth=0.3, camera=fine))) == 4


def test_gain_is_the_entropy_of_the_visible_voxels_above_the_floor():
    information = Information(volume(), KeyframeSettings())
    assert information.gain(flat(SEEN)) == 1.75
    assert information.gain(flat(SEEN[1:2])) == 0.5
    assert information.gain(flat(SEEN[:0])) == 0


def test_rho_is_the_share_of_visible_voxels_that_are_uncertain_in_every_branch():
    information = Information(volume(), KeyframeSettings())
    assert information.rho(flat(SEEN)) == 0.25
    assert information.rho(flat(SEEN[1:])) == 0
    assert information.rho(flat(SEEN[:0])) == 0
    field_alone = Information(volume(), KeyframeSettings(high_branches=("imp",)))
    assert field_alone.rho(flat(SEEN)) == 0.75
    assert Information(volume(), KeyframeSettings(tau_high=0.3)).rho(flat(SEEN)) == 0


def test_what_was_told_tells_nothing_again_and_the_volume_stays():
    source = volume()
    information = Information(source, KeyframeSettings())
    information.consume(flat(SEEN[:1]))
    assert information.gain(flat(SEEN)) == 0.75
    assert information.rho(flat(SEEN)) == 0
    assert source["entropy"].max() == 1


@pytest.mark.parametrize(
    ("changed", "step", "reason"),
    [
        ({}, 3, "information"),
        ({"tau_info": 1.75}, 3, None),  # the gain must exceed it
        ({"tau_rho": 0.25}, 3, None),  # and so must rho
        ({"tau_info": 1.75}, 7, None),
        ({"tau_info": 1.75}, 8, "gap"),  # max_gap steps after the last keyframe
        ({"tau_rho": 0.25}, 8, "gap"),
        ({"tau_info": 1.75, "max_gap": 3}, 3, "gap"),
        ({"tau_view": 1.0}, 99, None),  # whatever it brings, and however long it waited
    ],
)
def test_a_frame_is_chosen_for_its_information_or_after_a_gap(changed, step, reason):
    settings = KeyframeSettings(**{"tau_info": 1.7, "tau_rho": 0.2, "max_gap": 8} | changed)
    chosen = select_keyframes([look(step=step)], [keyframe(-90)], volume(), 4, settings)
    assert [(k.frame.step, k.round, k.reason) for k in chosen] == ([(step, 4, reason)] if reason else [])
    assert all((k.delta, k.gain, k.rho) == (1.0, 1.75, 0.25) for k in chosen)


def test_of_two_frames_that_see_the_same_only_the_first_brings_information():
    settings = KeyframeSettings(tau_info=0.5, tau_rho=0.01, max_gap=8)
    frames = [look(roll_deg=90 * i, step=i) for i in range(3)] + [look(roll_deg=270, step=8)]
    chosen = select_keyframes(frames, [keyframe(-90)], volume(), 0, settings)
    assert [(k.frame.step, k.reason, k.gain) for k in chosen] == [(0, "information", 1.75), (8, "gap", 0.0)]


def test_the_gap_counts_from_the_newest_keyframe_and_the_first_frame_waits_for_nothing():
    settings = KeyframeSettings(tau_info=9.0, max_gap=4)
    frames = [look(90 * i, step=i) for i in range(4)] + [look(90 * i, roll_deg=90, step=4 + i) for i in range(4)]
    chosen = select_keyframes(frames, [], volume(), 0, settings)
    assert [(k.frame.step, k.reason) for k in chosen] == [(0, "gap"), (4, "gap")]


@pytest.mark.parametrize(("turn_deg", "taken"), [(16.0, False), (16.5, True), (-16.0, False), (-16.5, True)])
def test_without_a_volume_the_viewpoint_decides_alone(turn_deg, taken):
    """tau_view 0.18 of a field of view of 90 degrees are 16.2 degrees."""
    chosen = select_keyframes([look(turn_deg, step=1)], [keyframe()], None, 0, KeyframeSettings())
    assert [k.reason for k in chosen] == ["viewpoint"] * taken


def test_view_distance_is_half_angle_half_lack_of_overlap():
    """Of the four samples of a frame a camera turned left by half its field of view sees the two on the left."""
    camera = Camera.from_fov(48, 48, 90)
    frame, left = look(depth=1.0, camera=camera), look(45, depth=1.0, camera=camera)
    points = depth_samples(frame)
    assert len(points) == 4
    assert view_distance(frame, points, frame) == 0
    assert view_distance(frame, points, left) == pytest.approx(0.5 * 0.5 + 0.5 * 0.5)
    # Its own readings are nearer: something hides the samples from it.
    assert view_distance(frame, points, look(45, depth=0.9, camera=camera)) == pytest.approx(0.5 * 0.5 + 0.5)
    assert view_distance(frame, points, look(180, depth=1.0, camera=camera)) == 1
    known = [Keyframe(f, 0, "viewpoint", 1.0, 0.0, 0.0) for f in (look(180, camera=camera), left)]
    assert divergence(frame, known) == pytest.approx(0.5)
