"""The parts that policies are made of, against known answers."""

import box_world
import numpy as np
import pytest
from test_policies import Explorer

from active3d_pipe.planning.policies import voronoi
from active3d_pipe.planning.policies.activegs import confidence
from active3d_pipe.planning.policies.base import facing, looking_at
from active3d_pipe.planning.policies.fisherrf import COLUMNS, SCALE, Fisher, gain
from active3d_pipe.planning.policies.panorama import panorama, pixel_clusters, sphere_rays
from active3d_pipe.planning.policies.space import frontier_clusters, in_view, line_of_sight
from active3d_pipe.storage.poses import read_poses


@pytest.fixture(scope="module")
def explorer():
    """The two rooms after the first turn, with a real map."""
    made = Explorer("fisherrf", True)
    made.capture()
    return made


def test_random_signs_give_the_diagonal_of_the_fisher_matrix(explorer):
    context = explorer.context()
    fisher = Fisher(context.the_map, context.camera, np.random.default_rng(0))
    fisher.camera = context.camera.scaled(0.1)
    fisher.values = fisher.values[::20].copy()
    T = explorer.walked[-1]
    image = fisher._pass.forward(fisher.values, fisher.camera, T)
    exact = np.zeros((len(fisher.values), len(COLUMNS)))
    for index in np.ndindex(3, *image.shape[1:]):
        one = np.zeros(image.shape, np.float32)
        one[index] = 1
        exact += fisher._pass.backward(one)[:, COLUMNS].astype(np.float64) ** 2
    exact *= SCALE * SCALE
    estimate = fisher.diagonal(T, probes=400)
    assert exact.max() > 0
    big = exact > 0.05 * exact.max()
    assert big.sum() > 5
    ratio = estimate[big] / exact[big]
    assert abs(ratio.mean() - 1) < 0.05 and ratio.std() < 0.3
    assert (estimate[exact == 0] == 0).all()
    # What the training views hold already is worth less.
    assert gain(exact, exact) < gain(exact, np.zeros_like(exact))


def test_perturbing_the_field_leaves_it_as_it_was(explorer):
    view = explorer.context().the_map
    points = explorer.world.grid.centres().reshape(-1, 3)[::50]
    before = view.query_sdf(points)
    state = {k: v.copy() for k, v in explorer.hybrid.field.state().items()}
    for decoder_only in (False, True):
        moved = view.perturbed_sdf(points, 3, np.random.default_rng(0), decoder_only=decoder_only)
        assert moved.shape == (3, len(points)) and np.abs(moved - before).max() > 0
    for name, value in explorer.hybrid.field.state().items():
        np.testing.assert_array_equal(value, state[name])


def test_a_panorama_shows_what_a_view_shows(explorer):
    context = explorer.context()
    T = explorer.walked[-1]
    image = panorama(context.the_map, T[:3, 3], 2.0, context.camera)
    camera = context.camera
    view = context.the_map.render(camera, T)
    local = image.rays.reshape(-1, 3) @ T[:3, :3]
    inside = local[:, 2] > 0.9
    u = (local[inside, 0] / local[inside, 2] * camera.fx + camera.cx).astype(int)
    v = (local[inside, 1] / local[inside, 2] * camera.fy + camera.cy).astype(int)
    distance = view.depth[v, u] / local[inside, 2]
    both = (distance > 0) & (image.distance_m.ravel()[inside] > 0)
    assert both.mean() > 0.5
    assert np.median(np.abs(distance - image.distance_m.ravel()[inside])[both]) < 0.03
    assert sphere_rays(2.0)[1].sum() == pytest.approx(4 * np.pi)


def test_pixel_clusters_wrap_around_and_drop_what_is_sparse():
    mask = np.zeros((20, 40), bool)
    mask[5:9, :3] = mask[5:9, 37:] = True
    mask[14:18, 15:20] = True
    mask[2, 20] = True
    labels, n = pixel_clusters(mask, 2.0, 4)
    assert n == 2
    assert labels[6, 0] == labels[6, 39] != labels[15, 17] > 0
    assert labels[2, 20] == 0


