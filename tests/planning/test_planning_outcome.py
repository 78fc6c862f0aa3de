import box_world
import numpy as np
import pytest
from scipy.stats import spearmanr

from active3d_pipe.geometry import se3
from active3d_pipe.geometry.voxel_traversal import fan_stride, ray_fan
from active3d_pipe.information.gain import OPEN, SURFACE
from active3d_pipe.planning.config import PlanningSettings
from active3d_pipe.planning.decide import bootstrap_decision, decide
from active3d_pipe.planning.outcome import Account, expected_along
from active3d_pipe.planning.reference_reward import sight, surface_share
from active3d_pipe.planning.reward import build_reward_field
from active3d_pipe.structures import Decision
from active3d_pipe.structures.motion import MotionSettings

SETTINGS, MOTION = PlanningSettings(), MotionSettings()


def reference_path_gain(field, poses, camera):
    """Every voxel once, at the best of its looks, with Python loops."""
    grid = field.grid
    fan = ray_fan(camera, 2 * fan_stride(camera, grid.voxel_size, field.max_range_m))[2]
    best = np.zeros(grid.size)
    for T in poses:
        origin = (T[:3, 3] - grid.origin) / grid.voxel_size
        for ray in fan:
            direction = T[:3, :3] @ ray
            passed = 1.0
            for ijk in sight(field, origin, direction)[0]:
                v = int(np.ravel_multi_index(ijk, grid.shape))
                if field.kind[v] == OPEN:
                    best[v] = max(best[v], passed)
                elif field.kind[v] == SURFACE and field.quality[v] < field.enough_quality:
                    distance = grid.voxel_size * float(np.linalg.norm(np.asarray(ijk) + 0.5 - origin))
                    share = surface_share(field, v, direction, distance)[0]
                    best[v] = max(best[v], passed * share / (1 - field.quality[v] / field.enough_quality))
                if field.kind[v] != 0:
                    length = 1 / np.abs(direction).sum() if field.kind[v] == OPEN else 1.0
                    passed *= max(float(field.through[v]), 1e-6) ** length
                    if passed < 0.02:
                        break
    return float(best @ field.gain_imp), float(best @ field.gain_exp)


def test_what_a_path_promises_equals_the_reference():
    world = box_world.build((2.6, 2.2, 1.8), [((1.0, 0.8, 0.5), (1.6, 1.4, 0.7))])
    seen = np.array([se3.pose_from_yaw_pitch(np.array([0.5, 0.5, 1.0]), a, 0.0) for a in (0.2, 0.9)])
    for T in seen:
        world.capture(T)
    field = build_reward_field(world.volume(), seen, world.camera, SETTINGS)
    poses = np.array([
        se3.pose_from_yaw_pitch(np.array([0.5 + 0.1 * i, 0.5, 1.0]), 0.9 + 0.1 * i, 0.1) for i in range(3)
    ])
    got, want = expected_along(field, poses, world.camera), reference_path_gain(field, poses, world.camera)
    assert want[0] > 20
    np.testing.assert_allclose(got, want, rtol=0.01)
    alone = [expected_along(field, T[None], world.camera)[0] for T in poses]
    assert max(alone) < got[0] < sum(alone)
    assert expected_along(field, poses[:0], world.camera) == (0.0, 0.0)


def test_a_biased_branch_is_corrected():
    account = Account()
    for _ in range(20):
        account = account.with_outcome((100.0, 50.0), (50.0, 75.0))
    imp, exp = account.correction((100.0, 50.0))
    assert imp == pytest.approx(0.5, abs=0.06)
    assert exp == pytest.approx(1.5, abs=0.06)
    assert Account().correction((10.0, 10.0)) == (1.0, 1.0)
    assert Account().with_outcome((10.0, 10.0), (-500.0, 0.0)).correction((1.0, 1.0))[0] > 0
    assert Account().correction((0.0, 0.0)) == (1.0, 1.0)


def test_predicted_gain_comes_true():
    """Executed decisions of a whole exploration: large promises bring large entropy drops."""
    world = box_world.two_rooms()
    decision = bootstrap_decision(se3.pose_from_yaw_pitch(np.array([0.8, 0.8, 1.2]), 0.3, 0.0), MOTION, SETTINGS)
    # Short rounds, so that something is left to be found in the twelfth.
    settings = PlanningSettings(max_positions=150, rrt_iterations=100, max_steps_per_round=20)
    walked, pairs, last, whole = [], [], None, 0.0
    for k in range(12):
        for T in decision.path:
            world.capture(T)
            walked.append(T)
        volume = world.volume(k)
        decision = decide(
            volume, walked[-1], np.array(walked), world.camera, MOTION, settings, np.random.default_rng(k),
            previous=Decision.from_json(decision.to_json()),
        )
        if last is not None:
            outcome = decision.terms["previous"]
            # Nothing drifts in this world: the outcome is the drop of the whole, but for what more rays confirm.
            drop = (last["entropy_imp"] - volume["entropy_imp"]).sum()
            assert 0 < outcome["realised_imp"] <= 1.001 * drop
            whole += drop
            pairs.append((outcome["predicted_imp"], outcome["realised_imp"]))
        last = volume
    predicted, realised = np.array(pairs).T
    assert realised.sum() > 0.8 * whole
    assert spearmanr(predicted, realised)[0] > 0.75
    assert 0.6 < realised.sum() / predicted.sum() < 1.6
