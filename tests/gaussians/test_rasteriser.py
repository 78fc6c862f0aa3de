"""The rasteriser against the float64 reference: values, gradients, repeatability, corner cases."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from active3d_pipe.errors import InputError
from active3d_pipe.gaussians.config import GaussianSettings
from active3d_pipe.gaussians.raster_pass import RasterPass, may_be_seen, tile_grid
from active3d_pipe.gaussians.rasteriser import render, render_view
from active3d_pipe.gaussians.reference import render_reference
from active3d_pipe.geometry import se3
from active3d_pipe.structures import Camera, GaussianModel

COLUMNS = {
    "means": slice(0, 3), "log_scales": slice(3, 6), "quats": slice(6, 10), "opacity": slice(10, 11),
    "colors": slice(11, 14),
}


def random_values(n: int, seed: int, sizes: tuple[float, float] = (0.02, 0.3)) -> np.ndarray:
    """Gaussians in front of a camera at the origin that looks along +z, a few beside and behind it."""
    rng = np.random.default_rng(seed)
    means = rng.uniform([-2, -1.5, -0.5], [2, 1.5, 4], (n, 3))
    log_scales = np.log(rng.uniform(*sizes, (n, 3)))
    log_scales[:, 2] -= 1.5 * rng.random(n)
    quats = rng.normal(size=(n, 4)) * rng.uniform(0.5, 2, (n, 1))
    logits = rng.uniform(-2, 5, (n, 1))
    return np.concatenate([means, log_scales, quats, logits, rng.random((n, 3))], 1).astype(np.float32)


def tilted_pose(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return se3.look_at(rng.normal(size=3) * 0.1, rng.normal(size=3) * 0.2 + [0, 0, 3], up=[0.1, -1, 0.0])


def compare(
    values: np.ndarray, camera: Camera, T: np.ndarray, seen: np.ndarray | None = None, **options: float
) -> dict[str, float]:
    """Largest image error and relative L2 gradient errors, doubtful pixels (see the reference) left out."""
    raster = RasterPass(t_stop=0.0, **options)
    out = raster.forward(values, camera, T, seen=seen)
    exact = torch.from_numpy(values.astype(np.float64)).requires_grad_()
    image, doubtful = render_reference(exact, camera, T, seen=seen, **options)
    assert out.shape == tuple(image.shape)
    clear = ~doubtful.numpy()
    out_grad = np.random.default_rng(1).normal(size=out.shape).astype(np.float32) * clear
    (image * torch.from_numpy(out_grad.astype(np.float64))).sum().backward()
    grad = raster.backward(out_grad)
    errors = {"image": float((np.abs(out - image.detach().numpy()) * clear).max()), "clear": float(clear.mean())}
    for name, columns in COLUMNS.items():
        wanted = exact.grad.numpy()[:, columns]
        errors[name] = float(np.linalg.norm(grad[:, columns] - wanted) / max(np.linalg.norm(wanted), 1e-9))
    return errors


@pytest.mark.parametrize("compensate", [True, False])
@pytest.mark.parametrize(("dilation_px2", "size"), [(0.1, (0.02, 0.3)), (0.3, (0.004, 0.03))])
def test_matches_the_reference(compensate: bool, dilation_px2: float, size: tuple[float, float]) -> None:
    camera = Camera(83, 61, 60.0, 58.0, 40.0, 31.5)
    values = random_values(400, 3, size)
    errors = compare(values, camera, tilted_pose(0), compensate=compensate, dilation_px2=dilation_px2)
    assert errors["clear"] > 0.5
    assert errors["image"] < 3e-5
    for name in COLUMNS:
        assert errors[name] < 5e-5, (name, errors)


@pytest.mark.parametrize("compensate", [True, False])
def test_distance_from_the_observed_depth_matches_the_reference(compensate: bool) -> None:
    """Observations near what is drawn and far from it, so that both sides of the limit count."""
    camera = Camera(83, 61, 60.0, 58.0, 40.0, 31.5)
    values = random_values(400, 3)
    seen = np.random.default_rng(4).uniform(0.3, 3.5, (61, 83)).astype(np.float32)
    errors = compare(values, camera, tilted_pose(0), seen, compensate=compensate)
    assert errors["clear"] > 0.5
    assert errors["image"] < 3e-5
    for name in COLUMNS:
        assert errors[name] < 5e-5, (name, errors)
    plain, out = RasterPass(), RasterPass()
    image = out.forward(values, camera, tilted_pose(0), seen=seen)
    assert np.array_equal(plain.forward(values, camera, tilted_pose(0)), image[:5])
    grad = np.random.default_rng(1).normal(size=(6, 61, 83)).astype(np.float32)
    grad[5] = 0
    np.testing.assert_allclose(out.backward(grad), plain.backward(grad[:5].copy()), rtol=1e-5, atol=1e-5)


def test_disc_seen_edge_on_has_finite_matching_gradients() -> None:
    # A flat disc whose plane contains the viewing direction, at angles from exact to a little tilted.
    values = random_values(40, 5)
    values[:, :3] = np.random.default_rng(0).uniform([-0.5, -0.4, 1.5], [0.5, 0.4, 3], (40, 3))
    values[:, 3:6] = np.log([0.1, 0.1, 1e-4])
    tilt = np.linspace(0, 0.3, 40)
    values[:, 6:10] = np.stack([np.cos(np.pi / 4 + tilt), 0 * tilt, np.sin(np.pi / 4 + tilt), 0 * tilt], 1)
    camera = Camera.from_fov(48, 40, 80)
    errors = compare(values, camera, np.eye(4), compensate=True, dilation_px2=0.1)
    assert errors["image"] < 3e-5
    assert max(errors[name] for name in COLUMNS) < 2e-4, errors


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10_000), n=st.integers(1, 60), width=st.integers(1, 50), height=st.integers(1, 40),
    compensate=st.booleans(),
)
def test_random_scenes_match_the_reference(seed: int, n: int, width: int, height: int, compensate: bool) -> None:
    camera = Camera(width, height, 0.7 * width + 3, 0.8 * height + 3, 0.45 * width, 0.55 * height)
    errors = compare(random_values(n, seed), camera, tilted_pose(seed), compensate=compensate)
    assert errors["image"] < 1e-4
    for name in COLUMNS:
        assert errors[name] < 1e-3, (name, errors)


def test_early_stop_changes_little() -> None:
    camera = Camera.from_fov(64, 48, 90)
    values = random_values(3000, 1)
    full = RasterPass(t_stop=0.0).forward(values, camera, np.eye(4))
    raster = RasterPass()
    stopped = raster.forward(values, camera, np.eye(4))
    assert raster._state["used"].sum() < len(raster._state["entries"])
    assert np.abs(full - stopped)[:3].max() < 1.1e-4
    grad = raster.backward(np.ones_like(stopped))
    assert np.isfinite(grad).all()


def test_same_bytes_every_time() -> None:
    camera = Camera.from_fov(100, 70, 90)
    values = random_values(2000, 2)
    out_grad = np.random.default_rng(0).normal(size=(5, 70, 100)).astype(np.float32)
    results = []
    for _ in range(3):
        raster = RasterPass()
        out = raster.forward(values, camera, np.eye(4)).copy()
        results.append((out.tobytes(), raster.backward(out_grad).tobytes()))
    assert results[0] == results[1] == results[2]


def test_thread_count_does_not_change_the_bytes() -> None:
    import numba

    camera = Camera.from_fov(100, 70, 90)
    values = random_values(2000, 2)
    out_grad = np.random.default_rng(0).normal(size=(5, 70, 100)).astype(np.float32)
    results = []
    before = numba.get_num_threads()
    try:
        for threads in {1, before}:
            numba.set_num_threads(threads)
            raster = RasterPass()
            out = raster.forward(values, camera, np.eye(4)).copy()
            results.append((out.tobytes(), raster.backward(out_grad).tobytes()))
    finally:
        numba.set_num_threads(before)
    assert all(r == results[0] for r in results)


def test_empty_model_is_black() -> None:
    camera = Camera.from_fov(33, 17, 90)
    view = render_view(GaussianModel.empty(), camera, np.eye(4))
    assert view.rgb.shape == (17, 33, 3) and not view.rgb.any() and not view.alpha.any() and not view.depth.any()
    values = torch.zeros((0, 14), requires_grad=True)
    render(values, camera, np.eye(4)).rgb.sum().backward()
    assert values.grad is not None and values.grad.shape == (0, 14)


def test_gaussians_behind_the_camera_are_not_drawn() -> None:
    values = random_values(200, 4)
    values[:, 2] = -np.abs(values[:, 2])
    raster = RasterPass()
    out = raster.forward(values, Camera.from_fov(40, 30, 90), np.eye(4))
    assert not out.any()
    assert not raster.backward(np.ones_like(out)).any()
    assert raster.num_visible == 0


@pytest.mark.parametrize("seed", range(4))
def test_what_views_show_is_among_what_they_may_show(seed: int) -> None:
    values = random_values(3000, seed)
    values[:, :3] *= 3
    poses, cameras = [tilted_pose(seed), tilted_pose(seed + 9)], [Camera(83, 61, 90.0, 88.0, 40.0, 31.5)] * 2
    shown = np.zeros(len(values), bool)
    for camera, T in zip(cameras, poses):
        raster = RasterPass()
        rows, _ = raster.backward_rows(np.zeros_like(raster.forward(values, camera, T)))
        assert len(rows) == raster.num_visible and (np.diff(rows) > 0).all()
        shown[rows] = True
    may = may_be_seen(values, cameras, poses, RasterPass().dilation_px2)
    assert not (shown & ~may).any() and shown.any() and not may.all()
    assert not may_be_seen(values, [], [], 0.1).any()


def test_tiles_draw_their_part_and_nothing_else() -> None:
    camera = Camera.from_fov(70, 50, 90)
    values = random_values(500, 6)
    full = RasterPass().forward(values, camera, np.eye(4)).copy()
    across, down = tile_grid(camera)
    tiles = np.random.default_rng(0).permutation(across * down)[: across * down // 3]
    raster = RasterPass()
    part = raster.forward(values, camera, np.eye(4), tiles).copy()
    mask = np.isin(np.arange(across * down).reshape(down, across), tiles)
    size = -(-camera.width // across), -(-camera.height // down)
    assert size <= (16, 16)
    drawn = np.kron(mask, np.ones((16, 16), bool))[: camera.height, : camera.width]
    assert np.array_equal(part[:, drawn], full[:, drawn])
    assert not part[:, ~drawn].any()
    # Gradients of the drawn part equal those of the full pass whose outer gradient is zero elsewhere.
    out_grad = np.random.default_rng(0).normal(size=full.shape).astype(np.float32) * drawn
    part_grad = raster.backward(out_grad).copy()
    whole = RasterPass()
    whole.forward(values, camera, np.eye(4))
    np.testing.assert_allclose(part_grad, whole.backward(out_grad), rtol=1e-4, atol=1e-5)


def test_autograd_function_gives_the_kernel_gradients() -> None:
    camera = Camera.from_fov(45, 37, 90)
    start = random_values(300, 8)
    values = torch.from_numpy(start.copy()).requires_grad_()
    one = render(values, camera, np.eye(4))
    two = render(values * 1.0, camera, tilted_pose(1))  # a second image waits for its backward
    weights = torch.rand((37, 45), generator=torch.Generator().manual_seed(0))
    ((one.rgb * weights[..., None]).sum() + (one.depth * weights).sum() + (one.alpha * weights).sum()).backward()
    out_grad = np.broadcast_to(weights.numpy(), (5, 37, 45)).astype(np.float32)
    raster = RasterPass()
    raster.forward(start, camera, np.eye(4))
    assert np.array_equal(values.grad.numpy(), raster.backward(np.ascontiguousarray(out_grad)))
    assert two.alpha.requires_grad


def test_render_view_normalises_depth() -> None:
    model = GaussianModel(
        np.array([[0, 0, 2.0]], np.float32), np.log(np.full((1, 3), 0.3, np.float32)),
        np.array([[1, 0, 0, 0]], np.float32), np.array([2.0], np.float32), np.ones((1, 3), np.float32),
    )
    view = render_view(model, Camera.from_fov(41, 31, 90), np.eye(4))
    assert view.depth[15, 20] == pytest.approx(2.0, rel=1e-5)
    assert view.depth[0, 0] == 0 and view.alpha[0, 0] < 0.5


@pytest.mark.parametrize("values", [torch.zeros((3, 13)), torch.zeros((3, 14), dtype=torch.float64)])
def test_wrong_values_are_refused(values: torch.Tensor) -> None:
    with pytest.raises(InputError, match="render: values"):
        render(values, Camera.from_fov(8, 8, 90), np.eye(4))


def test_default_settings_use_compensation() -> None:
    assert GaussianSettings().opacity_compensation and GaussianSettings().dilation_px2 == 0.1
