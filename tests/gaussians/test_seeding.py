"""Seeding, error-driven adding, pruning and the coupling with the SDF."""

import numpy as np
import pytest
import torch

from active3d_pipe.errors import InputError
from active3d_pipe.gaussians.config import GaussianSettings
from active3d_pipe.gaussians.parameters import GaussianParameters
from active3d_pipe.gaussians.pruning import prune_mask
from active3d_pipe.gaussians.rasteriser import RenderedView, render_view
from active3d_pipe.gaussians.reference import rotation_matrices
from active3d_pipe.gaussians.sdf_coupling import sdf_gradient
from active3d_pipe.gaussians.seeding import discs, error_driven, frame_surface, seed_frame
from active3d_pipe.geometry import projection, se3
from active3d_pipe.structures import Camera, GaussianModel

CAMERA = Camera.from_fov(96, 72, 90)
POSE = se3.look_at([0.3, -0.2, 1.2], [2.0, 0.5, 0.9])


def plane_depth(normal: np.ndarray, offset: float) -> np.ndarray:
    """Depth image of the world plane normal . x = offset, 0 where it is behind or beyond 8 m."""
    rays = projection.pixel_rays(CAMERA).astype(np.float64) @ POSE[:3, :3].T
    with np.errstate(divide="ignore"):
        z = (offset - normal @ POSE[:3, 3]) / (rays @ normal)
    return np.where((z > 0) & (z < 8), z, 0).astype(np.float32)


def room_frame() -> tuple[np.ndarray, np.ndarray]:
    """Two walls that meet in a corner, one of them with fine stripes."""
    far = plane_depth(np.array([1.0, 0, 0]), 2.5)
    side = plane_depth(np.array([0, 1.0, 0]), 1.4)
    depth = np.where((side > 0) & ((far == 0) | (side < far)), side, far)
    points = projection.unproject(depth, POSE, CAMERA)
    rgb = np.full((*depth.shape, 3), 0.6, np.float32)
    striped = depth == side
    rgb[striped] = (0.5 + 0.4 * np.sign(np.sin(12 * points[striped][:, 2:3]))).astype(np.float32)
    return rgb, depth.astype(np.float32)


def test_surface_of_a_plane() -> None:
    normal = np.array([0.8, 0.6, 0.0])
    depth = plane_depth(normal, 2.0)
    depth[20:30, 40:50] = 0
    scene = frame_surface(depth, CAMERA, POSE)
    inner = np.zeros(depth.shape, bool)
    inner[3:-3, 3:-3] = True
    inner[16:34, 36:54] = False
    inner &= depth > 0
    assert inner.sum() > 1000
    np.testing.assert_allclose(scene.points[inner] @ normal, 2.0, atol=1e-4)
    np.testing.assert_allclose(scene.normals[inner] @ normal, -1.0, atol=1e-3)
    assert not scene.edge[inner].any() and scene.edge[19, 45]
    assert (scene.footprint[depth == 0] == 0).all()
    assert scene.footprint[inner].min() >= depth[inner].min() / CAMERA.fx * 0.999


def test_seeds_render_back_the_frame() -> None:
    rgb, depth = room_frame()
    model = seed_frame(rgb, depth, CAMERA, POSE, None, GaussianSettings(), 20_000, np.random.default_rng(0))
    view = render_view(model, CAMERA, POSE)
    shown = depth > 0
    assert (view.alpha[shown] > 0.5).mean() > 0.98
    assert np.median(np.abs(view.depth - depth)[shown]) < 0.02
    assert np.abs(view.rgb - rgb)[shown].mean() < 0.08


def test_octree_is_fine_where_colour_changes_and_coarse_elsewhere() -> None:
    rgb, depth = room_frame()
    settings = GaussianSettings(seed_cell_m=0.2)
    model = seed_frame(rgb, depth, CAMERA, POSE, None, settings, 20_000, np.random.default_rng(0))
    sigma = np.exp(model.log_scales[:, 0])
    striped = np.abs(model.means[:, 1] - 1.4) < 0.02
    plain = (np.abs(model.means[:, 0] - 2.5) < 0.02) & (model.means[:, 1] < 1.1)
    assert striped.sum() > 50 and plain.sum() > 50
    assert np.median(sigma[striped]) < 0.6 * np.median(sigma[plain])
    # The thin axis is the wall's normal.
    thin = rotation_matrices(torch.from_numpy(model.quats[striped].astype(np.float64)))[:, :, 2].numpy()
    assert np.median(np.abs(thin[:, 1])) > 0.99
    assert (model.log_scales[:, 2] < model.log_scales[:, 0]).all()


