"""Parameters: packing, Adam, growth, exact resume; and a whole optimisation step."""

import numpy as np
import pytest
import torch

from active3d_pipe.errors import ArtifactError
from active3d_pipe.gaussians import kernels_adam
from active3d_pipe.gaussians.config import GaussianSettings
from active3d_pipe.gaussians.losses import frame_loss
from active3d_pipe.gaussians.optimisation import RowGradient, optimise_step
from active3d_pipe.gaussians.parameters import GaussianParameters
from active3d_pipe.gaussians.rasteriser import render, render_view
from active3d_pipe.structures import Camera, GaussianModel


def wall(n: int, seed: int = 0) -> GaussianModel:
    """Discs on the plane z = 2 before a camera at the origin, coloured by position."""
    rng = np.random.default_rng(seed)
    means = np.column_stack([rng.uniform(-2, 2, n), rng.uniform(-1.5, 1.5, n), np.full(n, 2.0)])
    log_scales = np.tile(np.log([0.08, 0.08, 0.01]), (n, 1))
    quats = np.tile([1.0, 0, 0, 0], (n, 1))
    colors = 0.5 + 0.4 * np.sin(means * [3, 5, 1])
    arrays = (means, log_scales, quats, rng.uniform(1, 3, n), colors)
    return GaussianModel(*(np.asarray(a, np.float32) for a in arrays))


