"""The situations of the paper's figure on hierarchical uncertainty (cases a to k), and depth that never comes."""

from dataclasses import replace

import numpy as np
import pytest
from uncertainty_room import BOX_HIGH, CAMERA, SIZE, field, frames, gaussians_on, pose, residual, room_grid, room_sdf

from active3d_pipe.geometry import projection
from active3d_pipe.planning.config import PlanningSettings
from active3d_pipe.planning.reward import build_reward_field, exact_terms
from active3d_pipe.uncertainty.config import UncertaintySettings
from active3d_pipe.uncertainty.volume import compute_volume

GRID = room_grid()
CENTRES = GRID.centres()
TRUE_SDF = room_sdf(CENTRES.reshape(-1, 3)).reshape(GRID.shape)
S = UncertaintySettings(ray_stride=2, surface_rays=2)
AROUND = tuple(range(0, 360, 30))


def volume(fs, previous=None, *, query=field, views=None, settings=S):
    points = [projection.unproject(f.depth, f.T_world_camera, f.camera)[f.depth > 0][::8] for f in fs]
    return compute_volume(
        grid=GRID, round=0 if previous is None else previous.round + 1, previous=previous, field_query=query,
        gaussians=gaussians_on(np.concatenate(points)), new_frames=fs,
        views=[residual(f, 0.002, 0.01) for f in fs] if views is None else views, predicted=(), settings=settings,
    )


def reward(v, T, walked=()):
    """`GainTerms` of the view from T as the planner scores it, after the poses walked so far."""
    walked = np.array(walked).reshape(-1, 4, 4)
    return exact_terms(build_reward_field(v, walked, CAMERA, PlanningSettings()), T[None], CAMERA)[0]


@pytest.fixture(scope="module")
def looked_around():
    return volume(frames(AROUND))


def test_a_seen_void_is_not_uncertain_though_the_field_says_so():
    """(a) the head extrapolates a large sigma into empty space."""
    v = volume(frames(AROUND), query=lambda p: (field(p)[0], np.full(len(p), 0.5, np.float32)))
    void = (v["free_evidence"] >= 10) & (v["hit_evidence"] == 0) & (TRUE_SDF > 0.2)
    assert void.sum() > 2000
    assert v["u_final"][void].max() < 0.1
    assert v["entropy"][void].max() < 0.1


def test_b_e_unseen_space_is_uncertain_whatever_the_field_says():
    """(b, e) global exploration: the head is sure of itself where nobody looked."""
    v = volume(frames((0,)), query=lambda p: field(p, sigma=0.001))
    unseen = ~v.observed
    assert unseen.mean() > 0.5
    assert v["u_imp"][unseen].min() == 1
    assert v["u_final"][unseen].min() > 3 * v["u_final"][v.observed & (v["hit_evidence"] == 0)].mean()


def test_c_d_intricate_surface_stands_out_among_seen_ones():
    """(c, d) one wall is hard to render; the field is as sure of it as of all others."""
    fs = frames(AROUND)
    at_wall = [projection.unproject(f.depth, f.T_world_camera, f.camera)[..., 1] > SIZE[1] - 0.05 for f in fs]
    views = [residual(f, np.where(w, 0.03, 0.002), 0.01) for f, w in zip(fs, at_wall)]
    colour = [np.where(w, 0.4, 0.01).astype(np.float32) for w in at_wall]
    views = [replace(v, color_error=c) for v, c in zip(views, colour)]
    v = volume(fs, views=views)
    surface = v["hit_evidence"] >= 4
    wall = surface & (CENTRES[..., 1] > SIZE[1] - 0.05) & (CENTRES[..., 2] > 0.3) & (CENTRES[..., 2] < 1.7)
    others = surface & (CENTRES[..., 1] < SIZE[1] - 0.35)
    assert wall.sum() > 50
    assert v["u_exp"][wall].mean() > 5 * v["u_exp"][others].mean()
    assert np.median(v["u_final"][wall]) > 2 * np.median(v["u_final"][others])
    assert abs(v["u_imp"][wall].mean() - v["u_imp"][others].mean()) < 0.2


def test_f_h_phantom_structure_behind_the_walls_draws_no_attention(looked_around):
    """(f, h) the field invents a second room behind the wall: no view is worth more for it."""

    def phantom(points, beyond=SIZE[0] + 0.06):
        points = np.asarray(points)
        sdf, sigma = field(points)
        behind = points[:, 0] > beyond
        return np.where(behind, 0.05 * np.sin(40 * points[:, 1]), sdf), np.where(behind, 0.3, sigma)

    v, away = volume(frames(AROUND), query=phantom), (150, 180, 210)
    # With the wall in the map; and of a half of the room that nobody saw: there sight goes on into the invention.
    dreamt = volume(frames(away), query=lambda p: phantom(p, 1.7))
    for invented, plain in ((v, looked_around), (dreamt, volume(frames(away)))):
        for f in frames((-20, 0, 20), first_step=20):
            with_phantom, without = reward(invented, f.T_world_camera), reward(plain, f.T_world_camera)
            assert with_phantom.num_visible > 300
            assert with_phantom.reward == pytest.approx(without.reward, rel=0.02, abs=0.05)
    behind = CENTRES[..., 0] > SIZE[0] + 0.06
    hidden = behind & (v["hit_evidence"] == 0)
    # It does not come and go either: the field's moods there never reach u_time.
    later = volume(frames(AROUND, first_step=12), v)
    assert later["u_time"][hidden].max() < 0.05