def test_flat_wall_gives_one_disc_per_cell() -> None:
    depth = plane_depth(np.array([1.0, 0, 0]), 2.53)
    rgb = np.full((*depth.shape, 3), 0.5, np.float32)
    settings = GaussianSettings(seed_cell_m=0.4, seed_levels=3)
    model = seed_frame(rgb, depth, CAMERA, POSE, None, settings, 20_000, np.random.default_rng(0))
    cells = np.unique(np.floor(projection.unproject(depth, POSE, CAMERA)[2:-2, 2:-2].reshape(-1, 3) / 0.4), axis=0)
    sigma = np.exp(model.log_scales[:, 0])
    assert (sigma > 0.25).sum() >= 0.6 * len(cells)
    assert len(model) < 20 * len(cells)


def test_only_what_is_missing_is_seeded() -> None:
    rgb, depth = room_frame()
    settings = GaussianSettings()
    full = RenderedView(rgb, depth, np.ones_like(depth))
    rng = np.random.default_rng(0)
    assert len(seed_frame(rgb, depth, CAMERA, POSE, full, settings, 9999, rng)) == 0
    holes = np.ones_like(depth)
    holes[:, :20] = 0.1
    too_far = depth.copy()
    too_far[:, -20:] *= 1.2
    partial = RenderedView(rgb, too_far, holes)
    model = seed_frame(rgb, depth, CAMERA, POSE, partial, settings, 9999, rng)
    uv, _ = projection.project(model.means.astype(np.float64), POSE, CAMERA)
    assert len(model) > 20
    assert ((uv[:, 0] < 21) | (uv[:, 0] > CAMERA.width - 21)).all()
    # A rendered surface in front of the observed one is not the seeding's business.
    near = RenderedView(rgb, depth * 0.5, np.ones_like(depth))
    assert len(seed_frame(rgb, depth, CAMERA, POSE, near, settings, 9999, rng)) == 0


def test_seed_limit_and_repeatability() -> None:
    rgb, depth = room_frame()
    models = [
        seed_frame(rgb, depth, CAMERA, POSE, None, GaussianSettings(), 150, np.random.default_rng(3)) for _ in range(2)
    ]
    assert len(models[0]) <= 150
    assert models[0].means.tobytes() == models[1].means.tobytes()
    assert len(seed_frame(rgb, depth, CAMERA, POSE, None, GaussianSettings(), 0, np.random.default_rng(3))) == 0
    none = np.zeros_like(depth)
    assert len(seed_frame(rgb, none, CAMERA, POSE, None, GaussianSettings(), 99, np.random.default_rng(3))) == 0


def test_error_driven_adds_where_the_error_is() -> None:
    rgb, depth = room_frame()
    rendered_rgb, rendered_depth = rgb.copy(), depth.copy()
    rendered_rgb[30:40, 10:30] += 0.3
    rendered_depth[50:60, 60:80] += 0.2
    view = RenderedView(rendered_rgb, rendered_depth, np.ones_like(depth))
    settings = GaussianSettings()
    model = error_driven(rgb, depth, CAMERA, POSE, view, settings, 100, np.random.default_rng(0))
    uv, _ = projection.project(model.means.astype(np.float64), POSE, CAMERA)
    column, row = np.floor(uv).astype(int).T
    in_color = (row >= 30) & (row < 40) & (column >= 10) & (column < 30)
    in_depth = (row >= 50) & (row < 60) & (column >= 60) & (column < 80)
    assert len(model) == 100 and (in_color | in_depth).all() and in_color.any() and in_depth.any()
    again = error_driven(rgb, depth, CAMERA, POSE, view, settings, 100, np.random.default_rng(0))
    assert model.means.tobytes() == again.means.tobytes()
    right = RenderedView(rgb, depth, np.ones_like(depth))
    assert len(error_driven(rgb, depth, CAMERA, POSE, right, settings, 100, np.random.default_rng(0))) == 0


