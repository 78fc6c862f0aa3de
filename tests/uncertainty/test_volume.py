"""The whole volume: the paper's qualitative cases on the box room, determinism, refusals."""

from dataclasses import replace

import numpy as np
import pytest
from uncertainty_room import (
    BOX_HIGH,
    BOX_LOW,
    SIZE,
    field,
    frames,
    gaussians_on,
    residual,
    room_grid,
    room_sdf,
)

from active3d_pipe.errors import InputError, NumericalError
from active3d_pipe.geometry import projection
from active3d_pipe.structures import VOLUMES, GaussianModel, VoxelGrid
from active3d_pipe.uncertainty import volume as volume_module
from active3d_pipe.uncertainty.config import UncertaintySettings
from active3d_pipe.uncertainty.terms import MASKED, open_to_the_field
from active3d_pipe.uncertainty.volume import compute_volume, make_grid

GRID = room_grid()
# The camera of these tests has few pixels, so few rays must do.
S = UncertaintySettings(ray_stride=2, residual_stride=1, surface_rays=1)
CENTRES = GRID.centres()
FLAT = CENTRES.reshape(-1, 3)
TRUE_SDF = room_sdf(FLAT).reshape(GRID.shape)
LOOKS = (-30, 0, 30)


def surface_points(fs):
    points = [projection.unproject(f.depth, f.T_world_camera, f.camera) for f in fs]
    return np.concatenate([p[::4, ::4].reshape(-1, 3) for p in points] or [np.zeros((0, 3))])


def volume(
    fs, previous=None, *, query=field, views=None, predicted=(), gaussians=None, settings=S, grid=GRID, last=None
):
    return compute_volume(
        grid=grid, round=0 if previous is None else previous.round + 1, previous=previous, field_query=query,
        gaussians=gaussians if gaussians is not None else gaussians_on(surface_points(fs)), new_frames=fs,
        views=[residual(f, 0.005, 0.02) for f in fs] if views is None else views, predicted=predicted,
        settings=settings, last_field_query=last,
    )


@pytest.fixture(scope="module")
def seen():
    """Three looks in one direction: half of the room stays unseen."""
    return volume(frames(LOOKS))


def test_what_is_seen_for_the_first_time_is_compared_with_the_last_rounds_field(seen):
    # Where the field was not asked the volume holds an SDF of long ago; the field itself has not changed since.
    known = open_to_the_field(volume_module._evidence_of(seen), S)
    stale = replace(seen, arrays={**seen.arrays, "sdf": np.where(known, seen["sdf"], np.float32(-0.1))})
    looks = frames((120, 150, 180), first_step=3)
    asked, unasked = (volume(looks, stale, last=query) for query in (field, None))
    revealed = (asked["hit_evidence"] > 0) & ~known
    assert revealed.sum() > 100 and unasked["u_time"][revealed].mean() > 0.1
    assert (asked["u_time"][revealed] == 0).all()


def known_free(v):
    """Inner free space that several rays passed and none hit."""
    return (v["free_evidence"] >= 10) & (v["hit_evidence"] == 0) & (TRUE_SDF > 0.1)


def test_all_arrays_are_there_and_in_range(seen):
    assert set(seen.arrays) == set(VOLUMES)
    for name, a in seen.arrays.items():
        assert a.dtype == np.float32
        assert a.flags.c_contiguous
        assert np.isfinite(a).all(), name
        if name not in ("sdf", "free_evidence", "hit_evidence", "cells_passed", "cells_hit"):
            assert a.min() >= 0, name
            assert a.max() <= 1, name
    np.testing.assert_allclose(seen["u_final"], (seen["u_imp"] + seen["u_exp"] + seen["u_time"]) / 3, atol=1e-6)
    np.testing.assert_allclose(seen["entropy"], (seen["entropy_imp"] + seen["entropy_exp"]) / 2, atol=1e-6)
    assert seen.fusion["source"] == "equal"


def test_unseen_space_is_uncertain_and_seen_free_space_is_not(seen):
    free, unseen = known_free(seen), ~seen.observed
    assert free.sum() > 2000
    assert unseen.sum() > 5000
    for name in ("u_imp", "entropy", "entropy_imp", "entropy_exp"):
        np.testing.assert_allclose(seen[name][unseen], 1, err_msg=name)
        assert seen[name][free].max() < 0.15, name
        assert seen[name][free].mean() < 0.03, name
    assert seen["u_final"][unseen].min() > 5 * seen["u_final"][free].max()
    assert (seen["occupancy"][unseen] == 0.5).all()
    assert seen["occupancy"][free].max() < 0.05


