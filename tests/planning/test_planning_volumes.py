"""The passes over whole volumes against their slow twins."""

import numpy as np
import pytest

from active3d_pipe.information.gain import FREE, OPEN, SURFACE
from active3d_pipe.planning import kernels_volumes as kernels
from active3d_pipe.planning import reference_volumes as reference

SHAPE = (9, 8, 7)


@pytest.fixture(params=range(3))
def world(request):
    """Random rays, occupancy, SDF, cells and kinds of some voxels; more of what matters than chance would give."""
    rng = np.random.default_rng(request.param)
    free, hit = (np.round(12 * rng.random(SHAPE)) * (rng.random(SHAPE) < 0.7) for _ in range(2))
    hit *= rng.random(SHAPE) < 0.4
    kind = rng.choice([FREE, FREE, FREE, OPEN, SURFACE], SHAPE).astype(np.uint8)
    passed, ended = (np.where(rng.random(SHAPE) < 0.5, rng.integers(0, 256, SHAPE), 0x0F) for _ in range(2))
    arrays = {
        "free": free, "hit": hit, "occupancy": rng.random(SHAPE), "sdf": rng.normal(0, 0.05, SHAPE), "passed": passed,
        "ended": ended, "clearance": rng.uniform(0, 1, SHAPE),
    }
    return {name: np.ascontiguousarray(a, np.float32) for name, a in arrays.items()} | {"kind": kind}


def picked(world, *names):
    return [world[name] for name in names]


def test_joint_occupancy(world):
    out = np.empty(SHAPE, np.float32)
    given = picked(world, "free", "hit", "occupancy", "sdf")
    kernels.joint_occupancy(*given, np.float32(4), np.float32(0.05), out)
    np.testing.assert_allclose(out, reference.joint_occupancy(*given, 4, 0.05), rtol=1e-5, atol=1e-7)
    assert (out[(world["free"] == 0) & (world["hit"] == 0)] == 1).all()


def test_free_by_rays(world):
    out = np.empty(SHAPE, bool)
    given = picked(world, "free", "hit", "occupancy")
    kernels.free_by_rays(*given, np.float32(2), np.float32(0.4), out)
    np.testing.assert_array_equal(out, reference.free_by_rays(*given, 2, 0.4))
    assert out.any() and not out.all()


def test_risk(world):
    out = np.empty(SHAPE, np.float32)
    kernels.risk(world["clearance"], np.float32(0.6), np.float32(0.3), out)
    np.testing.assert_allclose(out, reference.risk(world["clearance"], 0.6, 0.3), rtol=1e-4, atol=1e-6)


def test_sight(world):
    filled = tuple(np.empty(SHAPE, t) for t in (np.float32, np.float32, np.uint8, np.uint8))
    given = picked(world, "kind", "hit", "occupancy", "passed", "ended")
    kernels.sight(*given, np.float32(0.9), *filled)
    want = reference.sight(*given, np.float32(0.9))
    for got, right in zip(filled, want, strict=True):
        np.testing.assert_allclose(got, right, rtol=1e-6)
    assert all(len(np.unique(a)) > 20 for a in filled)


def test_half_seen_voxels_become_open(world):
    half = np.empty(SHAPE, np.uint8)
    kernels.half_seen(world["kind"], world["passed"], half)
    want = reference.half_seen(world["kind"], world["passed"])
    np.testing.assert_array_equal(half.view(bool), want)
    assert 3 < want.sum() < want.size / 3
    kind, of_interest, opaque = world["kind"].copy(), np.empty(SHAPE, np.uint8), np.empty(SHAPE, np.uint8)
    kernels.open_half_seen(half, world["hit"], kind, of_interest, opaque)
    np.testing.assert_array_equal(kind, np.where(want, OPEN, world["kind"]))
    np.testing.assert_array_equal(of_interest, (kind != FREE) | (world["hit"] > 0))
    np.testing.assert_array_equal(opaque, kind == SURFACE)


def test_powers():
    looks = np.array([0, 1, 0, 2.5, 0], np.float32)
    np.testing.assert_allclose(kernels.powers(np.float32(0.5), looks), np.float32(0.5) ** looks, rtol=1e-6)
