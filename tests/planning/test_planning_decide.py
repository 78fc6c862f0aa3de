from itertools import pairwise

import box_world
import numpy as np
import pytest

from active3d_pipe.errors import InputError
from active3d_pipe.geometry import se3
from active3d_pipe.planning.config import PlanningSettings
from active3d_pipe.planning.decide import bootstrap_decision, decide
from active3d_pipe.structures import Decision, Reason
from active3d_pipe.structures.motion import MotionSettings

MOTION, SETTINGS = MotionSettings(), PlanningSettings()
START = (0.8, 0.8, 1.2)


def explore(world, start, *, budget, motion=MOTION, settings=SETTINGS, target=None):
    """Run the loop capture -> volume -> decide until it stops; (walked poses, decisions, seen share per step)."""
    decision = bootstrap_decision(se3.pose_from_yaw_pitch(np.array(start), 0.3, 0.0), motion, settings)
    walked, decisions, curve = [], [], []
    while not decision.stop and len(walked) < budget:
        for T in decision.path:
            world.capture(T)
            walked.append(T)
            if target is not None:
                curve.append((world.seen & target).sum() / target.sum())
        rng = np.random.default_rng(len(decisions))
        volume = world.volume(len(decisions))
        decision = decide(
            volume, walked[-1], np.array(walked), world.camera, motion, settings, rng, previous=decision
        )
        decisions.append(decision)
    return np.array(walked), decisions, curve


def check_motion(world, walked, motion):
    """Every step within its limits, and the body truly clear along the whole way."""
    steps = np.linalg.norm(np.diff(walked[:, :3, 3], axis=0), axis=1)
    turns = [se3.rotation_angle(a[:3, :3], b[:3, :3]) for a, b in pairwise(walked)]
    assert steps.max() <= motion.max_step_m
    assert np.degrees(max(turns)) <= motion.max_turn_deg
    middle = 0.5 * (walked[:-1, :3, 3] + walked[1:, :3, 3])
    assert world.clearance(np.concatenate([walked[:, :3, 3], middle])).min() >= motion.agent_radius_m


def test_two_rooms_are_explored_without_touching_anything_and_then_it_stops():
    world = box_world.two_rooms()
    target, _ = box_world.reachable_surface(world, START)
    settings = PlanningSettings(
        stop_reward=40.0, spread_share=0, max_positions=250, exact_top=20, rrt_iterations=300
    )
    walked, decisions, curve = explore(world, START, budget=420, target=target, settings=settings)
    assert decisions[-1].reason is Reason.STOP_GAIN
    assert curve[-1] >= 0.96
    assert np.argmax(np.array(curve) >= 0.9) <= 170
    check_motion(world, walked, MOTION)
    assert walked[:, 0, 3].max() > 5.0
    # No wavering between the rooms: the door is passed a few times at most.
    assert np.abs(np.diff(walked[:, 0, 3] > 3.97)).sum() <= 5
    for decision in decisions[:-1]:
        assert 1 <= len(decision.path) <= settings.max_steps_per_round
        assert decision.ranking[decision.chosen].reward >= settings.stop_reward
        assert decision.ranking[decision.chosen].reachable
        assert {"gain_imp", "gain_exp", "path_length_m", "max_risk", "num_candidates"} <= decision.terms.keys()
    assert Decision.from_json(decisions[0].to_json()).to_json() == decisions[0].to_json()


def test_a_ground_robot_keeps_its_height():
    world = box_world.build((3.0, 2.6, 2.0), [((1.2, 0.9, 0), (1.8, 1.5, 0.9))])
    motion = MotionSettings(model="ground")
    walked, decisions, _ = explore(
        world, (0.6, 0.6, 1.0), budget=150, motion=motion, settings=PlanningSettings(stop_reward=30.0, spread_share=0.2)
    )
    np.testing.assert_array_equal(walked[:, 2, 3], 1.0)
    check_motion(world, walked, motion)
    assert np.ptp(walked[:, 0, 3]) > 0.8
    assert decisions[-1].reason is Reason.STOP_GAIN


