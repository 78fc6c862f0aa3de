"""The exported Gaussians look nearly as good in other programs as the map in ours.

Two programs of the two kinds there are. splat-transform (PlayCanvas) adds 0.3 px2 to every projected covariance and
lets the primitive grow, as the reference implementation of 3D Gaussian splatting does; Spark (three.js) adds as much
and dims it in exchange. Our rasteriser adds 0.1 px2 and dims. `gaussians.ply` is fitted to both; it is judged
against what the map itself, `gaussians.safetensors`, looks like here.
"""

import logging
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from active3d_pipe.gaussians.parameters import GaussianParameters
from active3d_pipe.gaussians.rasteriser import render_view
from active3d_pipe.geometry.sampling import spread
from active3d_pipe.pipeline.config import Config, load_run_config
from active3d_pipe.sim.observable import held_out_poses
from active3d_pipe.storage import capture_log, splats
from active3d_pipe.storage.files import read_json, read_tensors
from active3d_pipe.structures import Camera
from stages import shared
from tests.interop.conftest import NODE, need, run_program
from tests.tiny_run import active3d

# The figures of every comparison: pytest --log-cli-level=INFO shows them.
log = logging.getLogger(__name__)
pytestmark = pytest.mark.interop

MOST_DB = 1.5  # how much worse another program's image may be than ours, PSNR against the truth
# A guard against a broken file, not a claim: Spark differs from us in more than the filter. It sorts by distance, not
# by depth (0.4 dB of 2.0 dB on a furnished room); its float32 encoding changes nothing; the rest is unexplained.
MOST_DB_SPARK = 4.0
VIEWS = 4  # captured frames, and as many held-out views
TINY_WIDTH = 640  # splat-transform cannot draw images as small as the tiny run's frames
CAPTURE_SIZE = {
    "run.steps": 40, "mapping.refinement_iterations": 600, "mapping.refinement_field_iterations": 20,
    "export.mesh.voxel_size_m": 0.05, "evaluation.num_points": 5000, "evaluation.density_per_m2": 50.0,
    "evaluation.num_views": 5, "evaluation.circle_views": 4, "evaluation.train_views": 5,
    "evaluation.curve_points": 2000, "evaluation.lpips": "off",
}  # fmt: skip


