"""The planner alone, on real scenes: true depth carves the volume, no map is trained. A minute for a thousand steps.

    python benchmarks/planning.py SCENE.glb [SCENE.glb ...] [--policies active3d frontier volume] [--steps 1000]
        [--ground] [--set stop_reward=2 ...] [--out FILE.npz]

Prints for every scene and policy: the share of the observable surface that was seen (a sample counts when a captured
depth image has a point within 5 cm of it, as the completion ratio counts), steps to 90, 95 and 98 %, why it
stopped, collisions and least clearance along the way, rank correlation of predicted and realised gain, and the
milliseconds of a decision by module.
What a run with the map reaches is less, by what the map does not reconstruct though it was seen.
"""

import argparse
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import expit
from scipy.stats import spearmanr

from active3d_pipe.evaluation.geometry_metrics import sample_surface
from active3d_pipe.geometry import projection
from active3d_pipe.information.entropy import bernoulli_entropy
from active3d_pipe.information.gain import entropy_drop
from active3d_pipe.planning import decide as decide_module
from active3d_pipe.planning import walk as walk_module
from active3d_pipe.planning.config import PlanningSettings
from active3d_pipe.planning.decide import bootstrap_decision
from active3d_pipe.planning.policies import base, trajectory
from active3d_pipe.planning.policies import context as context_module
from active3d_pipe.planning.policies.context import PolicyContext
from active3d_pipe.planning.policies.registry import make_policy
from active3d_pipe.sim.config import CameraSettings, SceneSettings, SensorSettings
from active3d_pipe.sim.observable import observable_points
from active3d_pipe.sim.simulator import Simulator, make_simulator
from active3d_pipe.structures import Decision, Frame, UncertaintyVolume
from active3d_pipe.structures.motion import MotionSettings
from active3d_pipe.uncertainty import occupancy
from active3d_pipe.uncertainty.carving import RayEvidence, integrate_depth, looks_in_vain
from active3d_pipe.uncertainty.config import UncertaintySettings
from active3d_pipe.uncertainty.volume import make_grid

NEAR_M = 0.05
MODULES = {  # functions that decisions are made of -> name in the table of times
    "build_reward_field": "information", "begin_free_space": "risk field", "build_free_space": "risk field",
    "score": "candidates and reward", "reward_density": "path", "plan_path": "path",
    "looks_along": "looks along the path",
}  # fmt: skip
CALLERS = (decide_module, walk_module, context_module, base, trajectory)  # modules that call them by name


class CarvedWorld:
    """A scene, what its depth carved so far, and which samples of its observable surface were seen."""

    def __init__(self, sim: Simulator, truth: np.ndarray, settings: UncertaintySettings) -> None:
        self.sim, self.settings, self.truth = sim, settings, truth
        self.grid = make_grid(sim.scene.bounds_low, sim.scene.bounds_high, settings)
        self.evidence = RayEvidence.none(self.grid)
        self.curve: list[float] = []
        self.vain = np.zeros(self.grid.shape, np.float32)
        self.covered = np.zeros(len(truth), bool)
        self.last: UncertaintyVolume | None = None

    def capture(self, poses: np.ndarray, first_step: int) -> None:
        """Frames at poses (N, 4, 4)."""
        camera = self.sim.camera
        blank = np.zeros((camera.height, camera.width, 3), np.uint8)
        frames = [Frame(first_step + i, 0, camera, T, blank, self.sim.depth(T)) for i, T in enumerate(poses)]
        self.evidence = self.evidence.joined(integrate_depth(self.grid, frames, self.settings))
        self.vain += looks_in_vain(self.grid, frames, self.evidence.hit > 0, self.settings)
        self.curve += [self._mark(f) for f in frames]

    def _mark(self, frame: Frame) -> float:
        """Note what a frame shows; the share of the surface that was seen so far."""
        points = projection.unproject(frame.depth, frame.T_world_camera, frame.camera)[frame.depth > 0]
        left = np.flatnonzero(~self.covered)
        if len(points) and len(left):
            near = cKDTree(points).query(self.truth[left], distance_upper_bound=NEAR_M)[0]
            self.covered[left[np.isfinite(near)]] = True
        return float(self.covered.mean())

    def volume(self, round_index: int) -> UncertaintyVolume:
        """What this evidence makes of the uncertainty volume when the field knows no more than the rays."""
        e, s = self.evidence, self.settings
        log_odds = occupancy.ray_log_odds(e, s)
        p = expit(log_odds).astype(np.float32)
        entropy = bernoulli_entropy(p)
        zero = np.zeros(self.grid.shape, np.float32)
        observed = occupancy.observation(e, s)
        share = occupancy.resolvable(self.vain, observed, s)
        entropy = share * entropy
        unseen = share * occupancy.attention(e, s) * (1 - observed)
        sdf = np.where(e.free > e.hit, 0.1, -0.1)
        arrays: dict[str, np.ndarray] = {
            "u_imp": unseen, "u_exp": zero, "u_time": zero, "u_final": unseen, "occupancy": p, "entropy_imp": entropy,
            "entropy_exp": entropy, "entropy": entropy, "sdf": sdf, "free_evidence": e.free, "hit_evidence": e.hit,
            "view_quality": e.quality, "cells_passed": e.passed, "cells_hit": e.ended, "vain_looks": self.vain,
        }
        arrays = {k: a.astype(np.float32) for k, a in arrays.items()}
        drop = None if self.last is None else entropy_drop(self.last.arrays, arrays)
        self.last = UncertaintyVolume(self.grid, round_index, arrays, drop_bits=drop)
        return self.last


