"""What the planner decides: the next best view, the path to it, and why."""

from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np

from active3d_pipe.errors import InputError
from active3d_pipe.structures.frame import check_pose


class Reason(StrEnum):
    """Why a decision is what it is."""

    START = "start"  # first decision of a run: look around from the start pose
    BEST_GAIN = "best_gain"  # the candidate with the highest utility
    FALLBACK = "fallback"  # the best one was unreachable; the next reachable one
    RELAXED = "relaxed_clearance"  # reachable only with reduced clearance
    BACKTRACK = "backtrack"  # nothing reachable; go back along the walked path
    LOOK_AROUND = "look_around"  # cannot move; turn on the spot
    SPREAD = "spread_views"  # nothing new is left to see; where surface was looked at too little
    STOP_GAIN = "stop_gain"  # best expected gain below the threshold
    STOP_STUCK = "stop_stuck"  # no reachable goal at all
    STOP_BUDGET = "stop_budget"  # step budget spent


@dataclass(frozen=True, slots=True, eq=False)
class ScoredCandidate:
    """A candidate view and its scores.

    `T_world_camera` (4, 4); `reward` R(c) of eq. nbv_reward; `gain_imp`, `gain_exp` expected entropy
    reduction of each branch in bits; `travel_m` distance along the path or straight-line estimate;
    `utility` the number by which candidates are ranked; `reachable` None = not tried.
    """

    T_world_camera: np.ndarray
    reward: float
    gain_imp: float
    gain_exp: float
    num_visible: int
    travel_m: float
    utility: float
    reachable: bool | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Decision:
    """One decision: the feedback edge from planning to capture.

    Attributes:
        round: the round whose volumes it was taken from; capture executes it in round + 1.
        reason: see `Reason`.
        stop: True when the run should end; the path is then empty.
        path: (M, 4, 4) float64 T_world_camera, one pose for every step to execute, each within the
            motion limits of its predecessor, the current pose excluded.
        ranking: the top candidates, best first; ranking[chosen] is the winner.
        chosen: index into `ranking`, or -1.
        terms: costs and numbers that explain it (path length, risk, seconds per part are *not* here:
            a decision is the same bytes on every run).
    """

    round: int
    reason: Reason
    stop: bool
    path: np.ndarray
    ranking: tuple[ScoredCandidate, ...] = ()
    chosen: int = -1
    terms: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        path = np.asarray(self.path, dtype=np.float64).reshape(-1, 4, 4)
        object.__setattr__(self, "path", path)
        for i, T in enumerate(path):
            check_pose(T, f"decision of round {self.round}, path pose {i}")

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values; inverse of `from_json`."""
        ranking = [{**asdict(c), "T_world_camera": c.T_world_camera.tolist()} for c in self.ranking]
        return {
            "schema": "active3d.decision/1",
            "round": self.round,
            "reason": self.reason.value,
            "stop": self.stop,
            "path": self.path.tolist(),
            "ranking": ranking,
            "chosen": self.chosen,
            "terms": self.terms,
        }

    @classmethod
    def from_json(cls, doc: dict[str, Any]) -> "Decision":
        """Inverse of `to_json`; raises InputError on a document of another form."""
        try:
            ranking = tuple(
                ScoredCandidate(**{**c, "T_world_camera": np.asarray(c["T_world_camera"])}) for c in doc["ranking"]
            )
            return cls(
                doc["round"], Reason(doc["reason"]), doc["stop"], np.asarray(doc["path"], dtype=np.float64),
                ranking, doc["chosen"], doc["terms"],
            )
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"decision document: {error!r}; expected the form active3d.decision/1") from error
