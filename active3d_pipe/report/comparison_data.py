"""Reading the runs of a comparison: metrics, curves, time."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from active3d_pipe.report.comparison import Result

METRICS_FILE, CURVES_FILE = Path("evaluation/metrics.json"), Path("evaluation/curves.json")
CURVE = "completion_ratio_surface_observable"
LOOP = ("capture", "mapping", "uncertainty", "planning")


def is_complete(run: Path) -> bool:
    """Whether a run folder holds an evaluation."""
    return (run / METRICS_FILE).is_file()


def read_result(
    scene: str, variant: str, seed: int, run: Path, error: str = "", outdated: bool = False
) -> Result:
    """What a run folder says; state `failed` with the error given, `missing` when there is no evaluation yet.

    Nor is there one when the run is `outdated`: made with other settings than are asked for.
    """
    nothing = np.zeros((0, 3))
    if error:
        return Result(scene, variant, seed, "failed", {}, nothing, error)
    if outdated or not is_complete(run):
        return Result(scene, variant, seed, "missing", {}, nothing)
    try:
        found, curve = _json(run / METRICS_FILE)["metrics"].items(), _curve(run)
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as damage:
        line = f"{run / 'evaluation'} cannot be read ({damage}); active3d evaluate {run}"
        return Result(scene, variant, seed, "failed", {}, nothing, line)
    metrics = {name: float(value) for name, value in found if _is_number(value)}
    seconds = loop_seconds(run)
    if seconds is not None and metrics.get("steps"):
        metrics["seconds_per_step"] = seconds / metrics["steps"]
    return Result(scene, variant, seed, "done", metrics, curve)


def loop_seconds(run: Path) -> float | None:
    """Wall seconds of the loop by the journal: the newest commit of every node; None without a journal."""
    newest: dict[str, float] = {}
    try:
        for line in (run / "journal.jsonl").read_text(encoding="utf-8").splitlines():
            event = json.loads(line)
            if event.get("event") == "commit" and event.get("seconds") is not None:
                newest[event["node"]] = float(event["seconds"])
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None
    return sum(s for node, s in newest.items() if node.split("/")[0] in LOOP) or None


def _curve(run: Path) -> np.ndarray:
    """(P, 3) step, walked metres (NaN where the evaluation does not say), completion ratio."""
    if not (run / CURVES_FILE).is_file():
        return np.zeros((0, 3))
    points = [p for p in _json(run / CURVES_FILE) if p.get(CURVE) is not None]
    return np.array([(p["step"], p.get("path_m", np.nan), p[CURVE]) for p in points]).reshape(-1, 3)


def _json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
