"""How well the uncertainty volume predicts what the map gets wrong, on the recorded frames of finished runs.

    python benchmarks/uncertainty.py --out runs/uncertainty RUN [RUN ...]

The frames of each run are mapped again at reduced resolution, round by round, with the volume computed from it. The
volume of round k is then judged on the voxels whose surface the frames of the next rounds show: the realised error
of the map of round k there is the normalised residual (`ViewResidual.normalised`): half colour, a quarter rendered
depth, a quarter the field's SDF at the observed points, each saturating at its scale. Space where the map has nothing
counts as wrong.
Prints a Markdown table: Spearman's rank correlation and AUSE (mean over rounds 1..), for all revealed voxels, and for
those that rays had ended in before (where seen against unseen is no help). Curves go to OUT as PNG.
Runs whose judgement is in OUT already are only read. Numbers are comparable among runs of one resolution only.
"""

import argparse
import pickle
import time
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np

from active3d_pipe.geometry.thinning import thinned
from active3d_pipe.mapping.hybrid_map import HybridMap
from active3d_pipe.mapping.update import update_map
from active3d_pipe.pipeline.config import Config, load_config, load_run_config, with_values
from active3d_pipe.storage.files import read_json
from active3d_pipe.structures import Frame
from active3d_pipe.uncertainty.carving import integrate_depth
from active3d_pipe.uncertainty.explicit import ViewResidual, backproject
from active3d_pipe.uncertainty.metrics import ause, rank_correlation, reliability, sparsification
from active3d_pipe.uncertainty.volume import compute_volume, make_grid
from stages import shared
from stages.uncertainty import examined_frames, residuals

TERMS = ("u_imp", "u_exp", "u_time", "equal weights", "u_final")
REVEALING_STRIDE = 2  # every n-th pixel's ray reveals voxels, whatever rays the volume is made of
SETS = ("all revealed", "seen before")
COLORS = ("tab:blue", "tab:orange", "tab:green", "tab:gray", "tab:red")


def smaller(frame: Frame, scale: int) -> Frame:
    """The frame at 1 / scale of its resolution."""
    if scale == 1:
        return frame
    rgb, depth, camera = thinned(frame, scale)
    return Frame(frame.step, frame.stamp_ns, camera, frame.T_world_camera, np.rint(rgb * 255).astype(np.uint8), depth)


def judge(
    volume: Any, ahead: list[ViewResidual], frames: list[Frame], settings: Any
) -> dict[str, tuple[dict[str, np.ndarray], np.ndarray]]:
    """For both sets of voxels: uncertainty by term, and realised error."""
    error, coverage = backproject(volume.grid, ahead, settings)
    rays = integrate_depth(volume.grid, frames, settings.model_copy(update={"ray_stride": REVEALING_STRIDE}))
    revealed = (rays.hit > 0) & (coverage > 0)
    values = {name: volume[name] for name in ("u_imp", "u_exp", "u_time", "u_final")}
    values["equal weights"] = (values["u_imp"] + values["u_exp"] + values["u_time"]) / 3
    masks = zip(SETS, (revealed, revealed & (volume["hit_evidence"] > 0)), strict=True)
    return {name: ({term: u[m] for term, u in values.items()}, error[m]) for name, m in masks if m.sum() >= 100}


