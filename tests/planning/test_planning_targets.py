import box_world
import numpy as np
import pytest

from active3d_pipe.geometry import se3
from active3d_pipe.planning import kernels_targets
from active3d_pipe.planning.choice import score
from active3d_pipe.planning.config import PlanningSettings
from active3d_pipe.planning.free_space import build_free_space
from active3d_pipe.planning.reference_reward import cell_bit
from active3d_pipe.planning.reward import build_reward_field, exact_terms
from active3d_pipe.planning.targets import hidden_positions, target_positions
from active3d_pipe.structures.motion import MotionSettings

SETTINGS, MOTION = PlanningSettings(), MotionSettings()


def reference_viewpoints(
    targets, bits, places, opaque, clear, through, normal, shape, nearest, farthest, falloff, steps, fixed
):
    """The obvious loop."""
    out = []
    for t, bit in zip(targets, bits, strict=True):
        cell = int(np.log2(bit)) if bit else None
        eye = t + (0.5 if cell is None else 0.25 + 0.5 * np.array([cell >> 2 & 1, cell >> 1 & 1, cell & 1]))
        looks = np.full(len(places), -1.0)
        for n, p in enumerate(places):
            d = p + 0.5 - eye
            distance = np.linalg.norm(d)
            if not nearest <= distance <= farthest:
                continue
            m = int(np.ceil(distance)) * (1 if cell is None else 2)
            passed, crossed = 1.0, set()
            for point in (eye + i / m * d for i in range(1, m)):
                ijk = tuple(np.floor(point).astype(int))
                v = np.ravel_multi_index(ijk, shape)
                if opaque[v]:
                    own = ijk == tuple(t) and (cell is None or cell_bit(point) == bit)
                    passed *= own or bool(clear[v] & cell_bit(point))
                elif ijk != tuple(t) and v not in crossed:
                    passed *= through[v]
                    crossed.add(v)
            side = normal[np.ravel_multi_index(tuple(t), shape)].astype(float)
            cos = side @ d / (np.linalg.norm(side) * distance) if np.linalg.norm(side) > 1 and not bit else 1.0
            if passed >= 0.05:
                looks[n] = passed * min(1, falloff / distance) * cos
        seen = looks > 0.05
        rate = looks / (steps + fixed)
        out.append((np.where(seen, looks, -1), np.where(seen, rate, -1)))
    return out


def test_best_viewpoints_equal_the_reference():
    rng = np.random.default_rng(1)
    shape = (14, 12, 9)
    opaque = (rng.random(shape) < 0.06).view(np.uint8).ravel()
    through = np.where(opaque, 0, rng.choice([1.0, 0.8], opaque.shape)).astype(np.float32)
    normal = np.where(rng.random((opaque.size, 1)) < 0.5, rng.integers(-90, 90, (opaque.size, 3)), 0).astype(np.int8)
    places = np.stack([rng.integers(0, n, 150) for n in shape], -1).astype(np.int32)
    targets = np.stack([rng.integers(0, n, 20) for n in shape], -1).astype(np.int32)
    steps = rng.uniform(0, 40, len(places)).astype(np.float32)
    clear = np.where(opaque, rng.integers(0, 256, opaque.size), 255).astype(np.uint8)
    bits = np.where(rng.random(len(targets)) < 0.5, 0, 1 << rng.integers(0, 8, len(targets))).astype(np.uint8)
    opaque[np.ravel_multi_index(tuple(targets[bits > 0].T), shape)] = 1
    args = (np.float32(1.5), np.float32(9), np.float32(4), steps, np.float32(10))
    got = kernels_targets.best_viewpoints(targets, bits, places, opaque, clear, through, normal, shape, *args)
    want = reference_viewpoints(targets, bits, places, opaque, clear, through, normal, shape, *args)
    assert (got >= 0).all(axis=1).sum() > 10
    for (a, b), (looks, rates) in zip(got, want, strict=True):
        for chosen, values in ((a, looks), (b, rates)):
            if chosen < 0:
                assert values.max() < 0
            else:
                assert values[chosen] == pytest.approx(values.max(), rel=1e-4)


def test_best_of_each_block_equals_the_reference():
    rng = np.random.default_rng(2)
    worth = (rng.integers(-2, 5, (11, 7, 8)) * (rng.random((11, 7, 8)) < 0.3)).astype(np.float32)
    first, total = kernels_targets.best_of_each_block(worth, 3)
    blocks = [worth[i:i + 3, j:j + 3, k:k + 3] for i in range(0, 12, 3) for j in range(0, 9, 3) for k in range(0, 9, 3)]
    corners = [(i, j, k) for i in range(0, 12, 3) for j in range(0, 9, 3) for k in range(0, 9, 3)]
    assert len(first) == len(blocks)
    for at, mass, block, corner in zip(first, total, blocks, corners, strict=True):
        assert mass == np.maximum(block, 0).sum()
        if block.max(initial=0) <= 0:
            assert at == -1
        else:
            best = np.unravel_index(block.argmax(), block.shape)
            assert at == np.ravel_multi_index(np.add(corner, best), worth.shape)


