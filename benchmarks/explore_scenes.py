"""Explore several scenes and tabulate quality and time. Resumable: runs that are complete are only read.

    python benchmarks/explore_scenes.py --steps 400 --out runs/scenes SCENE.glb [SCENE.glb ...]

Prints a Markdown table; run folders stay for inspection.
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

LOOP = ("capture", "mapping", "uncertainty", "planning")


def explore(scene: Path, out: Path, steps: int, seed: int, settings: list[str]) -> Path:
    """Run (or go on with) one scene; returns the run folder."""
    run = out / f"{scene.parent.name}_{steps}_{seed}"
    command = [sys.executable, "-m", "active3d_pipe.cli.main", "run", "default", "--out", str(run)]
    for text in (f"scene.file={scene}", f"run.steps={steps}", f"run.seed={seed}", *settings):
        command += ["--set", text]
    subprocess.run(command, check=True)
    return run


def seconds(run: Path) -> dict[str, float]:
    """Wall seconds by stage, from the journal: the newest commit of every node."""
    newest = {}
    for line in (run / "journal.jsonl").read_text().splitlines():
        event = json.loads(line)
        if event["event"] == "commit":
            newest[event["node"]] = event["seconds"]
    total: dict[str, float] = {}
    for node, s in newest.items():
        stage = node.split("/")[0]
        total[stage] = total.get(stage, 0.0) + s
    return total


def row(run: Path) -> list[str]:
    """One line of the table."""
    m = json.loads((run / "evaluation" / "metrics.json").read_text())["metrics"]
    spent = seconds(run)
    loop = sum(spent.get(stage, 0.0) for stage in LOOP)

    def show(name: str, factor: float = 1.0, digits: int = 2) -> str:
        value = m.get(name)
        return "-" if value is None else f"{value * factor:.{digits}f}"

    return [
        run.name, str(m["steps"]), str(m["collisions"]), show("completion_ratio_surface_observable", 100, 1),
        show("completion_ratio_surface", 100, 1), show("accuracy_cm_surface"), show("completion_cm_surface_observable"),
        show("precision_surface", 100, 1), show("psnr"), show("ssim", 1, 3), show("lpips", 1, 3), show("psnr_gap"),
        f"{loop / m['steps']:.2f}", f"{spent.get('export', 0):.0f}", f"{spent.get('evaluation', 0):.0f}",
    ]


HEAD = [
    "run", "steps", "collisions", "C.R. observable %", "C.R. whole %", "accuracy cm", "completion cm", "precision %",
    "PSNR dB", "SSIM", "LPIPS", "gap dB", "s/step", "export s", "evaluation s",
]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("runs/scenes"))
    parser.add_argument("--set", action="append", default=[], dest="settings")
    given = parser.parse_args()
    os.makedirs(given.out, exist_ok=True)
    rows = [row(explore(s.resolve(), given.out, given.steps, given.seed, given.settings)) for s in given.scenes]
    for line in (HEAD, ["---"] * len(HEAD), *rows):
        print("| " + " | ".join(line) + " |")


if __name__ == "__main__":
    main()
