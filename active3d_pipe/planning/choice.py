"""Scoring all candidates and choosing among them: gain against the steps it costs."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from active3d_pipe.geometry.voxel_traversal import fan_stride
from active3d_pipe.information.gain import GainTerms
from active3d_pipe.planning.candidates import (
    NUM_ELEVATIONS,
    Directions,
    coarse_positions,
    fine_positions,
    view_directions,
)
from active3d_pipe.planning.config import PlanningSettings
from active3d_pipe.planning.free_space import FreeSpace
from active3d_pipe.planning.kernels_candidates import spread_values
from active3d_pipe.planning.reward import RewardField, exact_terms, sphere_rewards
from active3d_pipe.planning.targets import hidden_positions, target_positions
from active3d_pipe.structures.camera import Camera
from active3d_pipe.structures.decision import Decision, ScoredCandidate
from active3d_pipe.structures.motion import MotionSettings

# Of the short list a fan of rays that is so many times coarser says which may lead; only those get the dense one.
GLANCE = 2
# Times `hidden_reward` and `stop_reward` from which a glance at the largest reward says surely that it is above them.
PLENTY = 3
# Rows of rays of the first estimate of all places, half as dense each way as that of its leaders.
FEW_ELEVATIONS = NUM_ELEVATIONS // 2
# Where hidden space was searched: how many positions for each exactly scored view are estimated a second time, and the
# rows of rays they are estimated with.
SECOND_LOOKS, FINE_ELEVATIONS = 4, 48


@dataclass(frozen=True, slots=True, eq=False)
class Pool:
    """The candidates on the short list, best first.

    Attributes:
        poses: (C, 4, 4). voxels: (C, 3) int64 voxel of each position.
        terms: gain of each, exact of those that lead by utility or by reward.
        travel_m: (C,) geodesic cost. utility: (C,). committed: (C,) bool, the goal of the decision before.
        num_candidates: how many views were scored at all.
        positions: (P, 3) int64, all positions scored. best_rewards: (P,) float32 reward of the best view of each.
    """

    poses: np.ndarray
    voxels: np.ndarray
    terms: list[GainTerms]
    travel_m: np.ndarray
    utility: np.ndarray
    committed: np.ndarray
    num_candidates: int
    positions: np.ndarray
    best_rewards: np.ndarray

    def ranking(self, count: int, reachable: dict[int, bool]) -> tuple[ScoredCandidate, ...]:
        """The best `count` as they are reported; `reachable` says which were tried, and how it went."""
        return tuple(
            ScoredCandidate(
                self.poses[i], t.reward, t.gain_imp, t.gain_exp, t.num_visible, float(self.travel_m[i]),
                float(self.utility[i]), reachable.get(i),
            )
            for i, t in enumerate(self.terms[:count])
        )


def view_cost_steps(
    travel_m: np.ndarray, R: np.ndarray, rotations: np.ndarray, motion: MotionSettings
) -> np.ndarray:
    """Steps until a view is reached: the longer of walking and turning, which go on at the same time. (C,)."""
    trace = np.einsum("ij,vij->v", R, rotations)
    angle = np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))
    return np.maximum(travel_m / motion.max_step_m, angle / motion.max_turn_deg)


def utility_rate(rewards: np.ndarray, steps: np.ndarray, settings: PlanningSettings) -> np.ndarray:
    """Utility of views: log(1 + R / R_0) per step it takes to get there, fixed cost of a view included.

    The logarithm says that the first part of a large gain is worth most. Without it a doorway with a whole unseen
    room behind always beats the last corner of this one, which then has to be come back for from far away.
    """
    return np.log1p(np.maximum(rewards, 0) / settings.reward_scale) / (steps + settings.view_steps)


def positions_world(space: FreeSpace, voxels: np.ndarray, T_world_camera: np.ndarray) -> np.ndarray:
    """(P, 3) world positions of voxels; the agent's own voxel stands for where it is, the ground keeps its height."""
    out = space.grid.centre_of(voxels)
    out[(voxels == space.start).all(axis=-1)] = T_world_camera[:3, 3]
    if space.planar:
        out[:, 2] = T_world_camera[2, 3]
    return out


