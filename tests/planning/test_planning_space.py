from dataclasses import replace
from itertools import product

import box_world
import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from active3d_pipe.geometry import se3
from active3d_pipe.planning import reference_volumes
from active3d_pipe.planning.candidates import coarse_positions, fine_positions
from active3d_pipe.planning.config import PlanningSettings
from active3d_pipe.planning.free_space import build_free_space, clearance, known_free, mark_body, without_half_seen
from active3d_pipe.planning.kernels_candidates import best_of_blocks
from active3d_pipe.planning.kernels_distance import geodesic, open_moves
from active3d_pipe.planning.kernels_rrt import FAR, segment_cost
from active3d_pipe.planning.risk_field import joint_occupancy
from active3d_pipe.structures import VoxelGrid
from active3d_pipe.structures.motion import MotionSettings

MOTION, SETTINGS = MotionSettings(), PlanningSettings()


@pytest.fixture(scope="module")
def seen():
    """Two rooms after a look around in the first one; (world, volume, pose, walked positions)."""
    world = box_world.two_rooms()
    start = np.array([0.8, 0.8, 1.2])
    for yaw in np.arange(0, 6.28, 0.5):
        for pitch in (-0.5, 0.3):
            world.capture(se3.pose_from_yaw_pitch(start, yaw, pitch))
    return world, world.volume(), se3.pose_from_yaw_pitch(start, 0.0, 0.0), start[None]


def arrays(free, hit, occupancy, sdf):
    one = np.ones((1, 1, 1), np.float32)
    values = {"free_evidence": free, "hit_evidence": hit, "occupancy": occupancy, "sdf": sdf}
    return {k: one * np.float32(v) for k, v in values.items()}


def test_joint_occupancy_drops_phantoms_fills_gaps_and_distrusts_the_unseen():
    phantom = joint_occupancy(arrays(60, 0, 0.02, -0.2), SETTINGS)
    gap = joint_occupancy(arrays(1, 0, 0.4, -0.2), SETTINGS)
    both_free = joint_occupancy(arrays(30, 0, 0.02, 0.3), SETTINGS)
    unseen = joint_occupancy(arrays(0, 0, 0.5, 0.3), SETTINGS)
    assert phantom.item() < 0.15
    assert gap.item() > 0.8
    assert both_free.item() < 0.05
    assert unseen.item() == 1


