"""A user's first hour: run, look, run again, resume, re-run a stage."""

import itertools
import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from active3d_pipe.storage import capture_log, meshes, splats, volumes
from active3d_pipe.storage.files import read_json

pytestmark = pytest.mark.timeout(1200)  # the first test makes the run, cold kernels included
Cli = Callable[..., subprocess.CompletedProcess]


def test_run_leaves_everything_that_is_promised(tiny_run: Path) -> None:
    for name in (
        "run.toml", "manifest.json", "journal.jsonl", "export/mesh.ply", "export/mesh.glb", "export/gaussians.ply",
        "evaluation/metrics.json", "evaluation/metrics.csv", "evaluation/curves.csv", "report/index.html",
    ):
        assert (tiny_run / name).stat().st_size > 0, name


def test_steps_obey_the_budget_and_the_motion_limits(tiny_run: Path) -> None:
    frames = [f for p in sorted(tiny_run.glob("capture/*/frames.mcap")) for f in capture_log.read_frames(p)]
    assert [f.step for f in frames] == list(range(30))
    for a, b in itertools.pairwise(frames):
        assert np.linalg.norm(a.T_world_camera[:3, 3] - b.T_world_camera[:3, 3]) <= 0.1 + 1e-6
        cosine = (np.trace(a.T_world_camera[:3, :3].T @ b.T_world_camera[:3, :3]) - 1) / 2
        assert np.degrees(np.arccos(np.clip(cosine, -1, 1))) <= 10.01
    assert sum(read_json(p)["collisions"] for p in tiny_run.glob("capture/*/capture.json")) == 0


def test_the_map_learns_what_it_saw(tiny_run: Path) -> None:
    metrics = read_json(tiny_run / "evaluation" / "metrics.json")["metrics"]
    assert metrics["psnr_train"] > 22  # a grey image scores about 12
    assert metrics["accuracy_median_cm_surface"] < 5
    assert 0.05 < metrics["completion_ratio_surface"] <= 1
    mesh = meshes.read_mesh(tiny_run / "export" / "mesh.ply")
    assert len(mesh.faces) > 500
    assert len(splats.read_splats(tiny_run / "export" / "gaussians.ply")) > 1000


def test_uncertainty_falls_where_the_agent_looked(tiny_run: Path) -> None:
    rounds = sorted(tiny_run.glob("uncertainty/*/volume.zarr"))
    first, last = volumes.read_volume(rounds[0]), volumes.read_volume(rounds[-1])
    assert last.observed.sum() >= first.observed.sum()
    assert last["entropy"].sum() < first["entropy"].sum()
    unseen = ~last.observed
    assert last["u_imp"][unseen].mean() > last["u_imp"][last.observed].mean()


def test_running_again_does_nothing(tiny_run: Path, tiny_config: Path, run_cli: Cli) -> None:
    journal = (tiny_run / "journal.jsonl").read_bytes()
    again = run_cli("run", tiny_config, "--out", tiny_run)
    assert again.returncode == 0, again.stderr
    assert "nothing to do" in again.stdout
    assert (tiny_run / "journal.jsonl").read_bytes() == journal


def test_every_stage_is_a_no_op_with_an_unchanged_key(tiny_run: Path, run_cli: Cli) -> None:
    for stage in ("capture", "mapping", "uncertainty", "planning", "export", "evaluation", "report"):
        at = ["--round", 1] if stage in ("capture", "mapping", "uncertainty", "planning") else []
        done = run_cli("run-stage", stage, "--run", tiny_run, *at)
        assert done.returncode == 0, done.stderr
        assert "up to date" in done.stdout, (stage, done.stdout)


def test_dry_run_names_what_a_change_would_rerun(tiny_run: Path, run_cli: Cli) -> None:
    done = run_cli("resume", tiny_run, "--dry-run", "--json", "--set", "evaluation.num_views=6")
    assert done.returncode == 0, done.stderr
    states = {node["node"]: node["hit"] for node in json.loads(done.stdout)["nodes"]}
    missed = {node for node, hit in states.items() if not hit}
    assert missed == {"evaluation", "report"}
    done = run_cli("resume", tiny_run, "--dry-run", "--json", "--set", "planning.eta=0.1")
    states = {node["node"]: node["hit"] for node in json.loads(done.stdout)["nodes"]}
    assert states["capture/round_0000"]
    assert states["mapping/round_0000"]
    assert states["uncertainty/round_0000"]
    assert not states["planning/round_0000"]


def test_force_makes_the_same_bytes(tiny_run: Path, run_cli: Cli) -> None:
    for stage in ("capture", "mapping", "uncertainty", "planning"):
        folder = tiny_run / stage / "round_0001"
        before = {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
        done = run_cli("run-stage", stage, "--run", tiny_run, "--round", 1, "--force")
        assert done.returncode == 0, done.stderr
        after = {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
        assert before == after, stage


def test_planning_decides_from_artifacts_alone(tiny_run: Path, tmp_path: Path) -> None:
    """The scene file is gone behind the planner's back; the same artifacts give the same decision."""
    import shutil

    copy = tmp_path / "run"
    shutil.copytree(tiny_run, copy)
    text = (copy / "run.toml").read_text()
    import tomllib

    scene = tomllib.loads(text)["scene"]["file"]
    (copy / "run.toml").write_text(text.replace(scene, str(tmp_path / "no_such_scene.glb")))
    from active3d_pipe.pipeline.stage import NodeId, StageContext
    from stages.planning import STAGE

    node = NodeId("planning", 1)
    record = read_json(copy / "planning" / "round_0001" / "record.json")
    from active3d_pipe.pipeline.config import Config, load_run_config

    config = load_run_config(copy / "run.toml", Config)
    inputs = {n: copy / str(n) for n in STAGE.inputs(1)}
    out = tmp_path / "out"
    out.mkdir()
    seed = record["parts"]["seed"]
    STAGE.run(StageContext(node, 1, inputs, out, config, {}, seed, 2, lambda text: None))
    assert (out / "decision.json").read_bytes() == (tiny_run / "planning" / "round_0001" / "decision.json").read_bytes()
