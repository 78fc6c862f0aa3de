"""A round of mapping on an analytic room: keyframes, window, working set, and the same bytes after a resume."""

from dataclasses import replace

import numpy as np
import pytest
from room_with_ball import HIGH, LOW, render

from active3d_pipe.geometry import projection, se3
from active3d_pipe.mapping.branches import target
from active3d_pipe.mapping.config import MappingSettings
from active3d_pipe.mapping.hybrid_map import HybridMap
from active3d_pipe.mapping.keyframes import (
    Keyframe,
    depth_samples,
    divergence,
    overlap,
    select_keyframes,
    view_distance,
)
from active3d_pipe.mapping.refine import refine
from active3d_pipe.mapping.update import update_map
from active3d_pipe.mapping.window import choose_window, draw_older
from active3d_pipe.structures import Camera

CAMERA = Camera.from_fov(96, 64, 80.0)
SETTINGS = MappingSettings.model_validate(
    {"refinement_iterations": 20, "refinement_field_iterations": 3, "field": {"rays": 128, "prior_points": 32}}
)


def pose(yaw_deg: float, position=(-0.5, 0.6, 0.9)) -> np.ndarray:
    yaw = np.radians(yaw_deg)
    forward = np.array([np.cos(yaw), np.sin(yaw), -0.1])
    return se3.look_at(np.asarray(position), np.asarray(position) + forward)


def frames_between(first: int, last: int, turn_deg: float = 10.0) -> list:
    return [render(CAMERA, pose(turn_deg * i), step=i) for i in range(first, last)]


def keyframe(frame, round: int = 0) -> Keyframe:
    return Keyframe(frame, round, "viewpoint", 1.0, 0.0, 0.0)


def grown(rounds: int = 2) -> HybridMap:
    hybrid = HybridMap.create(LOW, HIGH, SETTINGS, np.random.default_rng(0))
    for k in range(rounds):
        frames = frames_between(6 * k, 6 * (k + 1), 25.0)
        update_map(hybrid, frames, None, k, SETTINGS, np.random.default_rng(k), lambda _: None)
    return hybrid


def all_bytes(hybrid: HybridMap) -> dict[str, bytes]:
    return {f"{t}.{n}": a.tobytes() for t, arrays in hybrid.state().items() for n, a in arrays.items()}


def test_divergence_is_the_least_view_distance() -> None:
    known = [keyframe(f) for f in frames_between(0, 12, 31.0)]
    for frame in (render(CAMERA, pose(17.0)), render(CAMERA, pose(100.0, (0.5, -0.8, 0.5)))):
        points = depth_samples(frame, 24)
        slow = min(view_distance(frame, points, k.frame) for k in known)
        assert divergence(frame, known) == pytest.approx(slow, abs=1e-12)
    assert divergence(known[3].frame, known, enough=0.2) <= 0.2
    assert divergence(known[3].frame, []) == 1.0


def test_overlap_is_the_share_of_points_in_front_of_the_depth_of_the_other_view() -> None:
    points = depth_samples(render(CAMERA, pose(0.0)), 3)
    shares = []
    for turn in (0.0, 20.0, 45.0, 180.0):
        other = render(CAMERA, pose(turn, (-0.3, 0.5, 1.0)))
        uv, z = projection.project(points, other.T_world_camera, CAMERA)
        inside = projection.in_image(uv, z, CAMERA)
        column, row = np.floor(uv[inside]).astype(int).T
        reading = other.depth[row, column]
        slow = np.sum((reading > 0) & (z[inside] < 1.1 * reading)) / len(points)
        shares.append(overlap(points, other))
        assert shares[-1] == pytest.approx(slow, abs=1e-12)
    assert shares[0] > shares[1] > shares[2] > shares[3]
    assert overlap(points[:0], render(CAMERA, pose(0.0))) == 0.0


def test_select_keyframes_takes_what_diverges_and_nothing_twice() -> None:
    frames = frames_between(0, 18, 8.0)
    chosen = select_keyframes(frames, [], None, 0, SETTINGS.keyframes)
    assert chosen[0].frame is frames[0] and 3 <= len(chosen) < len(frames)
    assert select_keyframes(frames, chosen, None, 1, SETTINGS.keyframes) == []
    every = SETTINGS.keyframes.model_copy(update={"policy": "every_n", "every_n": 5})
    assert [k.frame.step for k in select_keyframes(frames, [], None, 0, every)] == [0, 5, 10, 15]


def test_frames_without_a_reading_are_new_viewpoints_by_their_angle_alone() -> None:
    blind = [replace(f, depth=np.zeros_like(f.depth)) for f in frames_between(0, 1) * 6]
    assert len(select_keyframes(blind, [], None, 0, SETTINGS.keyframes)) == 1


def test_window_holds_the_newest_and_their_neighbours_and_replay_the_others() -> None:
    known = [keyframe(f) for f in frames_between(0, 36, 10.0)]
    settings = SETTINGS.window.model_copy(update={"size": 6})
    window = choose_window(known, known[-2:], frames_between(34, 36, 10.0), settings)
    # The camera has turned full circle: the neighbours of the last views are the first ones.
    assert {34, 35} <= set(window) and min(window) < 3 and len(window) == 6
    # A round back where the agent was before adds no keyframe; its neighbours are not the last ones.
    again = choose_window(known, [], frames_between(16, 19, 10.0), settings)
    assert len(again) == 6 and all(12 <= i <= 23 for i in again)
    assert choose_window(known, [], [], settings) == list(range(30, 36))
    older = draw_older(np.random.default_rng(0), window, len(known), settings)
    assert len(older) == 2 and not set(older) & set(window)
    assert draw_older(np.random.default_rng(0), range(len(known)), len(known), settings) == []


