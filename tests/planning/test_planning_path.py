from itertools import pairwise

import box_world
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from active3d_pipe.geometry import se3
from active3d_pipe.planning import kernels_rrt
from active3d_pipe.planning.config import PlanningSettings
from active3d_pipe.planning.free_space import build_free_space
from active3d_pipe.planning.path import look_around, resample, step_path, turn_towards
from active3d_pipe.planning.risk_field import interpolate
from active3d_pipe.planning.rrt_star import cost_rate, plan_path
from active3d_pipe.structures.motion import MotionSettings

MOTION, SETTINGS = MotionSettings(), PlanningSettings()


def obeys(T_start, path, motion=MOTION):
    poses = np.concatenate([T_start[None], path])
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turns = [se3.rotation_angle(a[:3, :3], b[:3, :3]) for a, b in pairwise(poses)]
    return steps.max(initial=0) <= motion.max_step_m and np.degrees(max(turns, default=0)) <= motion.max_turn_deg


angle = st.floats(-np.pi, np.pi)
tilt = st.floats(-1.4, 1.4)


@settings(deadline=None, max_examples=60)
@given(angle, tilt, angle, tilt)
def test_turning_arrives_within_the_limit_and_stays_level(yaw, pitch, yaw_goal, pitch_goal):
    R = se3.pose_from_yaw_pitch(np.zeros(3), yaw, pitch)[:3, :3]
    goal = se3.pose_from_yaw_pitch(np.zeros(3), yaw_goal, pitch_goal)[:3, :3]
    turns_until(R, goal)


def turns_until(R, goal):
    """How many turns of at most 10 degrees lead to the goal; a level camera stays level."""
    n, level, limit = 0, abs(R[2, 0]) < 1e-9, np.radians(10)
    while se3.rotation_angle(R, goal) > 1e-6:
        new = turn_towards(R, goal, limit)
        assert se3.rotation_angle(R, new) <= limit + 1e-9
        assert not level or abs(new[2, 0]) < 1e-9
        R, n = new, n + 1
        assert n < 60
    return n


def test_turning_a_rolled_camera_arrives_too():
    roll = np.array([[np.cos(1), -np.sin(1), 0], [np.sin(1), np.cos(1), 0], [0, 0, 1]])
    R = se3.pose_from_yaw_pitch(np.zeros(3), 0.3, 0.2)[:3, :3] @ roll
    goal = se3.pose_from_yaw_pitch(np.zeros(3), 2.0, 0.0)[:3, :3]
    # 97 degrees of yaw at least; the shortest rotation needs no detour.
    assert turns_until(R, goal) == np.ceil(np.degrees(se3.rotation_angle(R, goal)) / 10)


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10**6), st.integers(1, 6))
def test_step_paths_obey_the_motion_limits_and_end_at_the_goal(seed, corners):
    rng = np.random.default_rng(seed)
    T = se3.pose_from_yaw_pitch(rng.normal(size=3), rng.uniform(-3, 3), rng.uniform(-1, 1))
    points = np.concatenate([T[None, :3, 3], T[:3, 3] + rng.normal(size=(corners, 3)).cumsum(axis=0)])
    goal = se3.pose_from_yaw_pitch(np.zeros(3), rng.uniform(-3, 3), rng.uniform(-1, 1))[:3, :3]
    middle = se3.pose_from_yaw_pitch(np.zeros(3), rng.uniform(-3, 3), 0.0)[:3, :3]
    path = step_path(T, points, [(0.7, middle), (99.0, goal)], MOTION)
    assert obeys(T, path)
    np.testing.assert_allclose(path[-1, :3, 3], points[-1], atol=1e-9)
    assert se3.rotation_angle(path[-1, :3, :3], goal) < 1e-5
    assert len(step_path(T, points, [(99.0, goal)], MOTION, 3)) == min(3, len(path))


def test_a_path_looks_at_its_waypoint_when_it_passes():
    T = se3.pose_from_yaw_pitch(np.zeros(3), 0.0, 0.0)
    side = se3.pose_from_yaw_pitch(np.zeros(3), 1.2, 0.0)[:3, :3]
    path = step_path(T, np.array([[0, 0, 0], [1.99, 0, 0]]), [(1.0, side), (1.99, T[:3, :3])], MOTION)
    assert len(path) == 20
    assert se3.rotation_angle(path[9][:3, :3], side) < 1e-6
    assert se3.rotation_angle(path[-1][:3, :3], T[:3, :3]) < 1e-6


def test_resampling_keeps_the_length():
    points = np.array([[0, 0, 0], [0.31, 0, 0], [0.31, 0.2, 0]])
    positions, s = resample(points, 0.1)
    assert len(positions) == 6 and s[-1] == pytest.approx(0.51)
    np.testing.assert_allclose(positions[-1], points[-1])
    assert len(resample(points[:1], 0.1)[0]) == 0


@pytest.mark.parametrize("pitch", [0.0, 0.4])
def test_look_around_turns_once_and_sees_up_and_down(pitch):
    T = se3.pose_from_yaw_pitch(np.array([1.0, 2.0, 3.0]), 0.5, pitch)
    path = look_around(T, 360.0, 25.0, MOTION)
    assert obeys(T, path)
    assert 36 <= len(path) <= 60
    assert (path[:, :3, 3] == T[:3, 3]).all()
    pitches = np.degrees([se3.yaw_pitch(P)[1] for P in path])
    assert pitches.min() < -18 and pitches.max() > 18
    assert len(look_around(T, 0.0, 25.0, MOTION)) == 0


