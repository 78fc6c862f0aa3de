"""Every mapping preset through every stage, on a recorded walk."""

import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from active3d_pipe.storage.files import read_json

Cli = Callable[..., subprocess.CompletedProcess]
PRESETS = ("tsdf", "co_slam", "nice_slam", "splatam", "monogs", "loopsplat")


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_every_map_runs_through_the_whole_pipeline_on_the_walk_of_another_run(
    tiny_run: Path, tiny_config: Path, run_cli: Cli, tmp_path: Path
) -> None:
    room = tiny_config.parent / "room" / "scene.glb"
    done = run_cli(
        "compare", *PRESETS, "--scene", room, "--base", tiny_config, "--out", tmp_path, "--json",
        "--set", "planning.policy=trajectory", "--set", f"planning.trajectory={tiny_run}",
        "--set", "mapping.refinement_iterations=30",
    )
    assert done.returncode == 0, done.stderr
    runs = json.loads(done.stdout)["runs"]
    assert len(runs) == len(PRESETS)
    walked = read_json(tiny_run / "evaluation" / "metrics.json")["metrics"]
    for name in runs:
        metrics = read_json(tmp_path / name / "evaluation" / "metrics.json")["metrics"]
        assert metrics["path_m"] == pytest.approx(walked["path_m"], abs=0.2), name
        assert metrics["psnr_train"] > 14, name
        assert metrics["completion_ratio_surface"] > 0.05, name
