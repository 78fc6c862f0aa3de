from dataclasses import replace

import box_world
import numpy as np
import pytest
from scipy.ndimage import distance_transform_cdt, distance_transform_edt

from active3d_pipe.geometry import se3
from active3d_pipe.geometry.voxel_traversal import ray_fan
from active3d_pipe.information.gain import FREE, OPEN, SURFACE
from active3d_pipe.planning import kernels_distance, reference_reward
from active3d_pipe.planning.candidates import view_directions
from active3d_pipe.planning.config import PlanningSettings
from active3d_pipe.planning.reward import build_reward_field, exact_terms, sphere_rewards, spread_poses

SETTINGS = PlanningSettings()


@pytest.fixture(scope="module")
def scene():
    """A room with a table, seen from a few poses; (world, poses, reward field)."""
    world = box_world.build((2.6, 2.2, 1.8), [((1.0, 0.8, 0.5), (1.6, 1.4, 0.7)), ((0, 1.8, 0), (0.6, 2.2, 1.4))])
    poses = [se3.pose_from_yaw_pitch(np.array([0.5, 0.5, 1.0]), a, p) for a, p in ((0.2, 0), (0.9, -0.4))]
    for T in poses:
        world.capture(T)
    return world, np.array(poses), build_reward_field(world.volume(), np.array(poses), world.camera, SETTINGS)


def test_the_scene_has_all_kinds(scene):
    kinds = np.bincount(scene[2].kind)
    assert (kinds > 100).all() and len(kinds) == 3


def test_exact_terms_equal_the_reference(scene):
    world, _, field = scene
    poses = np.array([
        se3.pose_from_yaw_pitch(np.array([0.51, 0.62, 0.93]), 2.5, 0.2),
        se3.pose_from_yaw_pitch(np.array([1.93, 0.41, 1.22]), 1.2, -0.5),
    ])
    fan = ray_fan(world.camera, 12)[2]
    for got, T in zip(exact_terms(field, poses, world.camera, 12), poses, strict=True):
        want = reference_reward.exact_terms(field, T, fan)
        assert want.reward > 10 and want.gain > 10
        for name in ("reward", "surface", "gain_imp", "gain_exp"):
            assert getattr(got, name) == pytest.approx(getattr(want, name), rel=0.01), name
        assert got.num_visible == pytest.approx(want.num_visible, rel=0.01)
        assert got.num_open == pytest.approx(want.num_open, rel=0.02)


def test_sphere_rewards_equal_the_reference(scene):
    """Jumps over free space sample other points of the same rays, so single rays differ a little, sums hardly."""
    world, _, field = scene
    d = view_directions(world.camera, 8, (0.0,))
    position = np.array([0.73, 0.58, 1.03])
    got = sphere_rewards(field, position[None], d)[0]
    want = reference_reward.sphere_gain(
        field, (position - field.grid.origin) / field.grid.voxel_size, d.rays.astype(float), d.solid_angles
    ) @ d.members.T
    np.testing.assert_allclose(got, want, rtol=0.06, atol=0.01 * want.max())


def test_sphere_rewards_rank_views_as_the_exact_sum_does(scene):
    world, _, field = scene
    d = view_directions(world.camera, 12, (-35.0, 0.0, 30.0))
    position = np.array([0.55, 0.55, 1.05])
    poses = np.stack([np.eye(4)] * len(d.rotations))
    poses[:, :3, :3], poses[:, :3, 3] = d.rotations, position
    exact = np.array([t.reward for t in exact_terms(field, poses, world.camera)])
    fast = sphere_rewards(field, position[None], d)[0]
    assert np.corrcoef(exact, fast)[0, 1] > 0.97
    # The exact sum counts a voxel in full that lies half outside the frustum or behind an edge.
    assert 0.7 * exact.sum() < fast.sum() < 1.05 * exact.sum()


def test_each_voxel_counts_once(scene):
    """Sixteen times the rays see hardly more: what lies at the rims, no voxel a second time."""
    world, _, field = scene
    camera = world.camera.scaled(4)
    T = se3.pose_from_yaw_pitch(np.array([0.5, 0.5, 1.0]), 0.5, 0.0)[None]
    assert len(ray_fan(camera, 1)[2]) > 15 * len(ray_fan(camera, 4)[2])
    dense, normal = (exact_terms(field, T, camera, n)[0] for n in (1, 4))
    for name in ("reward", "surface", "gain_imp", "gain_exp", "num_visible", "num_open"):
        assert 1 <= getattr(dense, name) / getattr(normal, name) < 1.1, name


