"""The copy of the Gaussians for other programs: what it gains, what it leaves alone."""

import numpy as np
import pytest

from active3d_pipe.errors import NumericalError
from active3d_pipe.export.config import ExportSettings
from active3d_pipe.export.viewer_model import fit_to_viewers, viewer_kernels
from active3d_pipe.gaussians.config import GaussianSettings
from active3d_pipe.gaussians.rasteriser import render_view
from active3d_pipe.geometry import se3
from active3d_pipe.structures import Camera, Frame, GaussianModel

SETTINGS = GaussianSettings()
CAMERA = Camera.from_fov(96, 64, 60)


@pytest.fixture(scope="module")
def wall():
    """A chequered wall of discs about half a pixel wide, seen from 1 m."""
    y, z = np.meshgrid(np.arange(-0.62, 0.62, 0.012), np.arange(-0.42, 0.42, 0.012), indexing="ij")
    n = y.size
    means = np.stack([np.zeros(n), y.ravel(), z.ravel()], axis=1).astype(np.float32)
    chequer = ((np.floor(y / 0.05) + np.floor(z / 0.05)) % 2).ravel()
    colors = np.stack([0.2 + 0.6 * chequer, 0.3 + 0.3 * chequer, 0.7 - 0.4 * chequer], axis=1).astype(np.float32)
    log_scales = np.log(np.tile(np.float32([0.001, 0.006, 0.006]), (n, 1)))
    quats = np.tile(np.float32([1, 0, 0, 0]), (n, 1))
    return GaussianModel(means, log_scales, quats, np.full(n, 3, np.float32), colors)


@pytest.fixture(scope="module")
def frames(wall):
    poses = [se3.look_at(np.array([1.0, y, 0.1]), np.array([0.0, y / 2, 0.0])) for y in (-0.2, 0.0, 0.2)]
    views = [render_view(wall, CAMERA, T, SETTINGS) for T in poses]
    return [
        Frame(
            step=i, stamp_ns=i, rgb=(np.clip(v.rgb, 0, 1) * 255).round().astype(np.uint8), depth=v.depth, camera=CAMERA,
            T_world_camera=T,
        )
        for i, (T, v) in enumerate(zip(poses, views, strict=True))
    ]


def psnr(model, frame, settings):
    drawn = np.clip(render_view(model, frame.camera, frame.T_world_camera, settings).rgb, 0, 1)
    return float(-10 * np.log10(np.mean((drawn - frame.rgb / 255.0) ** 2)))


def fit(model, frames, **settings):
    return fit_to_viewers(model, frames, SETTINGS, ExportSettings(**settings), np.random.default_rng(5))


def test_the_copy_looks_better_in_viewers_and_the_map_stays(wall, frames):
    before = [np.copy(getattr(wall, name)) for name in ("means", "log_scales", "quats", "opacity_logits", "colors")]
    fitted = fit(wall, frames, viewer_iterations=240)
    plain, dimming = viewer_kernels(SETTINGS)
    gain = [np.mean([psnr(fitted, f, kernel) - psnr(wall, f, kernel) for f in frames]) for kernel in (plain, dimming)]
    assert gain[0] > 8
    assert gain[1] > 0
    for name, array in zip(("means", "log_scales", "quats", "opacity_logits", "colors"), before, strict=True):
        np.testing.assert_array_equal(getattr(wall, name), array)


def test_same_seed_same_bytes(wall, frames):
    a, b = (fit(wall, frames, viewer_iterations=12) for _ in range(2))
    for name in ("means", "log_scales", "quats", "opacity_logits", "colors"):
        assert getattr(a, name).tobytes() == getattr(b, name).tobytes()


@pytest.mark.parametrize("no_frames", [False, True])
def test_without_iterations_or_frames_it_is_a_plain_copy(wall, frames, no_frames):
    copy = fit(wall, [] if no_frames else frames, viewer_iterations=5 if no_frames else 0)
    for name in ("means", "log_scales", "quats", "opacity_logits", "colors"):
        np.testing.assert_array_equal(getattr(copy, name), getattr(wall, name))


def test_no_gaussians_no_work(frames):
    assert len(fit(GaussianModel.empty(), frames, viewer_iterations=5)) == 0


def test_a_loss_that_is_not_finite_says_what_to_change(wall, frames):
    broken = GaussianModel(
        wall.means, wall.log_scales, wall.quats, wall.opacity_logits, np.full_like(wall.colors, np.nan)
    )
    with pytest.raises(NumericalError, match=r"export\.viewer_learning_rate_scale"):
        fit(broken, frames, viewer_iterations=3)