def test_confidence_grows_with_views_from_several_sides(explorer):
    kappa = confidence(explorer.context().the_map)
    assert ((kappa >= 0) & (kappa <= 1)).all()
    assert (kappa > 0.3).mean() > 0.01
    frames = explorer.hybrid.keyframes
    try:
        explorer.hybrid.keyframes = frames[:2]
        fewer = confidence(explorer.context().the_map)
    finally:
        explorer.hybrid.keyframes = frames
    assert fewer.mean() < kappa.mean()


def test_the_graph_spans_both_rooms_and_the_door():
    world = box_world.two_rooms()
    outline = ~world.solid[:, :, 28]
    from scipy.ndimage import binary_erosion

    nodes, distance = voronoi._junctions(binary_erosion(outline, iterations=5), 0.05)
    x = world.fine.origin[0] + nodes[:, 0] * 0.05
    assert (x < 3.5).any() and (x > 4.5).any()
    straight = np.linalg.norm(nodes[:, None] - nodes[None], axis=-1)
    assert np.isfinite(distance).all()
    assert (distance >= straight - 1e-6).all()


def test_frontiers_border_the_unknown_and_sight_ends_at_walls(explorer):
    context = explorer.context()
    space = context.free_space()
    clusters = frontier_clusters(context, space, 5)
    assert clusters and [len(c) for c in clusters] == sorted((len(c) for c in clusters), reverse=True)
    for cluster in clusters:
        assert space.free[tuple(cluster.T)].all()
    here = np.array([1.0, 0.5, 1.2])
    sight = line_of_sight(context, here, np.array([[1.3, 0.6, 1.3], [7.0, 0.5, 1.2]]))
    assert sight.tolist() == [True, False]
    counts = in_view(context, np.array(explorer.walked[-2:]), ~context.volume.observed)
    assert (counts[:, 0] <= counts[:, 1]).all() and (counts[:, 1] > 100).all()


def test_directions():
    R = looking_at(np.zeros((2, 3)), np.array([[1.0, 0, 0], [0, 0, 1.0]]), 60)
    np.testing.assert_allclose(R[0][:, 2], (1, 0, 0), atol=1e-12)
    assert np.degrees(np.arcsin(R[1][2, 2])) == pytest.approx(60)
    np.testing.assert_allclose(facing(np.array([0, 2.0, 5]), np.eye(3))[:, 2], (0, 1, 0), atol=1e-12)
    np.testing.assert_array_equal(facing(np.array([0, 0, 1.0]), np.eye(3)), np.eye(3))


def test_poses_are_read_from_every_form(tmp_path):
    import json

    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = (0, 0.1, 0.2)
    (tmp_path / "a.json").write_text(json.dumps(poses.tolist()))
    (tmp_path / "b.json").write_text(json.dumps({"poses": poses.tolist()}))
    np.save(tmp_path / "c.npy", poses)
    np.savetxt(tmp_path / "d.txt", poses.reshape(3, 16))
    for k in range(3):
        folder = tmp_path / "run" / "capture" / f"round_{k:04d}"
        folder.mkdir(parents=True)
        (folder / "capture.json").write_text(json.dumps({"poses": poses[k : k + 1].tolist()}))
    for name in ("a.json", "b.json", "c.npy", "d.txt", "run"):
        np.testing.assert_allclose(read_poses(tmp_path / name), poses)
    from active3d_pipe.errors import InputError

    (tmp_path / "bad.json").write_text('{"x": 1}')
    (tmp_path / "empty").mkdir()
    for name, said in (("bad.json", "holds no poses"), ("empty", "no captures"), ("none.txt", "cannot be read")):
        with pytest.raises(InputError, match=said):
            read_poses(tmp_path / name)
