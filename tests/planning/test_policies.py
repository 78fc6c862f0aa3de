"""Every registered policy keeps the contract, in a small true world with a real map."""

import copy
import re
import sys
from itertools import pairwise
from pathlib import Path

import box_world
import numpy as np
import pytest

from active3d_pipe.errors import ConfigError, InputError
from active3d_pipe.geometry import projection, se3
from active3d_pipe.mapping.config import MappingSettings
from active3d_pipe.mapping.hybrid_map import HybridMap
from active3d_pipe.mapping.update import update_map
from active3d_pipe.planning.config import PlanningSettings
from active3d_pipe.planning.decide import bootstrap_decision
from active3d_pipe.planning.policies.context import MapView, PolicyContext
from active3d_pipe.planning.policies.registry import POLICIES, make_policy, needs_map, source_digest
from active3d_pipe.structures import Decision, Frame
from active3d_pipe.structures.motion import MotionSettings

MOTION = MotionSettings()
START = (0.8, 0.8, 1.2)
TINY_MAP = MappingSettings.model_validate({
    "gaussian_iterations_per_step": 0.3, "field_iterations_per_step": 0.6, "gaussians": {"max_count": 20000},
    "field": {"rays": 256, "plane_resolutions_m": [0.32, 0.12], "color_plane_resolutions_m": [0.32, 0.12]},
})
DOCS = Path(__file__).parents[2] / "docs" / "policies.md"


class Explorer:
    """The loop capture -> map -> volume -> decide in the box world."""

    def __init__(self, policy, with_map, settings=None):
        self.world = box_world.two_rooms()
        self.settings = settings or PlanningSettings(policy=policy, rrt_iterations=100)
        low, high = self.world.grid.low, self.world.grid.high
        self.hybrid = HybridMap.create(low, high, TINY_MAP, np.random.default_rng(0)) if with_map else None
        start = se3.pose_from_yaw_pitch(np.array(START), 0.3, 0.0)
        self.decision = bootstrap_decision(start, MOTION, self.settings)
        self.walked, self.decisions = [], []

    def capture(self):
        """Walk the decided path; fold the frames into the map."""
        frames = []
        for T in self.decision.path:
            depth = self.world.capture(T)
            points = projection.unproject(depth, T, self.world.camera)
            rgb = (127 + 100 * np.sin(3 * points)).astype(np.uint8)
            frames.append(Frame(len(self.walked), 0, self.world.camera, T, rgb, depth))
            self.walked.append(T)
        if self.hybrid is not None:
            rng = np.random.default_rng(1)
            update_map(self.hybrid, frames, None, len(self.decisions), TINY_MAP, rng, lambda _: None)

    def context(self, recorded=None):
        centres = self.world.grid.centres().reshape(-1, 3)
        if self.hybrid is not None:
            sdf = self.hybrid.field.query_sdf(centres).reshape(self.world.grid.shape)
        else:
            from scipy.ndimage import distance_transform_edt

            sdf = np.clip(0.1 * distance_transform_edt(self.world.hit == 0) - 0.08, -0.1, 0.1).astype(np.float32)
        volume = self.world.volume(len(self.decisions), sdf)
        near = (self.world.quality < 0.5).astype(np.float32)
        volume.arrays["u_imp"][:] = np.maximum(volume["u_final"], near * (self.world.hit > 0))
        view = None if self.hybrid is None else MapView(lambda: self.hybrid)
        rng = np.random.default_rng(len(self.decisions))
        return PolicyContext(
            volume, np.array(self.walked), self.world.camera, MOTION, self.settings, rng, self.decision, view, recorded
        )

    def step(self, policy, recorded=None, *, walk=True):
        """Capture, decide (the first time twice: the same), keep the decision."""
        if walk:
            self.capture()
        first = policy.decide(self.context(recorded))
        if not self.decisions:
            assert first.to_json() == policy.decide(self.context(recorded)).to_json()
        self.decision = first
        self.decisions.append(first)
        return first

    def check(self, decision):
        """What holds for every decision of every policy."""
        path = np.concatenate([self.walked[-1][None], decision.path])
        assert np.isfinite(decision.path).all()
        assert len(decision.path) > 0 or decision.stop
        assert decision.stop == decision.reason.value.startswith("stop")
        if decision.reason.value != "look_around":
            assert len(decision.path) <= self.settings.max_steps_per_round
        for a, b in pairwise(path):
            assert np.linalg.norm(b[:3, 3] - a[:3, 3]) <= MOTION.max_step_m + 1e-9
            assert np.degrees(se3.rotation_angle(a[:3, :3], b[:3, :3])) <= MOTION.max_turn_deg + 1e-6
        middles = 0.5 * (path[:-1, :3, 3] + path[1:, :3, 3])
        places = np.concatenate([path[:, :3, 3], middles])
        assert self.world.clearance(places).min() >= MOTION.agent_radius_m
        grid = self.world.grid
        ijk = grid.index_of(places)
        assert grid.contains_index(ijk).all()
        assert Decision.from_json(decision.to_json()).to_json() == decision.to_json()
        if decision.chosen >= 0:
            assert decision.ranking[decision.chosen].reachable
            utilities = [c.utility for c in decision.ranking]
            assert utilities == sorted(utilities, reverse=True)