def test_working_set_changes_neither_number_nor_values() -> None:
    hybrid = grown()
    before = {row.tobytes() for row in hybrid.gaussians.values.numpy()}
    frame = hybrid.keyframes[0].frame
    with hybrid.working_set([frame]):
        inside = len(hybrid.gaussians)
        assert 0 < inside < hybrid.num_gaussians == len(before)
        part = hybrid.render(frame.camera, frame.T_world_camera)
    whole = hybrid.render(frame.camera, frame.T_world_camera)
    assert len(hybrid.gaussians) == hybrid.num_gaussians == len(before)
    assert {row.tobytes() for row in hybrid.gaussians.values.numpy()} == before
    assert np.abs(part.rgb - whole.rgb).max() < 1e-5 and np.abs(part.alpha - whole.alpha).max() < 1e-5


def test_resting_primitives_keep_their_bytes_while_others_train() -> None:
    hybrid = grown(1)
    rows = {row.tobytes() for row in hybrid.gaussians.values.numpy()}
    frames = frames_between(0, 1)
    raster_seen = len(rows)
    settings = SETTINGS.model_copy(update={"window": SETTINGS.window.model_copy(update={"replay": 0.0, "size": 1})})
    hybrid.settings = settings
    hybrid.keyframes = hybrid.keyframes[:1]
    update_map(hybrid, frames, None, 1, settings, np.random.default_rng(5), lambda _: None)
    kept = sum(row.tobytes() in rows for row in hybrid.gaussians.values.numpy())
    assert 0 < kept < raster_seen


def test_a_map_from_its_state_goes_on_with_the_same_bytes() -> None:
    straight, stopped = grown(1), grown(1)
    state = {t: {n: a.copy() for n, a in arrays.items()} for t, arrays in stopped.state().items()}
    resumed = HybridMap.from_state(SETTINGS, state, stopped.keyframes)
    frames = frames_between(6, 12, 25.0)
    for hybrid in (straight, resumed):
        update_map(hybrid, frames, None, 1, SETTINGS, np.random.default_rng(1), lambda _: None)
        refine(hybrid, frames, np.random.default_rng(2), lambda _: None)
    assert all_bytes(straight) == all_bytes(resumed)


def test_a_round_teaches_both_branches_what_the_frames_show() -> None:
    hybrid = grown(2)
    frame = hybrid.keyframes[-1].frame
    view = hybrid.render(frame.camera, frame.T_world_camera)
    shown = view.alpha > 0.5
    assert shown.mean() > 0.95
    assert np.median(np.abs(view.depth - frame.depth)[shown]) < 0.03
    assert np.abs(view.rgb - frame.rgb / 255.0)[shown].mean() < 0.06
    points = depth_samples(frame, 4).astype(np.float32)
    assert np.median(np.abs(hybrid.field.query_sdf(points))) < 0.05


@pytest.mark.parametrize("stride", [1, 2])
def test_rounds_learn_the_view_from_every_pixel_and_from_means_of_them(stride: int) -> None:
    settings = SETTINGS.model_copy(update={"round_stride": stride, "gaussian_iterations_per_step": 0.0})
    frames = frames_between(0, 3)
    errors = []
    for iterations in (0.0, 30.0):
        hybrid = HybridMap.create(LOW, HIGH, settings, np.random.default_rng(0))
        how = settings.model_copy(update={"gaussian_iterations_per_keyframe": iterations, "add_per_round": 0})
        update_map(hybrid, frames, None, 0, how, np.random.default_rng(0), lambda _: None)
        views = [hybrid.render(f.camera, f.T_world_camera).rgb for f in frames]
        errors.append(np.mean([(v - f.rgb / 255) ** 2 for v, f in zip(views, frames)]))
    assert errors[1] < 0.6 * errors[0]
    small = target(frames[0], stride)
    assert small.rgb.shape == (CAMERA.height // stride, CAMERA.width // stride, 3) and small.rgb.max() <= 1
    assert small.camera.fx == pytest.approx(CAMERA.fx / stride)


@pytest.mark.parametrize(
    ("changed", "coupled"),
    [({}, True), ({"representation": "implicit_only"}, False),
     ({"representation": "explicit_only", "geometry": "tsdf"}, False)],
)
def test_only_the_hybrid_map_pulls_its_gaussians_to_the_field(changed: dict, coupled: bool, monkeypatch) -> None:
    pulls = []

    def pull(*args):
        pulls.append(args)

    monkeypatch.setattr("active3d_pipe.mapping.branches.coupling_gradient", pull)
    settings = SETTINGS.model_copy(update={"coupling_every": 2, "refinement_field_iterations": 0} | changed)
    hybrid = HybridMap.create(LOW, HIGH, settings, np.random.default_rng(0))
    frames = frames_between(0, 3, 25.0)
    update_map(hybrid, frames, None, 0, settings, np.random.default_rng(0), lambda _: None)
    of_round = len(pulls)
    refine(hybrid, frames, np.random.default_rng(0), lambda _: None)
    assert (of_round > 0) == (len(pulls) > of_round) == coupled
