"""Each ablation file switches off what it says and leaves the rest as it is."""

from importlib.resources import files

import numpy as np
import pytest
from uncertainty_room import field, frames, gaussians_on, residual, room_grid

from active3d_pipe.geometry import projection
from active3d_pipe.mapping.config import KeyframeSettings
from active3d_pipe.mapping.keyframes import Information
from active3d_pipe.pipeline.config import load_config
from active3d_pipe.structures import UncertaintyVolume
from active3d_pipe.uncertainty.volume import compute_volume

FOLDER = files("configs").joinpath("ablations")
BASE = load_config(None)
# file -> the settings that it may change
SWITCHES = {
    "without_triplane": {"mapping.field.encoder"},
    "without_mlp_uncertainty": {
        "uncertainty.terms", "uncertainty.lambda_imp", "uncertainty.lambda_exp", "mapping.keyframes.high_branches",
    },
    "without_depth_uncertainty": {"uncertainty.depth_residual_weight"},
    "without_rgb_uncertainty": {"uncertainty.depth_residual_weight"},
    "without_sdf_temporal": {"uncertainty.terms"},
    "without_risk_planning": {"planning.policy", "planning.lambda_risk", "planning.eta"},
    "without_uncertainty_keyframes": {"mapping.keyframes.policy"},
    "temporal_window": {"mapping.window.policy"},
    "implicit_only": {
        "mapping.representation", "mapping.keyframes.high_branches", "uncertainty.terms", "uncertainty.lambda_imp",
        "uncertainty.lambda_exp",
    },
    "explicit_only": {
        "mapping.representation", "mapping.geometry", "mapping.keyframes.high_branches", "uncertainty.terms",
        "uncertainty.lambda_imp", "uncertainty.lambda_exp",
    },
}


def flat(document: dict, prefix: str = "") -> dict:
    out = {}
    for name, value in document.items():
        if isinstance(value, dict):
            out |= flat(value, f"{prefix}{name}.")
        else:
            out[prefix + name] = value
    return out


def config_of(name: str):
    return load_config(str(FOLDER.joinpath(f"{name}.toml")))


def two_rounds(settings, depth_error=0.03, color_error=0.1, temporal=0.04) -> UncertaintyVolume:
    """The second volume on the box room; the field moves by `temporal` m in between."""
    settings = settings.model_copy(update={"ray_stride": 2, "fusion": "equal"})
    first, second = frames((-30, 0)), frames((0, 30), first_step=2)
    volume = None
    for k, fs in enumerate((first, second)):
        surface = np.concatenate([
            projection.unproject(f.depth, f.T_world_camera, f.camera)[::4, ::4].reshape(-1, 3) for f in fs
        ])

        def query(p, k=k):
            sdf, sigma = field(p)
            return sdf - np.float32(temporal * k), sigma

        views = [residual(f, depth_error, color_error) for f in fs]
        volume = compute_volume(
            grid=room_grid(), round=k, previous=volume, field_query=query, gaussians=gaussians_on(surface),
            new_frames=fs, views=views, predicted=views if k else [], settings=settings,
        )
    return volume


@pytest.fixture(scope="module")
def whole() -> UncertaintyVolume:
    return two_rounds(BASE.uncertainty)


def changed(a: UncertaintyVolume, b: UncertaintyVolume) -> set[str]:
    return {name for name in a.arrays if not np.array_equal(a[name], b[name])}


def test_every_file_of_the_folder_is_here() -> None:
    assert {file.name.removesuffix(".toml") for file in FOLDER.iterdir()} == set(SWITCHES)


@pytest.mark.parametrize("name", SWITCHES)
def test_the_file_changes_what_it_says_and_nothing_else(name: str) -> None:
    base, ablated = flat(BASE.model_dump()), flat(config_of(name).model_dump())
    assert {key for key in base if base[key] != ablated[key]} == SWITCHES[name]


def test_without_mlp_uncertainty_u_imp_reaches_no_sum(whole: UncertaintyVolume) -> None:
    config = config_of("without_mlp_uncertainty")
    volume = two_rounds(config.uncertainty)
    assert changed(whole, volume) == {"u_final", "entropy"}
    assert volume.fusion["alphas"][0] == 0
    assert np.array_equal(volume["entropy"], volume["entropy_exp"])
    # V_high no longer asks the field: a sure field leaves it as it is.
    sure = UncertaintyVolume(volume.grid, 1, {**volume.arrays, "u_imp": np.zeros_like(volume["u_imp"])}, {})
    assert Information(volume, BASE.mapping.keyframes).high.any()
    assert not Information(sure, BASE.mapping.keyframes).high.any()
    high = Information(sure, config.mapping.keyframes).high
    assert np.array_equal(high, volume["u_exp"] > config.mapping.keyframes.tau_high)


@pytest.mark.parametrize(("name", "branch", "index"), [("implicit_only", "imp", 0), ("explicit_only", "exp", 1)])
def test_with_one_branch_the_other_reaches_no_sum(
    whole: UncertaintyVolume, name: str, branch: str, index: int
) -> None:
    config = config_of(name)
    volume = two_rounds(config.uncertainty)
    assert changed(whole, volume) == {"u_final", "entropy"}
    assert np.flatnonzero(volume.fusion["alphas"]).tolist() == [index]
    assert np.array_equal(volume["entropy"], volume[f"entropy_{branch}"])
    keyframes = config.mapping.keyframes
    assert np.array_equal(Information(volume, keyframes).high, volume[f"u_{branch}"] > keyframes.tau_high)


@pytest.mark.parametrize(
    ("name", "deaf_to", "hears"),
    [("without_depth_uncertainty", "depth_error", "color_error"),
     ("without_rgb_uncertainty", "color_error", "depth_error")],
)
def test_without_one_residual_u_exp_hears_the_other_only(
    whole: UncertaintyVolume, name: str, deaf_to: str, hears: str
) -> None:
    settings = config_of(name).uncertainty
    volume = two_rounds(settings)
    assert {"u_exp", "u_final"} <= changed(whole, volume)
    assert changed(whole, volume) <= {"u_exp", "u_final"}
    assert np.array_equal(volume["u_exp"], two_rounds(settings, **{deaf_to: 0.0})["u_exp"])
    assert not np.array_equal(volume["u_exp"], two_rounds(settings, **{hears: 0.0})["u_exp"])


def test_without_sdf_temporal_a_moving_field_adds_nothing(whole: UncertaintyVolume) -> None:
    settings = config_of("without_sdf_temporal").uncertainty
    volume = two_rounds(settings)
    assert whole["u_time"].max() > 0 and changed(whole, volume) == {"u_final"}
    assert volume.fusion["alphas"][2] == 0


def test_high_branches_choose_the_volumes_of_v_high(whole: UncertaintyVolume) -> None:
    def high(*branches: str) -> np.ndarray:
        return Information(whole, KeyframeSettings(high_branches=branches)).high

    assert np.array_equal(high("imp", "exp"), high("imp") & high("exp"))
    assert high("imp").sum() != high("exp").sum()