@pytest.fixture(scope="module")
def after_first_look():
    """Two rooms after the bootstrap turn: (world, walked poses, bootstrap decision)."""
    world = box_world.two_rooms()
    first = bootstrap_decision(se3.pose_from_yaw_pitch(np.array(START), 0.3, 0.0), MOTION, SETTINGS)
    for T in first.path:
        world.capture(T)
    return world, first.path, first


def take(world, walked, seed=0, settings=SETTINGS, previous=None, volume=None):
    return decide(
        volume or world.volume(3), walked[-1], walked, world.camera, MOTION, settings,
        np.random.default_rng(seed), previous=previous,
    )


def test_same_input_same_bytes(after_first_look):
    world, walked, first = after_first_look
    a, b = (take(world, walked, previous=first) for _ in range(2))
    assert a.to_json() == b.to_json()
    assert a.round == 3


def test_the_ranking_is_sorted_and_explained(after_first_look):
    world, walked, first = after_first_look
    d = take(world, walked, previous=first)
    utilities = [c.utility for c in d.ranking]
    assert utilities == sorted(utilities, reverse=True)
    assert len(d.ranking) == SETTINGS.num_ranked
    assert d.terms["num_candidates"] > 1000
    assert d.terms["gain"] == pytest.approx(d.terms["gain_imp"] + d.terms["gain_exp"])
    assert all(c.gain_exp > 0 for c in d.ranking)


def test_it_goes_on_to_a_goal_it_did_not_reach(after_first_look):
    world, walked, _ = after_first_look
    settings = PlanningSettings(max_steps_per_round=5, min_steps_per_round=1, view_steps=40.0)
    d = take(world, walked, settings=settings)
    assert d.terms["goal_ahead"]
    goal = d.ranking[d.chosen].T_world_camera
    again = take(world, np.concatenate([walked, d.path]), settings=settings, previous=d)
    assert again.terms["committed"]
    np.testing.assert_allclose(again.ranking[again.chosen].T_world_camera, goal)


def test_it_stops_when_nothing_is_left_to_gain(after_first_look):
    world, walked, _ = after_first_look
    d = take(world, walked, settings=PlanningSettings(stop_reward=1e6, spread_share=0))
    assert d.stop and d.reason is Reason.STOP_GAIN and len(d.path) == 0
    assert 0 < d.terms["best_reward"] < 1e6


def test_before_it_stops_it_spreads_its_views_for_a_share_of_the_steps(after_first_look):
    """From the first turn some surface was looked at often, some hardly; nothing new counts here."""
    world, walked, first = after_first_look
    settings = PlanningSettings(stop_reward=1e6, spread_share=0.6, max_steps_per_round=12)
    previous, decisions = first, []
    while not previous.stop:
        previous = take(world, walked, settings=settings, previous=previous)
        walked = np.concatenate([walked, previous.path])
        decisions.append(previous)
        for T in previous.path:
            world.capture(T)
    *spread, last = decisions
    assert all(d.reason is Reason.SPREAD and len(d.path) > 0 for d in spread)
    assert last.reason is Reason.STOP_GAIN
    steps = np.cumsum([len(d.path) for d in spread])
    assert [d.terms["spread_steps"] for d in spread] == steps.tolist()
    explored = len(first.path) + 1  # the pose where the agent stands counts once more
    assert steps[-2] < 0.6 * explored <= steps[-1]
    assert spread[-1].terms["spread_shortfall"] < spread[0].terms["spread_shortfall"]
    assert {d.terms["stop_reward"] for d in decisions} == {1e6}
    check_motion(world, walked, MOTION)


def test_while_views_are_spread_it_asks_every_fourth_round_whether_something_new_is_in_reach(after_first_look):
    world, walked, first = after_first_look
    spreading = take(world, walked, settings=PlanningSettings(stop_reward=1e6, spread_share=9.0), previous=first)
    assert spreading.reason is Reason.SPREAD
    settings = PlanningSettings(spread_share=9.0)  # to which there is much left to see
    found = {
        k: take(world, walked, settings=settings, previous=spreading, volume=world.volume(k)) for k in range(4, 9)
    }
    assert [k for k, d in found.items() if d.reason is Reason.BEST_GAIN] == [4, 8]
    assert all(found[k].reason is Reason.SPREAD for k in (5, 6, 7))
    assert found[5].terms["best_reward"] == spreading.terms["best_reward"]