def test_passable_places_are_truly_clear(seen):
    world, volume, T, walked = seen
    space = build_free_space(volume, T, walked, MOTION, SETTINGS)
    ijk = np.argwhere(space.reachable)
    assert len(ijk) > 500
    sample = ijk[:: max(1, len(ijk) // 300)]
    assert world.clearance(space.grid.centre_of(sample)).min() >= MOTION.agent_radius_m


def test_clearance_outside_and_unknown_count_as_obstacles():
    free = np.zeros((9, 9, 9), bool)
    free[1:8, 1:8, 1:8] = True
    d = clearance(free, 0.1, 1.0)
    assert d[4, 4, 4] == pytest.approx(0.35)
    assert d[0].max() == 0
    assert clearance(np.ones((5, 5, 5), bool), 0.1, 1.0)[2, 2, 2] == pytest.approx(0.25)


def test_body_is_free():
    grid = VoxelGrid(np.zeros(3), 0.1, (10, 10, 10))
    free = np.zeros(grid.shape, bool)
    mark_body(free, grid, np.array([[0.5, 0.5, 0.5], [0.0, 0.0, 0.0]]), 0.2)
    near = [np.linalg.norm(grid.centres() - centre, axis=-1) <= 0.2 for centre in (0.5, 0.0)]
    assert (free == near[0] | near[1]).all()
    assert free[0, 0, 0] and not free[9, 9, 9]


def test_the_voxel_of_a_tiny_body_is_free():
    grid = VoxelGrid(np.zeros(3), 0.1, (10, 10, 10))
    free = np.zeros(grid.shape, bool)
    mark_body(free, grid, np.array([[0.49, 0.41, 0.45], [-0.5, 0.5, 0.5]]), 0.01)
    assert np.argwhere(free).tolist() == [[4, 4, 4]]


def test_a_tight_start_never_lets_paths_through_what_is_not_free(seen):
    _, volume, T, walked = seen
    unknown = replace(volume, arrays=volume.arrays | {"free_evidence": np.zeros_like(volume["free_evidence"])})
    space = build_free_space(unknown, T, walked, replace_radius(0.05), SETTINGS)
    assert 0 < space.escape_m < space.required_m
    start, beside = (space.start + np.float32(0.5)).astype(np.float32), np.array([9.0, 0.0, 0.0], np.float32)
    escape = (np.float32(space.required_m), np.float32(space.escape_m), start, np.float32(99), np.float32(0.5))
    assert segment_cost(start, start + beside, np.ones_like(space.checked_m), space.checked_m, *escape) >= FAR


def replace_radius(radius_m):
    return MOTION.model_copy(update={"agent_radius_m": radius_m})


def test_the_way_on_from_another_place_keeps_the_whole_clearance(seen):
    _, volume, T, walked = seen
    space = replace(build_free_space(volume, T, walked, MOTION, SETTINGS), escape_m=0.1)
    there = np.argwhere(space.reachable)[-1]
    assert space.moved_to(there, SETTINGS, 5.0).escape_m == space.required_m


def test_geodesic_is_no_shorter_than_the_straight_line_and_follows_passable_voxels(seen):
    _, volume, T, walked = seen
    space = build_free_space(volume, T, walked, MOTION, SETTINGS)
    ijk = np.argwhere(space.reachable)
    straight = np.linalg.norm(ijk - space.start, axis=1) * space.grid.voxel_size
    cost = space.cost[tuple(ijk.T)]
    assert (cost >= straight - 1e-4).all()
    goal = ijk[cost.argmax()]
    path = space.grid_path(goal)
    assert (path[0] == space.start).all() and (path[-1] == goal).all()
    assert np.abs(np.diff(path, axis=0)).max() == 1
    assert space.passable[tuple(path.T)].all()


def slow_moves(passable, planar):
    """{voxel: neighbours}: every voxel of the box that a step spans must be passable."""
    found = {}
    for v in map(tuple, np.argwhere(passable).tolist()):
        found[v] = []
        for step in np.ndindex(3, 3, 3):
            to = tuple(int(a + b - 1) for a, b in zip(v, step))
            if to == v or (planar and to[2] != v[2]) or min(to) < 0 or (np.array(to) >= passable.shape).any():
                continue
            if all(passable[corner] for corner in product(*({a, b} for a, b in zip(v, to)))):
                found[v].append(to)
    return found


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("share", [0.0, 0.06, 0.35])
def test_moves_and_geodesic_costs_equal_the_slow_ones(planar, share):
    rng = np.random.default_rng(5)
    passable = (rng.random((9, 8, 6)) >= share).astype(np.uint8)
    start = tuple(np.argwhere(passable)[40].tolist())
    moves, slow = open_moves(passable, planar), slow_moves(passable, planar)
    for v in np.ndindex(passable.shape):
        bits = {9 * (a - v[0] + 1) + 3 * (b - v[1] + 1) + c - v[2] + 1 for a, b, c in slow.get(v, [])}
        assert moves[v] == sum(1 << bit for bit in bits), v
    rate = rng.uniform(1, 3, passable.shape).astype(np.float32)
    number = {v: n for n, v in enumerate(slow)}
    edges = [(number[v], number[u], 0.1 * np.linalg.norm(np.subtract(v, u)) * (rate[v] + rate[u]) / 2)
             for v, near in slow.items() for u in near]
    rows, columns, lengths = (np.array(a) for a in zip(*edges))
    graph = coo_matrix((lengths, (rows, columns)), shape=(len(slow), len(slow))).tocsr()
    want = dijkstra(graph, indices=number[start])
    cost, parent = geodesic(moves, rate, np.array(start), np.float32(0.1), np.float32(1e29))
    got = np.array([cost[v] for v in slow], np.float64)
    np.testing.assert_allclose(np.where(got > 1e29, np.inf, got), want, rtol=1e-5)
    assert (cost[passable == 0] > 1e29).all()
    for v in slow:
        if v != start and cost[v] < 1e29:
            before = tuple(int(c) for c in np.unravel_index(parent[v], passable.shape))
            length = 0.1 * np.linalg.norm(np.subtract(v, before)) * (rate[v] + rate[before]) / 2
            assert cost[v] == pytest.approx(cost[before] + length, rel=1e-5)
    near = geodesic(moves, rate, np.array(start), np.float32(0.1), np.float32(0.3))[0]
    assert (near[cost <= 0.3] == cost[cost <= 0.3]).all()


def test_voxels_that_rays_passed_in_the_half_away_from_a_wall_only_are_not_free():
    rng = np.random.default_rng(0)
    free = rng.random((6, 5, 4)) < 0.7
    passed = rng.integers(0, 256, free.shape).astype(np.uint8)
    passed[rng.random(free.shape) < 0.4] &= 0x33
    want = free.copy()
    for v in np.argwhere(free):
        for axis, upper in product(range(3), (0, 1)):
            beside = v.copy()
            beside[axis] += 2 * upper - 1
            if not 0 <= beside[axis] < free.shape[axis] or free[tuple(beside)]:
                continue
            cells = [c for c in range(8) if (c >> (2 - axis) & 1) == upper]
            if not any(passed[tuple(v)] >> c & 1 for c in cells):
                want[tuple(v)] = False
    got = without_half_seen(free, passed.astype(np.float32))
    assert (got == want).all() and 0 < (free & ~want).sum() < free.sum() / 2
    assert (reference_volumes.drop_half_seen(free, passed) == want).all()
    assert (without_half_seen(free, np.zeros(free.shape, np.float32)) == free).all()


def test_a_wall_in_the_middle_of_voxels_that_no_ray_ended_in_is_no_free_space(seen):
    """Rays that ran along it passed its voxels' near half: the clearance in front of it must not count that half."""
    _, volume, _, walked = seen
    passable = known_free(volume, volume["occupancy"], walked, 0.01, SETTINGS)
    i, j, k = np.argwhere(passable[1:-1, 1:-1, 1:-1])[0] + 1
    free, hit = volume["free_evidence"].copy(), volume["hit_evidence"].copy()
    occupancy, passed = volume["occupancy"].copy(), volume["cells_passed"].copy()
    free[i, j - 1, k], hit[i, j - 1, k], occupancy[i, j - 1, k] = 0, 0, 0.5
    free[i, j, k], hit[i, j, k], occupancy[i, j, k], passed[i, j, k] = 18, 0, 0.001, 0xCC
    changed = {"free_evidence": free, "hit_evidence": hit, "occupancy": occupancy, "cells_passed": passed}
    grazed = replace(volume, arrays={**volume.arrays, **changed})
    away = np.array([[1e3, 1e3, 1e3]])
    assert not known_free(grazed, occupancy, away, 0.01, SETTINGS)[i, j, k]
    passed[i, j, k] = 0xFF
    assert known_free(grazed, occupancy, away, 0.01, SETTINGS)[i, j, k]


def test_risk_is_one_at_the_body_zero_in_the_open_and_never_rises_with_clearance(seen):
    _, volume, T, walked = seen
    risk = build_free_space(volume, T, walked, MOTION, SETTINGS).risk
    order = np.argsort(risk.clearance_m.ravel())
    assert (np.diff(risk.risk.ravel()[order]) <= 1e-6).all()
    assert risk.risk[risk.clearance_m <= MOTION.agent_radius_m].min() == 1
    assert risk.risk[risk.clearance_m >= SETTINGS.preferred_clearance_m].max() == 0
    outside = risk.at(np.array([[99.0, 0, 0]]))
    assert (outside[0][0], outside[1][0]) == (1.0, 0.0)
    v = np.argwhere(risk.clearance_m > 0.2)[7]
    assert risk.at(risk.grid.centre_of(v)[None])[1][0] == pytest.approx(float(risk.clearance_m[tuple(v)]), abs=1e-6)


def test_ground_motion_stays_in_its_layer(seen):
    _, volume, T, walked = seen
    space = build_free_space(volume, T, walked, MotionSettings(model="ground"), SETTINGS)
    layers = np.unique(np.argwhere(space.reachable)[:, 2])
    assert layers.tolist() == [space.start[2]]
    assert space.reachable.sum() > 50


def test_candidates_cover_all_reachable_space(seen):
    _, volume, T, walked = seen
    space = build_free_space(volume, T, walked, MOTION, SETTINGS)
    coarse = coarse_positions(space, SETTINGS)
    assert space.reachable[tuple(coarse.T)].all()
    ijk = np.argwhere(space.reachable)[::7]
    nearest = np.array([np.linalg.norm(coarse - v, axis=1).min() for v in ijk]) * space.grid.voxel_size
    assert nearest.max() <= SETTINGS.coarse_spacing_m * 3**0.5
    few = coarse_positions(space, PlanningSettings(max_positions=5))
    assert 1 <= len(few) <= 5
    block = SETTINGS.coarse_spacing_m / space.grid.voxel_size
    while len(found := best_of_blocks(space.reachable.view(np.uint8), space.risk.clearance_m, round(block))) > 5:
        block *= 1.2
    assert (few == found).all()
    fine = fine_positions(space, coarse[:2], SETTINGS)
    assert space.reachable[tuple(fine.T)].all()
    assert np.abs(fine - coarse[0]).max(axis=1).min() <= 5
