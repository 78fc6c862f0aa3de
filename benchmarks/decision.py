"""What a decision costs, by module: uncertainty volume, free space, reward field, candidates, path.

    python benchmarks/decision.py RUN ... [--rounds 8] [--repeats 3] [--set uncertainty.ray_stride=4 ...]

Rounds of finished runs, evenly spread, are decided again from their artifacts (the newest map stands for that of every
round; nothing is written). Milliseconds, the least of the repeats; a part does not count what its parts count. Run it
on an idle machine.
"""

import argparse
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from run_folder import FinishedRun

from active3d_pipe.gaussians import parameters
from active3d_pipe.geometry.sampling import spread
from active3d_pipe.planning import choice, decide, reward, walk
from active3d_pipe.storage.files import read_json
from active3d_pipe.structures import Camera, Decision
from active3d_pipe.uncertainty import volume as volumes
from stages import shared
from stages.uncertainty import examined_frames, residuals

# (module, function, row of the table)
PARTS = [
    (volumes, "_query", "volume: field queries"),
    (volumes, "integrate_depth", "volume: rays of the new frames"),
    (volumes, "looks_in_vain", "volume: rays of the new frames"),
    (volumes.explicit, "backproject", "volume: residuals"),
    (volumes.explicit, "explicit_uncertainty", "volume: residuals"),
    (volumes.occupancy, "opacity_mass", "volume: Gaussians"),
    (parameters.GaussianParameters, "to_model", "volume: Gaussians"),
    (decide, "begin_free_space", "free space and risk field"),
    (decide, "build_reward_field", "reward field"),
    (reward, "_looks", "looks in vain at what is open"),
    (choice, "target_positions", "candidates"),
    (choice, "hidden_positions", "search of hidden space"),
    (choice, "coarse_positions", "candidates"),
    (choice, "fine_positions", "candidates"),
    (choice, "sphere_rewards", "rewards of all views"),
    (choice, "exact_terms", "exact rewards of the best"),
    (walk, "plan_path", "path"),
    (walk, "_poses", "path"),
    (walk, "_chain", "views that follow"),
    (decide, "spread_field", "looks that surface is short of"),
    (decide, "expected_along", "account of the gain"),
    (decide, "account_terms", "account of the gain"),
]


class Stopwatch:
    """Time spent in wrapped functions, each without what other wrapped functions inside it take."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._inside: list[float] = []

    def wrapped(self, function: Callable, label: str) -> Callable:
        def timed(*args: Any, **kwargs: Any) -> Any:
            self._inside.append(0.0)
            start = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                spent = time.perf_counter() - start
                self.seconds[label] += spent - self._inside.pop()
                if self._inside:
                    self._inside[-1] += spent

        return timed


def decide_again(run: FinishedRun, k: int, repeats: int) -> dict[str, float]:
    """Seconds of round k by part, those of the fastest repeat."""
    config, path = run.config, run.path
    hybrid = shared.load_map(path / "mapping" / f"round_{run.last_round:04d}", run.inputs, config, to_train=False)
    before = shared.load_volume(path / "uncertainty" / f"round_{k - 1:04d}")
    frames = shared.load_frames(path / "capture" / f"round_{k:04d}")
    settings, notes = config.uncertainty, {}
    ahead = frames[:: settings.predict_every]
    predicted = residuals(hybrid, ahead, settings.render_stride, notes, of_field=True)
    views = residuals(hybrid, examined_frames(hybrid, frames, before, settings), settings.render_stride, notes)
    walked = shared.walked_poses(run.inputs, k)
    camera = Camera(**shared.load_rig(run.inputs)["camera"])
    previous = Decision.from_json(read_json(path / "planning" / f"round_{k - 1:04d}" / shared.DECISION_NAME))
    best: dict[str, float] = {}
    for _ in range(repeats):
        watch = Stopwatch()
        with ExitStack() as stack:
            for owner, name, label in PARTS:
                stack.enter_context(patch.object(owner, name, watch.wrapped(getattr(owner, name), label)))
            volume = watch.wrapped(volumes.compute_volume, "volume: terms, fusion, entropy")(
                grid=before.grid, round=k, previous=before, field_query=hybrid.field.query_geometry,
                gaussians=hybrid.gaussians.to_model(copy=False), new_frames=frames, views=views, predicted=predicted,
                settings=settings, last_field_query=hybrid.field.query_geometry,
            )
            watch.wrapped(decide.decide, "choice, and waiting for distances")(
                volume, walked[-1], walked, camera, config.motion, config.planning, np.random.default_rng(0),
                previous=previous,
            )
        if not best or sum(watch.seconds.values()) < sum(best.values()):
            best = dict(watch.seconds)
    return best


def main() -> None:
    """Parse the command line and print a table for every run."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--rounds", type=int, default=8, help="rounds of each run, evenly spread")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--set", action="append", default=[], dest="settings", help="instead of the run's, a.b=value")
    args = parser.parse_args()
    for path in args.runs:
        run = FinishedRun(path, tuple(args.settings))
        rounds = [k for k in spread(range(1, run.last_round + 1), args.rounds) if _grids_agree(run, k)]
        decide_again(run, rounds[0], 1)  # compiles
        found = [decide_again(run, k, args.repeats) for k in rounds]
        total = [sum(f.values()) * 1e3 for f in found]
        print(f"\n{path}: rounds {rounds}, decision and volume {[round(t) for t in total]} ms")
        print("| part | mean ms | worst ms |\n|---|---|---|")
        labels = dict.fromkeys(label for f in found for label in f)
        for label in sorted(labels, key=lambda name: -sum(f.get(name, 0) for f in found)):
            values = [f.get(label, 0.0) * 1e3 for f in found]
            print(f"| {label} | {np.mean(values):.0f} | {np.max(values):.0f} |")
        print(f"| sum | {np.mean(total):.0f} | {np.max(total):.0f} |")


def _grids_agree(run: FinishedRun, k: int) -> bool:
    """Whether the volume did not grow in round k: the newest map's box is not that of the round."""
    grids = [shared.load_volume(run.path / "uncertainty" / f"round_{i:04d}").grid for i in (k - 1, k)]
    return grids[0].shape == grids[1].shape


if __name__ == "__main__":
    main()
