"""View protocols and the page that joins all metrics."""

import csv
import io
import json

import numpy as np
import pytest

from active3d_pipe.evaluation import evaluate as ev
from active3d_pipe.evaluation import views
from active3d_pipe.evaluation.config import EvaluationSettings
from active3d_pipe.evaluation.culling import SeenBy
from active3d_pipe.evaluation.geometry_metrics import prepare_truth
from active3d_pipe.evaluation.names import describe
from active3d_pipe.geometry import se3
from active3d_pipe.structures import Camera, Frame, TriangleMesh

CAMERA = Camera.from_fov(64, 48, 90)
SETTINGS = EvaluationSettings(num_points=5000, density_per_m2=200, lpips="off", curve_points=2000)


def frame(level: int, depth: float, step: int = 0) -> Frame:
    rgb = np.full((48, 64, 3), level, np.uint8)
    return Frame(step, step, CAMERA, np.eye(4), rgb, np.full((48, 64), depth, np.float32))


def constant_render(rgb: float, depth: float, alpha: float = 1.0):
    def render(camera, T):
        shape = (camera.height, camera.width)
        return np.full((*shape, 3), rgb), np.full(shape, depth, np.float32), np.full(shape, alpha, np.float32)
    return render


def square(half: float, z: float) -> TriangleMesh:
    vertices = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]], np.float32)
    return TriangleMesh(vertices, np.array([[0, 1, 2], [0, 2, 3]], np.int32))


def test_known_renders_have_known_scores():
    frames = [frame(51, 2.0), frame(102, 2.0)]  # 0.2 and 0.4; the render is 0.3 everywhere
    scores, source = ev.evaluate_views(constant_render(0.3, 2.05), {"heldout": frames}, SETTINGS)
    summary = scores["heldout"].summary
    assert summary["psnr"]["mean"] == pytest.approx(20.0, abs=1e-6)
    assert summary["depth_l1_cm"]["mean"] == pytest.approx(5.0, abs=1e-3)
    assert summary["lpips"]["mean"] is None and "off" in source
    assert summary["rendered_share"]["mean"] == 1.0
    assert summary["ms_ssim"]["mean"] is None  # the image is too small for five octaves


def test_summary_takes_the_bad_end():
    rows = [{"psnr": float(v), "depth_l1_cm": float(v)} for v in range(1, 102)]
    s = views.summarise(rows)
    assert (s["psnr"]["mean"], s["psnr"]["median"], s["psnr"]["p10"], s["psnr"]["worst"]) == (51, 51, 11, 1)
    assert (s["depth_l1_cm"]["p10"], s["depth_l1_cm"]["worst"]) == (91, 101)


def test_gap_is_train_minus_heldout():
    sets = {"heldout": [frame(51, 2.0)], "train": [frame(77, 2.0)], "circle": []}
    scores, _ = ev.evaluate_views(constant_render(0.3, 2.0), sets, SETTINGS)
    flat = ev.view_metrics(scores)
    assert "psnr_circle" not in flat
    assert flat["psnr_gap"] == pytest.approx(flat["psnr_train"] - flat["psnr"]) and flat["psnr_gap"] > 10


def test_circle_looks_inward_from_the_radius():
    centre = np.array([1.0, 2.0, 1.5])
    poses = views.circle_poses(centre, 0.8, 12)
    assert poses.shape == (12, 4, 4)
    np.testing.assert_allclose(np.linalg.norm(poses[:, :3, 3] - centre, axis=1), 0.8)
    np.testing.assert_allclose(poses[:, 2, 3], 1.5)
    np.testing.assert_allclose(poses[:, :3, 3] + 0.8 * poses[:, :3, 2], np.tile(centre, (12, 1)), atol=1e-12)
    assert views.circle_poses(centre, 1.0, 0).shape == (0, 4, 4)


def test_examples_go_from_worst_to_best():
    rows = [{"view": i, "psnr": p} for i, p in enumerate([30.0, 20.0, 25.0, None, 35.0])]
    assert views.pick_examples(rows, 3) == [1, 0, 4] or views.pick_examples(rows, 3) == [1, 2, 4]
    assert views.pick_examples(rows, 9) == [1, 2, 0, 4]
    assert views.pick_examples(rows, 0) == views.pick_examples([], 3) == []
    image = views.view_images(constant_render(0.3, 2.0), frame(51, 2.0), 4)
    assert image.render_rgb.dtype == np.uint8 and image.render_rgb[0, 0, 0] == 77
    assert image.psnr == pytest.approx(20.0, abs=1e-6)