def test_what_has_been_seen_is_worth_nothing_any_more(scene):
    world, _, field = scene
    T = se3.pose_from_yaw_pitch(np.array([0.55, 0.55, 1.05]), 2.4, 0.0)
    before = exact_terms(field, T[None], world.camera)[0]
    after = exact_terms(field.after(T, world.camera), T[None], world.camera)[0]
    assert before.reward > 10
    assert after.reward == pytest.approx(0, abs=1e-6)
    assert after.num_visible == before.num_visible


def test_grazed_surface_gains_from_a_frontal_view_but_not_from_another_grazing_one():
    world = box_world.build((3.0, 3.0, 1.6), [])
    along = se3.pose_from_yaw_pitch(np.array([0.4, 2.7, 0.8]), 0.0, 0.0)
    for yaw in np.arange(0, 6.28, 0.6):
        world.capture(se3.pose_from_yaw_pitch(along[:3, 3], yaw, 0.0))
    settings = PlanningSettings(credit_views=0)
    field = build_reward_field(world.volume(), along[None], world.camera, settings)
    frontal = se3.pose_from_yaw_pitch(np.array([2.0, 1.7, 0.8]), np.pi / 2, 0.0)
    grazing = se3.pose_from_yaw_pitch(np.array([0.5, 2.7, 0.8]), 0.0, 0.0)
    terms = exact_terms(field, np.stack([frontal, grazing]), world.camera)
    assert terms[0].surface > 10
    assert terms[0].surface > 3 * terms[1].surface


def test_voxels_looked_at_in_vain_lose_credit(scene):
    """As behind a window: rays through it never return, so what lies there stays open for ever."""
    world, poses, _ = scene
    volume = world.volume()
    T = se3.pose_from_yaw_pitch(np.array([0.5, 0.5, 1.0]), 3.6, 0.0)
    looks = np.repeat(T[None], 8, axis=0)
    looks[:, 0, 3] += np.linspace(0, 0.1, 8)
    none, many = (
        build_reward_field(volume, np.concatenate([poses, p]), world.camera, SETTINGS) for p in (looks[:0], looks)
    )
    a, b = (exact_terms(f, T[None], world.camera)[0] for f in (none, many))
    assert a.reward > 50
    assert b.reward < 0.1 * a.reward
    back = se3.pose_from_yaw_pitch(np.array([0.5, 0.5, 1.0]), 0.9, 0.4)
    assert exact_terms(many, back[None], world.camera)[0].reward > 0


def test_distance_transforms_equal_scipy():
    rng = np.random.default_rng(0)
    source = (rng.random((13, 17, 11)) < 0.01).astype(np.uint8)
    squared = kernels_distance.distance_transform(source, 9, False)
    np.testing.assert_array_equal(squared, np.minimum(np.round(distance_transform_edt(source == 0) ** 2), 81))
    chess = kernels_distance.distance_transform(source, 5, True)
    np.testing.assert_array_equal(chess, np.minimum(distance_transform_cdt(source == 0, "chessboard"), 5))


@pytest.mark.parametrize("reach", [127, 128, 300])
def test_far_distances_do_not_overflow(reach):
    """Two squares of the reach fit int16 up to 127."""
    source = np.zeros((320, 3, 260), np.uint8)
    source[0, 1, 0] = 1
    squared = kernels_distance.distance_transform(source, reach, False)
    assert squared.max() == reach**2
    np.testing.assert_array_equal(squared, np.minimum(np.round(distance_transform_edt(source == 0) ** 2), reach**2))
    chess = kernels_distance.distance_transform(source, reach, True)
    np.testing.assert_array_equal(chess, np.minimum(distance_transform_cdt(source == 0, "chessboard"), reach))


def test_spread_poses_are_distinct_and_start_with_the_newest():
    poses = np.stack([se3.pose_from_yaw_pitch(np.array([0.1 * i, 0, 0]), 0.0, 0.0) for i in range(30)])
    chosen = spread_poses(poses, 4)
    assert chosen[0] == 29 and chosen[1] == 0
    assert len(set(chosen.tolist())) == 4
    assert len(spread_poses(poses[:2], 4)) == 2


def test_kind_constants_match_the_kernels():
    assert (FREE, OPEN, SURFACE) == (0, 1, 2)


