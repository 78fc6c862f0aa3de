"""Are the planner's views good for rendering too? Its keyframes against as many random views of free space.

    python benchmarks/view_choice.py RUN [RUN ...] [--iterations N]

Both sets go through the same mapper from nothing, in rounds of ten, every view a keyframe, then through the same
refinement over those views alone; judged on the evaluation's held-out views. Random views are drawn as the held-out
ones are (positions uniform in reachable space, directions on the sphere), from another seed. Prints Markdown.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from mapping import quality
from run_folder import FinishedRun

from active3d_pipe.mapping.hybrid_map import HybridMap
from active3d_pipe.mapping.refine import refine
from active3d_pipe.mapping.update import update_map
from active3d_pipe.sim.observable import held_out_poses
from active3d_pipe.structures import Frame

ROUND = 10  # views


def planned_views(run: FinishedRun) -> list[Frame]:
    """The keyframes of the run's last map, in order of capture."""
    last = run.path / "mapping" / f"round_{run.last_round:04d}"
    steps = {doc["step"] for doc in json.loads((last / "keyframes.json").read_text())}
    return [frame for frame in run.frames if frame.step in steps]


def random_views(run: FinishedRun, count: int, seed: int) -> list[Frame]:
    """As many views as the planner's keyframes, rendered anew."""
    text = f"{run.simulator.scene.name} random views {seed}"
    clearance = run.config.evaluation.view_clearance_m
    poses = held_out_poses(run.simulator, count, text, min_clearance_m=clearance)
    return [run.simulator.render(T, step=i) for i, T in enumerate(poses)]


def trained(run: FinishedRun, frames: list[Frame], iterations: int) -> HybridMap:
    """A map of `frames` alone."""
    rig = json.loads((run.inputs[next(iter(run.inputs))] / "capture.json").read_text())["rig"]
    low, high = np.array(rig["bounds"])
    base = run.config.mapping
    settings = base.model_copy(update={
        "keyframes": base.keyframes.model_copy(update={"policy": "every_n", "every_n": 1}),
        "refinement_iterations": iterations,
    })
    hybrid = HybridMap.create(low, high, settings, np.random.default_rng(0))
    for k in range(0, len(frames), ROUND):
        some = frames[k : k + ROUND]
        update_map(hybrid, some, None, k // ROUND, settings, np.random.default_rng([0, k]), lambda _: None)
    refine(hybrid, frames, np.random.default_rng(1), lambda _: None)
    return hybrid


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--iterations", type=int, default=1000, help="of the refinement")
    parser.add_argument("--seed", type=int, default=0, help="of the random views")
    given = parser.parse_args()
    print("| scene | views | of | held-out dB | SSIM | train dB | Gaussians |")
    print("|---|---|---|---|---|---|---|", flush=True)
    for path in given.runs:
        run = FinishedRun(path)
        planned, held_out = planned_views(run), run.held_out()
        for name, frames in (("planner", planned), ("random", random_views(run, len(planned), given.seed))):
            hybrid = trained(run, frames, given.iterations)
            held, similarity = quality(hybrid, held_out)
            cells = (run.simulator.scene.name, str(len(frames)), name, f"{held:.2f}", f"{similarity:.3f}",
                     f"{quality(hybrid, frames)[0]:.2f}", str(len(hybrid.gaussians)))
            print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
