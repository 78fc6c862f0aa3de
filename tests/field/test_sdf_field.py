import numpy as np
import pytest
import torch
from room_with_ball import HIGH, LOW, RADIUS, SPHERE, scene_sdf, seen_by

from active3d_pipe.errors import ArtifactError, ConfigError, NumericalError
from active3d_pipe.field.config import FieldSettings
from active3d_pipe.field.optimise import FieldOptimiser, field_step
from active3d_pipe.field.rays import sample_rays
from active3d_pipe.field.rays import surface_points as readings
from active3d_pipe.field.sdf_field import SdfField

FIT = FieldSettings(rays=512, grid_voxel_m=0.1)


def train(field, frames, settings, iterations, seed=0, optimiser=None):
    optimiser = optimiser or FieldOptimiser(field, settings)
    rng = np.random.default_rng(seed)
    terms = {}
    for i in range(iterations):
        batch = sample_rays(frames, settings.rays, rng)
        terms = field_step(field, optimiser, batch, settings, rng, rate=0.1 if i > 0.7 * iterations else 1.0)
    return optimiser, terms


@pytest.fixture(scope="module")
def fitted(frames):
    # The box reaches 1.5 m beyond the room: what lies behind its wall stays unseen.
    field = SdfField(LOW - 0.1, HIGH + np.array([1.5, 0.1, 0.1]), FIT, torch.Generator().manual_seed(0))
    _, terms = train(field, frames, FIT, 200)
    return field, terms


def surface_points(n, seed=1):
    rng = np.random.default_rng(seed)
    d = rng.normal(size=(n, 3))
    ball = SPHERE + RADIUS * d / np.linalg.norm(d, axis=1, keepdims=True)
    floor = np.column_stack([rng.uniform(LOW[0], HIGH[0], n), rng.uniform(LOW[1], HIGH[1], n), np.zeros(n)])
    return np.concatenate([ball, floor])


def test_fits_a_room_with_a_ball_within_a_centimetre(fitted, frames):
    field, _ = fitted
    p = surface_points(2000)
    seen = seen_by(frames, p)
    error = np.abs(field.query_sdf(p[seen]))
    assert seen.mean() > 0.7 and error.mean() < 0.006 and np.quantile(error, 0.95) < 0.02
    rng = np.random.default_rng(2)
    p = rng.uniform(LOW, HIGH, (4000, 3))
    truth = scene_sdf(p)
    error = field.query_sdf(p[truth > 0]) - np.minimum(truth[truth > 0], 0.1)
    assert np.abs(error).mean() < 0.01
    far = truth > 0.15
    assert (field.query_sdf(p[far]) > 0.05).mean() > 0.99  # no phantom surface in free space


def test_readings_beside_the_rays_bring_the_surface_nearer(frames):
    """In as many iterations, with half of the rays."""
    errors = []
    for rays, more in ((256, 0), (128, 2048)):
        settings = FIT.model_copy(update={"rays": rays})
        field = SdfField(LOW - 0.1, HIGH + 0.1, settings, torch.Generator().manual_seed(0))
        optimiser, rng = FieldOptimiser(field, settings), np.random.default_rng(0)
        for i in range(120):
            batch, surface = sample_rays(frames, rays, rng), readings(frames, more, rng)
            terms = field_step(field, optimiser, batch, settings, rng, 0.1 if i > 80 else 1.0, surface=surface)
        assert (terms["surface"] > 0) == (more > 0)
        p = surface_points(2000)
        errors.append(np.abs(field.query_sdf(p[seen_by(frames, p)])).mean())
    assert errors[1] < 0.9 * errors[0]


