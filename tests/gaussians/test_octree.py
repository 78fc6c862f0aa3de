"""Octree leaves against plain recursion over cells, on random points."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from active3d_pipe.gaussians.kernels_seeding import LEAF_WIDTH, morton_keys, octree_leaves

CELL, LEVELS = 0.4, 4


def random_surface(seed, n=3000):
    """Points on both sides of the origin; colours and normals that agree in some places and not in others."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.1, 1.1, (n, 3)) * [1, 1, 0.3]
    normals = rng.normal([0, 0, 1], np.where(points[:, :1] > 0, 0.5, 0.05))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    colors = np.clip(0.5 + np.where(points[:, 1:2] > 0, 0.2, 0.01) * rng.normal(size=(n, 3)), 0, 1)
    footprint = rng.uniform(0.03, 0.15, n)
    edge = rng.random(n) < 0.002
    return *(a.astype(np.float32) for a in (points, normals, colors, footprint)), edge


def reference(points, normals, colors, footprint, edge, color_spread, normal_length):
    """(N, 11) float64 leaves, cell by cell."""
    finest = np.floor(points.astype(np.float64) / (CELL / 2 ** (LEVELS - 1))).astype(int)
    out = []

    def descend(at, level):
        size = CELL / 2**level
        spread = np.sqrt(colors[at].astype(float).var(axis=0).mean())
        agree = np.linalg.norm(normals[at].mean(axis=0))
        split = edge[at].any() or spread > color_spread or agree < normal_length
        if not split or level + 1 == LEVELS or size / 2 < footprint[at].min():
            means = [a[at].astype(float).mean(axis=0) for a in (points, normals, colors)]
            out.append(np.concatenate([*means, [size, footprint[at].min()]]))
            return
        for child in groups(finest[at] >> (LEVELS - 2 - level)):
            descend(at[child], level + 1)

    for cell in groups(finest >> (LEVELS - 1)):
        descend(cell, 0)
    return np.array(out)


def groups(cells):
    """Indices of equal rows of `cells` (N, 3)."""
    inverse = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
    return [np.flatnonzero(inverse == k) for k in range(inverse.max() + 1)]


def leaves_of(surface, color_spread, normal_length, room=3000):
    keys = np.empty(len(surface[0]), np.uint64)
    morton_keys(surface[0], CELL / 2 ** (LEVELS - 1), keys)
    leaves = np.full((room, LEAF_WIDTH), np.nan, np.float32)
    order = np.argsort(keys, kind="stable")
    return octree_leaves(keys, order, *surface, LEVELS, CELL, color_spread, normal_length, leaves), leaves


@pytest.mark.parametrize(("seed", "color_spread", "normal_length"), [(0, 0.1, 0.9), (1, 0.1, 0.0), (2, 9.0, 0.9)])
def test_octree_leaves_equal_the_reference(seed, color_spread, normal_length):
    surface = random_surface(seed)
    found, leaves = leaves_of(surface, color_spread, normal_length)
    want = reference(*surface, color_spread, normal_length)
    assert found == len(want)
    assert len(np.unique(want[:, 9])) >= 3  # leaves of several sizes
    twin = cKDTree(want[:, :3]).query(leaves[:found, :3])[1]
    assert sorted(twin) == list(range(found))
    np.testing.assert_allclose(leaves[:found], want[twin], atol=1e-5)
    assert np.isnan(leaves[found:]).all()


def test_leaves_beyond_the_room_for_them_are_only_counted():
    surface = random_surface(0)
    found, whole = leaves_of(surface, 0.1, 0.9)
    again, few = leaves_of(surface, 0.1, 0.9, room=50)
    assert again == found > 50
    np.testing.assert_array_equal(few, whole[:50])


def test_morton_keys_order_cells_by_their_parents():
    """The key of a cell's parent is the key without its last three bits, whatever the signs."""
    points = random_surface(3)[0]
    cells = np.floor(points.astype(np.float64) / 0.05).astype(int) + (1 << 20)
    keys = np.empty(len(points), np.uint64)
    morton_keys(points, 0.05, keys)
    want = [sum((int(c) >> b & 1) << (3 * b + j) for j, c in enumerate(cell) for b in range(21)) for cell in cells]
    assert keys.tolist() == want