def target(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    view = render_view(wall(900, 7), camera, np.eye(4))
    return view.rgb, view.depth


def test_model_round_trip() -> None:
    model = wall(50)
    back = GaussianParameters.from_model(model).to_model()
    for name in ("means", "log_scales", "quats", "opacity_logits", "colors"):
        assert np.array_equal(getattr(model, name), getattr(back, name))
    params = GaussianParameters.from_model(model)
    params.colors[:] = 0.25
    assert (params.to_model().colors == 0.25).all()


def test_no_primitive_grows_beyond_the_bound_not_even_by_the_steps_that_it_owes() -> None:
    settings = GaussianSettings()
    params = GaussianParameters.from_model(wall(20))
    bound = 1.05 * float(np.exp(params.values.numpy()[:, 3:6].max()))
    wider = np.zeros((20, 14), np.float32)
    wider[:, 3:6] = -1e-4  # dL/dlog-scale that makes them grow
    rows = np.arange(10, dtype=np.int32)
    for some in (np.arange(20, dtype=np.int32), rows, rows, rows):  # the last ten owe three steps
        params.step(wider[some], settings, rows=some, largest_m=bound)
    scales = np.exp(params.values.numpy()[:, 3:6])
    assert scales.max() <= bound * (1 + 1e-6)
    assert scales[:, 0].min() > 0.99 * bound  # both kinds came up to it
    free = GaussianParameters.from_model(wall(20))
    for _ in range(4):
        free.step(wider, settings)
    assert np.exp(free.values.numpy()[:, 3:6]).max() > 1.05 * bound


def test_adam_equals_torch_for_every_primitive_whenever_it_was_added() -> None:
    settings = GaussianSettings()
    old, new = wall(20), wall(10, 1)
    params = GaussianParameters.from_model(old)
    rates = np.array(
        [settings.lr_means_m] * 3 + [settings.lr_log_scales] * 3 + [settings.lr_quats] * 4
        + [settings.lr_opacity_logits] + [settings.lr_colors] * 3
    )

    def reference(start: np.ndarray, grads: list[np.ndarray]) -> np.ndarray:
        columns = [torch.from_numpy(start[:, j].copy().astype(np.float64)).requires_grad_() for j in range(14)]
        groups = [{"params": [c], "lr": float(r)} for c, r in zip(columns, rates)]
        optimiser = torch.optim.Adam(groups, eps=float(kernels_adam.EPSILON))
        for g in grads:
            for j, c in enumerate(columns):
                c.grad = torch.from_numpy(g[:, j].astype(np.float64))
            optimiser.step()
        return np.stack([c.detach().numpy() for c in columns], 1)

    rng = np.random.default_rng(0)
    grads = [rng.normal(size=(30, 14)).astype(np.float32) * 1e-4 for _ in range(9)]
    start_old, start_new = params.values.numpy().copy(), GaussianParameters.from_model(new).values.numpy().copy()
    for g in grads[:4]:
        params.step(g[:20], settings)
    params.append(new)
    for g in grads[4:]:
        params.step(g, settings)
    wanted = np.concatenate([
        reference(start_old, [g[:20] for g in grads]), reference(start_new, [g[20:] for g in grads[4:]])
    ])
    np.testing.assert_allclose(params.values.numpy(), wanted, rtol=2e-5, atol=2e-6)
    assert params.steps.tolist() == [9] * 20 + [5] * 10


def test_visible_only_leaves_the_others_alone() -> None:
    params = GaussianParameters.from_model(wall(20))
    before = params.values.numpy().copy()
    visible = np.arange(20) % 3 == 0
    settings = GaussianSettings(visible_only=True)
    for _ in range(2):
        params.step(np.ones((7, 14), np.float32), settings, rows=np.flatnonzero(visible).astype(np.int32))
    changed = (params.values.numpy() != before).any(1)
    assert np.array_equal(changed, visible) and np.array_equal(params.steps.numpy() == 2, visible)


@pytest.mark.parametrize("already", [0, 3, 30, 400])
@pytest.mark.parametrize("share", [0.05, 0.5])
def test_steps_that_are_owed_come_to_those_taken_one_by_one(already: int, share: float) -> None:
    """Against an optimiser that moves every primitive in every iteration, the gradient of the unseen being zero."""
    settings, rng = GaussianSettings(), np.random.default_rng(already)
    lazy, diligent = GaussianParameters.from_model(wall(400)), GaussianParameters.from_model(wall(400))
    pull = rng.normal(size=(400, 14)).astype(np.float32)

    def gradient() -> np.ndarray:
        return ((pull + rng.normal(size=(400, 14))) * 1e-4).astype(np.float32)

    for _ in range(already):
        grad = gradient()
        for params in (lazy, diligent):
            params.step(grad, settings)
    start = diligent.values.numpy().copy()
    for i in range(60):
        grad, shown = gradient(), rng.random(400) < share
        rows = np.flatnonzero(shown).astype(np.int32)
        lazy.rows(rows)
        lazy.step(grad[rows], settings, rows=rows)
        diligent.step(np.where(shown[:, None], grad, 0).astype(np.float32), settings)
        if i == 30:
            for params in (lazy, diligent):
                params.append(wall(7, 3))
                params.keep(np.arange(407) < 400)
    way = np.abs(diligent.values.numpy() - start)
    assert np.array_equal(lazy.steps.numpy(), diligent.steps.numpy())
    apart = np.abs(lazy.values.numpy() - diligent.values.numpy())
    assert apart.sum() < 0.03 * way.sum() and way.sum() > 1
    np.testing.assert_allclose(lazy.moment2.numpy(), diligent.moment2.numpy(), rtol=1e-3, atol=1e-12)
    np.testing.assert_allclose(lazy.moment1.numpy(), diligent.moment1.numpy(), rtol=1e-3, atol=1e-9)


def test_a_view_moves_what_it_shows_and_the_rest_goes_on() -> None:
    camera, settings = Camera.from_fov(60, 44, 60), GaussianSettings()
    rgb, depth = target(camera)
    behind = wall(50, 3)
    behind.means[:, 2] = -2
    params = GaussianParameters.from_model(wall(300))
    params.append(behind)
    params.step(np.full((350, 14), 1e-4, np.float32), settings)
    before = params.values.numpy().copy()
    _, near = params.near(camera, np.eye(4), settings.dilation_px2)
    assert 50 < len(near) < 300 and (np.diff(near) > 0).all()
    for _ in range(3):
        optimise_step(params, camera, np.eye(4), rgb, depth, settings)
    assert params.steps.tolist() == [4] * 350
    # Adam's way under a gradient that is gone: b1 / (1 - b1^2) of a step in the first iteration, and so on.
    b1, b2 = settings.adam_beta1, settings.adam_beta2
    factor = 0.0
    for j in (1, 2, 3):
        moment, square = b1**j * (1 - b1) / (1 - b1 ** (1 + j)), b2**j * (1 - b2) / (1 - b2 ** (1 + j))
        factor += moment / np.sqrt(square)
    way = before[300:, 0] - params.values.numpy()[300:, 0]
    np.testing.assert_allclose(way, settings.lr_means_m * factor, rtol=5e-3)


def test_zero_gradient_moves_nothing() -> None:
    params = GaussianParameters.from_model(wall(5))
    before = params.values.numpy().copy()
    for _ in range(3):
        params.step(np.zeros((5, 14), np.float32), GaussianSettings())
    assert np.array_equal(params.values.numpy(), before)


def test_resume_gives_the_same_bytes() -> None:
    camera, settings = Camera.from_fov(60, 44, 90), GaussianSettings()
    rgb, depth = target(camera)
    params = GaussianParameters.from_model(wall(300))
    for _ in range(4):
        optimise_step(params, camera, np.eye(4), rgb, depth, settings)
    params.append(wall(30, 5))
    stored = {name: np.frombuffer(a.tobytes(), a.dtype).reshape(a.shape) for name, a in params.state().items()}
    resumed = GaussianParameters.from_state(stored)
    for _ in range(4):
        terms = optimise_step(params, camera, np.eye(4), rgb, depth, settings, 0.5)
        assert terms == optimise_step(resumed, camera, np.eye(4), rgb, depth, settings, 0.5)
    for name, a in params.state().items():
        assert a.tobytes() == resumed.state()[name].tobytes()


def test_state_holds_moments_of_what_moved_only() -> None:
    moved = GaussianParameters.from_model(wall(20))
    moved.step(np.ones((20, 14), np.float32), GaussianSettings())
    resting = moved.rest(np.arange(20) < 8)
    assert len(moved) == 12 and resting.shape == (8, 14)
    moved.wake(resting)
    moved.append(wall(3, 2))
    state = moved.state()
    assert [len(state[n]) for n in ("values", "moment1", "moment2", "steps")] == [23, 15, 15, 15]
    back = GaussianParameters.from_state(state)
    for name in ("values", "moment1", "moment2", "steps"):
        assert torch.equal(getattr(back, name), getattr(moved, name))


def test_primitives_that_are_added_one_lot_after_the_other_start_like_those_that_were_there() -> None:
    lots = [wall(7 + i, i) for i in range(40)]
    grown, plain = GaussianParameters.from_model(lots[0]), GaussianParameters.from_model(lots[0])
    rng = np.random.default_rng(0)
    for i, lot in enumerate(lots[1:]):
        before = plain.values.numpy().copy()
        grown.append(lot)
        new = GaussianParameters.from_model(lot)
        held = [(getattr(plain, k), getattr(new, k)) for k in ("values", "moment1", "moment2", "steps")]
        plain = GaussianParameters(*(torch.cat(pair) for pair in held))
        assert np.array_equal(grown.values.numpy()[: len(before)], before)
        grads = rng.normal(size=(len(grown), 14)).astype(np.float32)
        for params in (grown, plain):
            params.step(grads, GaussianSettings())
        if i % 7 == 3:
            keep = rng.random(len(grown)) < 0.8
            grown.keep(keep)
            plain.keep(keep)
        for name in ("values", "moment1", "moment2", "steps"):
            assert torch.equal(getattr(grown, name), getattr(plain, name))


@pytest.mark.parametrize("damage", ["missing", "shape", "dtype"])
def test_damaged_state_is_refused(damage: str) -> None:
    params = GaussianParameters.from_model(wall(5))
    params.step(np.ones((5, 14), np.float32), GaussianSettings())
    state = params.state()
    if damage == "missing":
        del state["moment2"]
    elif damage == "shape":
        state["steps"] = state["steps"][:3]
    else:
        state["moment1"] = state["moment1"].astype(np.float64)
    with pytest.raises(ArtifactError, match="optimiser state"):
        GaussianParameters.from_state(state)


def test_keep_drops_rows_everywhere() -> None:
    params = GaussianParameters.from_model(wall(30))
    grad = np.random.default_rng(0).normal(size=(30, 14)).astype(np.float32)
    params.step(grad, GaussianSettings())
    mask = np.arange(30) % 2 == 1
    wanted = {name: a[mask] for name, a in params.state().items()}
    params.keep(mask)
    assert len(params) == 15
    for name, a in params.state().items():
        assert np.array_equal(a, wanted[name])


def test_step_equals_autograd_and_lowers_the_loss() -> None:
    camera, settings = Camera.from_fov(64, 48, 90), GaussianSettings()
    rgb, depth = target(camera)
    params = GaussianParameters.from_model(wall(600))
    other = GaussianParameters.from_model(wall(600))
    leaf = other.values.clone().requires_grad_()
    loss, terms = frame_loss(render(leaf, camera, np.eye(4)), rgb, depth, settings)
    loss.backward()
    other.step(leaf.grad, settings)
    first = optimise_step(params, camera, np.eye(4), rgb, depth, settings)
    assert first["loss"] == terms["loss"] and first["visible"] > 0
    assert np.array_equal(params.values.numpy(), other.values.numpy())
    for _ in range(60):
        last = optimise_step(params, camera, np.eye(4), rgb, depth, settings)
    assert last["loss"] < 0.4 * first["loss"]
    assert last["psnr"] > first["psnr"] + 5


def test_extra_gradient_is_added() -> None:
    camera, settings = Camera.from_fov(32, 32, 90), GaussianSettings()
    rgb, depth = target(camera)
    params = GaussianParameters.from_model(wall(100))
    pulled = np.arange(0, 100, 2, dtype=np.int32)
    extra = np.zeros((50, 14), np.float32)
    extra[:, 2] = 100.0
    assert np.array_equal(params.rows(pulled), params.values.numpy()[pulled])
    optimise_step(
        params, camera, np.eye(4), rgb, depth, settings, extra_gradient=RowGradient(pulled, extra)
    )
    np.testing.assert_allclose(params.means.numpy()[::2, 2], 2 - settings.lr_means_m, atol=1e-6)
    assert (params.means.numpy()[1::2, 2] > 2 - settings.lr_means_m).any()


def test_empty_model_takes_a_step() -> None:
    camera = Camera.from_fov(20, 16, 90)
    params = GaussianParameters.from_model(GaussianModel.empty())
    rgb, depth = np.full((16, 20, 3), 0.5, np.float32), np.ones((16, 20), np.float32)
    terms = optimise_step(params, camera, np.eye(4), rgb, depth, GaussianSettings())
    assert terms["l1"] == pytest.approx(0.5) and terms["depth_l1"] == pytest.approx(1)
