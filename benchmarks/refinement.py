"""Refine the last map of a run under several settings, and compare what export would hand over.

    python benchmarks/refinement.py RUN [--variant NAME key=value ...]... [--iterations N] [--mesh] [--seed N]

Same map, same logged frames, same held-out views for all variants; settings are paths below `mapping`, on top of
the run's own. Prints a Markdown table: held-out PSNR (mean, tenth percentile), SSIM, error of the rendered depth
(cm: mean, median; share over 5 cm), PSNR of 50 captured views, primitives, seconds, and with `--mesh` the geometry.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from mapping import geometry, quality, settings_of
from run_folder import FinishedRun

from active3d_pipe.evaluation.image_metrics import psnr, ssim
from active3d_pipe.geometry.sampling import spread
from active3d_pipe.mapping.branches import unit_rgb
from active3d_pipe.mapping.hybrid_map import HybridMap
from active3d_pipe.mapping.refine import refine
from active3d_pipe.structures import Frame
from stages import shared
from stages.export import MAX_FRAMES


def judged(hybrid: HybridMap, views: list[Frame]) -> list[str]:
    """Cells of the table: PSNR, its tenth percentile, SSIM, depth error mean and median, share over 5 cm."""
    rows = []
    for frame in views:
        shown = hybrid.render(frame.camera, frame.T_world_camera)
        image, truth, valid = np.clip(shown.rgb, 0, 1), unit_rgb(frame), frame.depth > 0
        off = np.abs(shown.depth - frame.depth)[valid]
        rows.append((psnr(image, truth), ssim(image, truth), off.mean(), np.median(off), np.mean(off > 0.05)))
    mean, worst = np.mean(rows, axis=0), np.percentile([row[0] for row in rows], 10)
    return [
        f"{mean[0]:.2f}", f"{worst:.2f}", f"{mean[1]:.4f}", f"{100 * mean[2]:.2f}", f"{100 * mean[3]:.2f}",
        f"{100 * mean[4]:.1f}",
    ]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--variant", nargs="+", action="append", default=[], metavar=("NAME", "SETTING"))
    parser.add_argument("--iterations", type=int, default=1000)
    parser.add_argument("--mesh", action="store_true", help="also judge the mesh")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    run = FinishedRun(given.run)
    views, last = run.held_out(), run.path / "mapping" / f"round_{run.last_round:04d}"
    frames = shared.load_covering(run.inputs, run.last_round, MAX_FRAMES)
    truth, head = None, ""
    if given.mesh:
        truth = run.truth()
        head = " accuracy cm | completion cm | C.R. % | MAD cm |"
    print(f"{given.run}: {len(frames)} frames, {len(views)} held-out views, {given.iterations} iterations\n")
    head = f"| variant | dB | 10th perc. | SSIM | depth cm | median | > 5 cm % | captured dB | Gaussians | s |{head}"
    print(f"{head}\n{'|---' * (head.count('|') - 1)}|", flush=True)
    for name, *pairs in given.variant or [["defaults"]]:
        base = run.config.mapping.model_dump() | {"refinement_iterations": given.iterations}
        config = run.config.model_copy(update={"mapping": settings_of(pairs, base)})
        hybrid = shared.load_map(last, run.inputs, config)
        start = time.perf_counter()
        refine(hybrid, frames, np.random.default_rng(given.seed), lambda _: None)
        took = time.perf_counter() - start
        captured, _ = quality(hybrid, spread(frames, 50))
        cells = [name, *judged(hybrid, views), f"{captured:.2f}", str(len(hybrid.gaussians)), f"{took:.0f}"]
        if truth:
            cells.append(geometry(hybrid, frames, config, truth))
        print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