def test_the_field_is_asked_only_where_its_answer_matters(seen):
    """A second round asks for a part of the volume; a field that answers otherwise elsewhere changes nothing."""
    asked = []

    def counting(points):
        asked.append(len(points))
        return field(points)

    # Often enough the same look that most of the seen free space is sure.
    again = frames(LOOKS * 4)
    plain = volume(again, seen, query=counting)
    assert asked[0] < 0.7 * GRID.size

    def whole(grid, query, previous, mask):
        return ask(grid, query, None, mask)

    ask, module = volume_module._query, volume_module
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_query", whole)
        full = volume(again, seen)
    for name in VOLUMES:
        if name != "sdf":
            np.testing.assert_allclose(plain[name], full[name], atol=MASKED, err_msg=name)


def test_seen_surface_is_occupied_and_sure(seen):
    surface = seen["hit_evidence"] >= 4
    assert surface.sum() > 150
    assert seen["occupancy"][surface].min() > 0.8
    assert seen["occupancy"][surface].mean() > 0.98
    assert seen["entropy_exp"][surface].mean() < 0.2
    assert (seen["view_quality"][surface] > 0).all()
    assert not seen["view_quality"][seen["hit_evidence"] == 0].any()


def test_behind_the_furniture_stays_unknown(seen):
    shadow = (CENTRES[..., 0] > BOX_HIGH[0] + 0.15) & (CENTRES[..., 0] < SIZE[0] - 0.1) & (CENTRES[..., 2] < 0.3)
    shadow &= (np.abs(CENTRES[..., 1] - 1.15) < 0.1) & (CENTRES[..., 2] > 0.05)
    assert shadow.sum() > 4
    np.testing.assert_allclose(seen["entropy"][shadow], 1)


def test_phantom_structure_in_seen_free_space_draws_no_attention(seen):
    """The field invents a vague slab in the middle of seen free space, and another one in unseen space."""
    slab = np.abs(CENTRES[..., 0] - 1.5) < 0.12

    def phantom(points):
        points = np.asarray(points)
        sdf, sigma = field(points)
        inside = np.abs(points[:, 0] - 1.5) < 0.12
        return np.where(inside, -0.05, sdf), np.where(inside, 0.5, sigma)

    v = volume(frames(LOOKS), query=phantom)
    where = slab & known_free(v)
    assert where.sum() > 100
    for name in ("u_imp", "u_final", "entropy_imp", "entropy"):
        assert v[name][where].max() < 0.15, name
    assert v["occupancy"][where].max() < 0.2
    # The phantom comes and goes from round to round: still no attention.
    later = volume(frames(LOOKS, first_step=3), seen, query=phantom)
    assert later["u_time"][slab & known_free(seen)].max() < 0.15
    # The same doubt about a seen surface counts.
    doubtful = volume(frames(LOOKS), query=lambda p: (field(p)[0], np.full(len(p), 0.5)))
    surface = doubtful["hit_evidence"] >= 4
    assert doubtful["u_imp"][surface].min() > 0.6


def test_a_changed_surface_is_flagged_and_fades():
    """The box appears where free space had been seen."""
    before = volume(frames(LOOKS, box=False, pitch_deg=-25), query=lambda p: field(p, box=False))
    assert before["u_time"].max() == 0
    after = volume(frames(LOOKS, first_step=3, pitch_deg=-25), before)
    on_box = (room_sdf(FLAT) < 0.05).reshape(GRID.shape) & (after["hit_evidence"] >= 6)
    on_box &= before["free_evidence"] > 10
    on_box &= ((CENTRES > BOX_LOW) & (CENTRES < BOX_HIGH)).all(-1) & (CENTRES[..., 2] > 0.15)
    assert on_box.sum() > 10
    assert after["u_time"][on_box].min() > 0.5
    assert after["u_time"][~after.observed].max() == 0
    elsewhere = after.observed & (np.abs(room_sdf(FLAT) - room_sdf(FLAT, box=False)) < 1e-3).reshape(GRID.shape)
    assert after["u_time"][elsewhere].max() < 1e-6
    later = volume(frames(LOOKS, first_step=6, pitch_deg=-25), after)
    np.testing.assert_allclose(later["u_time"][on_box], after["u_time"][on_box] * S.temporal_decay, rtol=1e-5)


