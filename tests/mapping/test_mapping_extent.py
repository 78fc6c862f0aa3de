"""The box of an unknown scene: found in depth readings, grown with them, not blown up by outliers."""

import numpy as np
import pytest

from active3d_pipe.geometry import se3
from active3d_pipe.mapping.config import ExtentSettings
from active3d_pipe.mapping.extent import first_box, grown_box
from active3d_pipe.structures import Camera, Frame

CAMERA = Camera.from_fov(160, 120, 90, near=0.05, far=10.0)
SETTINGS = ExtentSettings()
ROOM = np.array([[-2.0, -1.5, 0.0], [2.0, 1.5, 2.5]])
EYE = np.array([0.3, -0.2, 1.2])


def look(depth, yaw=0.0, position=EYE, step=0):
    T = se3.pose_from_yaw_pitch(np.asarray(position), yaw, 0.0)
    rgb = np.zeros((*depth.shape, 3), np.uint8)
    return Frame(rgb=rgb, depth=depth.astype(np.float32), camera=CAMERA, T_world_camera=T, step=step, stamp_ns=step)


def wall_depth(yaw, position=EYE, room=ROOM, door=None):
    """Depth of the inside of a box; through `door` (y, half width) of the wall x = high one sees 3 m farther."""
    from active3d_pipe.geometry.projection import pixel_rays

    T = se3.pose_from_yaw_pitch(np.asarray(position), yaw, 0.0)
    d = pixel_rays(CAMERA) @ T[:3, :3].T
    with np.errstate(divide="ignore"):
        z = np.where(d > 0, (room[1] - position) / d, (room[0] - position) / d)
    out = z.min(axis=-1)
    if door is not None:
        at = position + d * out[..., None]
        through = (z.argmin(axis=-1) == 0) & (d[..., 0] > 0) & (np.abs(at[..., 1] - door[0]) < door[1])
        farther = (room[1, 0] + 3.0 - position[0]) / np.where(d[..., 0] > 0, d[..., 0], 1)
        out = np.where(through, np.minimum(farther, z[..., 1:].min(axis=-1)), out)
    return out


def around(room=ROOM, **more):
    return [look(wall_depth(yaw, room=room, **more), yaw, step=i) for i, yaw in enumerate(np.arange(6) * np.pi / 3)]


def test_the_first_box_holds_the_room_and_little_more():
    box = first_box(around(), SETTINGS)
    assert (box[0] <= ROOM[0] - SETTINGS.margin_m).all()
    assert (box[1] >= ROOM[1] + SETTINGS.margin_m).all()
    assert np.abs(box - ROOM).max() < 2 * SETTINGS.margin_m + 0.15
    np.testing.assert_array_equal(grown_box(box, around(), SETTINGS), box)


@pytest.mark.parametrize("share", [0.001, 0.02])
def test_outliers_of_the_sensor_do_not_blow_it_up(share):
    clean, frames, rng = first_box(around(), SETTINGS), around(), np.random.default_rng(0)
    for f in frames:
        hit = rng.random(f.depth.shape) < share
        f.depth[hit] = rng.uniform(0.1, 10, hit.sum())
        f.depth[rng.random(f.depth.shape) < share] = 0
        f.depth[rng.random(f.depth.shape) < share] = np.inf
    assert np.abs(first_box(frames, SETTINGS) - clean).max() < 0.25
    np.testing.assert_array_equal(grown_box(clean, frames, SETTINGS), clean)


def test_a_thin_far_part_counts():
    """A rod one pixel wide, 8 m away: few readings, but they stand together."""
    box = first_box(around(), SETTINGS)
    frame = look(wall_depth(0.0), 0.0)
    frame.depth[52:66, 80] = 8.0
    grown = grown_box(box, [frame, look(frame.depth, step=1)], SETTINGS)
    assert grown[1, 0] >= EYE[0] + 8.0 + SETTINGS.margin_m
    np.testing.assert_array_equal(grown[0], box[0])


def test_a_door_leads_to_growth_by_whole_chunks():
    box = first_box(around(), SETTINGS)
    frames = around(door=(0.0, 0.4))
    grown = grown_box(box, frames, SETTINGS)
    assert grown[1, 0] >= ROOM[1, 0] + 3.0 + SETTINGS.margin_m
    assert grown[1, 0] <= ROOM[1, 0] + 3.0 + SETTINGS.margin_m + SETTINGS.chunk_m + 1e-6
    chunks = (grown - box) / SETTINGS.chunk_m
    np.testing.assert_allclose(chunks, np.rint(chunks), atol=1e-6)
    np.testing.assert_array_equal(grown[0, :2], box[0, :2])
    np.testing.assert_array_equal(grown_box(grown, frames, SETTINGS), grown)


def test_no_readings_no_growth_and_readings_beyond_far_are_free_space_up_to_far():
    box = first_box(around(), SETTINGS)
    window = wall_depth(0.0)
    window[40:70, 60:100] = 0
    np.testing.assert_array_equal(grown_box(box, [look(window)], SETTINGS), box)
    window[40:70, 60:100] = 500.0
    grown = grown_box(box, [look(window)], SETTINGS)
    assert EYE[0] + 10 + SETTINGS.margin_m <= grown[1, 0] <= EYE[0] + 10 + SETTINGS.margin_m + SETTINGS.chunk_m


def test_limits_hold_growth_back():
    box = first_box(around(), SETTINGS)
    far = np.full((120, 160), 9.5)
    frames = [look(far, yaw, step=i) for i, yaw in enumerate(np.arange(6) * np.pi / 3)]
    edges = grown_box(box, frames, ExtentSettings(max_extent_m=8.0))
    assert (edges[1] - edges[0] <= 8.0 + 1e-6).all()
    assert (edges[1] - edges[0])[0] > 8.0 - SETTINGS.chunk_m
    volume = grown_box(box, frames, ExtentSettings(max_volume_m3=300.0))
    assert 200 < np.prod(volume[1] - volume[0]) <= 300.0
    first = first_box(frames, ExtentSettings(max_volume_m3=300.0))
    assert 250 < np.prod(first[1] - first[0]) <= 300.0


def test_a_blind_camera_has_a_box_around_it():
    box = first_box([look(np.zeros((120, 160)))], SETTINGS)
    assert (box[0] <= EYE - 0.5).all()
    assert (box[1] >= EYE + 0.5).all()
