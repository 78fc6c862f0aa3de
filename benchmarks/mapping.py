"""Replay the logged frames of a run through the mapper under several settings, and compare the maps.

    python benchmarks/mapping.py RUN [--variant NAME [FILE.toml] key=value ...]... [--rounds N] [--views N] [--refine]
        [--mesh] [--png DIR]

The frames, rounds and keyframes are those of the run (its last map says which frames were keyframes), so that the
variants see the same data; a variant that sets anything below `keyframes` chooses its own, by the uncertainty volumes
of the run (its walk had a fixed box, as those of furnished scenes have). Settings are paths below
`mapping`, as in `gaussian_iterations_per_step=1`; a file (configs/maps/*.toml) gives its table `mapping`. The scene
file of the run must be there: held-out views are rendered from it. `--mesh` adds the geometry of the mesh that export
would write, `--png` pictures of two held-out views and a captured one. Prints a Markdown table.
"""

import argparse
import json
import time
from collections import defaultdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from run_folder import FinishedRun

from active3d_pipe.evaluation.image_metrics import psnr, ssim
from active3d_pipe.geometry.sampling import spread
from active3d_pipe.mapping import branches, update
from active3d_pipe.mapping.config import MappingSettings
from active3d_pipe.mapping.hybrid_map import HybridMap
from active3d_pipe.mapping.keyframes import Keyframe
from active3d_pipe.mapping.refine import refine
from active3d_pipe.pipeline.config import Config
from active3d_pipe.pipeline.layers import read_toml
from stages import shared


def settings_of(pairs: list[str], base: dict[str, Any] | None = None) -> MappingSettings:
    """Mapping settings with the given `a.b=value` changes to `base` (the defaults), or those of a file."""
    document: dict[str, Any] = base or {}
    for pair in pairs:
        if pair.endswith(".toml"):
            document |= read_toml(Path(pair)).get("mapping", {})
            continue
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
    """Frames and uncertainty volume (where it is) by round, keyframe records and bounds of a run."""
    folders = sorted((run / "capture").glob("round_*"))[:rounds]
    frames = [shared.load_frames(folder) for folder in folders]
    last = sorted((run / "mapping").glob("round_*"))[-1]
    keyframes: dict[int, list[dict]] = defaultdict(list)
    for doc in json.loads((last / "keyframes.json").read_text()):
        keyframes[doc["round"]].append(doc)
    bounds = np.array(json.loads((folders[0] / "capture.json").read_text())["rig"]["bounds"])
    volumes = [run / "uncertainty" / folder.name for folder in folders]
    return SimpleNamespace(frames=frames, volumes=volumes, keyframes=keyframes, bounds=bounds)


def replay(data: SimpleNamespace, settings: MappingSettings, seed: int) -> tuple[HybridMap, dict[str, float]]:
    """Fold all rounds into a new map; seconds by module."""
    rng = np.random.default_rng(seed)
    hybrid = HybridMap.create(data.bounds[0], data.bounds[1], settings, rng)
    seconds: dict[str, float] = defaultdict(float)
    recorded = settings.keyframes == MappingSettings().keyframes
    real = update.select_keyframes
    for k, frames in enumerate(data.frames):
        volume = None if recorded or k == 0 else shared.load_volume(data.volumes[k - 1])
        if recorded:
            docs = [d for d in data.keyframes[k] if d["step"] - frames[0].step < len(frames)]
            new = [Keyframe(frames[d["step"] - frames[0].step], k, d["reason"], d["delta"], d["gain"], d["rho"])
                   for d in docs]
            update.select_keyframes = lambda *_, new=new: new
        draws = np.random.default_rng([seed, k])
        report = update.update_map(hybrid, frames, volume, k, settings, draws, lambda _: None)
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


