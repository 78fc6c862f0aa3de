"""The mapping presets of `configs/maps`: each learns the analytic room, resumes exactly, and is what it says."""

from importlib.resources import files
from typing import Any

import numpy as np
import pytest
from room_with_ball import HIGH, LOW, render

from active3d_pipe.field.sdf_field import SdfField
from active3d_pipe.field.tsdf import TsdfField
from active3d_pipe.gaussians.parameters import LOG_SCALES
from active3d_pipe.geometry import se3
from active3d_pipe.mapping.config import MappingSettings
from active3d_pipe.mapping.hybrid_map import HybridMap
from active3d_pipe.mapping.refine import refine
from active3d_pipe.mapping.update import open_submap, update_map
from active3d_pipe.pipeline.config import load_config
from active3d_pipe.pipeline.layers import read_toml
from active3d_pipe.structures import Camera

FOLDER = files("configs").joinpath("maps")
PRESETS = ("tsdf", "co_slam", "nice_slam", "splatam", "monogs", "loopsplat")
SURFACES = ("tsdf", "co_slam", "nice_slam")
CAMERA = Camera.from_fov(96, 64, 80.0)
# What makes a test quick; the presets' own kinds, weights and rules stay.
QUICK: dict[str, Any] = {
    "refinement_iterations": 20, "refinement_field_iterations": 3, "gaussian_iterations_per_step": 6.0,
    "field": {
        "rays": 256, "prior_points": 32, "free_samples": 8, "surface_samples": 8, "hash_levels": 8,
        "hash_finest_m": 0.05,
    },
    "tsdf": {"voxel_m": 0.04, "truncation_m": 0.1}, "gaussians": {"seed_stride": 1},
}


def settings_of(name: str) -> MappingSettings:
    document = read_toml(FOLDER.joinpath(f"{name}.toml"))["mapping"]
    for key, value in QUICK.items():
        document[key] = {**document.get(key, {}), **value} if isinstance(value, dict) else value
    if name in SURFACES[1:]:
        document["field_iterations_per_step"] = 5.0
    return MappingSettings.model_validate(document)


def frames_between(first: int, last: int) -> list:
    """A turn on the spot, 25 degrees a frame."""
    out = []
    for i in range(first, last):
        yaw, at = np.radians(25.0 * i), np.array([-0.5, 0.6, 0.9])
        out.append(render(CAMERA, se3.look_at(at, at + np.array([np.cos(yaw), np.sin(yaw), -0.1])), step=i))
    return out


def grown(settings: MappingSettings, rounds: int = 2) -> HybridMap:
    hybrid = HybridMap.create(LOW, HIGH, settings, np.random.default_rng(0))
    for k in range(rounds):
        frames = frames_between(8 * k, 8 * (k + 1))
        update_map(hybrid, frames, None, k, settings, np.random.default_rng(k), lambda _: None)
    return hybrid


def all_bytes(hybrid: HybridMap) -> dict[str, bytes]:
    return {f"{t}.{n}": a.tobytes() for t, arrays in hybrid.state().items() for n, a in arrays.items()}


def test_every_file_lies_on_top_of_the_defaults() -> None:
    names = {f.name.removesuffix(".toml") for f in FOLDER.iterdir() if f.name.endswith(".toml")}
    assert names == {"hybrid", *PRESETS}
    base = load_config(None)
    assert load_config(str(FOLDER.joinpath("hybrid.toml"))) == base
    for name in PRESETS:
        config = load_config(str(FOLDER.joinpath(f"{name}.toml")))
        own = {"dispute_m": 0.0, "sheet_frames": 0}  # the mesh must be the map's own surface
        mesh = base.export.mesh
        assert config.export.mesh == mesh.model_copy(update=own), name
        same = config.model_copy(
            update={
                "mapping": base.mapping, "uncertainty": base.uncertainty,
                "export": config.export.model_copy(update={"mesh": mesh}),
            }
        )
        assert same == base and config.mapping != base.mapping, name


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_maps_the_room_and_resumes_exactly(name: str) -> None:
    settings = settings_of(name)
    hybrid = grown(settings)
    assert isinstance(hybrid.field, SdfField if name in SURFACES[1:] else TsdfField)
    assert (hybrid.num_gaussians == 0) == (name in SURFACES)
    frame = hybrid.keyframes[-1].frame
    view = hybrid.render(frame.camera, frame.T_world_camera)
    shown = view.alpha > 0.5
    assert shown.mean() > 0.9
    assert np.median(np.abs(view.depth - frame.depth)[shown]) < 0.05
    assert np.abs(view.rgb - frame.rgb / 255.0)[shown].mean() < 0.15
    if name in ("splatam",):
        scales = hybrid.gaussians.values.numpy()[:, LOG_SCALES]
        assert (scales == scales[:, :1]).all()

    state = {t: {n: a.copy() for n, a in arrays.items()} for t, arrays in hybrid.state().items()}
    resumed = HybridMap.from_state(settings, state, hybrid.keyframes)
    frames = frames_between(16, 19)
    for one in (hybrid, resumed):
        update_map(one, frames, None, 2, settings, np.random.default_rng(2), lambda _: None)
        refine(one, frames, np.random.default_rng(3), lambda _: None)
    assert all_bytes(hybrid) == all_bytes(resumed)
    again = resumed.render(frame.camera, frame.T_world_camera)
    assert np.array_equal(again.rgb, hybrid.render(frame.camera, frame.T_world_camera).rgb)
    assert not np.array_equal(again.rgb, view.rgb)  # and the view is not that of before


def test_splatam_adds_nothing_but_by_its_silhouette() -> None:
    settings = settings_of("splatam")
    hybrid = grown(settings, 1)
    report = update_map(
        hybrid, frames_between(8, 12), None, 1, settings, np.random.default_rng(1), lambda _: None
    )
    assert report.numbers["added"] == 0
    count = len(hybrid.gaussians)
    found = refine(hybrid, frames_between(0, 12), np.random.default_rng(3), lambda _: None)
    assert found.numbers["added"] == 0 and len(hybrid.gaussians) <= count


def test_submaps_rest_while_the_next_one_is_mapped_and_all_are_refined() -> None:
    settings = settings_of("loopsplat")
    settings = settings.model_copy(update={"window": settings.window.model_copy(update={"submap_keyframes": 2})})
    hybrid = grown(settings, 1)
    assert hybrid.submap == (0, 0) and len(hybrid.keyframes) == 2
    first = hybrid.gaussians.values.numpy().copy()
    update_map(hybrid, frames_between(10, 18), None, 1, settings, np.random.default_rng(1), lambda _: None)
    assert hybrid.submap == (2, len(first)) and len(hybrid.gaussians) > len(first)
    assert hybrid.gaussians.values.numpy()[: len(first)].tobytes() == first.tobytes()
    assert open_submap(hybrid, 0) == [2, 3]
    refine(hybrid, frames_between(0, 10), np.random.default_rng(3), lambda _: None)
    rows = {row.tobytes() for row in hybrid.gaussians.values.numpy()}
    assert sum(row.tobytes() in rows for row in first) < 0.5 * len(first)
