"""The decision of a round: next best view, path, or stop, with reasons.

`decide` is the planner on one page: free space and risk field, reward field, candidates, choice, path. It sees the
uncertainty volume and the poses walked so far, never the scene.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from active3d_pipe.errors import InputError
from active3d_pipe.planning.candidates import Directions, view_directions
from active3d_pipe.planning.choice import Pool, reward_density, score, utility_rate, view_cost_steps
from active3d_pipe.planning.config import PlanningSettings
from active3d_pipe.planning.free_space import FreeSpace, begin_free_space, build_free_space
from active3d_pipe.planning.looks import looks_along
from active3d_pipe.planning.outcome import account_terms, expected_along
from active3d_pipe.planning.path import look_around, step_path
from active3d_pipe.planning.reward import RewardField, build_reward_field, exact_terms
from active3d_pipe.planning.rrt_star import PlannedPath, plan_path
from active3d_pipe.structures.camera import Camera
from active3d_pipe.structures.decision import Decision, Reason
from active3d_pipe.structures.frame import check_pose
from active3d_pipe.structures.motion import MotionSettings
from active3d_pipe.structures.uncertainty_volume import UncertaintyVolume


@dataclass(frozen=True, slots=True, eq=False)
class _Task:
    """What stays the same while one decision is taken."""

    round: int
    T: np.ndarray
    camera: Camera
    directions: Directions
    motion: MotionSettings
    settings: PlanningSettings
    rng: np.random.Generator

    @property
    def round_length_m(self) -> float:
        """How far one round can walk."""
        return self.settings.max_steps_per_round * self.motion.max_step_m


# Times the pairs of the quick search for hidden space in the thorough one.
THOROUGH_PAIRS = 20
# Views that are appended to a short path at most.
LONGEST_CHAIN = 4


def decide(
    volume: UncertaintyVolume,
    T_world_camera: np.ndarray,
    walked_poses: np.ndarray,
    camera: Camera,
    motion: MotionSettings,
    settings: PlanningSettings,
    rng: np.random.Generator,
    *,
    previous: Decision | None = None,
) -> Decision:
    """Choose the next best view (eq. nbv_eig) and the path to it (eq. risk_path), or stop.

    Args:
        volume: what is known, on the grid, after the newest round.
        T_world_camera: (4, 4) current pose.
        walked_poses: (N, 4, 4) every pose captured so far, oldest first.
        camera: its field of view and range; the resolution does not matter.
        rng: for RRT*; same generator state, same decision.
        previous: the decision before this one, for commitment to its goal and for the fallbacks.

    Returns:
        A decision with at most `max_steps_per_round` poses. It stops when no reachable view has an expected
        reward above `stop_reward`, or when the agent cannot move and turning and going back did not help.

    Raises:
        InputError: the current pose is no rigid transform or lies outside the grid.
    """
    T = check_pose(T_world_camera, "current pose")
    grid = volume.grid
    if not grid.contains_index(grid.index_of(T[:3, 3])):
        raise InputError(
            f"current position {T[:3, 3].round(2).tolist()} lies outside the volume {grid.low.round(2).tolist()} .. "
            f"{grid.high.round(2).tolist()}; enlarge the bounds"
        )
    walked = np.concatenate([np.asarray(walked_poses, dtype=np.float64).reshape(-1, 4, 4), T[None]])
    space = begin_free_space(volume, T, walked[:, :3, 3], motion, settings)
    field = build_reward_field(volume, walked, camera, settings)
    directions = view_directions(camera, settings.num_yaws, settings.pitches_deg)
    task = _Task(volume.round, T, camera, directions, motion, settings, rng)
    decision = _choose(task, volume, walked, space(), field, previous)
    promised = expected_along(field, decision.path, camera)
    return replace(decision, terms={**decision.terms, **account_terms(volume, promised, previous)})


def _choose(
    task: _Task, volume: UncertaintyVolume, walked: np.ndarray, space: FreeSpace, field: RewardField,
    previous: Decision | None,
) -> Decision:
    """The decision itself, without the account of predicted and realised gain."""
    T, camera, motion, settings = task.T, task.camera, task.motion, task.settings
    best = 0.0
    before = np.inf if previous is None else previous.terms.get("best_reward", np.inf)
    turns = (task.round,) if before < settings.hidden_reward else ()
    # The quick search overlooks what few views can see; only a thorough one may say that nothing is left.
    for relaxed, thorough in ((False, False), (False, True), (True, False)):
        if relaxed:
            space = build_free_space(volume, T, walked[:, :3, 3], motion, settings, relaxed=True)
        how = _thorough(settings) if thorough else settings
        pairs = settings.hidden_pairs * (THOROUGH_PAIRS if thorough else 1)
        both = (task.round, task.round + 1)
        pool = score(
            space, field, T, camera, motion, how, previous, hidden_pairs=pairs, turns=both if thorough else turns
        )
        best = max((t.reward for t in pool.terms), default=0.0)
        if best >= settings.stop_reward:
            decision = _go(task, space, pool, field, Reason.RELAXED if relaxed else Reason.BEST_GAIN)
            if decision is not None:
                return decision
    terms = {**_space_terms(space), "best_reward": best, "stop_reward": settings.stop_reward}
    if _movable(space):
        ranking = pool.ranking(settings.num_ranked, {})
        return Decision(volume.round, Reason.STOP_GAIN, True, np.zeros((0, 4, 4)), ranking, -1, terms)
    return _unstick(task, space, walked, previous, terms)


def _thorough(settings: PlanningSettings) -> PlanningSettings:
    """The same search with several times the positions, targets and exactly scored views."""
    names = ("max_positions", "max_targets", "refine_top", "exact_top")
    return settings.model_copy(update={n: getattr(settings, n) * settings.stop_search for n in names})


def bootstrap_decision(T_start: np.ndarray, motion: MotionSettings, settings: PlanningSettings) -> Decision:
    """The first decision of a run (round -1, executed in round 0): look around from the start pose.

    The start pose itself is the first pose of the path: nothing has been captured yet.
    """
    T = check_pose(T_start, "start pose")
    turn = look_around(T, settings.bootstrap_turn_deg, settings.bootstrap_pitch_deg, motion)
    path = np.concatenate([T[None], turn])
    return Decision(-1, Reason.START, False, path, terms={"path_steps": len(path), "path_length_m": 0.0})


def _go(task: _Task, space: FreeSpace, pool: Pool, field: RewardField, reason: Reason) -> Decision | None:
    """Walk to the best candidate that can be walked to; None when there is none."""
    settings, T = task.settings, task.T
    density = reward_density(pool, space)
    tried: dict[int, bool] = {}
    for index in range(len(pool.terms)):
        if pool.terms[index].reward < settings.stop_reward:
            continue
        path = plan_path(space, T[:3, 3], pool.voxels[index], density, settings, task.rng)
        poses = _poses(task, path, T, pool.poses[index], field, None)
        tried[index] = len(poses) > 0
        if len(poses):
            break
        if len(tried) >= settings.num_ranked:
            return None
    else:
        return None
    goal_ahead = len(poses) > settings.max_steps_per_round
    chained = 0
    if len(poses) < settings.min_steps_per_round:
        poses, chained = _chain(task, poses, index, space, pool, field, density)
    chosen = pool.terms[index]
    ranking = pool.ranking(max(settings.num_ranked, index + 1), tried)
    terms: dict[str, Any] = {
        **_space_terms(space),
        "reward": chosen.reward,
        "reward_surface": chosen.surface,
        "gain_imp": chosen.gain_imp,
        "gain_exp": chosen.gain_exp,
        "gain": chosen.gain,
        "num_visible": chosen.num_visible,
        "num_open": chosen.num_open,
        "utility": float(pool.utility[index]),
        "travel_m": float(pool.travel_m[index]),
        "best_reward": max(t.reward for t in pool.terms),
        "stop_reward": settings.stop_reward,
        "num_candidates": pool.num_candidates,
        "num_positions": len(pool.positions),
        "path_length_m": path.length_m,
        "path_cost": path.cost,
        "path_cost_grid": path.grid_cost,
        "path_steps": min(len(poses), settings.max_steps_per_round),
        "max_risk": path.max_risk,
        "min_clearance_m": path.min_clearance_m,
        "goal_ahead": goal_ahead,
        "committed": bool(pool.committed[index]),
        "chained_views": chained,
    }
    if reason is Reason.BEST_GAIN and len(tried) > 1:
        reason = Reason.FALLBACK
    return Decision(task.round, reason, False, poses[: settings.max_steps_per_round], ranking, index, terms)


def _poses(
    task: _Task, path: PlannedPath, T: np.ndarray, T_goal: np.ndarray, field: RewardField, max_steps: int | None
) -> np.ndarray:
    """Step poses along a path from pose T, looking where the reward lies on the way."""
    spacing = task.settings.coarse_spacing_m
    looks = looks_along(path.points, T[:3, :3], T_goal, field, task.directions, task.motion, spacing)
    return step_path(T, path.points, looks, task.motion, max_steps)


def _chain(
    task: _Task,
    poses: np.ndarray,
    index: int,
    space: FreeSpace,
    pool: Pool,
    field: RewardField,
    density: np.ndarray,
) -> tuple[np.ndarray, int]:
    """Continue a short path to the views that are best after the ones before it; (poses, number of views added).

    A round costs mapping and planning, however short its path. What the views so far will have seen counts no more.
    """
    settings = task.settings
    open_views = [i for i in range(len(pool.terms)) if i != index]
    added = 0
    while len(poses) < settings.min_steps_per_round and open_views and added < LONGEST_CHAIN:
        T = poses[-1]
        field = field.after(T, task.camera)
        here = space.moved_to(pool.voxels[index], settings, task.round_length_m)
        travel = here.cost[tuple(pool.voxels[open_views].T)]
        near = [i for i, c in zip(open_views, travel, strict=True) if c < task.round_length_m]
        if not near:
            break
        terms = exact_terms(field, pool.poses[near], task.camera)
        rotations = pool.poses[near][:, :3, :3]
        cost = view_cost_steps(here.cost[tuple(pool.voxels[near].T)], T[:3, :3], rotations, task.motion)
        best = int(utility_rate(np.array([t.reward for t in terms]), cost, settings).argmax())
        if terms[best].reward < settings.stop_reward:
            break
        index = near[best]
        path = plan_path(here, T[:3, 3], pool.voxels[index], density, settings, task.rng)
        more = _poses(task, path, T, pool.poses[index], field, settings.max_steps_per_round)
        poses = np.concatenate([poses, more])
        open_views.remove(index)
        added += 1
    return poses, added


def _movable(space: FreeSpace) -> bool:
    """Whether the agent can leave the spot it stands on for a place with the full clearance."""
    return bool((space.reachable & (space.risk.clearance_m >= space.required_m - 1e-6)).any())


def _space_terms(space: FreeSpace) -> dict[str, Any]:
    return {
        "free_m3": float(space.free.sum() * space.grid.voxel_size**3),
        "reachable_m3": float(space.reachable.sum() * space.grid.voxel_size**3),
        "start_clearance_m": float(space.risk.clearance_m[tuple(space.start)]),
    }


def _unstick(
    task: _Task, space: FreeSpace, walked: np.ndarray, previous: Decision | None, terms: dict[str, Any]
) -> Decision:
    """The agent cannot move: look around once, then go back the way it came, then stop."""
    tried = None if previous is None else previous.reason
    if tried not in (Reason.LOOK_AROUND, Reason.BACKTRACK, Reason.START):
        path = look_around(task.T, 360.0, task.settings.bootstrap_pitch_deg, task.motion)
        return Decision(task.round, Reason.LOOK_AROUND, False, path, terms=terms)
    back = _way_back(space, walked)
    if tried is not Reason.BACKTRACK and back is not None:
        path = step_path(task.T, back, [], task.motion, task.settings.max_steps_per_round)
        if len(path):
            return Decision(task.round, Reason.BACKTRACK, False, path, terms=terms)
    return Decision(task.round, Reason.STOP_STUCK, True, np.zeros((0, 4, 4)), terms=terms)


def _way_back(space: FreeSpace, walked: np.ndarray) -> np.ndarray | None:
    """Positions from here back along the walked path to the first place with the full clearance, (M, 3)."""
    positions = walked[::-1, :3, 3]
    clearance = space.risk.at(positions)[1]
    good = np.flatnonzero(clearance >= space.required_m)
    return None if len(good) == 0 or good[0] == 0 else positions[: good[0] + 1]