def score(  # noqa: PLR0913  (what a decision knows, by name)
    space: FreeSpace,
    field: RewardField,
    T_world_camera: np.ndarray,
    camera: Camera,
    motion: MotionSettings,
    settings: PlanningSettings,
    previous: Decision | None,
    *,
    hidden_pairs: int = 0,
    turns: Sequence[int] = (),
) -> Pool:
    """Score every view of the reachable space, coarse to fine, and the best ones exactly.

    `hidden_pairs`, `turns`: how thoroughly unseen space is searched for what few places see (`hidden_positions`).
    """
    R = T_world_camera[:3, :3]
    directions = view_directions(camera, settings.num_yaws, settings.pitches_deg)
    found = _estimate(space, field, T_world_camera, camera, motion, settings, directions, hidden_pairs, turns)
    chosen = _shortlist(found.voxels, found.rewards, found.utility, directions, settings)
    at = np.array([p for p, _ in chosen], dtype=np.int64)
    poses = np.tile(np.eye(4), (len(chosen), 1, 1))
    if chosen:
        poses[:, :3, :3] = directions.rotations[[v for _, v in chosen]]
        poses[:, :3, 3] = positions_world(space, found.voxels[at], T_world_camera)
    goal_voxels = found.voxels[at]
    committed = np.zeros(len(chosen), bool)
    old = _previous_goal(previous, space)
    if old is not None:
        poses = np.concatenate([poses, old[0][None]])
        goal_voxels = np.concatenate([goal_voxels, old[1][None]])
        committed = np.append(committed, True)
    travel = space.cost[tuple(goal_voxels.T)].astype(np.float64)
    steps = view_cost_steps(travel, R, poses[:, :3, :3], motion)

    def ranked(terms: list[GainTerms]) -> np.ndarray:
        final = utility_rate(np.array([t.reward for t in terms]), steps, settings)
        return np.where(committed, final * settings.commitment, final)

    terms = glance(field, poses, camera)
    by_reward = np.array([t.reward for t in terms])
    # Those that lead by reward say whether anything is left to see: far from that, a glance at them is enough.
    plenty = by_reward.max(initial=0) > PLENTY * max(settings.hidden_reward, settings.stop_reward)
    rankings = (ranked(terms),) if plenty else (ranked(terms), by_reward)
    leaders = [np.argsort(-ranking, kind="stable")[: settings.exact_top // 4] for ranking in rankings]
    again = np.union1d(np.concatenate(leaders), np.flatnonzero(committed))
    for i, exact in zip(again.tolist(), exact_terms(field, poses[again], camera), strict=True):
        terms[i] = exact
    final = ranked(terms)
    order = np.argsort(-final, kind="stable")
    return Pool(
        poses[order], goal_voxels[order], [terms[i] for i in order], travel[order], final[order], committed[order],
        found.num_candidates, found.voxels, found.rewards.max(axis=1),
    )


def glance(field: RewardField, poses: np.ndarray, camera: Camera) -> list[GainTerms]:
    """`exact_terms` by a coarser fan of rays: in a quarter of the time, which of the poses (C, 4, 4) may lead."""
    return exact_terms(field, poses, camera, GLANCE * fan_stride(camera, field.grid.voxel_size, field.max_range_m))


class _Estimates(NamedTuple):
    """Estimated views: (P, 3) int64 `voxels`, (P, V) `rewards` and `utility` there; `num_candidates` asked in all."""

    voxels: np.ndarray
    rewards: np.ndarray
    utility: np.ndarray
    num_candidates: int


def _estimate(  # noqa: PLR0913  (what `score` knows, and the directions)
    space: FreeSpace, field: RewardField, T_world_camera: np.ndarray, camera: Camera, motion: MotionSettings,
    settings: PlanningSettings, directions: Directions, hidden_pairs: int, turns: Sequence[int],
) -> _Estimates:
    """All views from a coarse lattice and from what is worth seeing, the best places' surroundings, a second look."""
    # Turning is the same from every position, so it is measured once a view.
    turning = view_cost_steps(np.zeros(len(directions.rotations)), T_world_camera[:3, :3], directions.rotations, motion)

    def estimates(voxels: np.ndarray, rays: Directions) -> tuple[np.ndarray, np.ndarray]:
        rewards = sphere_rewards(field, positions_world(space, voxels, T_world_camera), rays)
        walking = space.cost[tuple(voxels.T)] / np.float32(motion.max_step_m)
        return rewards, utility_rate(rewards, np.maximum(walking[:, None], turning[None]), settings)

    # The place where the agent stands is always a candidate: turning is the cheapest motion.
    seeing = target_positions(space, field, motion, settings)
    hidden = [hidden_positions(space, field, motion, settings, hidden_pairs, turn) for turn in turns]
    voxels = np.unique(np.concatenate([space.start[None], coarse_positions(space, settings), seeing, *hidden]), axis=0)
    few = view_directions(camera, settings.num_yaws, settings.pitches_deg, FEW_ELEVATIONS)
    rewards, utility = estimates(voxels, directions if turns else few)
    if not turns:
        again = _worth_another_look(rewards, utility, SECOND_LOOKS * settings.exact_top)
        rewards[again], utility[again] = estimates(voxels[again], directions)
    top = np.argsort(-utility.max(axis=1), kind="stable")[: settings.refine_top]
    fine = fine_positions(space, voxels[top], settings)
    fine = fine[~(fine[:, None] == voxels[None]).all(axis=-1).any(axis=1)]
    if len(fine):
        more = estimates(fine, directions)
        voxels = np.concatenate([voxels, fine])
        rewards, utility = np.concatenate([rewards, more[0]]), np.concatenate([utility, more[1]])
    num_candidates = rewards.size
    if turns:
        voxels = voxels[_worth_another_look(rewards, utility, SECOND_LOOKS * settings.exact_top)]
        finer = view_directions(camera, settings.num_yaws, settings.pitches_deg, FINE_ELEVATIONS)
        rewards, utility = estimates(voxels, finer)
    return _Estimates(voxels, rewards, utility, num_candidates)


def _worth_another_look(rewards: np.ndarray, utility: np.ndarray, most: int) -> np.ndarray:
    """Ascending indices of at most `most` positions (P, V): half by their best reward, half by their best utility.

    Through a gap of a few voxels one ray of a sphere sees far more than its solid angle holds, or nothing: the best of
    thousands of such estimates is an accident, unless those that lead are estimated again with other rays.
    """
    leaders = [np.argsort(-ranking.max(axis=1), kind="stable")[: most // 2] for ranking in (rewards, utility)]
    return np.unique(np.concatenate(leaders))


def _shortlist(
    voxels: np.ndarray, rewards: np.ndarray, utility: np.ndarray, directions: Directions, settings: PlanningSettings
) -> list[tuple[int, int]]:
    """(position, view) pairs worth an exact look: most by utility, some by reward alone, spread out.

    Views that nearly repeat a better one (closer than the coarse spacing is fine and 40 degrees) are left out, so
    that the list holds alternatives. Those by reward alone decide whether anything is left to see.
    """
    out: list[tuple[int, int]] = []
    near_angle = math.radians(40)
    near_voxels = max(1, round(0.5 * settings.coarse_spacing_m / settings.fine_spacing_m))
    taken = np.zeros(rewards.shape, bool)
    for ranking, count in ((rewards, settings.exact_top // 4), (utility, settings.exact_top)):
        left = np.where(taken, -1, ranking)
        while len(out) < count:
            p, v = divmod(int(left.argmax()), rewards.shape[1])
            if left[p, v] <= 0:
                break
            out.append((p, v))
            close = np.abs(voxels - voxels[p]).max(axis=1) <= near_voxels
            similar = np.ix_(close, directions.angles[v] < near_angle)
            left[similar] = -1
            taken[similar] = True
    return out


def _previous_goal(previous: Decision | None, space: FreeSpace) -> tuple[np.ndarray, np.ndarray] | None:
    """Goal pose and voxel of the decision before, while it is still ahead and reachable."""
    if previous is None or previous.chosen < 0 or not previous.terms.get("goal_ahead", False):
        return None
    T = previous.ranking[previous.chosen].T_world_camera
    voxel = space.grid.index_of(T[:3, 3])
    if not space.grid.contains_index(voxel) or not space.reachable[tuple(voxel)]:
        return None
    if space.planar and voxel[2] != space.start[2]:
        return None
    return np.asarray(T, dtype=np.float64), voxel


def reward_density(pool: Pool, space: FreeSpace) -> np.ndarray:
    """R(x) of eq. risk_path in [0, 1], float32 [X, Y, Z]: the best view near x relative to the best anywhere.

    Spread from the scored positions with a Gaussian of half a metre; 0 far away from all of them.
    """
    sigma = 0.35 / space.grid.voxel_size
    reach = np.arange(round(2 * sigma) + 1)
    half = np.exp(-0.5 * (reach / sigma) ** 2)
    kernel = np.concatenate([half[:0:-1], half]).astype(np.float32)
    total, weight = spread_values(pool.positions, pool.best_rewards, kernel / kernel.sum(), space.grid.shape)
    out = np.where(weight > 1e-6, total / np.maximum(weight, 1e-6), 0)
    return (out / max(float(out.max()), 1e-9)).astype(np.float32)