def replay(run: Path, given: argparse.Namespace) -> list[dict]:
    """Judgements of rounds 0.. of one run; each is a dict by set of voxels."""
    # The run says what was mapped; the uncertainty judged is that of the present defaults, plus --set.
    present = load_config(None, given.settings).uncertainty
    config = load_run_config(run / "run.toml", Config).model_copy(update={"uncertainty": present})
    config = with_values(config, uncertainty={"render_stride": max(1, present.render_stride // given.scale)})
    settings = config.uncertainty
    folders = sorted(p for p in (run / "capture").iterdir() if (p / shared.LOG_NAME).exists())[: given.rounds]
    rounds = [[smaller(f, given.scale) for f in shared.load_frames(p)] for p in folders]
    bounds = np.array(read_json(folders[0] / shared.CAPTURE_NAME)["rig"]["bounds"])
    rng = np.random.default_rng(0)
    hybrid = HybridMap.create(bounds[0], bounds[1], config.mapping, rng)
    grid = make_grid(bounds[0], bounds[1], settings)
    volume, found = None, []
    predicted: list[ViewResidual] = []
    spent = {"residuals": 0.0, "volume": 0.0, "steps": 0.0}
    for k, frames in enumerate(rounds):
        last = None if volume is None else deepcopy(hybrid.field).query_geometry
        update_map(hybrid, frames, volume, k, config.mapping, rng, lambda text: None)
        views = residuals(hybrid, examined_frames(hybrid, frames, volume, settings), settings.render_stride, spent)
        start = time.perf_counter()
        volume = compute_volume(
            grid=grid, round=k, previous=volume, field_query=hybrid.field.query_geometry,
            gaussians=hybrid.gaussians.to_model(copy=False), new_frames=frames, views=views, predicted=predicted,
            settings=settings, last_field_query=last,
        )
        spent["volume"] += time.perf_counter() - start
        spent["steps"] += len(frames)
        if k + 1 == len(rounds):
            break
        predicted = residuals(
            hybrid, rounds[k + 1][:: settings.predict_every], settings.render_stride, spent, of_field=True
        )
        future = [f for later in rounds[k + 1 : k + 1 + given.horizon] for f in later][::2]
        ahead = residuals(hybrid, future, settings.render_stride, {}, of_field=True)
        found.append({"sets": judge(volume, ahead, future, settings), "alphas": volume.fusion["alphas"]})
        print(f"{run.name}: round {k} of {len(rounds)}, alphas {np.round(volume.fusion['alphas'], 2)}", flush=True)
    per_step = {name: 1e3 * spent[name] / spent["steps"] for name in ("residuals", "volume")}
    print(f"{run.name}: ms a step " + ", ".join(f"{name} {ms:.1f}" for name, ms in per_step.items()))
    return found


def scores(found: list[dict], which: str, term: str) -> tuple[float, float]:
    """Mean rank correlation and AUSE over the rounds after the first, whose weights are not fitted yet."""
    pairs = [r["sets"][which] for r in found[1:] if which in r["sets"]]
    return tuple(float(np.mean([f(u[term], e) for u, e in pairs])) for f in (rank_correlation, ause))  # type: ignore


def table(by_run: dict[str, list[dict]]) -> str:
    """Markdown: a row for every run and set of voxels, and their mean; rank correlation / AUSE by term."""
    lines = ["| run | voxels | " + " | ".join(TERMS) + " |", "|" + " --- |" * (2 + len(TERMS))]
    for which in SETS:
        all_scores = np.array([[scores(found, which, term) for term in TERMS] for found in by_run.values()])
        for name, row in [*zip(by_run, all_scores, strict=True), ("**mean**", all_scores.mean(axis=0))]:
            cells = " | ".join(f"{r:.2f} / {a:.3f}" for r, a in row)
            lines.append(f"| {name} | {which} | {cells} |")
    return "\n".join(lines)


def plot(found: list[dict], title: str, path: Path) -> None:
    """Sparsification curves and the reliability diagram of one run, all rounds after the first together."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(15, 4.5), layout="constrained")
    for axis, which in zip(axes, SETS, strict=False):
        pairs = [r["sets"][which] for r in found[1:] if which in r["sets"]]
        for term, color in zip(TERMS, COLORS, strict=True):
            curves = [sparsification(u[term], e)[:2] for u, e in pairs]
            axis.plot(curves[0][0], np.mean([c[1] for c in curves], axis=0), color=color, label=term)
        oracle = np.mean([sparsification(u["u_final"], e)[2] for u, e in pairs], axis=0)
        axis.plot(np.arange(100) / 100, oracle, "k--", label="oracle")
        axis.set(xlabel="share of most uncertain voxels removed", ylabel="mean error of the rest, 1 = all", title=which)
        axis.legend()
    for which, marker in zip(SETS, "os", strict=True):
        pairs = [r["sets"][which] for r in found[1:] if which in r["sets"]]
        u, e = (np.concatenate(part) for part in ([p["u_final"] for p, _ in pairs], [e for _, e in pairs]))
        bins = reliability(u, e)
        axes[2].errorbar(bins.uncertainty, bins.error, bins.spread, marker=marker, capsize=3,
                         label=f"{which}, calibration error {bins.calibration_error:.3f}")
    axes[2].plot([0, 1], [0, 1], "k--")
    axes[2].set(xlabel="u_final, predicted", ylabel="realised error", title="reliability of u_final")
    axes[2].legend()
    figure.suptitle(title)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, help="run folders (their capture logs are read)")
    parser.add_argument("--out", type=Path, default=Path("runs/uncertainty"))
    parser.add_argument("--scale", type=int, default=2, help="resolution is divided by this")
    parser.add_argument("--rounds", type=int, default=12, help="rounds of each run that are replayed")
    parser.add_argument("--horizon", type=int, default=3, help="rounds ahead whose frames reveal the error")
    parser.add_argument("--set", action="append", default=[], dest="settings", help="uncertainty.name=value")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    by_run = {}
    for run in given.runs:
        kept = given.out / f"{run.name}_{given.scale}_{given.rounds}_{given.horizon}.pickle"
        if not kept.exists():
            kept.write_bytes(pickle.dumps(replay(run, given)))
        by_run[run.name] = pickle.loads(kept.read_bytes())
        plot(by_run[run.name], run.name, given.out / f"{run.name}.png")
    text = table(by_run)
    (given.out / "table.md").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