def test_geometry_is_culled_and_unculled():
    truth_mesh = square(1.0, 0.0)
    truth = prepare_truth(truth_mesh, SETTINGS)
    hidden = square(1.0, -0.5)  # an invented sheet under the floor, which the camera above cannot see
    faces = np.concatenate([truth_mesh.faces, hidden.faces + 4]).astype(np.int32)
    reconstruction = TriangleMesh(np.concatenate([truth_mesh.vertices, hidden.vertices]), faces)
    above = se3.look_at(np.array([0.0, 0.0, 2.0]), np.zeros(3))[None]
    m = ev.evaluate_geometry(
        reconstruction, truth, SETTINGS, seen_by=SeenBy(CAMERA, above),
        query_sdf=lambda p: p[:, 2] + 0.02,
    )
    assert m["precision_surface"] == 1.0 and m["precision_surface_unculled"] == pytest.approx(0.5, abs=0.03)
    assert m["accuracy_cm_surface"] == pytest.approx(0, abs=1e-3)
    assert m["accuracy_cm_surface_unculled"] == pytest.approx(25, abs=1.5)
    assert m["mad_cm"] == pytest.approx(2.0, abs=1e-4)
    assert (m["reconstruction_area_m2"], m["truth_area_m2"]) == (4.0, 4.0)


def test_curves_rise_with_the_reconstruction():
    truth = prepare_truth(square(1.0, 0.0), ev.curve_settings(SETTINGS), floors=False)
    points = [ev.curve_point(step, square(h, 0.0), truth, SETTINGS) for step, h in ((10, 0.3), (20, 0.6), (30, 1.0))]
    ratios = [p["completion_ratio_surface"] for p in points]
    assert ratios == sorted(ratios) and ratios[-1] == 1.0 and [p["step"] for p in points] == [10, 20, 30]
    # A strip of 5 cm around the square counts as reconstructed.
    assert ratios[1] == pytest.approx((1.2**2 + 4 * 1.2 * 0.05 + np.pi * 0.05**2) / 4, abs=0.03)


def test_every_metric_is_explained_and_json_able():
    truth = prepare_truth(square(1.0, 0.0), SETTINGS, lambda p: p[:, 0] > 0)
    camera = SeenBy(CAMERA, se3.look_at(np.array([0.0, 0.0, 2.0]), np.zeros(3))[None])
    m = ev.evaluate_geometry(square(1.0, 0.01), truth, SETTINGS, seen_by=camera, query_sdf=lambda p: p[:, 2])
    sets = {"heldout": [frame(51, 2.0)], "train": [frame(77, 2.0)], "circle": [frame(77, 2.0)]}
    m |= ev.view_metrics(ev.evaluate_views(constant_render(0.3, 2.0), sets, SETTINGS)[0])
    m |= {"steps": 10, "rounds": 2, "collisions": 0, "path_m": 1.5, "min_clearance_m": 0.4}
    unexplained = [name for name in m if describe(name) is None]
    assert unexplained == []
    rows = ev.summary_rows(m)
    assert [r["name"] for r in rows] == list(m)
    assert json.loads(json.dumps(m, allow_nan=False)) == m


def test_a_share_is_listed_as_a_share_of_one():
    rows = ev.summary_rows({"completion_ratio_surface": 0.98, "psnr": 30.0, "not described": 1})
    assert [(row["value"], row["unit"]) for row in rows] == [(0.98, "of 1"), (30.0, "dB")]


def test_csv_has_one_column_a_key_and_empty_cells():
    text = ev.rows_to_csv([{"step": 1, "psnr": 20.5}, {"step": 2, "psnr": None, "note": "a,b"}])
    rows = list(csv.DictReader(io.StringIO(text)))
    assert rows == [{"step": "1", "psnr": "20.5", "note": ""}, {"step": "2", "psnr": "", "note": "a,b"}]
