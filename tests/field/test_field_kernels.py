"""Encoders against torch's grid_sample, in values and gradients."""

import numpy as np
import pytest
import torch

from active3d_pipe.field import kernels
from active3d_pipe.field.encoding import EncodeGrid, EncodePlanes, PlaneLayout, node_counts
from active3d_pipe.geometry.lattice import LatticePoints

EXTENT = np.array([1.0, 0.7, 0.5])
LOW = np.array([-0.3, 0.2, 1.0], np.float32)


def points(n, seed=0):
    """Some of them outside of the box, some on its border."""
    rng = np.random.default_rng(seed)
    p = LOW + EXTENT * rng.uniform(-0.1, 1.1, (n, 3))
    p[:4] = LOW
    p[4:8] = LOW + EXTENT
    return p.astype(np.float32)


def unit(x, n, resolution):
    """Coordinates for grid_sample with align_corners, in [-1, 1]."""
    return 2 * x / ((n - 1) * resolution) - 1


def reference_planes(table, p, layout, resolutions):
    levels = [torch.zeros((len(p), table.shape[1]), dtype=table.dtype) for _ in range(layout.levels)]
    local = torch.from_numpy(p.astype(np.float64) - LOW).to(table.dtype)
    for first, na, nb, a, b, level in layout.rows[:, :6]:
        plane = table[first : first + na * nb].reshape(1, na, nb, -1).permute(0, 3, 1, 2)
        at = torch.stack([
            unit(local[:, b], nb, resolutions[level]), unit(local[:, a], na, resolutions[level]),
        ], dim=-1)[None, None]
        levels[level] = levels[level] + torch.nn.functional.grid_sample(
            plane, at, align_corners=True, padding_mode="border"
        )[0, :, 0].T
    return torch.cat(levels, dim=1)


@pytest.mark.parametrize("resolutions", [(0.24, 0.06), (0.11,)])
def test_planes_equal_grid_sample(resolutions):
    layout = PlaneLayout.of_box(EXTENT, resolutions)
    p = points(500)
    table = torch.randn(layout.nodes, 16, generator=torch.Generator().manual_seed(1), requires_grad=True)
    out = EncodePlanes.apply(table, p, LOW, layout)
    weight = torch.randn(out.shape, generator=torch.Generator().manual_seed(2))
    (gradient,) = torch.autograd.grad((out * weight).sum(), table)
    exact = table.detach().double().requires_grad_()
    expected = reference_planes(exact, p, layout, resolutions)
    (expected_gradient,) = torch.autograd.grad((expected * weight.double()).sum(), exact)
    np.testing.assert_allclose(out.detach(), expected.detach(), atol=2e-5)
    np.testing.assert_allclose(gradient, expected_gradient, atol=5e-5)
    assert gradient.abs().max() > 1


def test_grid_equals_grid_sample():
    resolution = 0.1
    n = node_counts(EXTENT, resolution)
    p = points(500)
    grid = torch.randn(*n, 4, generator=torch.Generator().manual_seed(1), requires_grad=True)
    out = EncodeGrid.apply(grid, p, LOW, np.zeros(3, np.int64), np.float32(1 / resolution))
    weight = torch.randn(out.shape, generator=torch.Generator().manual_seed(2))
    (gradient,) = torch.autograd.grad((out * weight).sum(), grid)
    exact = grid.detach().double().requires_grad_()
    local = torch.from_numpy(p.astype(np.float64) - LOW)
    at = torch.stack([unit(local[:, i], n[i], resolution) for i in (2, 1, 0)], dim=-1)[None, None, None]
    expected = torch.nn.functional.grid_sample(
        exact.permute(3, 0, 1, 2)[None], at, align_corners=True, padding_mode="border"
    )[0, :, 0, 0].T
    (expected_gradient,) = torch.autograd.grad((expected * weight.double()).sum(), exact)
    np.testing.assert_allclose(out.detach(), expected.detach(), atol=2e-5)
    np.testing.assert_allclose(gradient, expected_gradient, atol=5e-5)