def test_g_phantom_structure_in_the_room_draws_no_attention():
    """(g) redundant structure in space that was seen to be free."""

    def phantom(points):
        sdf, sigma = field(points)
        inside = np.linalg.norm(points - np.array([1.3, 1.9, 1.2]), axis=1) < 0.25
        return np.where(inside, -0.05, sdf), np.where(inside, 0.3, sigma)

    v = volume(frames(AROUND), query=phantom)
    inside = (np.linalg.norm(CENTRES - np.array([1.3, 1.9, 1.2]), axis=-1) < 0.25) & (v["free_evidence"] >= 10)
    assert inside.sum() > 20
    assert v["u_final"][inside].max() < 0.1
    assert v["occupancy"][inside].max() < 0.3


def test_k_occluded_space_stays_uncertain_though_all_that_is_seen_is_perfect():
    """(k) alpha blending cannot see behind the box: the renderings are faultless, the shadow stays uncertain."""
    fs = frames((-30, 0, 30))
    v = volume(fs, views=[residual(f) for f in fs])
    assert v["u_exp"].max() < 1e-6
    shadow = (CENTRES[..., 0] > BOX_HIGH[0] + 0.1) & (CENTRES[..., 0] < SIZE[0] - 0.1) & (CENTRES[..., 2] < 0.25)
    shadow &= (np.abs(CENTRES[..., 1] - 1.15) < 0.15) & (CENTRES[..., 2] > 0.05)
    assert shadow.sum() > 4
    seen = v["hit_evidence"] >= 4
    assert v["u_final"][shadow].min() > 3 * v["u_final"][seen].mean()
    assert v["entropy"][shadow].min() == pytest.approx(1)


def window(f, low=(-1.0, 0.4, 0.7), high=(0.1, 1.9, 1.6)):
    """A copy of a frame whose rays through the wall x = 0 (window or mirror) come back without a reading."""
    p = projection.unproject(f.depth, f.T_world_camera, f.camera)
    lost = ((p > np.array(low)) & (p < np.array(high))).all(-1)
    return replace(f, depth=np.where(lost, 0, f.depth).astype(np.float32)), lost


def test_missing_depth_loses_attraction_after_looks_in_vain():
    """A window gives no depth however often one looks: each round in vain halves what is expected there."""
    v, u, walked, by_volume, planned, ahead = None, [], [], [], [], []
    for k in range(4):
        fs, lost = zip(*(window(f) for f in frames((150, 180, 210), first_step=3 * k)))
        assert lost[1].mean() > 0.05
        v = volume(fs, v)
        walked += [f.T_world_camera for f in fs]
        pane = (v["vain_looks"] > k) & ~v.observed
        assert pane.sum() > 20
        u.append(v["u_imp"][pane].mean())
        by_volume.append(reward(v, pose(180)).reward)
        planned.append(reward(v, pose(180), walked).reward)
        ahead.append(reward(v, pose(0), walked).reward)
    for now, before in zip(u[1:], u):
        assert now == pytest.approx(before / 2, rel=0.05)
    assert by_volume[3] < 0.25 * by_volume[0]
    # The planner counts the looks itself, too.
    assert planned[0] < 0.5 * by_volume[0] and planned[3] < 0.1 * planned[0]
    # Unseen space elsewhere keeps all of its attraction.
    assert ahead[0] > 5 * by_volume[0]
    assert ahead[1:] == pytest.approx(ahead[:1] * 3, rel=0.01)
    elsewhere = ~v.observed & (v["vain_looks"] == 0)
    assert elsewhere.sum() > 1000
    assert v["u_imp"][elsewhere].min() == 1


def test_a_reading_at_last_ends_the_doubt():
    fs, _ = zip(*(window(f) for f in frames((150, 180, 210))))
    blind = volume(fs)
    pane = (blind["vain_looks"] > 0) & ~blind.observed
    seen = volume(frames((150, 180, 210), first_step=3), blind)
    found = pane & (seen["hit_evidence"] >= 3)
    assert found.sum() > 10
    fresh = volume(frames((150, 180, 210), first_step=3))
    np.testing.assert_allclose(seen["u_imp"][found], fresh["u_imp"][found], atol=0.25)
    assert seen["occupancy"][found].min() > 0.8


def test_random_dropout_is_no_look_in_vain():
    rng = np.random.default_rng(0)
    fs = [replace(f, depth=np.where(rng.random(f.depth.shape) < 0.2, 0, f.depth)) for f in frames((0, 10, 20))]
    v = volume(fs)
    unseen = ~v.observed
    assert (v["vain_looks"][unseen] > 0).mean() < 0.01


def test_no_look_in_vain_through_a_wall():
    """A ray without a reading says nothing of what lies behind known solid voxels."""
    before = volume(frames(AROUND))
    f = frames((0,), first_step=12)[0]
    dark = replace(f, depth=np.zeros_like(f.depth))
    v = volume([dark], before)
    outside = (CENTRES > SIZE + 0.06).any(-1) | (CENTRES < -0.06).any(-1)
    assert (v["vain_looks"][~outside] > 0).sum() > 100
    assert (v["vain_looks"][outside & (before["hit_evidence"] == 0)] > 0).mean() < 0.02
