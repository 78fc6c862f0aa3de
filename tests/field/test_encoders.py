"""The encoders beside the tri-planes: the hash grid against a slow reference, and fields on every encoder."""

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from room_with_ball import HIGH, LOW, scene_sdf

from active3d_pipe.field import kernels_hash
from active3d_pipe.field.config import FieldSettings
from active3d_pipe.field.encoders import DenseGrids
from active3d_pipe.field.encoding import EncodeHash, HashLayout
from active3d_pipe.field.optimise import FieldOptimiser, field_step
from active3d_pipe.field.rays import sample_rays
from active3d_pipe.field.sdf_field import SdfField

EXTENT = np.array([1.0, 0.7, 0.5])
CORNER = np.array([-0.3, 0.2, 1.0], np.float32)
LAYOUT = HashLayout.of_box(EXTENT, levels=4, coarsest_cells=4, finest_m=0.02, log2_size=9)
KINDS = {
    "hash": {"hash_levels": 8, "hash_finest_m": 0.04, "hash_log2_size": 14, "grid_channels": 0},
    "grids": {"level_channels": 8, "grid_channels": 0},
    "none": {"grid_voxel_m": 0.1},
}


def points(n, seed=0):
    """Some of them outside of the box, some on its border."""
    p = CORNER + EXTENT * np.random.default_rng(seed).uniform(-0.1, 1.1, (n, 3))
    p[:4], p[4:8] = CORNER, CORNER + EXTENT
    return p.astype(np.float32)


def reference_hash(table, p, layout):
    """Point by point, corner by corner, in Python's whole numbers."""
    out = []
    for point in p.astype(np.float64):
        features = []
        for (first, size, side), inv, last in zip(layout.rows, layout.inv_resolution, layout.last, strict=True):
            at = np.clip((point - CORNER) * float(inv), 0, float(last))
            cell = np.minimum(np.floor(at).astype(int), int(last) - 1)
            value = 0
            for corner in np.ndindex(2, 2, 2):
                node = [int(v) for v in cell + corner]
                weight = np.prod([f if c else 1 - f for c, f in zip(corner, at - cell, strict=True)])
                if side:
                    entry = (node[0] * int(side) + node[1]) * int(side) + node[2]
                else:
                    entry = (node[0] ^ node[1] * 2654435761 ^ node[2] * 805459861) % int(size)
                value = value + weight * table[int(first) + entry]
            features.append(value)
        out.append(torch.cat(features))
    return torch.stack(out)


def test_hash_grid_equals_the_reference_in_values_and_gradients():
    assert (LAYOUT.rows[:, 2] > 0).any() and (LAYOUT.rows[:, 2] == 0).any()  # direct and hashed levels
    p = points(120)
    table = torch.randn(LAYOUT.nodes, 2, generator=torch.Generator().manual_seed(1), requires_grad=True)
    out = EncodeHash.apply(table, p, CORNER, LAYOUT)
    weight = torch.randn(out.shape, generator=torch.Generator().manual_seed(2))
    (gradient,) = torch.autograd.grad((out * weight).sum(), table)
    exact = table.detach().double().requires_grad_()
    expected = reference_hash(exact, p, LAYOUT)
    (expected_gradient,) = torch.autograd.grad((expected * weight.double()).sum(), exact)
    np.testing.assert_allclose(out.detach(), expected.detach(), atol=3e-5)
    np.testing.assert_allclose(gradient, expected_gradient, atol=1e-4)
    assert gradient.abs().max() > 1


def test_hash_layout_goes_from_the_coarsest_to_the_finest_cell():
    layout = HashLayout.of_box(np.array([8.0, 6.0, 3.0]), 16, 16, 0.02, 16)
    assert layout.last[0] == 16 and layout.last[-1] == 400
    assert (np.diff(layout.last) > 0).all()
    assert (layout.rows[:, 1] <= 2**16).all() and layout.nodes == layout.rows[:, 1].sum()


def test_hash_gradient_has_the_same_bits_for_any_number_of_threads():
    import numba

    p = points(4000)
    g = np.random.default_rng(3).normal(size=(len(p), 8)).astype(np.float32)
    results = []
    try:
        for n in (1, min(2, numba.config.NUMBA_NUM_THREADS)):
            numba.set_num_threads(n)
            d = np.zeros((LAYOUT.nodes, 2), np.float32)
            kernels_hash.hash_backward(p, CORNER, LAYOUT.rows, LAYOUT.inv_resolution, LAYOUT.last, g, d)
            results.append(d.tobytes())
    finally:
        numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    assert results[0] == results[1]


def test_dense_grids_are_their_levels_side_by_side():
    both = DenseGrids(CORNER, EXTENT, (0.3, 0.1), 4)
    table = both.initial(torch.Generator().manual_seed(0))
    p = points(200)
    parts = torch.split(table, both.sizes)
    alone = [DenseGrids(CORNER, EXTENT, (r,), 4).encode(t, p) for r, t in zip((0.3, 0.1), parts, strict=True)]
    assert torch.equal(both.encode(table, p), torch.cat(alone, dim=1))
    assert both.width == 8 and table.shape == both.shape


@pytest.mark.parametrize("kind", KINDS)
def test_a_field_on_every_encoder_learns_the_room_and_resumes_exactly(kind, frames):
    settings = FieldSettings(encoder=kind, rays=256, prior_points=32, **KINDS[kind])

    def make(seed=0):
        field = SdfField(LOW - 0.1, HIGH + 0.1, settings, torch.Generator().manual_seed(seed))
        return field, FieldOptimiser(field, settings)

    def train(field, optimiser, rng, iterations):
        for _ in range(iterations):
            field_step(field, optimiser, sample_rays(frames, settings.rays, rng), settings, rng)

    field, optimiser = make()
    train(field, optimiser, np.random.default_rng(0), 60)
    p = np.random.default_rng(1).uniform(LOW, HIGH, (3000, 3)).astype(np.float32)
    p = p[scene_sdf(p) > 0]
    error = np.abs(field.query_sdf(p) - np.minimum(scene_sdf(p), 0.1))
    assert error.mean() < 0.02
    g = field.geometry(p)
    np.testing.assert_allclose(field.query_geometry(p)[1], g.sigma.detach() * field.truncation_m, rtol=1e-4)

    other, other_optimiser = make(seed=9)
    other.load_state(field.state())
    other_optimiser.load_state(optimiser.state())
    for f, o in ((field, optimiser), (other, other_optimiser)):
        train(f, o, np.random.default_rng(2), 2)
    assert all(a.tobytes() == other.state()[n].tobytes() for n, a in field.state().items())


def test_without_an_encoder_there_are_no_tables_but_v_alpha(make_field):
    names = set(make_field(FieldSettings(encoder="none")).state())
    assert "grid" in names and not names & {"planes", "color_planes"}
    with pytest.raises(ValidationError, match="uncertainty head"):
        FieldSettings(encoder="none", grid_channels=0)
