"""The decision of a round: next best view, path, or stop, with reasons.

`decide` is the planner on one page: free space and risk field, reward field, candidates, choice, path. It sees the
uncertainty volume and the poses walked so far, never the scene.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from active3d_pipe.errors import InputError
from active3d_pipe.planning.candidates import view_directions
from active3d_pipe.planning.choice import score
from active3d_pipe.planning.config import PlanningSettings
from active3d_pipe.planning.exposure import spread_field
from active3d_pipe.planning.free_space import FreeSpace, begin_free_space, build_free_space
from active3d_pipe.planning.outcome import account_terms, expected_along
from active3d_pipe.planning.path import look_around, step_path
from active3d_pipe.planning.reward import RewardField, build_reward_field
from active3d_pipe.planning.walk import Task, go, space_terms
from active3d_pipe.structures.camera import Camera
from active3d_pipe.structures.decision import Decision, Reason
from active3d_pipe.structures.frame import check_pose
from active3d_pipe.structures.motion import MotionSettings
from active3d_pipe.structures.uncertainty_volume import UncertaintyVolume

# Times the pairs of the quick search for hidden space in the thorough one.
THOROUGH_PAIRS = 20
# What a view must bring at least that spreads the walk; 1 = what one voxel was short of that was never looked at.
LEAST_SHORT = 1.0
# While views are spread, every how many rounds a quick search asks whether something new has come into reach.
ASK_EVERY = 4


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
    task = Task(volume.round, T, camera, directions, motion, settings, rng)
    decision = _choose(task, volume, walked, space(), field, previous)
    promised = expected_along(field, decision.path, camera)
    spent = {} if previous is None else {k: v for k, v in previous.terms.items() if k == "spread_steps"}
    return replace(decision, terms={**spent, **decision.terms, **account_terms(volume, promised, previous)})


def _choose(
    task: Task, volume: UncertaintyVolume, walked: np.ndarray, space: FreeSpace, field: RewardField,
    previous: Decision | None,
) -> Decision:
    """The decision itself, without the account of predicted and realised gain."""
    T, camera, motion, settings = task.T, task.camera, task.motion, task.settings
    before = np.inf if previous is None else previous.terms.get("best_reward", np.inf)
    # While views are spread, what few places see was just sought in vain; it is sought once more before the stop.
    spreading = previous is not None and previous.reason is Reason.SPREAD
    turns = (task.round,) if before < settings.hidden_reward and not spreading else ()
    usual = space
    best = before
    for search in _searches(spreading, task.round):
        if search == "spread":
            decision = _spread(task, volume, usual, field, previous, len(walked), best)
            if decision is not None:
                return decision
            continue
        relaxed, thorough = search == "relaxed", search == "thorough"
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
            decision = go(task, space, pool, field, Reason.RELAXED if relaxed else Reason.BEST_GAIN)
            if decision is not None:
                return decision
    terms = {**space_terms(space), "best_reward": best, "stop_reward": settings.stop_reward}
    if _movable(space):
        ranking = pool.ranking(settings.num_ranked, {})
        return Decision(volume.round, Reason.STOP_GAIN, True, np.zeros((0, 4, 4)), ranking, -1, terms)
    return _unstick(task, space, walked, previous, terms)


def _searches(spreading: bool, number: int) -> tuple[str, ...]:
    """In which order views are sought in round `number`; the first search that finds one ends it.

    The quick search overlooks what few views can see; only a thorough one may say that nothing new is left. Once it
    has said so it is put off to the end of the spreading, and the quick one to every few rounds: they take long.
    """
    if not spreading:
        return "quick", "thorough", "relaxed", "spread"
    ask = ("quick",) if number % ASK_EVERY == 0 else ()
    return *ask, "spread", "thorough", "relaxed"


def _spread(
    task: Task, volume: UncertaintyVolume, space: FreeSpace, field: RewardField, previous: Decision | None,
    steps: int, best: float,
) -> Decision | None:
    """Look at surface that was looked at less than its share; None when enough was, or no such view is reachable.

    steps: walked so far. best: the highest reward of a view of what is new, which is what the decision reports.
    """
    settings = task.settings
    spent = 0 if previous is None else previous.terms.get("spread_steps", 0)
    if spent >= settings.spread_share * (steps - spent) or not _movable(space):
        return None
    left, shortfall = spread_field(
        field, volume["hit_evidence"], space, task.camera, settings.target_block_m, task.rng
    )
    pool = score(space, left, task.T, task.camera, task.motion, settings, previous)
    lenient = replace(task, settings=settings.model_copy(update={"stop_reward": LEAST_SHORT}))
    decision = go(lenient, space, pool, left, Reason.SPREAD)
    if decision is None:
        return None
    terms = {
        "best_reward": best, "stop_reward": settings.stop_reward, "spread_shortfall": shortfall,
        "spread_steps": spent + len(decision.path),
    }
    return replace(decision, terms={**decision.terms, **terms})


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


def _movable(space: FreeSpace) -> bool:
    """Whether the agent can leave the spot it stands on for a place with the full clearance."""
    return bool((space.reachable & (space.risk.clearance_m >= space.required_m - 1e-6)).any())


def _unstick(
    task: Task, space: FreeSpace, walked: np.ndarray, previous: Decision | None, terms: dict[str, Any]
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