def watch(seconds: dict[str, list[float]]) -> None:
    """Let the parts of a decision add up their time in seconds[name][-1]; of what returns a function, its time too."""

    def timed(function: Any, name: str) -> Any:
        def call(*args: Any, **kwargs: Any) -> Any:
            start = time.perf_counter()
            out = function(*args, **kwargs)
            seconds[name][-1] += time.perf_counter() - start
            return timed(out, name) if callable(out) else out

        return call

    for attribute, name in MODULES.items():
        callers = [module for module in CALLERS if hasattr(module, attribute)]
        if not callers:
            raise AttributeError(f"nothing calls {attribute} any more: MODULES is out of date")
        for module in callers:
            setattr(module, attribute, timed(getattr(module, attribute), name))


def explore(
    world: CarvedWorld, policy: str, steps: int, motion: MotionSettings, settings: PlanningSettings, seed: int,
    seconds: dict[str, list[float]],
) -> dict[str, Any]:
    """One run of the loop without a map."""
    sim, chosen = world.sim, make_policy(policy)
    decision = bootstrap_decision(sim.scene.start_pose, motion, settings)
    walked, curve, log = [sim.scene.start_pose], world.curve, []
    collisions, clearance = 0, np.inf
    while True:
        path = decision.path[: steps - len(curve)]
        for n, T in enumerate(path):
            d = sim.segment_clearance(walked[-1][:3, 3], T[:3, 3])
            clearance = min(clearance, d)
            if d < motion.agent_radius_m and np.linalg.norm(walked[-1][:3, 3] - T[:3, 3]) > 1e-6:
                collisions += 1
                path = path[:n]
                break
            walked.append(T)
        world.capture(path if len(path) else np.array(walked[-1:]), len(curve))
        if len(curve) >= steps:
            return _result(walked, curve, log, "budget", collisions, clearance)
        volume = world.volume(len(log))
        for name in (*MODULES.values(), "whole decision"):
            if len(seconds[name]) <= len(log):
                seconds[name].append(0.0)
        start = time.perf_counter()
        context = PolicyContext(
            volume, np.array(walked[1:]), sim.camera, motion, settings, np.random.default_rng([seed, len(log)]),
            None if not log else decision,
        )
        decision = chosen.decide(context)
        seconds["whole decision"][-1] = time.perf_counter() - start
        log.append(decision)
        if decision.stop:
            return _result(walked, curve, log, decision.reason.value, collisions, clearance)