def test_oneblob_is_a_partition_of_one_inside_and_local():
    p = points(300)
    bins = 16
    out = np.empty((len(p), 3 * bins), np.float32)
    kernels.oneblob(p, LOW, (1 / EXTENT).astype(np.float32), bins, out)
    x = np.clip((p - LOW) / EXTENT, 0, 1)
    u = np.linspace(0, 1, 20001)
    for a in range(3):
        blob = out[:, a * bins : (a + 1) * bins]
        inner = (x[:, a] > 1 / bins) & (x[:, a] < 1 - 1 / bins)
        np.testing.assert_allclose(blob[inner].sum(axis=1), 1, atol=1e-5)
        assert ((blob > 1e-6).sum(axis=1) <= 3).all()
        # One value by numeric integration of the kernel over its bin.
        kernel = 15 / 16 * np.clip(1 - ((u - x[20, a]) * bins) ** 2, 0, None) ** 2 * bins
        expected = [kernel[(u >= j / bins) & (u < (j + 1) / bins)].sum() * (u[1] - u[0]) for j in range(bins)]
        np.testing.assert_allclose(blob[20], expected, atol=2e-3)


def test_fused_decoder_equals_the_differentiable_path(make_field, small):
    field = make_field(small)
    rng = np.random.default_rng(0)
    with torch.no_grad():
        field.grid += torch.from_numpy(rng.normal(size=tuple(field.grid.shape)).astype(np.float32))
        field.planes *= 50
        field.geometry_weight *= 3
    p = rng.uniform(field.low - 0.2, field.high + 0.2, (1000, 3)).astype(np.float32)
    g = field.geometry(p)
    sdf, sigma = field.query_geometry(p)
    expected = g.sdf.detach().numpy().clip(-1, 1) * field.truncation_m
    assert expected.std() > 0.01
    np.testing.assert_allclose(sdf, expected, atol=2e-6)
    np.testing.assert_allclose(field.query_sdf(p), expected, atol=2e-6)
    np.testing.assert_allclose(sigma, g.sigma.detach().numpy() * field.truncation_m, rtol=1e-4)


@pytest.mark.parametrize(("hidden", "grid_channels"), [(32, 4), (16, 8)])
def test_lattice_decoder_equals_the_differentiable_path(make_field, small, hidden, grid_channels):
    field = make_field(small.model_copy(update={"hidden": hidden, "grid_channels": grid_channels}))
    rng = np.random.default_rng(0)
    with torch.no_grad():
        for p in (field.grid, field.planes, field.geometry_weight, field.sigma_weight):
            p += torch.from_numpy(rng.normal(scale=0.5, size=tuple(p.shape)).astype(np.float32))
        field.bias += torch.from_numpy(rng.normal(size=2 * hidden).astype(np.float32))
    axes = tuple(
        np.sort(rng.uniform(field.low[d] - 0.2, field.high[d] + 0.2, n)).astype(np.float32)
        for d, n in enumerate((13, 9, 11))
    )
    lattice = LatticePoints(axes, rng.choice(13 * 9 * 11, 500, replace=False))
    p = np.asarray(lattice)
    g = field.geometry(p)
    expected = g.sdf.detach().numpy().clip(-1, 1) * field.truncation_m
    assert expected.std() > 0.03
    sdf, sigma = field.query_geometry(lattice)
    np.testing.assert_allclose(sdf, expected, atol=2e-6)
    np.testing.assert_allclose(field.query_sdf(lattice), expected, atol=2e-6)
    assert g.sigma.std() > 0.1
    np.testing.assert_allclose(sigma, g.sigma.detach().numpy() * field.truncation_m, rtol=1e-4)
    # A node has the same value whichever others are asked for.
    some = rng.random(500) < 0.1
    assert np.array_equal(field.query_sdf(lattice[some]), field.query_sdf(lattice)[some])


def test_backward_has_the_same_bits_for_any_number_of_threads():
    import numba

    layout = PlaneLayout.of_box(EXTENT, (0.1,))
    p = points(5000)
    g = np.random.default_rng(3).normal(size=(len(p), 16)).astype(np.float32)
    results = []
    try:
        for n in (1, min(2, numba.config.NUMBA_NUM_THREADS)):
            numba.set_num_threads(n)
            d, dg = np.zeros((layout.nodes, 16), np.float32), np.zeros((11, 8, 6, 4), np.float32)
            kernels.planes_backward(p, LOW, layout.rows, layout.inv_resolution, g, 0, d)
            kernels.grid_backward(p, LOW, np.zeros(3, np.int64), np.float32(10), g, 0, dg)
            results.append(d.tobytes() + dg.tobytes())
    finally:
        numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    assert results[0] == results[1]