def geometry(hybrid: HybridMap, frames: list, config: Config, truth: Any) -> str:
    """Accuracy (cm), completion (cm, what is observable), completion ratio (%, observable), MAD (cm) of the mesh."""
    from active3d_pipe.evaluation.culling import SeenBy
    from active3d_pipe.evaluation.evaluate import evaluate_geometry
    from active3d_pipe.export.final_mesh import final_mesh

    mesh = final_mesh(hybrid.field, frames, config.export.mesh)
    seen_by = SeenBy(frames[0].camera, np.stack([f.T_world_camera for f in frames]), [f.depth for f in frames])
    found = evaluate_geometry(
        mesh, truth, config.evaluation, seen_by=seen_by, query_sdf=hybrid.field.query_sdf
    )
    return " | ".join([
        f"{found['accuracy_cm_surface']:.2f}", f"{found['completion_cm_surface_observable']:.2f}",
        f"{100 * found['completion_ratio_surface_observable']:.1f}", f"{found['mad_cm']:.2f}",
    ])


def save_views(path: Path, hybrid: HybridMap, views: list) -> None:
    """Observed and rendered views side by side, one below the other."""
    from PIL import Image

    rows = []
    for frame in views:
        shown = np.clip(hybrid.render(frame.camera, frame.T_world_camera).rgb, 0, 1)
        rows.append(np.concatenate([frame.rgb, (shown * 255 + 0.5).astype(np.uint8)], axis=1))
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate(rows)).save(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--variant", nargs="+", action="append", default=[], metavar=("NAME", "SETTING"))
    parser.add_argument("--rounds", type=int)
    parser.add_argument("--views", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--refine", action="store_true", help="also refine over all frames, as export does")
    parser.add_argument("--mesh", action="store_true", help="also judge the mesh")
    parser.add_argument("--png", type=Path, help="folder for pictures of each variant")
    given = parser.parse_args()
    data = load(given.run, given.rounds)
    run = FinishedRun(given.run)
    views = run.held_out(given.views)
    everything = [f for frames in data.frames for f in frames]
    seen = spread(everything, given.views)
    steps = len(everything)
    print(f"{given.run.name}: {steps} frames in {len(data.frames)} rounds, {len(views)} held-out views", flush=True)
    truth, head, rule = None, "", ""
    if given.mesh:
        truth = run.truth()
        head, rule = "| accuracy cm | completion cm | C.R. % | MAD cm ", "|---|---|---|---"
    print(f"| variant | held-out dB | SSIM | train dB | Gaussians | keyframes {head}| ms/step | by module (ms/step) |")
    print(f"|---|---|---|---|---|---{rule}|---|---|", flush=True)
    for name, *pairs in given.variant or [["defaults"]]:
        settings = settings_of(pairs)
        hybrid, seconds = replay(data, settings, given.seed)
        found = geometry(hybrid, everything, run.config, truth) if given.mesh and not given.refine else ""
        tell(name, hybrid, views, seen, seconds, steps, found or " | ".join("-" * (4 if given.mesh else 0)))
        if given.refine:
            start = time.perf_counter()
            report = refine(hybrid, everything, np.random.default_rng(given.seed), lambda _: None)
            took = time.perf_counter() - start
            found = geometry(hybrid, everything, run.config, truth) if given.mesh else ""
            tell(f"{name}, refined {took:.0f} s", hybrid, views, seen, report.seconds, steps, found)
        if given.png:
            save_views(given.png / f"{name}.png", hybrid, [views[0], views[1], seen[len(seen) // 2]])


def tell(
    name: str, hybrid: HybridMap, views: list, seen: list, seconds: dict[str, float], steps: int, geometry: str
) -> None:
    """Print one row."""
    held, similarity = quality(hybrid, views)
    train, _ = quality(hybrid, seen)
    modules = ", ".join(f"{n} {1000 * s / steps:.0f}" for n, s in sorted(seconds.items(), key=lambda x: -x[1]))
    total = 1000 * sum(seconds.values()) / steps
    cells = (f"{held:.2f}", f"{similarity:.3f}", f"{train:.2f}", str(len(hybrid.gaussians)), str(len(hybrid.keyframes)))
    cells += (*([geometry] if geometry else []), f"{total:.0f}", modules)
    print("| " + " | ".join((name, *cells)) + " |", flush=True)


if __name__ == "__main__":
    main()