def _result(
    walked: list, curve: list, log: list[Decision], reason: str, collisions: int, clearance: float
) -> dict[str, Any]:
    return {
        "walked": np.array(walked[1:]), "curve": np.array(curve), "log": log, "reason": reason,
        "collisions": collisions, "clearance": clearance,
    }


def gain_correlation(log: list[Decision]) -> tuple[float, float]:
    """(rank correlation, realised / predicted) of the gain of executed decisions, bits."""
    pairs = [
        (t["predicted_imp"] + t["predicted_exp"], t["realised_imp"] + t["realised_exp"])
        for t in (d.terms.get("previous", {}) for d in log) if "predicted_imp" in t
    ]
    if len(pairs) < 3:
        return float("nan"), float("nan")
    a = np.array(pairs)
    return float(spearmanr(a[:, 0], a[:, 1])[0]), float(a[:, 1].sum() / max(a[:, 0].sum(), 1e-9))


def first_at(curve: np.ndarray, share: float) -> str:
    """Step at which a share is reached."""
    return str(int(np.argmax(curve >= share)) + 1) if curve.max() >= share else "-"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--policies", nargs="+", default=["active3d"])
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--points", type=int, default=40_000)
    parser.add_argument("--ground", action="store_true")
    parser.add_argument("--set", action="append", default=[], dest="settings", help="a field of planning, name=number")
    parser.add_argument("--out", type=Path, help="save walks and curves (npz)")
    given = parser.parse_args()
    motion = MotionSettings(model="ground" if given.ground else "free")
    changed: dict[str, Any] = {}
    for text in given.settings:
        name, value = text.split("=")
        at = changed.setdefault("information", {}) if name.startswith("information.") else changed
        at[name.rpartition(".")[2]] = float(value)
    settings = PlanningSettings.model_validate(changed)
    seconds: dict[str, list[float]] = defaultdict(list)
    watch(seconds)
    saved = {}
    head = ("scene", "policy", "steps", "seen %", "90 %", "95 %", "98 %", "end", "collisions", "clearance m",
            "gain rank corr.", "realised / predicted")  # fmt: skip
    print("| " + " | ".join(head) + " |\n|" + "---|" * len(head))
    times = []
    for file in given.scenes:
        sim = make_simulator(SceneSettings(file=str(file)), CameraSettings(width=300, height=170), SensorSettings(), 0)
        points = sample_surface(sim.scene.surface, given.points, np.random.default_rng(1)).astype(np.float64)
        points = points[observable_points(sim, points, np.random.default_rng(0))]
        name = file.resolve().parent.name
        for policy in given.policies:
            seconds.clear()
            world = CarvedWorld(sim, points, UncertaintySettings())
            r = explore(world, policy, given.steps, motion, settings, given.seed, seconds)
            rank, ratio = gain_correlation(r["log"])
            print(
                f"| {name} | {policy} | {len(r['curve'])} | {100 * r['curve'][-1]:.1f} | "
                + " | ".join(first_at(r["curve"], q) for q in (0.9, 0.95, 0.98))
                + f" | {r['reason']} | {r['collisions']} | {r['clearance']:.3f} | {rank:.2f} | {ratio:.2f} |",
                flush=True,
            )
            times.append((name, policy, {k: 1e3 * np.array(v) for k, v in seconds.items()}))
            key = f"{name}/{policy}"
            saved |= {f"{key}/walked": r["walked"], f"{key}/curve": r["curve"], f"{key}/covered": world.covered}
            saved |= {f"{name}/points": points}
            saved[f"{key}/log"] = np.array([str(d.terms | {"reason": d.reason.value}) for d in r["log"]])
    if given.out:
        np.savez_compressed(given.out, **saved)
    names = [*dict.fromkeys(MODULES.values()), "whole decision"]
    print("\nMilliseconds a decision (median; 95th percentile of the whole)\n")
    print("| scene | policy | " + " | ".join(names) + " | 95 % |\n|" + "---|" * (len(names) + 3))
    for name, policy, ms in times:
        cells = " | ".join(f"{np.median(ms[n]):.0f}" for n in names)
        print(f"| {name} | {policy} | {cells} | {np.percentile(ms['whole decision'], 95):.0f} |")


if __name__ == "__main__":
    main()
