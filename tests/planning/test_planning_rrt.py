"""The kernels of RRT* against plain twins, on random volumes."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt, gaussian_filter

from active3d_pipe.planning import kernels_rrt as kernels
from active3d_pipe.planning.risk_field import interpolate
from active3d_pipe.structures import VoxelGrid

SHAPE = (24, 20, 8)
GRID = VoxelGrid(np.zeros(3), 1.0, SHAPE)  # kernels think in voxels
REQUIRED, ESCAPE, ESCAPE_RADIUS, SPACING = (np.float32(v) for v in (1.0, 0.3, 3.0, 0.25))
START = np.array([2.4, 3.1, 4.2], np.float32)


def volumes(seed):
    """Random (rate, clearance): smooth costs, scattered obstacles; a wall at x = 12 with a door at y > 13."""
    rng = np.random.default_rng(seed)
    rate = 1 + 25 * gaussian_filter(rng.random(SHAPE), 1.5, mode="nearest") ** 4
    solid = rng.random(SHAPE) < 0.004
    solid[12, :13] = True
    solid[1:5, 1:5] = solid[10:14, 13:] = False
    clearance = np.maximum(distance_transform_edt(~solid) - 0.5, 0)
    clearance[1:4, 1:5] = np.minimum(clearance[1:4, 1:5], 0.6)  # the start is in a tight spot
    return rate.astype(np.float32), clearance.astype(np.float32)


def check_of(seed):
    return (*volumes(seed), REQUIRED, ESCAPE, START, ESCAPE_RADIUS, SPACING)


def reference_cost(p, q, check, pieces=None):
    """(cost of an edge or FAR, least surplus of clearance): means over the pieces, float64."""
    rate, clearance, required, escape, start, radius, spacing = check
    p, q = np.asarray(p, float), np.asarray(q, float)
    length = np.linalg.norm(q - p)
    n = pieces or max(1, int(np.ceil(length / spacing)))
    places = p + (q - p) * np.append((np.arange(n) + 0.5) / n, 1)[:, None]
    need = np.where(np.linalg.norm(places - start, axis=1) <= radius, min(required, escape), required)
    surplus = (interpolate(clearance, GRID, places, outside=0.0) - need).min()
    if surplus < -1e-4:
        return float(kernels.FAR), surplus
    return length * interpolate(rate, GRID, places[:-1], outside=0.0).mean(), surplus


def test_segment_cost_equals_the_reference():
    check = check_of(0)
    ends = np.random.default_rng(1).uniform(0.2, np.array(SHAPE) - 0.2, (600, 2, 3)).astype(np.float32)
    ends[:100, 0] = START
    ends[:, 1] = ends[:, 0] + 0.25 * (ends[:, 1] - ends[:, 0])
    want, surplus = np.array([reference_cost(p, q, check) for p, q in ends]).T
    got = np.array([kernels.segment_cost(p, q, *check) for p, q in ends])
    clear_cut = np.abs(surplus + 1e-4) > 1e-5
    np.testing.assert_allclose(got[clear_cut], want[clear_cut], rtol=1e-4)
    refused = want >= kernels.FAR
    assert 50 < refused.sum() < 550 and (~refused[:100]).sum() > 10
    # It is the integral: pieces ten times as short change little.
    fine = np.array([reference_cost(p, q, check, 400)[0] for p, q in ends[~refused]])
    both = fine < kernels.FAR
    assert both.sum() > 50
    np.testing.assert_allclose(got[~refused][both], fine[both], rtol=0.02)


def test_near_a_tight_start_less_clearance_suffices():
    check = check_of(0)
    strict = (*check[:3], REQUIRED, *check[4:])
    out, away = START + np.float32([0, 1, 0]), START + np.float32([0, 0, 1])
    assert kernels.segment_cost(out, away, *check) < kernels.FAR == kernels.segment_cost(out, away, *strict)
    elsewhere = (*check[:4], np.float32([20, 3, 4]), *check[5:])
    assert kernels.segment_cost(out, away, *elsewhere) == kernels.FAR


def reference_tree(seed_path, samples, check, step, radius, least_rate):
    """RRT* by the book: the cost of a node is summed up along its branch every time that it is asked for."""
    nodes = [np.asarray(p, np.float32) for p in seed_path]
    parent = {m: m - 1 for m in range(1, len(nodes))}
    edge = {m: kernels.segment_cost(nodes[m - 1], nodes[m], *check) for m in parent}
    goal = len(nodes) - 1

    def cost(m):
        return edge[m] + cost(parent[m]) if m else 0.0

    def apart(p, q):
        return float(np.linalg.norm(p.astype(float) - q))

    for x in samples:
        if (apart(nodes[0], x) + apart(x, nodes[goal])) * least_rate >= cost(goal):
            continue
        near = int(np.argmin([apart(p, x) for p in nodes]))
        new = nodes[near] + np.float32(min(1, step / apart(nodes[near], x))) * (x - nodes[near])
        around = [m for m, p in enumerate(nodes) if m == near or apart(p, new) <= radius]
        reach = {m: kernels.segment_cost(nodes[m], new, *check) for m in around}
        reach = {m: e for m, e in reach.items() if e < kernels.FAR}
        if not reach:
            continue
        best = min(reach, key=lambda m: cost(m) + reach[m])
        nodes.append(new)
        k = len(nodes) - 1
        parent[k], edge[k] = best, reach[best]
        for m in reach:
            back = kernels.segment_cost(new, nodes[m], *check)
            if m not in (0, best) and cost(k) + max(back, reach[m]) < cost(m) - 1e-4:
                parent[m], edge[m] = k, back
    path = [goal]
    while path[-1]:
        path.append(parent[path[-1]])
    return np.array([nodes[m] for m in path[::-1]]), cost(goal)


def grow(seed, count):
    """(path, cost, seed path, its edge costs, check, samples, what limits the edges) of a way through the door."""
    check = check_of(seed)
    corners = np.array([START, [2.5, 16.5, 4.5], [21.5, 16.5, 4.5], [21.5, 3.5, 4.5]], np.float32)
    legs = [a + (b - a) * np.arange(1, 14)[:, None] / 13 for a, b in pairwise(corners)]
    way = np.concatenate([corners[:1], *legs]).astype(np.float32)
    check = (check[0], np.where(near_way(way), np.maximum(check[1], 2), check[1]).astype(np.float32), *check[2:])
    edges = np.array([kernels.segment_cost(p, q, *check) for p, q in pairwise(way)], np.float32)
    samples = np.random.default_rng(seed).uniform(0, SHAPE, (count, 3)).astype(np.float32)
    limits = np.float32(4.0), np.float32(6.0), check[0].min()
    path, cost, checks = kernels.rrt_star(way, edges, samples, *check[:4], check[5], *limits, check[6])
    assert edges.max() < kernels.FAR and checks > 0
    return path, cost, way, edges, check, samples, limits


def near_way(way):
    """(X, Y, Z) bool, voxels near a polyline's points: there the way is kept clear."""
    out = np.ones(SHAPE, bool)
    out[tuple(np.floor(way).astype(int).T)] = False
    return distance_transform_edt(out) <= 2


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_rrt_star_improves_on_its_seed_and_tells_the_true_cost(seed):
    path, cost, way, edges, check, _, (_, radius, _) = grow(seed, 800)
    np.testing.assert_array_equal(path[[0, -1]], way[[0, -1]])
    costs = [reference_cost(p, q, check)[0] for p, q in pairwise(path)]
    assert max(costs) < kernels.FAR
    assert cost == pytest.approx(sum(costs), rel=1e-4)
    assert cost < 0.95 * edges.sum()
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() <= radius + 1e-4


def test_rrt_star_keeps_its_seed_when_nothing_is_better():
    _, _, way, edges, check, _, limits = grow(0, 1)
    nothing = np.zeros((0, 3), np.float32)
    path, cost, checks = kernels.rrt_star(way, edges, nothing, *check[:4], check[5], *limits, check[6])
    np.testing.assert_array_equal(path, way)
    assert cost == pytest.approx(edges.sum(), rel=1e-5) and checks == 0


@pytest.mark.parametrize("seed", [0, 1])
def test_rrt_star_equals_the_reference(seed):
    path, cost, way, edges, check, samples, limits = grow(seed, 120)
    want, want_cost = reference_tree(way, samples, check, *limits)
    assert want_cost < 0.99 * edges.sum()
    assert cost == pytest.approx(want_cost, rel=1e-4)
    np.testing.assert_allclose(path, want, atol=1e-4)
