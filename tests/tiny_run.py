"""One tiny real run, made once: a generated room, a small camera, a few rounds, every stage."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

TINY = """
[scene]
file = "{scene}"

[run]
steps = 30
seed = 3

[run.keep]
last = 1000
every = 1

[camera]
width = 96
height = 54

[planning]
bootstrap_turn_deg = 120.0
rrt_iterations = 100
max_steps_per_round = 8

[mapping]
gaussian_iterations_per_step = 2.0
refinement_iterations = 30
refinement_field_iterations = 20

[mapping.gaussians]
max_count = 20000

[mapping.field]
rays = 256
plane_resolutions_m = [0.32, 0.12]
color_plane_resolutions_m = [0.32, 0.12]

[export]
viewer_iterations = 40

[export.mesh]
voxel_size_m = 0.05

[evaluation]
num_points = 5000
density_per_m2 = 50.0
num_views = 5
circle_views = 4
train_views = 5
curve_points = 2000
lpips = "off"
"""


def active3d(*arguments: object, env: dict[str, str] | None = None) -> subprocess.CompletedProcess:
    """Run the command line in a process of its own."""
    command = [sys.executable, "-m", "active3d_pipe.cli.main", "--quiet", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, env={**os.environ, **(env or {})}, check=False)


@pytest.fixture(scope="session")
def run_cli() -> Callable[..., subprocess.CompletedProcess]:
    return active3d


@pytest.fixture(scope="session")
def tiny_config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tiny")
    scene = folder / "room" / "scene.glb"
    made = active3d("scene", "make", "--rooms", 1, "--seed", 5, "--detail", 0.3, "--out", scene)
    assert made.returncode == 0, made.stderr
    config = folder / "tiny.toml"
    config.write_text(TINY.format(scene=scene))
    return config


@pytest.fixture(scope="session")
def tiny_run(tiny_config: Path) -> Path:
    """A complete run; read only."""
    run = tiny_config.parent / "run"
    done = active3d("run", tiny_config, "--out", run)
    assert done.returncode == 0, done.stderr
    return run