@pytest.fixture(scope="module")
def space():
    """All of the two rooms seen; the agent in the first."""
    world = box_world.two_rooms()
    for x, y in ((0.8, 0.8), (3.2, 3.2), (2.0, 2.9), (4.8, 3.2), (4.6, 1.2), (6.9, 1.4), (6.3, 3.0)):
        for yaw in np.arange(0, 6.28, 0.6):
            for pitch in (-0.6, 0.5):
                world.capture(se3.pose_from_yaw_pitch(np.array([x, y, 1.2]), yaw, pitch))
    T = se3.pose_from_yaw_pitch(np.array([0.83, 0.79, 1.22]), 0.0, 0.0)
    return world, build_free_space(world.volume(), T, T[None, :3, 3], MOTION, SETTINGS), T


def dense(points):
    """Sixty points on every edge of a polyline."""
    s = np.linspace(0, 1, 60)[:, None]
    return np.concatenate([a + (b - a) * s for a, b in pairwise(points)])


def plan(space, T, goal, seed=0, settings=SETTINGS, reward=None):
    return plan_path(space, T[:3, 3], np.asarray(goal), reward, settings, np.random.default_rng(seed))


def test_rrt_star_goes_through_the_door_and_is_truly_clear(space):
    world, free, T = space
    goal = free.grid.index_of(np.array([6.8, 1.2, 1.0]))
    assert free.reachable[tuple(goal)]
    path = plan(free, T, goal)
    assert path.cost <= path.grid_cost + 1e-4
    assert path.length_m >= np.linalg.norm(path.points[-1] - path.points[0])
    np.testing.assert_allclose(path.points[0], T[:3, 3])
    np.testing.assert_allclose(path.points[-1], free.grid.centre_of(goal))
    fine = dense(path.points)
    assert world.clearance(fine).min() >= MOTION.agent_radius_m
    crossing = fine[np.abs(fine[:, 0] - 3.97).argmin()]
    assert 2.6 < crossing[1] < 3.4 and crossing[2] < 2.0


def test_samples_make_the_path_cheaper_and_the_same_seed_gives_the_same_path(space):
    _, free, T = space
    goal = free.grid.index_of(np.array([6.8, 1.2, 1.0]))
    none = plan(free, T, goal, settings=PlanningSettings(rrt_iterations=0))
    many = PlanningSettings(rrt_iterations=1500)
    first, again, other = (plan(free, T, goal, seed, many) for seed in (0, 0, 1))
    assert none.num_checks == 0 < first.num_checks
    assert max(first.cost, other.cost) < 0.985 * none.cost < none.grid_cost
    np.testing.assert_array_equal(first.points, again.points)
    assert not np.array_equal(first.points, other.points)


def test_the_cost_of_a_path_is_its_length_and_its_risk(space):
    _, free, T = space
    path = plan(free, T, free.grid.index_of(np.array([6.8, 1.2, 1.0])), settings=PlanningSettings(lambda_risk=10.0))
    assert path.cost == pytest.approx(path.length_m + 10 * total_risk(free, path), rel=2e-3)
    assert path.cost > 1.05 * path.length_m
    assert path.max_risk == pytest.approx(free.risk.at(dense(path.points))[0].max(), abs=0.02)
    assert path.min_clearance_m == pytest.approx(free.risk.at(dense(path.points))[1].min(), abs=0.01)


def total_risk(free, path):
    """Integral of C_risk along a path, m: means of sixty pieces of every edge."""
    middle = (np.arange(60) + 0.5) / 60
    edges = ((a + (b - a) * middle[:, None], np.linalg.norm(b - a)) for a, b in pairwise(path.points))
    return sum(length * free.risk.at(points)[0].mean() for points, length in edges)


def test_risk_bends_the_path_away_from_obstacles(space):
    _, free, T = space
    goal = free.grid.index_of(np.array([6.8, 1.2, 1.0]))
    bold = plan(free, T, goal, settings=PlanningSettings(lambda_risk=0.0))
    careful = plan(free, T, goal, settings=PlanningSettings(lambda_risk=10.0))
    assert total_risk(free, careful) < 0.3 * total_risk(free, bold)
    assert careful.max_risk < 0.5 * bold.max_risk
    assert bold.length_m < careful.length_m < 1.1 * bold.length_m
    assert bold.cost == pytest.approx(bold.length_m)


def test_reward_draws_the_path(space):
    _, free, T = space
    goal = free.grid.index_of(np.array([3.0, 0.8, 1.2]))
    x, y = free.grid.axis(0), free.grid.axis(1)
    reward = np.zeros(free.grid.shape, np.float32)
    attracted = reward.copy()
    attracted[np.ix_((x > 1.2) & (x < 2.6), (y > 1.1) & (y < 1.5), np.arange(free.grid.shape[2]) > 0)] = 1
    greedy = PlanningSettings(eta=0.8, rrt_iterations=2000)
    plain, drawn = plan(free, T, goal, reward=reward), plan(free, T, goal, reward=attracted, settings=greedy)

    def share(path):
        points = dense(path.points)
        return interpolate(attracted, free.grid, points, outside=0.0).mean()

    assert share(drawn) > share(plain) + 0.2
    assert cost_rate(free, attracted, greedy).min() > 0


def test_trilinear_kernel_equals_the_reference(space):
    _, free, _ = space
    rng = np.random.default_rng(3)
    points = free.grid.low + rng.random((200, 3)) * (free.grid.high - free.grid.low)
    want = interpolate(free.risk.risk, free.grid, points, outside=1.0)
    local = ((points - free.grid.origin) / free.grid.voxel_size).astype(np.float32)
    got = [kernels_rrt.trilinear(free.risk.risk, *p) for p in local]
    np.testing.assert_allclose(got, want, atol=2e-4)