@pytest.fixture(scope="session")
def capture_size_run(tiny_config: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A complete run with a 600x340 camera: the one that ACTIVE3D_INTEROP_RUN names, else a short one made here."""
    named = os.environ.get("ACTIVE3D_INTEROP_RUN")
    if named:
        need((Path(named) / "export" / "gaussians.ply").is_file(), f"a complete run at {named}", "active3d run ...")
        return Path(named)
    scene = load_run_config(tiny_config, Config).scene.file
    run = tmp_path_factory.mktemp("capture_size") / "run"
    settings = [word for key, value in CAPTURE_SIZE.items() for word in ("--set", f"{key}={value}")]
    done = active3d("run", "default", "--out", run, "--set", f"scene.file={scene}", *settings)
    assert done.returncode == 0, done.stderr
    return run


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((a.astype(np.float64) - b) ** 2)))


class Judge:
    """Truth and our own image of some keyframes and some held-out views of a run, at a given width."""

    def __init__(self, run: Path, width: int | None = None) -> None:
        config = load_run_config(run / "run.toml", Config)
        width = width or config.camera.width
        size = {"width": width, "height": round(width * config.camera.height / config.camera.width)}
        config = config.model_copy(update={"camera": config.camera.model_copy(update=size)})
        simulator = shared.make_simulator(config, config.run.seed)
        frames = [f for p in sorted(run.glob("capture/*/frames.mcap")) for f in capture_log.read_frames(p)]
        # What the last frame of a run shows for the first time is in no keyframe, and hardly learnt by a short run.
        keys = {key["step"] for key in read_json(run / "export" / "keyframes.json")}
        frames = [f for f in frames if f.step in keys]
        clearance = config.evaluation.view_clearance_m
        held_out = held_out_poses(simulator, VIEWS, simulator.scene.name, min_clearance_m=clearance)
        self.camera: Camera = simulator.camera
        self.poses = [f.T_world_camera for f in spread(frames, VIEWS)] + list(held_out)
        self.truths = [simulator.render(T).rgb.astype(np.float32) / 255 for T in self.poses]
        values = read_tensors(run / "export" / "gaussians.safetensors")[0]["values"]
        model, settings = GaussianParameters.from_values(values).to_model(), config.mapping.gaussians
        self.ours = [np.clip(render_view(model, self.camera, T, settings).rgb, 0, 1) for T in self.poses]
        self.captured = len(self.poses) - len(held_out)

    def check(self, name: str, theirs: list[np.ndarray], most_db: float = MOST_DB) -> None:
        """Another program's images of `poses`: in the mean over captured and over held-out views, within `most_db`."""
        a = np.array([psnr(image, truth) for image, truth in zip(self.ours, self.truths, strict=True)])
        b = np.array([psnr(image, truth) for image, truth in zip(theirs, self.truths, strict=True)])
        size = f"{self.camera.width}x{self.camera.height}"
        for kind, part in (("captured", slice(self.captured)), ("held-out", slice(self.captured, None))):
            line = f"{name} {size} {kind}: {b[part].mean():.2f} dB, ours {a[part].mean():.2f} dB"
            log.info("%s; gap by view %s", line, np.round(a[part] - b[part], 2).tolist())
            assert a[part].mean() - b[part].mean() <= most_db, line
        # A wrong view, of another pose say, scores below 12 dB. A short run has not seen all that held-out views show.
        worst = min(a[: self.captured].min(), b[: self.captured].min())
        assert worst > 20, f"{name} {size}: ours {a}, theirs {b}"


@pytest.fixture(scope="session")
def small(tiny_run: Path) -> Judge:
    return Judge(tiny_run, TINY_WIDTH)


@pytest.fixture(scope="session")
def real(capture_size_run: Path) -> Judge:
    return Judge(capture_size_run)


def test_splat_transform_on_the_tiny_run(
    tiny_run: Path, small: Judge, splat_transform: Callable[[Path, Camera, np.ndarray], np.ndarray]
) -> None:
    ply = tiny_run / "export" / "gaussians.ply"
    small.check("splat-transform", [splat_transform(ply, small.camera, T) for T in small.poses])


def test_spark_on_the_tiny_run(tiny_run: Path, small: Judge, spark: Callable[..., list[np.ndarray]]) -> None:
    small.check("Spark", spark(tiny_run / "export" / "gaussians.ply", small.camera, small.poses), MOST_DB_SPARK)


def test_splat_transform_at_the_capture_resolution(
    capture_size_run: Path, real: Judge, splat_transform: Callable[[Path, Camera, np.ndarray], np.ndarray]
) -> None:
    ply = capture_size_run / "export" / "gaussians.ply"
    real.check("splat-transform", [splat_transform(ply, real.camera, T) for T in real.poses])


def test_spark_at_the_capture_resolution(
    capture_size_run: Path, real: Judge, spark: Callable[..., list[np.ndarray]]
) -> None:
    real.check("Spark", spark(capture_size_run / "export" / "gaussians.ply", real.camera, real.poses), MOST_DB_SPARK)


def test_splat_transform_reads_every_gaussian(tiny_run: Path, tmp_path: Path, splat_transform: object) -> None:
    """Round trip through the other program's reader and writer: the same numbers."""
    path, copy = tiny_run / "export" / "gaussians.ply", tmp_path / "copy.ply"
    run_program(["node", NODE / "node_modules/@playcanvas/splat-transform/bin/cli.mjs", "-q", path, copy])
    ours, body = splats.read_splats(path), copy.read_bytes()
    assert f"element vertex {len(ours)}\n".encode() in body
    again = splats.read_splats(copy)
    for name in ("means", "log_scales", "quats", "opacity_logits", "colors"):
        np.testing.assert_allclose(getattr(again, name), getattr(ours, name), rtol=0, atol=1e-6)
