"""A run that is not told how large the scene is: `scene.bounds = "auto"`."""

import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from active3d_pipe.geometry.projection import unproject
from active3d_pipe.sim.config import SceneSettings
from active3d_pipe.sim.scene import load_scene
from active3d_pipe.storage import capture_log, meshes, volumes
from active3d_pipe.storage.files import read_json, read_tensors

pytestmark = pytest.mark.timeout(1200)
Cli = Callable[..., subprocess.CompletedProcess]
# A short first look at the near wall, then a turn on the spot: the room is discovered over several rounds.
LOOK_AT = (-2.6, 0.6, 1.3)
SETTINGS = (
    "scene.bounds=auto", f"scene.start_look_at={list(LOOK_AT)}", "planning.bootstrap_turn_deg=20",
    "planning.policy=trajectory", "planning.max_steps_per_round=18", "export.viewer_iterations=0", "export.glb=false",
    "mapping.refinement_iterations=5", "mapping.refinement_field_iterations=20", "evaluation.num_views=1",
    "evaluation.circle_views=0", "evaluation.train_views=1", "evaluation.curve_points=0", "evaluation.num_points=2000",
    "run.steps=60",
)  # fmt: skip


@pytest.fixture(scope="module")
def auto_run(tiny_config: Path, run_cli: Cli) -> Path:
    file = tiny_config.parent / "room" / "scene.glb"
    start = load_scene(SceneSettings(file=str(file), start_look_at=LOOK_AT)).start_pose
    turn = []
    for angle in np.radians(np.arange(10, 361, 10)):
        T = start.copy()
        T[:2, :3] = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ start[:2, :3]
        turn.append(T.tolist())
    poses = tiny_config.parent / "turn.json"
    poses.write_text(json.dumps(turn))
    run = tiny_config.parent / "auto"
    options = [part for text in (*SETTINGS, f"planning.trajectory={poses}") for part in ("--set", text)]
    done = run_cli("run", tiny_config, "--out", run, *options)
    assert done.returncode == 0, done.stderr
    return run


def boxes(run: Path) -> np.ndarray:
    return np.array([read_json(p)["bounds"] for p in sorted(run.glob("mapping/*/mapping.json"))])


def test_the_box_grows_with_what_was_seen_and_holds_the_room_at_the_end(auto_run: Path, tiny_config: Path) -> None:
    assert read_json(auto_run / "capture" / "round_0000" / "capture.json")["rig"]["bounds"] is None
    found = boxes(auto_run)
    assert (np.diff(found[:, 0], axis=0) <= 0).all()
    assert (np.diff(found[:, 1], axis=0) >= 0).all()
    chunks = (found - found[0]) / 0.4
    assert np.abs(chunks).max() >= 1  # it did grow
    np.testing.assert_allclose(chunks, np.rint(chunks), atol=1e-5)
    room, walls = load_scene(SceneSettings(file=str(tiny_config.parent / "room" / "scene.glb"))), 0.35
    assert (found[0][1] - found[0][0]).max() < 3  # a corner of the room
    assert (found[-1][0] <= room.bounds_low + walls).all()
    assert (found[-1][1] >= room.bounds_high - walls).all()
    assert (found[-1][1] - found[-1][0] < room.bounds_high - room.bounds_low + 1).all()
    for path in auto_run.glob("capture/*/frames.mcap"):
        for frame in capture_log.read_frames(path):
            points = unproject(frame.depth, frame.T_world_camera, frame.camera)[frame.depth > 0]
            assert ((points > found[-1][0]) & (points < found[-1][1])).all(axis=1).mean() > 0.9999


def test_every_artifact_of_a_round_is_in_its_box(auto_run: Path) -> None:
    for path, box in zip(sorted(auto_run.glob("uncertainty/*")), boxes(auto_run), strict=True):
        volume = volumes.read_volume(path / "volume.zarr")
        assert (volume.grid.low <= box[0]).all()
        assert (volume.grid.high >= box[1]).all()
        layer = volume.observed
        border = np.ones(layer.shape, bool)
        border[1:-1, 1:-1, 1:-1] = False
        assert not layer[border].any()  # around what was seen there is space that was not
    field, _ = read_tensors(auto_run / "export" / "field.safetensors")
    np.testing.assert_allclose(field["boxes"][1], boxes(auto_run)[-1] + np.array([[-0.2], [0.2]]), atol=1e-6)
    mesh = meshes.read_mesh(auto_run / "export" / "mesh.ply")
    assert len(mesh.faces) > 300


def test_growth_from_files_gives_the_bytes_of_growth_in_memory(auto_run: Path, run_cli: Cli) -> None:
    found = boxes(auto_run)
    k = 1 + int(np.argmax(np.abs(np.diff(found, axis=0)).max(axis=(1, 2)) > 0))
    for stage in ("mapping", "uncertainty"):
        folder = auto_run / stage / f"round_{k:04d}"
        before = {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
        done = run_cli("run-stage", stage, "--run", auto_run, "--round", k, "--force")
        assert done.returncode == 0, done.stderr
        after = {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
        assert before == after, stage