def test_a_walled_in_agent_looks_around_goes_back_and_stops():
    world = box_world.build((3.0, 2.0, 2.0), [])
    T = se3.pose_from_yaw_pitch(np.array([1.5, 1.0, 1.0]), 0.0, 0.0)
    away = se3.pose_from_yaw_pitch(np.array([0.6, 1.0, 1.0]), 0.0, 0.0)
    volume = world.volume()
    for name, value in (("free_evidence", 0), ("hit_evidence", 9), ("occupancy", 0.99), ("view_quality", 1)):
        volume[name][:] = value
    free = np.linalg.norm(world.grid.centres() - away[:3, 3], axis=-1) < 0.7
    for name, value in (("free_evidence", 30), ("hit_evidence", 0), ("occupancy", 0.01)):
        volume[name][free] = value
    walked = np.stack([away, se3.pose_from_yaw_pitch(np.array([1.0, 1.0, 1.0]), 0.0, 0.0), T])
    first = take(world, walked, volume=volume)
    second = take(world, walked, volume=volume, previous=first)
    third = take(world, walked, volume=volume, previous=second)
    assert [d.reason for d in (first, second, third)] == [
        Reason.LOOK_AROUND, Reason.BACKTRACK, Reason.STOP_STUCK
    ]
    assert len(first.path) >= 36
    assert third.stop
    assert np.linalg.norm(second.path[-1][:3, 3] - away[:3, 3]) < np.linalg.norm(T[:3, 3] - away[:3, 3])


def test_a_narrow_door_is_passed_with_less_clearance():
    """Both sides are free space; only a gap as wide as the agent needs joins them, and all gain lies beyond."""
    world = box_world.build((3.0, 2.0, 2.0), [])
    grid = world.grid
    x, y, _ = np.moveaxis(grid.centres(), -1, 0)
    volume = world.volume()
    inside = ((grid.centres() > 0.1) & (grid.centres() < np.array([2.9, 1.9, 1.9]))).all(axis=-1)
    wall = (np.abs(x - 1.525) < 0.06) & (np.abs(y - 1.0) > 0.26)
    for name, value in (("free_evidence", 30), ("hit_evidence", 0), ("occupancy", 0.01), ("view_quality", 0)):
        volume[name][inside] = value
    for name, value in (("free_evidence", 0), ("hit_evidence", 9), ("occupancy", 0.99), ("view_quality", 1)):
        volume[name][~inside | wall] = value
    poor = ~inside & (x > 1.7) & (x < 2.3) & ((y < 0.1) | (y > 1.9))
    volume["view_quality"][poor] = 0
    T = se3.pose_from_yaw_pitch(np.array([0.825, 1.025, 1.025]), np.pi, 0.0)
    settings = PlanningSettings(stop_reward=30.0, clearance_margin_m=0.15)
    d = take(world, T[None], volume=volume, settings=settings)
    assert d.reason is Reason.RELAXED
    assert d.ranking[d.chosen].T_world_camera[0, 3] > 1.5
    assert d.terms["min_clearance_m"] >= MOTION.agent_radius_m - 1e-6


def test_a_pose_outside_the_volume_is_one_clear_line(after_first_look):
    world, walked, _ = after_first_look
    outside = se3.pose_from_yaw_pitch(np.array([40.0, 0, 0]), 0.0, 0.0)
    with pytest.raises(InputError, match="outside the volume"):
        decide(world.volume(), outside, walked, world.camera, MOTION, SETTINGS, np.random.default_rng(0))


def test_bootstrap_starts_at_the_start_pose():
    T = se3.pose_from_yaw_pitch(np.array(START), 0.3, 0.2)
    d = bootstrap_decision(T, MOTION, SETTINGS)
    np.testing.assert_allclose(d.path[0], T)
    assert (d.round, d.reason, d.stop) == (-1, Reason.START, False)
    assert len(bootstrap_decision(T, MOTION, PlanningSettings(bootstrap_turn_deg=0)).path) == 1