def test_normals_point_into_free_space(fitted):
    field, _ = fitted
    d = np.random.default_rng(3).normal(size=(500, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    n = field.normals(SPHERE + RADIUS * d)
    cosine = (n * d).sum(axis=1)
    assert np.median(cosine) > 0.97
    np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1, atol=1e-5)


def test_sigma_is_low_where_seen_and_stays_high_where_unseen(fitted):
    field, _ = fitted
    rng = np.random.default_rng(4)
    p = rng.uniform(LOW, HIGH, (3000, 3))
    seen = p[scene_sdf(p) > 0.05]
    unseen = rng.uniform([HIGH[0] + 0.3, *LOW[1:]], [field.high[0], *HIGH[1:]], (1000, 3))
    assert not field.visited(unseen).any()
    sigma_seen, sigma_unseen = field.query_geometry(seen)[1], field.query_geometry(unseen)[1]
    assert np.median(sigma_seen) < 0.05
    assert np.quantile(sigma_unseen, 0.1) > 0.5 * FIT.sigma_prior_m


def test_colour(fitted):
    field, _ = fitted
    p = surface_points(500)
    samples = field.query(p, batch=300)
    assert np.abs(samples.color[:500] - [0.9, 0.2, 0.1]).mean() < 0.08
    assert np.abs(samples.color[500:] - [0.2, 0.5, 0.8]).mean() < 0.08
    assert samples.sdf.shape == samples.sigma.shape == (1000,)
    assert samples.color.dtype == samples.sdf.dtype == samples.sigma.dtype == np.float32


def test_new_field_is_free_and_uncertain(make_field, small):
    field = make_field(small)
    s = field.query(np.random.default_rng(0).uniform(LOW, HIGH, (2000, 3)))
    assert s.sdf.min() > 0.5 * small.truncation_m
    np.testing.assert_allclose(np.median(s.sigma), small.sigma_prior_m, rtol=0.05)


def test_same_seed_same_bytes_and_exact_resume(frames, make_field, small):
    def run(field, optimiser, rng, n):
        for _ in range(n):
            field_step(field, optimiser, sample_rays(frames, small.rays, rng), small, rng)

    def data(arrays):
        return {k: v.tobytes() for k, v in sorted(arrays.items())}

    whole = make_field(small)
    adam = FieldOptimiser(whole, small)
    run(whole, adam, np.random.default_rng(7), 8)

    rng = np.random.default_rng(7)
    first = make_field(small)
    adam_first = FieldOptimiser(first, small)
    run(first, adam_first, rng, 5)
    second = make_field(small, seed=99)
    adam_second = FieldOptimiser(second, small)
    second.load_state(first.state())
    adam_second.load_state(adam_first.state())
    run(second, adam_second, rng, 3)
    assert data(second.state()) == data(whole.state())
    assert data(adam_second.state()) == data(adam.state())


def test_state_is_a_copy_and_a_wrong_one_is_refused(frames, make_field, small):
    field = make_field(small)
    state = field.state()
    optimiser, _ = train(field, frames, small, 1)
    assert not np.array_equal(state["grid"], field.state()["grid"])
    with pytest.raises(ArtifactError, match="planes is missing"):
        field.load_state({k: v for k, v in state.items() if k != "planes"})
    with pytest.raises(ArtifactError, match="grid is"):
        field.load_state({**state, "grid": state["grid"][1:]})
    adam = optimiser.state()
    with pytest.raises(ArtifactError, match=r"grid\.exp_avg is"):
        optimiser.load_state({**adam, "grid.exp_avg": adam["grid.exp_avg"][1:]})


def test_rays_without_reading_change_no_geometry_loss(frames, make_field, small):
    import dataclasses

    field = make_field(small)
    batch = sample_rays(frames, small.rays, np.random.default_rng(0))
    blind = dataclasses.replace(batch, valid=np.zeros_like(batch.valid), depth=np.zeros_like(batch.depth))
    terms = field_step(field, FieldOptimiser(field, small), blind, small, np.random.default_rng(1))
    assert terms["sdf"] == terms["free"] == terms["rgb"] == terms["depth"] == terms["uncertainty"] == 0
    assert field.visits.sum() == 0


def test_bad_bounds_sizes_and_values(make_field, small, frames):
    generator = torch.Generator().manual_seed(0)
    with pytest.raises(ConfigError, match="low < high"):
        SdfField([0, 0, 0], [1, 0, 1], small, generator)
    with pytest.raises(ConfigError, match="max_table_megabytes"):
        SdfField([0, 0, 0], [1000, 1000, 100], small, generator)
    field = make_field(small)
    with torch.no_grad():
        field.grid.fill_(float("nan"))
    with pytest.raises(NumericalError, match="not finite"):
        train(field, frames, small, 1)