def test_a_side_that_was_not_seen_is_worth_a_look():
    """The underside of a table top seen from above only; from below it is no news a second time."""
    world = box_world.build((3.0, 3.0, 2.0), [((1.0, 1.0, 1.0), (2.0, 2.0, 1.05))])
    above = [se3.pose_from_yaw_pitch(np.array([0.4, 0.4, 1.6]), y, -0.4) for y in np.arange(0, 6.28, 0.5)]
    low = [se3.pose_from_yaw_pitch(np.array([2.6, 0.4, 0.5]), y, -0.3) for y in np.arange(0, 6.28, 0.5)]
    under = se3.pose_from_yaw_pitch(np.array([0.6, 0.6, 0.3]), np.pi / 4, 0.6)
    for T in (*above, *low):
        world.capture(T)
    settings, coarse = PlanningSettings(credit_views=0), PlanningSettings(credit_views=0, cell_weight=0)
    before, never = (build_reward_field(world.volume(), under[None], world.camera, s) for s in (settings, coarse))
    for T in (under, se3.pose_from_yaw_pitch(np.array([1.5, 0.4, 0.3]), np.pi / 2, 0.6)):
        world.capture(T)
    after = build_reward_field(world.volume(), under[None], world.camera, settings)
    a, b, c = (exact_terms(f, under[None], world.camera)[0].surface for f in (before, after, never))
    assert a > b + 5
    assert a > c + 5
    n = before.grid.index_of(np.array([[1.1, 1.1, 1.02], [1.7, 1.7, 1.02]]))
    table = tuple(slice(a, b + 1) for a, b in n.T)
    counts = [np.unpackbits(f.open_bits.reshape(before.grid.shape)[table]).sum() for f in (before, after)]
    assert counts[0] > 50
    assert counts[1] < 0.2 * counts[0]


def test_sight_goes_on_through_the_clear_part_of_a_voxel():
    """A gap of 10 cm in a wall of surface voxels that rays went through before shows what lies behind it."""
    world = box_world.build((3.0, 2.0, 2.0), [((1.5, 0.0, 0.0), (1.6, 0.9, 2.0)), ((1.5, 1.0, 0.0), (1.6, 2.0, 2.0))])
    for y in np.linspace(0.85, 1.05, 12):
        world.capture(se3.pose_from_yaw_pitch(np.array([0.5, y, 1.0]), 0.0, 0.0))
    field = build_reward_field(world.volume(), np.zeros((0, 4, 4)), world.camera, SETTINGS)
    T = se3.pose_from_yaw_pitch(np.array([0.6, 0.95, 1.0]), 0.0, 0.0)[None]
    blind = replace(field, clear=np.where(field.kind == FREE, field.clear, np.uint8(0)))
    through, stopped = (exact_terms(f, T, world.camera)[0] for f in (field, blind))
    assert through.num_visible > stopped.num_visible + 20


def test_a_voxel_that_is_seen_free_by_halves_is_worth_a_look_and_stops_none():
    """As with a chair's seat between rays over it and rays under it; a second look in vain halves what is expected."""
    world = box_world.build((3.0, 2.0, 2.0), [])
    for yaw in np.arange(0, 6.28, 0.4):
        world.capture(se3.pose_from_yaw_pitch(np.array([0.6, 1.0, 1.0]), yaw, 0.0))
    T = se3.pose_from_yaw_pitch(np.array([0.6, 1.0, 1.0]), 0.0, 0.0)[None]
    volume = world.volume()
    at = tuple(volume.grid.index_of(np.array([1.53, 1.03, 1.03])))
    flat = np.ravel_multi_index(at, volume.grid.shape)
    settings = PlanningSettings(credit_views=0)
    fields = []
    for bits, used in ((0xFF, settings), (0x55, settings), (0x55, SETTINGS)):
        volume["cells_passed"][at] = bits
        fields.append(build_reward_field(volume, np.repeat(T, 8, axis=0), world.camera, used))
    whole, half, looked_at = fields
    assert [f.kind[flat] for f in fields] == [FREE, OPEN, OPEN]
    assert whole.value[flat] == 0 and half.value[flat] > 0 and half.through[flat] == 1 and not half.opaque[flat]
    assert half.gain_imp[flat] == half.gain_exp[flat] == 0
    assert 0 < looked_at.value[flat] < 0.5 * half.value[flat]
    a, b = (exact_terms(f, T, world.camera)[0] for f in (whole, half))
    assert b.reward - a.reward == pytest.approx(half.value[flat], rel=1e-3)
    assert b.surface == pytest.approx(a.surface)
    beside = (at[0], at[1], at[2] + 1)
    for name in ("free_evidence", "hit_evidence"):
        volume[name][beside] = 0
    at_the_border = build_reward_field(volume, T, world.camera, settings)
    assert at_the_border.kind[flat + 1] == OPEN and at_the_border.kind[flat] == FREE
    assert at_the_border.value[flat] == 0 and at_the_border.value[flat + 1] > 0
