"""What most policies are made of: propose views, score them, walk to the best one that can be walked to.

A policy that follows this pattern writes `propose` and `score`. Everything that is the arena's and not the policy's
is here, once: free space, the collision-checked path, motion limits, round length, going on to a goal that was not
reached yet, what to do when nothing is left or nothing can be reached.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from active3d_pipe.geometry import se3
from active3d_pipe.planning.free_space import FreeSpace
from active3d_pipe.planning.path import look_around, step_path
from active3d_pipe.planning.policies.context import PolicyContext
from active3d_pipe.planning.reward import exact_terms
from active3d_pipe.planning.rrt_star import PlannedPath, plan_path
from active3d_pipe.structures import Decision, Reason, ScoredCandidate

# Views that are tried, best first, before a policy counts as stuck.
MAX_TRIES = 10
Looks = tuple[np.ndarray, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """Candidate views.

    Attributes:
        poses: (C, 4, 4) T_world_camera, at the centres of `voxels` (the agent's own position in its own voxel).
        voxels: (C, 3) int64 voxels, reachable.
        looks: for every view the rotations (3, 3) to turn to afterwards, on the spot; empty = none for any.
        notes: plain values for `Decision.terms`; also what the policy wants to remember.
        gain: (C,) what `propose` found out already, for `score`.
    """

    poses: np.ndarray
    voxels: np.ndarray
    looks: Sequence[Looks] = ()
    notes: dict[str, Any] | None = None
    gain: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.poses)

    @classmethod
    def none(cls, notes: dict[str, Any] | None = None) -> "Views":
        """No candidates."""
        return cls(np.zeros((0, 4, 4)), np.zeros((0, 3), np.int64), notes=notes)

    @classmethod
    def at(
        cls, context: PolicyContext, space: FreeSpace, voxels: np.ndarray, rotations: np.ndarray,
        looks: Sequence[Looks] = (), notes: dict[str, Any] | None = None, gain: np.ndarray | None = None,
    ) -> "Views":
        """One view for every row of `voxels` (C, 3) and `rotations` (C, 3, 3)."""
        voxels = np.asarray(voxels, dtype=np.int64).reshape(-1, 3)
        poses = np.tile(np.eye(4), (len(voxels), 1, 1))
        poses[:, :3, :3] = np.asarray(rotations, dtype=np.float64).reshape(-1, 3, 3)
        poses[:, :3, 3] = places(context, space, voxels)
        return cls(poses, voxels, looks, notes, gain)


class ViewPolicy:
    """Next best view in three parts: `propose`, `score`, `path`; `decide` puts them together.

    Attributes:
        needs_map: whether `context.map` is wanted.
        turns_first: turn on the spot into the direction of travel, walk, then turn (a robot that looks ahead);
            otherwise the camera turns towards the goal's view on the way.
        commits: go on to the goal of the decision before until it is reached.
    """

    needs_map = False
    turns_first = False
    commits = True

    def propose(self, context: PolicyContext, space: FreeSpace) -> Views:
        """The candidate views; none when there is nothing left to look at, as for who never looks for any."""
        return Views.none()

    def score(self, context: PolicyContext, space: FreeSpace, views: Views) -> np.ndarray:
        """(C,) the higher the better; -inf = no candidate. Without a rule of its own: the gain that `propose` found."""
        return np.zeros(len(views)) if views.gain is None else views.gain

    def path(
        self, context: PolicyContext, space: FreeSpace, voxel: np.ndarray, targets: Sequence[np.ndarray]
    ) -> "Walk":
        """Every step to `voxel` and through the rotations `targets` there, by the shared planner and motion limits."""
        T = context.T_world_camera
        here = np.asarray(T[:3, 3])
        if (np.asarray(voxel) == space.start).all():
            points, planned = np.stack([here, here]), None
        else:
            planned = plan_path(space, here, np.asarray(voxel), None, context.settings, context.rng)
            points = planned.points
        return walk(context, points, targets, planned, turns_first=self.turns_first)

    def decide(self, context: PolicyContext) -> Decision:
        """Where to look next: the best-scored view that can be walked to, or what to do when there is none."""
        tried_any = False
        for relaxed in (False, True):
            space = context.free_space(relaxed=relaxed)
            reason = Reason.RELAXED if relaxed else Reason.BEST_GAIN
            if self.commits:
                onward = self._go_on(context, space)
                if onward is not None:
                    return onward
            if not space.reachable.any():
                continue
            views = self.propose(context, space)
            scores = np.asarray(self.score(context, space, views), dtype=np.float64) if len(views) else np.zeros(0)
            order = [int(i) for i in np.argsort(-scores, kind="stable") if np.isfinite(scores[i])]
            tried_any |= bool(order)
            for tries, i in enumerate(order[:MAX_TRIES]):
                looks = views.looks[i] if len(views.looks) else ()
                steps = self.path(context, space, views.voxels[i], (views.poses[i, :3, :3], *looks))
                if len(steps.poses):
                    if tries and not relaxed:
                        reason = Reason.FALLBACK
                    ranking = explain(context, space, views.poses[order], views.voxels[order], scores[order], tries)
                    return self._decision(context, reason, steps, ranking, tries, len(views), views.notes or {})
        if not tried_any and movable(context.free_space()):
            return self._stop(context, Reason.STOP_GAIN)
        return unstick(context, self._terms(context))

    def _go_on(self, context: PolicyContext, space: FreeSpace) -> Decision | None:
        """Go on to the goal of the decision before, or finish turning there; None when there is nothing to go on to."""
        before = context.previous
        if before is None or before.chosen < 0 or not before.terms.get("turns_left"):
            return None
        T_goal = np.asarray(before.ranking[before.chosen].T_world_camera, dtype=np.float64)
        voxel = space.grid.index_of(T_goal[:3, 3])
        if np.linalg.norm(T_goal[:3, 3] - context.T_world_camera[:3, 3]) < 1e-6:
            voxel = space.start
        elif not space.grid.contains_index(voxel) or not space.reachable[tuple(voxel)]:
            return None
        targets = [np.asarray(R, dtype=np.float64).reshape(3, 3) for R in before.terms["turns_left"]]
        steps = self.path(context, space, voxel, targets)
        if not len(steps.poses):
            return None
        score = np.array([before.ranking[before.chosen].utility])
        ranking = explain(context, space, T_goal[None], voxel[None], score, 0)
        kept = {k: v for k, v in before.terms.items() if k in before.terms.get("remembers", ())}
        return self._decision(context, Reason.BEST_GAIN, steps, ranking, 0, 1, kept | {"committed": True})

    def _decision(
        self, context: PolicyContext, reason: Reason, steps: "Walk", ranking: tuple[ScoredCandidate, ...], chosen: int,
        num_candidates: int, notes: dict[str, Any],
    ) -> Decision:
        limit = context.settings.max_steps_per_round
        left = [R.ravel().tolist() for R, end in zip(steps.targets, steps.ends, strict=True) if end > limit]
        best = ranking[chosen]
        terms = self._terms(context) | {
            "reward": best.reward, "gain_imp": best.gain_imp, "gain_exp": best.gain_exp,
            "gain": best.gain_imp + best.gain_exp, "num_visible": best.num_visible, "utility": best.utility,
            "travel_m": best.travel_m, "num_candidates": num_candidates, "path_steps": min(len(steps.poses), limit),
            "goal_ahead": bool(left), "turns_left": left, "committed": False, "remembers": sorted(notes),
        }
        if steps.planned is not None:
            terms |= {
                "path_length_m": steps.planned.length_m, "path_cost": steps.planned.cost,
                "path_cost_grid": steps.planned.grid_cost, "max_risk": steps.planned.max_risk,
                "min_clearance_m": steps.planned.min_clearance_m,
            }
        terms |= notes
        return Decision(context.volume.round, reason, False, steps.poses[:limit], ranking, chosen, terms)

    def _stop(self, context: PolicyContext, reason: Reason) -> Decision:
        return Decision(context.volume.round, reason, True, np.zeros((0, 4, 4)), terms=self._terms(context))

    def _terms(self, context: PolicyContext) -> dict[str, Any]:
        space = context.free_space()
        cell = space.grid.voxel_size**3
        return {
            "policy": context.settings.policy, "free_m3": float(space.free.sum() * cell),
            "reachable_m3": float(space.reachable.sum() * cell),
        }


@dataclass(frozen=True, slots=True, eq=False)
class Walk:
    """One pose for every step, (N, 4, 4); `ends[i]` is the number of steps after which `targets[i]` is reached."""

    poses: np.ndarray
    targets: tuple[np.ndarray, ...]
    ends: tuple[int, ...]
    planned: PlannedPath | None = None


def walk(
    context: PolicyContext, points: np.ndarray, targets: Sequence[np.ndarray], planned: PlannedPath | None = None, *,
    turns_first: bool = False,
) -> Walk:
    """Steps along the polyline `points` (M, 3), then through all `targets` (rotations) on the spot."""
    motion, T = context.motion, context.T_world_camera
    length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
    parts: list[np.ndarray] = []

    def add(points: np.ndarray, R: np.ndarray) -> None:
        start = parts[-1][-1] if parts and len(parts[-1]) else next((p[-1] for p in reversed(parts) if len(p)), T)
        arc = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
        parts.append(step_path(start, points, [(arc, R)], motion))

    if turns_first and length > 0:
        heading = facing(points[-1] - points[0], T[:3, :3])
        add(np.stack([points[0], points[0]]), heading)
        add(points, heading)
        points = np.stack([points[-1], points[-1]])
    ends = []
    for R in targets:
        add(points, np.asarray(R))
        points = np.stack([points[-1], points[-1]])
        ends.append(sum(len(p) for p in parts))
    poses = np.concatenate(parts) if parts else np.zeros((0, 4, 4))
    return Walk(poses, tuple(np.asarray(R) for R in targets), tuple(ends), planned)


def facing(direction: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """Level rotation (3, 3) that looks along the horizontal part of `direction` (3,), or `otherwise`."""
    if np.hypot(direction[0], direction[1]) < 1e-6:
        return np.asarray(otherwise)
    return se3.pose_from_yaw_pitch(np.zeros(3), float(np.arctan2(direction[1], direction[0])), 0.0)[:3, :3]


def looking_at(positions: np.ndarray, targets: np.ndarray, max_pitch_deg: float = 60.0) -> np.ndarray:
    """(C, 3, 3) level rotations at `positions` (C, 3) that look at `targets` (C, 3), pitch limited."""
    d = np.asarray(targets, dtype=np.float64) - positions
    yaw = np.arctan2(d[:, 1], d[:, 0])
    limit = np.radians(max_pitch_deg)
    pitch = np.clip(np.arctan2(d[:, 2], np.hypot(d[:, 0], d[:, 1])), -limit, limit)
    made = [se3.pose_from_yaw_pitch(np.zeros(3), y, p)[:3, :3] for y, p in zip(yaw, pitch, strict=True)]
    return np.array(made).reshape(-1, 3, 3)


def places(context: PolicyContext, space: FreeSpace, voxels: np.ndarray) -> np.ndarray:
    """(C, 3) world positions of voxels: their centres; the agent's own voxel stands for where it is."""
    out = space.grid.centre_of(voxels)
    here = context.T_world_camera[:3, 3]
    out[(voxels == space.start).all(axis=-1)] = here
    if space.planar:
        out[:, 2] = here[2]
    return out


def nearest_reachable(space: FreeSpace, points_world: np.ndarray, within_m: float) -> tuple[np.ndarray, np.ndarray]:
    """The reachable voxels (C, 3) nearest to points (C, 3), and (C,) bool, whether they lie within the limit."""
    ijk = np.argwhere(space.reachable)
    centres = space.grid.centre_of(ijk)
    voxels, found = np.zeros((len(points_world), 3), np.int64), np.zeros(len(points_world), bool)
    for n, p in enumerate(points_world):
        d = ((centres - p) ** 2).sum(axis=1)
        i = int(d.argmin())
        voxels[n], found[n] = ijk[i], d[i] <= within_m**2
    return voxels, found


def movable(space: FreeSpace) -> bool:
    """Whether the agent can leave the spot it stands on for a place with the full clearance."""
    return bool((space.reachable & (space.risk.clearance_m >= space.required_m - 1e-6)).any())


def unstick(context: PolicyContext, terms: dict[str, Any]) -> Decision:
    """The agent cannot get anywhere: look around once, then go back the way it came, then stop."""
    k, before = context.volume.round, context.previous
    tried = None if before is None else before.reason
    if tried not in (Reason.LOOK_AROUND, Reason.BACKTRACK, Reason.START):
        pitch = context.settings.bootstrap_pitch_deg
        return Decision(
            k, Reason.LOOK_AROUND, False, look_around(context.T_world_camera, 360.0, pitch, context.motion), terms=terms
        )
    space = context.free_space()
    back = context.walked_poses[::-1, :3, 3]
    good = np.flatnonzero(space.risk.at(back)[1] >= space.required_m)
    if tried is not Reason.BACKTRACK and len(good) and good[0] > 0:
        points = back[: good[0] + 1]
        path = step_path(context.T_world_camera, points, [], context.motion, context.settings.max_steps_per_round)
        if len(path):
            return Decision(k, Reason.BACKTRACK, False, path, terms=terms)
    return Decision(k, Reason.STOP_STUCK, True, np.zeros((0, 4, 4)), terms=terms)


def explain(
    context: PolicyContext, space: FreeSpace, poses: np.ndarray, voxels: np.ndarray, scores: np.ndarray, chosen: int
) -> tuple[ScoredCandidate, ...]:
    """The best views with the policy's score as utility; reward and gains on the scale common to all policies."""
    count = min(len(poses), max(context.settings.num_ranked, chosen + 1))
    terms = exact_terms(context.reward_field, poses[:count], context.camera)
    travel = space.cost[tuple(voxels[:count].T)]
    reachable = {i: i == chosen for i in range(chosen + 1)}
    return tuple(
        ScoredCandidate(
            poses[i], t.reward, t.gain_imp, t.gain_exp, t.num_visible, float(travel[i]), float(scores[i]),
            reachable.get(i),
        )
        for i, t in enumerate(terms)
    )