def test_discs_face_any_normal() -> None:
    rng = np.random.default_rng(0)
    normals = np.concatenate([rng.normal(size=(50, 3)), [[0, 0, -1.0], [0, 0, 1.0], [1e-4, 0, -1], [0, 0, 0]]])
    model = discs(np.zeros((54, 3)), normals, np.zeros((54, 3)), np.full(54, 0.1), 0.2, 0.9)
    axis = rotation_matrices(torch.from_numpy(model.quats.astype(np.float64)))[:, :, 2].numpy()
    unit = normals[:53] / np.linalg.norm(normals[:53], axis=1, keepdims=True)
    assert ((axis[:53] * unit).sum(1) > 1 - 1e-5).all() and axis[53, 2] == pytest.approx(1)
    np.testing.assert_allclose(model.opacities, 0.9, atol=1e-6)


def test_frame_surface_refuses_a_wrong_image() -> None:
    with pytest.raises(InputError, match="depth is"):
        frame_surface(np.zeros((3, 4), np.float32), CAMERA, POSE)


def some_params(n: int = 40) -> GaussianParameters:
    rng = np.random.default_rng(0)
    model = discs(rng.normal(size=(n, 3)), rng.normal(size=(n, 3)), rng.random((n, 3)), np.full(n, 0.05), 0.2, 0.8)
    return GaussianParameters.from_model(model)


def test_prune_drops_thin_huge_broken_and_excess() -> None:
    params = some_params()
    params.opacity_logits[:] = torch.linspace(0, 2, 40)
    params.opacity_logits[3] = -6
    params.log_scales[5, 1] = 1.0
    params.means[7, 2] = float("nan")
    drop = prune_mask(params, GaussianSettings())
    assert np.flatnonzero(drop).tolist() == [3, 5, 7]
    drop = prune_mask(params, GaussianSettings(max_count=30))
    assert np.flatnonzero(drop).tolist() == list(range(10))
    params.opacity_logits[:] = 1.0
    drop = prune_mask(params, GaussianSettings(max_count=30))
    assert np.flatnonzero(drop).tolist() == [5, 7, *range(32, 40)]
    assert prune_mask(GaussianParameters.from_model(GaussianModel.empty()), GaussianSettings()).shape == (0,)


def test_sdf_gradient_matches_autograd() -> None:
    """The field is a sphere of radius 1 round (0.1, 0, 0), negative inside."""
    params = some_params()
    params.log_scales[::2] = torch.log(torch.tensor([0.01, 0.05, 0.05]))
    params.quats[:] *= torch.linspace(0.5, 2, 40)[:, None]
    centre = torch.tensor([0.1, 0, 0], dtype=torch.float64)
    settings = GaussianSettings(sdf_band_m=0.5, sdf_weight=0.7, sdf_normal_weight=0.3)

    values = params.values.to(torch.float64).requires_grad_()
    offset = values[:, :3] - centre
    sdf = offset.norm(dim=1) - 1
    normal = (offset / offset.norm(dim=1, keepdim=True)).detach()
    near = sdf.abs() < 0.5
    R = rotation_matrices(values[:, 6:10])
    axis = R[torch.arange(40), :, values[:, 3:6].argmin(1)]
    cosine = (axis * normal).sum(1)
    wanted = (0.7 * sdf.abs() + 0.3 * (1 - cosine**2))[near].mean()
    wanted.backward()

    terms, gradient = sdf_gradient(params.values.numpy(), sdf.detach().numpy(), normal.numpy(), settings)
    assert 0 < terms["coupled"] < 40 and terms["energy"] == pytest.approx(float(wanted.detach()), rel=1e-5)
    np.testing.assert_allclose(gradient, values.grad.numpy(), atol=1e-6)


def test_sdf_gradient_leaves_untrusted_means_alone() -> None:
    values = some_params(4).values.numpy()
    sdf = np.array([0.01, np.nan, 3.0, 0.01])
    grad = np.array([[1.0, 0, 0], [1, 0, 0], [1, 0, 0], [0, 0, 0]])
    terms, gradient = sdf_gradient(values, sdf, grad, GaussianSettings())
    assert terms["coupled"] == 1 and gradient[0].any() and not gradient[1:].any()
    with pytest.raises(InputError, match="sdf coupling"):
        sdf_gradient(values, sdf[:2], grad, GaussianSettings())