def test_a_poorly_rendered_view_raises_u_exp_where_it_looks(seen):
    fs = frames(LOOKS)
    good = [residual(f, 0.0, 0.0) for f in fs]
    bad = [*good[:2], residual(fs[2], 0.3, 0.5)]
    a, b = volume(fs, views=good), volume(fs, views=bad)
    assert a["u_exp"].max() < 1e-6
    raised = b["u_exp"] > 0.2
    assert raised.sum() > 100
    assert (CENTRES[raised][:, 1] > CENTRES[b["hit_evidence"] > 0][:, 1].mean()).mean() > 0.7


def test_evidence_only_grows_and_knowledge_with_it(seen):
    after = volume(frames((150, 180, 210), first_step=3), seen)
    for name in ("free_evidence", "hit_evidence", "view_quality"):
        assert (after[name] >= seen[name]).all()
    assert after["entropy"].sum() < seen["entropy"].sum() - 2000
    assert after["u_final"].sum() < seen["u_final"].sum()


def test_fusion_learns_what_predicts_the_residual(seen):
    """The map is wrong exactly where it was unseen: u_imp is what predicts, and its weight says so."""
    fs = frames((60, 90, 120), first_step=3)
    predicted = []
    for f in fs:
        ijk = GRID.index_of(projection.unproject(f.depth, f.T_world_camera, f.camera))
        unknown = ~seen.observed[tuple(np.moveaxis(np.clip(ijk, 0, np.array(GRID.shape) - 1), -1, 0))]
        predicted.append(residual(f, np.where(unknown, 0.5, 0.0), 0.0, np.where(unknown, 0.0, 1.0)))
    s = S.model_copy(update={"depth_residual_weight": 1.0})
    v = volume(fs, seen, predicted=predicted, settings=s)
    assert v.fusion["source"] == "evidence"
    assert v.fusion["rows"] > S.fusion_min_rows
    assert v.fusion["alphas"][0] > 0.75
    assert v.fusion["noise"] < 0.35
    # The statistics travel with the volume: a round without predictions keeps what was learnt.
    later = volume(fs, v, settings=s)
    np.testing.assert_allclose(later.fusion["alphas"], v.fusion["alphas"], rtol=1e-3)


def test_same_input_same_bytes(seen):
    fs = frames((40, 80), first_step=3)
    a, b = (volume(fs, seen, predicted=[residual(f, 0.1, 0.1) for f in fs]) for _ in range(2))
    assert all(a[name].tobytes() == b[name].tobytes() for name in VOLUMES)
    assert a.fusion == b.fusion


def test_a_round_without_frames_views_or_gaussians(seen):
    nothing = volume([], gaussians=GaussianModel.empty(), views=[])
    assert not nothing.observed.any()
    np.testing.assert_allclose(nothing["entropy"], 1)
    still = volume([], seen, gaussians=GaussianModel.empty(), views=[])
    np.testing.assert_array_equal(still["free_evidence"], seen["free_evidence"])


def test_grid_covers_bounds_and_margin():
    grid = make_grid((0, 0, 0), SIZE, UncertaintySettings(margin_m=0.25))
    assert (grid.low <= -0.25).all()
    assert (grid.high >= SIZE + 0.25 - 1e-9).all()
    assert grid.voxel_size == 0.1


def test_bad_input_is_refused_in_one_line(seen):
    other = VoxelGrid(GRID.origin, 0.1, (5, 5, 5))
    cases = (
        (InputError, "one grid", {"grid": other, "previous": seen}),
        (InputError, "values of sigma", {"query": lambda p: (np.zeros(len(p)), np.zeros(3))}),
        (NumericalError, "NaN", {"query": lambda p: (np.full(len(p), np.nan), np.zeros(len(p)))}),
    )
    for error, words, change in cases:
        with pytest.raises(error, match=words) as caught:
            volume(frames((0,)), change.pop("previous", None), **change)
        assert "\n" not in str(caught.value)
    for wrong in ({"lambda_imp": 0.8, "lambda_exp": 0.8}, {"beta_1": 0.9, "beta_2": 0.9}, {"terms": ("imp", "imp")}):
        with pytest.raises(ValueError, match="expected"):
            UncertaintySettings(**wrong)
