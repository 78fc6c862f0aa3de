"""A field that grows says the same inside its old box, and learns outside it."""

import numpy as np
import pytest
import torch
from room_with_ball import HIGH, LOW

from active3d_pipe.field.growth import grown_field
from active3d_pipe.field.optimise import FieldOptimiser, field_step
from active3d_pipe.field.rays import sample_rays
from active3d_pipe.field.sdf_field import SdfField

# Neither a multiple of a node spacing nor of a bin.
BELOW, ABOVE = np.array([0.73, 0.0, 0.31]), np.array([1.47, 0.55, 0.0])


def draws(seed=1):
    return torch.Generator().manual_seed(seed)


def train(field, optimiser, frames, settings, seed=0, iterations=20):
    rng = np.random.default_rng(seed)
    for _ in range(iterations):
        field_step(field, optimiser, sample_rays(frames, settings.rays, rng), settings, rng)


@pytest.fixture
def trained(make_field, small, frames):
    field = make_field(small)
    optimiser = FieldOptimiser(field, small)
    train(field, optimiser, frames, small)
    return field, optimiser


def test_growth_leaves_the_function_inside_the_old_box(trained, small):
    field, optimiser = trained
    p = np.random.default_rng(0).uniform(field.low, field.high, (20000, 3)).astype(np.float32)
    p[:8] = np.stack(np.meshgrid(*np.stack([field.low, field.high], axis=1), indexing="ij"), -1).reshape(-1, 3)
    before, seen = field.query(p), field.visited(p)
    assert before.sdf.std() > 0.01
    for steps in (1, 3):  # at once, and bit by bit
        new, adam = field, optimiser
        for i in range(1, steps + 1):
            part = i / steps
            new, adam = grown_field(new, adam, field.low - part * BELOW, field.high + part * ABOVE, draws())
        assert np.abs(new.low - (field.low - BELOW)).max() < 1e-6
        after = new.query(p)
        np.testing.assert_allclose(after.sdf, before.sdf, rtol=0, atol=1e-6)
        np.testing.assert_allclose(after.sigma, before.sigma, rtol=0, atol=1e-6)
        np.testing.assert_allclose(after.color, before.color, rtol=0, atol=1e-5)
        # A corner belongs to the cell beyond it, where there is one.
        np.testing.assert_array_equal(new.visited(p[8:]), seen[8:])
        outside = np.random.default_rng(1).uniform(
            field.high + np.array([0.3, -1, -1]), field.high + np.array([1.4, 0, 0]), (500, 3)
        )
        assert not new.visited(outside).any()


def test_the_first_step_after_growth_moves_what_is_known_as_it_would_have_been(trained, small, frames):
    """Moments went along: one more iteration on the same rays changes the old nodes alike."""
    field, optimiser = trained
    settings = small.model_copy(update={"prior_points": 0, "weight_prior": 0.0, "weight_smoothness": 0.0})
    new, adam = grown_field(field, optimiser, field.low - BELOW, field.high + ABOVE, draws())
    p = np.random.default_rng(0).uniform(LOW, HIGH, (3000, 3))
    start = field.query_sdf(p)
    for f, a in ((field, optimiser), (new, adam)):
        train(f, a, frames, settings, seed=5, iterations=1)
    moved = field.query_sdf(p) - start
    assert np.abs(moved).mean() > 1e-4
    assert np.abs(new.query_sdf(p) - field.query_sdf(p)).mean() < 0.02 * np.abs(moved).mean()


def test_the_new_part_learns_a_surface(small, frames):
    """A field that began in half of the room fits the other half after it has grown."""
    settings = small.model_copy(update={"rays": 256})
    middle = 0.5 * (LOW + HIGH)
    field = SdfField(LOW - 0.1, [middle[0], *(HIGH[1:] + 0.1)], settings, draws(0))
    optimiser = FieldOptimiser(field, settings)
    train(field, optimiser, frames, settings, iterations=20)
    field, optimiser = grown_field(field, optimiser, LOW - 0.1, HIGH + 0.1, draws())
    train(field, optimiser, frames, settings, iterations=100)
    rng = np.random.default_rng(3)
    floor = np.column_stack([rng.uniform(middle[0] + 0.2, HIGH[0] - 0.1, 500), rng.uniform(LOW[1], HIGH[1], 500)])
    error = np.abs(field.query_sdf(np.column_stack([floor, np.full(500, LOW[2])])))
    assert np.median(error) < 0.03
    assert field.query_sdf(np.column_stack([floor, np.full(500, LOW[2] + 0.12)])).mean() > 0.04


def test_a_grown_field_is_restored_exactly(trained, small):
    field, optimiser = trained
    new, adam = grown_field(field, optimiser, field.low - BELOW, field.high + ABOVE, draws())
    anchor, box = new.state()["boxes"]
    copy = SdfField(box[0], box[1], small, draws(7), anchor)
    copy.load_state(new.state())
    again = FieldOptimiser(copy, small)
    again.load_state(adam.state())
    p = np.random.default_rng(0).uniform(new.low, new.high, (1000, 3))
    assert copy.query_sdf(p).tobytes() == new.query_sdf(p).tobytes()
    assert {k: v.tobytes() for k, v in again.state().items()} == {k: v.tobytes() for k, v in adam.state().items()}