@pytest.fixture(scope="module")
def begun():
    """After the first turn, which is the same for every policy; with a real map."""
    made = Explorer("active3d", True)
    made.capture()
    return made


@pytest.mark.parametrize("name", [n for n in POLICIES if n != "trajectory"])
def test_every_policy_keeps_the_contract(name, begun):
    world, policy = copy.deepcopy(begun), make_policy(name)
    world.settings = world.settings.model_copy(update={"policy": name})
    if not needs_map(name):
        world.hybrid = None
    world.check(world.step(policy, walk=False))
    if not world.decision.stop:
        world.check(world.step(policy))
    poses = np.array([*world.walked, *world.decision.path])
    assert np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum() > 0.3 or world.decision.stop


def test_a_recorded_trajectory_is_walked_pose_by_pose():
    leader = Explorer("random", False)
    for _ in range(3):
        leader.step(make_policy("random"))
    recorded = np.array(leader.walked)
    follower = Explorer("trajectory", False)
    policy = make_policy("trajectory")
    while not follower.decision.stop:
        follower.check(follower.step(policy, recorded))
    np.testing.assert_allclose(np.array(follower.walked), recorded)
    assert follower.decision.terms["skipped_poses"] == 0
    with pytest.raises(ConfigError, match=r"planning\.trajectory"):
        policy.decide(follower.context())


def test_the_example_of_the_documentation_runs(tmp_path, monkeypatch):
    text = re.search(r"```python\n(.*?)```", DOCS.read_text(), re.S).group(1)
    assert len(text.splitlines()) <= 42
    (tmp_path / "looking_up.py").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    name = "looking_up:LookingUp"
    try:
        settings = PlanningSettings(policy=name, rrt_iterations=100)
        world, policy = Explorer(name, needs_map(name), settings), make_policy(name)
        for _ in range(2):
            world.check(world.step(policy))
        assert len(world.decisions[0].ranking) > 1 and world.decision.terms["policy"] == name
        assert source_digest(name) is not None
    finally:
        sys.modules.pop("looking_up", None)


def test_unknown_policies_are_named_in_one_line():
    with pytest.raises(ValueError, match="did you mean 'frontier'"):
        PlanningSettings(policy="frontiers")
    with pytest.raises(ConfigError, match="cannot be loaded"):
        make_policy("no_such_module:Policy")


def test_only_policies_that_look_at_the_map_have_it_as_an_input():
    from types import SimpleNamespace

    from active3d_pipe.pipeline.graph import Registry
    from active3d_pipe.pipeline.stage import NodeId
    from stages.registry import FINISH, LOOP

    def inputs(policy):
        config = SimpleNamespace(planning=PlanningSettings(policy=policy))
        return {str(n) for n in Registry(LOOP, FINISH).inputs(NodeId("planning", 3), 3, config)}

    assert inputs("naruto") == inputs("active3d")
    assert inputs("fisherrf") - inputs("active3d") == {"mapping/round_0003"}


def test_the_map_must_be_asked_for():
    world = Explorer("frontier", False)
    world.capture()
    with pytest.raises(InputError, match="needs_map"):
        _ = world.context().the_map


def test_an_unfinished_goal_is_gone_on_to():
    settings = PlanningSettings(policy="naruto", rrt_iterations=100, max_steps_per_round=6)
    world, policy = Explorer("naruto", False, settings), make_policy("naruto")
    first = world.step(policy)
    assert first.terms["goal_ahead"] and len(first.path) == 6
    second = world.step(policy)
    assert second.terms["committed"]
    goals = [d.ranking[d.chosen].T_world_camera for d in (first, second)]
    np.testing.assert_allclose(goals[0][:3, 3], goals[1][:3, 3])


@pytest.mark.slow
@pytest.mark.parametrize("name", list(POLICIES))
def test_every_policy_explores_a_real_room(name, tmp_path):
    """The whole loop on a generated room, each policy in a run folder of its own; nothing is touched."""
    import json

    from tests.tiny_run import active3d

    recorded = tmp_path / "poses.json"
    start = se3.pose_from_yaw_pitch(np.array([1.0, 1.0, 1.2]), 0.0, 0.0)
    recorded.write_text(json.dumps([start.tolist()]))
    run = tmp_path / name
    settings = ["--set", f"planning.policy={name}"]
    if name == "trajectory":
        settings += ["--set", f"planning.trajectory={recorded}"]
    done = active3d("run", "smoke", "--out", run, "--set", "run.steps=40", *settings)
    assert done.returncode == 0, done.stderr
    metrics = json.loads((run / "evaluation" / "metrics.json").read_text())["metrics"]
    assert metrics["collisions"] == 0 and metrics["steps"] >= 16
    decisions = sorted((run / "planning").glob("round_*/decision.json"))
    assert all(json.loads(d.read_text())["reason"] for d in decisions)
