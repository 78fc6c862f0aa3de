"""Replay the logged frames of a run through the mapper under several settings, and compare the maps.

    python benchmarks/mapping.py RUN [--variant NAME key=value ...]... [--rounds N] [--views N] [--refine]

The frames, rounds and keyframes are those of the run (its last map says which frames were keyframes), so that the
variants see the same data. Settings are paths below `mapping`, as in `gaussian_iterations_per_step=1`. The scene file
of the run must be there: held-out views are rendered from it. Prints a Markdown table.
"""

import argparse
import json
import time
from collections import defaultdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from active3d_pipe.evaluation.image_metrics import psnr, ssim
from active3d_pipe.mapping import branches, update
from active3d_pipe.mapping.config import MappingSettings
from active3d_pipe.mapping.hybrid_map import HybridMap
from active3d_pipe.mapping.keyframes import Keyframe
from active3d_pipe.mapping.refine import refine
from active3d_pipe.pipeline.config import Config, load_run_config
from active3d_pipe.sim.observable import held_out_poses
from stages import shared


def settings_of(pairs: list[str]) -> MappingSettings:
    """Mapping settings with the given `a.b=value` changes."""
    document: dict[str, Any] = {}
    for pair in pairs:
        path, _, text = pair.partition("=")
        *parents, leaf = path.split(".")
        table = document
        for name in parents:
            table = table.setdefault(name, {})
        try:
            table[leaf] = json.loads(text)
        except json.JSONDecodeError:
            table[leaf] = text
    return MappingSettings.model_validate(document)


def load(run: Path, rounds: int | None) -> SimpleNamespace:
    """Frames by round, keyframe records, bounds and the configuration of a run."""
    folders = sorted((run / "capture").glob("round_*"))[:rounds]
    frames = [shared.load_frames(folder) for folder in folders]
    last = sorted((run / "mapping").glob("round_*"))[-1]
    keyframes: dict[int, list[dict]] = defaultdict(list)
    for doc in json.loads((last / "keyframes.json").read_text()):
        keyframes[doc["round"]].append(doc)
    bounds = np.array(json.loads((folders[0] / "capture.json").read_text())["rig"]["bounds"])
    return SimpleNamespace(frames=frames, keyframes=keyframes, bounds=bounds)


def replay(data: SimpleNamespace, settings: MappingSettings, seed: int) -> tuple[HybridMap, dict[str, float]]:
    """Fold all rounds into a new map; seconds by module."""
    rng = np.random.default_rng(seed)
    hybrid = HybridMap.create(data.bounds[0], data.bounds[1], settings, rng)
    seconds: dict[str, float] = defaultdict(float)
    recorded = settings.keyframes.policy == "uncertainty"
    real = update.select_keyframes
    for k, frames in enumerate(data.frames):
        if recorded:
            docs = [d for d in data.keyframes[k] if d["step"] - frames[0].step < len(frames)]
            new = [Keyframe(frames[d["step"] - frames[0].step], k, d["reason"], d["delta"], d["gain"], d["rho"])
                   for d in docs]
            update.select_keyframes = lambda *_, new=new: new
        report = update.update_map(hybrid, frames, None, k, settings, np.random.default_rng([seed, k]), lambda _: None)
        for name, value in report.seconds.items():
            seconds[name] += value
    update.select_keyframes = real
    return hybrid, seconds


def quality(hybrid: HybridMap, views: list) -> tuple[float, float]:
    """Mean PSNR (dB) and SSIM over views."""
    scores = []
    for frame in views:
        shown = np.clip(hybrid.render(frame.camera, frame.T_world_camera).rgb, 0, 1)
        truth = branches.unit_rgb(frame)
        scores.append((psnr(shown, truth), ssim(shown, truth)))
    return tuple(np.mean(scores, axis=0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--variant", nargs="+", action="append", default=[], metavar=("NAME", "SETTING"))
    parser.add_argument("--rounds", type=int)
    parser.add_argument("--views", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--refine", action="store_true", help="also refine over all frames, as export does")
    given = parser.parse_args()
    config = load_run_config(given.run / "run.toml", Config)
    data = load(given.run, given.rounds)
    simulator = shared.make_simulator(config, config.run.seed)
    poses = held_out_poses(
        simulator, given.views, simulator.scene.name, min_clearance_m=config.evaluation.view_clearance_m
    )
    views = [simulator.render(T) for T in poses]
    everything = [f for frames in data.frames for f in frames]
    seen = shared.spread(everything, given.views)
    steps = len(everything)
    print(f"{given.run.name}: {steps} frames in {len(data.frames)} rounds, {len(views)} held-out views", flush=True)
    print("| variant | held-out dB | SSIM | train dB | Gaussians | ms/step | by module (ms/step) |")
    print("|---|---|---|---|---|---|---|", flush=True)
    for name, *pairs in given.variant or [["defaults"]]:
        settings = settings_of(pairs)
        hybrid, seconds = replay(data, settings, given.seed)
        tell(name, hybrid, views, seen, seconds, steps)
        if given.refine:
            start = time.perf_counter()
            report = refine(hybrid, everything, np.random.default_rng(given.seed), lambda _: None)
            tell(f"{name}, refined {time.perf_counter() - start:.0f} s", hybrid, views, seen, report.seconds, steps)


def tell(name: str, hybrid: HybridMap, views: list, seen: list, seconds: dict[str, float], steps: int) -> None:
    """Print one row."""
    held, similarity = quality(hybrid, views)
    train, _ = quality(hybrid, seen)
    modules = ", ".join(f"{n} {1000 * s / steps:.0f}" for n, s in sorted(seconds.items(), key=lambda x: -x[1]))
    total = 1000 * sum(seconds.values()) / steps
    cells = (f"{held:.2f}", f"{similarity:.3f}", f"{train:.2f}", str(len(hybrid.gaussians)), f"{total:.0f}", modules)
    print("| " + " | ".join((name, *cells)) + " |", flush=True)


if __name__ == "__main__":
    main()
