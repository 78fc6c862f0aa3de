"""OMPL's RRT* and Informed RRT* as an oracle of the path planner: same cost, same clearance, same number of checks."""

from itertools import pairwise

import conftest
import numpy as np
import pytest

from active3d_pipe.planning import kernels_rrt
from active3d_pipe.planning.config import PlanningSettings
from active3d_pipe.planning.free_space import build_free_space
from active3d_pipe.planning.rrt_star import SAMPLE_SPACING, cost_rate, plan_path
from active3d_pipe.structures import VOLUMES, UncertaintyVolume, VoxelGrid
from active3d_pipe.structures.motion import MotionSettings

SETTINGS, MOTION = PlanningSettings(), MotionSettings()


def furnished(seed):
    """A free space of 6 x 5 x 2.4 m with a wall, a doorway and random boxes, and the pose that it is seen from."""
    rng = np.random.default_rng(seed)
    grid = VoxelGrid(np.zeros(3), 0.1, (60, 50, 24))
    solid = np.zeros(grid.shape, bool)
    solid[30:32] = True
    door = int(rng.integers(5, 36))
    solid[30:32, door : door + 9, :20] = False
    for _ in range(14):
        low, size = rng.integers(0, (52, 42, 16)), rng.integers(3, (12, 12, 20))
        box = tuple(slice(a, a + b) for a, b in zip(low, size, strict=True))
        if not (low[0] < 40 and low[0] + size[0] > 22) and not (solid[box][:1].all() or (low < 10).all()):
            solid[box] = True
    arrays = {name: np.zeros(grid.shape, np.float32) for name in VOLUMES}
    arrays["free_evidence"] = np.where(solid, 0, 30).astype(np.float32)
    arrays["hit_evidence"] = np.where(solid, 30, 0).astype(np.float32)
    arrays["occupancy"] = np.where(solid, 0.99, 0.01).astype(np.float32)
    arrays["sdf"] = np.where(solid, -0.1, 0.1).astype(np.float32)
    T = np.eye(4)
    T[:3, 3] = (0.55, 0.55, 0.55)
    return build_free_space(UncertaintyVolume(grid, 0, arrays), T, T[None, :3, 3], MOTION, SETTINGS), T


def problem_of(information, ends, objective):
    """OMPL's problem: from ends[0] to ends[1] (voxel units)."""
    from ompl import base

    problem = base.ProblemDefinition(information)
    states = [information.allocState() for _ in ends]
    for state, values in zip(states, ends, strict=True):
        for axis in range(3):
            state[axis] = float(values[axis])
    problem.setStartAndGoalStates(*states, 0.05)
    problem.setOptimizationObjective(objective)
    return problem


def box(shape):
    """The grid as OMPL's state space, voxel units."""
    from ompl import base

    where, bounds = base.RealVectorStateSpace(3), base.RealVectorBounds(3)
    for axis, n in enumerate(shape):
        bounds.setLow(axis, 0.0)
        bounds.setHigh(axis, float(n))
    where.setBounds(bounds)
    return where


def point(state):
    """OMPL's state as the kernels take it."""
    return np.array([state[0], state[1], state[2]], np.float32)


def ompl_cost(space, start, goal, name, budget):
    """Cost (m) of the best path that OMPL's planner finds until it has looked up as many places; inf = none."""
    from ompl import base, geometric, util

    util.setLogLevel(util.LogLevel.LOG_ERROR)
    grid = space.grid
    ends = [((p - grid.origin) / grid.voxel_size).astype(np.float32) for p in (start, goal)]
    check = (
        cost_rate(space, None, SETTINGS), space.checked_m, np.float32(space.required_m), np.float32(space.escape_m),
        ends[0], np.float32(SETTINGS.escape_m / grid.voxel_size), np.float32(SAMPLE_SPACING),
    )
    looked_up = 0

    def is_clear(p, q):
        nonlocal looked_up
        looked_up += int(np.ceil(np.linalg.norm(q - p) / SAMPLE_SPACING)) + 1
        return bool(kernels_rrt.segment_cost(p, q, *check) < kernels_rrt.FAR)

    class Clear(base.StateValidityChecker):
        def isValid(self, state):
            return is_clear(point(state), point(state))

    class Edge(base.MotionValidator):
        def checkMotion(self, a, b, last=None):
            return is_clear(point(a), point(b))

    class Cost(base.OptimizationObjective):
        def stateCost(self, state):
            return base.Cost(0.0)

        def motionCost(self, a, b):
            return base.Cost(float(kernels_rrt.segment_cost(point(a), point(b), *check)))

    information = base.SpaceInformation(box(grid.shape))
    kept = Clear(information), Edge(information), Cost(information)
    information.setStateValidityChecker(kept[0])
    information.setMotionValidator(kept[1])
    information.setup()
    problem = problem_of(information, ends, kept[2])
    planner = getattr(geometric, name)(information)
    planner.setRange(SETTINGS.rrt_step_m / grid.voxel_size)
    planner.setProblemDefinition(problem)
    planner.setup()
    planner.solve(base.PlannerTerminationCondition(lambda: looked_up >= budget))
    if not problem.hasExactSolution():
        return float("inf")
    points = [point(s) for s in problem.getSolutionPath().getStates()]
    return grid.voxel_size * float(sum(kernels_rrt.segment_cost(p, q, *check) for p, q in pairwise(points)))


@pytest.mark.interop
@pytest.mark.parametrize("name", ["RRTstar", "InformedRRTstar"])
def test_paths_cost_no_more_than_those_of_ompl(name):
    conftest.need_module("ompl")
    found = 0
    for seed in range(4):
        space, T = furnished(seed)
        ids = np.argwhere(space.reachable & (space.cost > 4))
        goal = ids[np.random.default_rng(seed).integers(len(ids))]
        path = plan_path(space, T[:3, 3], goal, None, SETTINGS, np.random.default_rng(seed))
        other = ompl_cost(space, T[:3, 3], space.grid.centre_of(goal), name, path.num_checks)
        found += np.isfinite(other)
        assert path.cost <= 1.03 * other, f"seed {seed}: {path.cost:.3f} m against {other:.3f} m"
    assert found >= 1