def looked_around(world, start):
    """Free space, reward field and last pose of an agent that turned on the spot, looking up and down."""
    start = np.array(start)
    poses = np.array([se3.pose_from_yaw_pitch(start, a, p) for a in np.arange(0, 6.28, 0.5) for p in (-0.5, 0.5)])
    for T in poses:
        world.capture(T)
    volume = world.volume()
    field = build_reward_field(volume, poses, world.camera, SETTINGS)
    space = build_free_space(volume, poses[-1], poses[:, :3, 3], MOTION, SETTINGS)
    return space, field, poses[-1]


def test_those_that_lead_the_short_list_are_scored_exactly():
    world = box_world.build((3.0, 2.4, 2.6), [((0.4, 0.35, 0.0), (2.6, 0.6, 1.2))])
    space, field, T = looked_around(world, (1.5, 1.6, 1.0))
    near_the_end = SETTINGS.model_copy(update={"hidden_reward": 1e6})
    pool = score(space, field, T, world.camera, MOTION, near_the_end, None)
    exact = [t.reward for t in exact_terms(field, pool.poses, world.camera)]
    found = [t.reward for t in pool.terms]
    for lead in (0, int(np.argmax(found))):
        assert found[lead] == exact[lead] > 0
    # While plenty is left to see, the largest reward need not be known exactly.
    early = score(space, field, T, world.camera, MOTION, SETTINGS, None)
    assert early.terms[0].reward == exact_terms(field, early.poses[:1], world.camera)[0].reward
    assert early.terms[0].reward > 0.5 * pool.terms[0].reward
    assert list(pool.utility) == sorted(pool.utility, reverse=True)
    # The others had a glance: about right, and mostly too low.
    assert found != exact and np.corrcoef(found, exact)[0, 1] > 0.9
    assert np.sum(found) < np.sum(exact)


def test_positions_that_see_what_is_left_are_found():
    """A niche that can be looked into from in front only: a lattice may miss it, the search from the niche does not."""
    niche = [((2.0, 0.0, 0.0), (2.2, 1.0, 2.0)), ((2.0, 1.3, 0.0), (2.2, 2.2, 2.0)), ((2.2, 0.0, 0.0), (3.4, 0.9, 2.0)),
             ((2.2, 1.4, 0.0), (3.4, 2.2, 2.0))]  # fmt: skip
    world = box_world.build((3.4, 2.2, 2.0), niche)
    space, field, _ = looked_around(world, (0.6, 0.5, 1.0))
    found = space.grid.centre_of(target_positions(space, field, MOTION, SETTINGS))
    assert space.reachable[tuple(space.grid.index_of(found).T)].all()
    assert ((np.abs(found[:, 1] - 1.15) < 0.25) & (found[:, 0] > 0.8)).any()
    none = PlanningSettings(max_targets=0)
    assert len(target_positions(space, field, MOTION, none)) == 0


def test_what_only_a_look_from_above_shows_is_found():
    """A shaft behind a sideboard: its rim is seen from everywhere, its depth from over it only."""
    world = box_world.build((3.0, 2.4, 2.6), [((0.4, 0.35, 0.0), (2.6, 0.6, 1.2))])
    space, field, T = looked_around(world, (1.5, 1.6, 1.0))
    found = {turn: hidden_positions(space, field, MOTION, SETTINGS, 10**9, turn) for turn in (0, 1)}
    for turn, voxels in found.items():
        assert len(voxels) > 10 and space.reachable[tuple(voxels.T)].all()
        assert ((voxels - space.start) % 2 == turn).all()
    above = space.grid.centre_of(np.concatenate(list(found.values())))
    assert ((above[:, 1] < 0.8) & (above[:, 2] > 1.5)).any()
    few = hidden_positions(space, field, MOTION, SETTINGS, 2000, 0)
    assert 0 < len(few) < len(found[0])
    pools = [
        score(space, field, T, world.camera, MOTION, SETTINGS, None, hidden_pairs=10**9, turns=turns)
        for turns in ((), (0, 1))
    ]
    quick, thorough = (max(t.reward for t in pool.terms) for pool in pools)
    assert thorough >= 0.9 * quick > SETTINGS.stop_reward
