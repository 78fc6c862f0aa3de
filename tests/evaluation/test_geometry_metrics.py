"""Distances on shapes whose answer is known in closed form."""

import numpy as np
import pytest
import trimesh

from active3d_pipe.errors import InputError, NumericalError
from active3d_pipe.evaluation.config import EvaluationSettings
from active3d_pipe.evaluation.geometry_metrics import (
    mad_cm,
    prepare_truth,
    sample_surface,
    surface_metrics,
    thinned_truth,
)
from active3d_pipe.structures import TriangleMesh

SETTINGS = EvaluationSettings(num_points=20_000, density_per_m2=2500)


def rectangle(width: float, height: float, z: float = 0.0) -> TriangleMesh:
    vertices = np.array([[0, 0, z], [width, 0, z], [width, height, z], [0, height, z]], np.float32)
    return TriangleMesh(vertices, np.array([[0, 1, 2], [0, 2, 3]], np.int32))


def sphere(radius: float) -> TriangleMesh:
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=radius)
    return TriangleMesh(mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32))


def join(*meshes: TriangleMesh) -> TriangleMesh:
    offsets = np.cumsum([0, *[len(m.vertices) for m in meshes[:-1]]])
    vertices = np.concatenate([m.vertices for m in meshes])
    return TriangleMesh(vertices, np.concatenate([m.faces + o for m, o in zip(meshes, offsets)]).astype(np.int32))


def test_samples_are_uniform_by_area():
    mesh = join(rectangle(3, 1), rectangle(1, 1, z=5))  # 3 m2 below, 1 m2 above
    points = sample_surface(mesh, 40_000, np.random.default_rng(0))
    above = points[:, 2] > 1
    assert above.mean() == pytest.approx(0.25, abs=0.01)
    counts, _, _ = np.histogram2d(points[~above, 0], points[~above, 1], bins=(6, 2), range=((0, 3), (0, 1)))
    expected = (~above).sum() / 12
    assert np.abs(counts - expected).max() < 5 * np.sqrt(expected)
    again = sample_surface(mesh, 40_000, np.random.default_rng(0))
    assert points.tobytes() == again.tobytes()


def test_shifted_plane_is_off_by_exactly_the_shift():
    truth = prepare_truth(rectangle(2, 2), SETTINGS)
    m = surface_metrics(rectangle(2, 2, z=0.01), truth, SETTINGS)
    for name in ("accuracy_cm", "completion_cm", "accuracy_median_cm", "completion_median_cm"):
        assert m[f"{name}_surface"] == pytest.approx(1.0, abs=1e-3)
    assert m["completion_ratio_surface"] == m["precision_surface"] == m["fscore_surface"] == 1.0
    far = surface_metrics(rectangle(2, 2, z=0.06), truth, SETTINGS)
    assert far["completion_ratio_surface"] == far["precision_surface"] == far["fscore_surface"] == 0.0


def test_spheres_differ_by_their_radii():
    m = surface_metrics(sphere(1.02), prepare_truth(sphere(1.0), SETTINGS), SETTINGS)
    assert m["accuracy_cm_surface"] == pytest.approx(2.0, abs=0.05)
    assert m["completion_cm_surface"] == pytest.approx(2.0, abs=0.05)


def test_directions_are_not_swapped():
    """Half of the truth reconstructed, perfectly: accuracy is perfect, completion is not."""
    truth = prepare_truth(rectangle(2, 1), SETTINGS)
    m = surface_metrics(rectangle(1, 1), truth, SETTINGS)
    assert m["accuracy_cm_surface"] == pytest.approx(0.0, abs=1e-4)
    assert m["precision_surface"] == 1.0
    # The missing half is 0..1 m away, 0.5 m on average; the strip of 5 cm still counts.
    assert m["completion_cm_surface"] == pytest.approx(25.0, abs=0.6)
    assert m["completion_ratio_surface"] == pytest.approx(0.525, abs=0.012)
    assert m["fscore_surface"] == pytest.approx(2 * 0.525 / 1.525, abs=0.012)
    # The other way round, a reconstruction with an invented half.
    m = surface_metrics(rectangle(2, 1), prepare_truth(rectangle(1, 1), SETTINGS), SETTINGS)
    assert m["completion_ratio_surface"] == 1.0 and m["precision_surface"] == pytest.approx(0.525, abs=0.012)


def test_perfect_reconstruction_scores_the_floor():
    mesh = rectangle(4, 4)
    truth = prepare_truth(mesh, SETTINGS)
    m = surface_metrics(mesh, truth, SETTINGS)
    assert m["accuracy_cm_surface"] == pytest.approx(0, abs=1e-4)
    # Nearest neighbour of a Poisson process: mean distance 0.5 / sqrt(points per area).
    assert m["accuracy_cm_p2p_floor"] == pytest.approx(50 / np.sqrt(20_000 / 16), rel=0.03)
    assert m["accuracy_cm_p2p"] == pytest.approx(m["accuracy_cm_p2p_floor"], rel=0.03)
    assert m["accuracy_cm_density_floor"] == pytest.approx(1.0, rel=0.03)
    assert m["completion_cm_density"] == pytest.approx(1.0, rel=0.03)


def test_fixed_density_does_not_depend_on_the_size_of_the_scene_and_p2p_does():
    small, large = (
        surface_metrics(r, prepare_truth(r, SETTINGS), SETTINGS) for r in (rectangle(1, 2), rectangle(6, 2))
    )
    assert small["accuracy_cm_density"] == pytest.approx(large["accuracy_cm_density"], rel=0.04)
    assert large["accuracy_cm_p2p"] > 2 * small["accuracy_cm_p2p"]


def test_unobservable_truth_is_left_out_of_the_observable_figures():
    truth = prepare_truth(rectangle(2, 1), SETTINGS, lambda points: points[:, 0] < 1)
    m = surface_metrics(rectangle(1, 1), truth, SETTINGS)
    assert m["completion_ratio_surface_observable"] == 1.0 and m["fscore_surface_observable"] == 1.0
    assert m["completion_cm_surface_observable"] == pytest.approx(0, abs=1e-4)
    assert m["completion_ratio_surface"] < 0.6
    assert "precision_surface_observable" not in m


def test_thinned_truth_says_the_same_with_fewer_points():
    truth = prepare_truth(rectangle(4, 1), SETTINGS, lambda p: p[:, 0] < 2)
    fewer = thinned_truth(truth, 5000)
    assert len(fewer.points) == len(fewer.observable) == 5000
    m = surface_metrics(rectangle(1, 1), fewer, SETTINGS)
    assert m["completion_ratio_surface"] == pytest.approx(0.25 + 0.05 / 4, abs=0.02)
    assert m["completion_ratio_surface_observable"] == pytest.approx(0.5 + 0.05 / 2, abs=0.03)
    assert not any("p2p" in name for name in m)


def test_empty_reconstruction_has_no_distances_and_completes_nothing():
    empty = TriangleMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    m = surface_metrics(empty, prepare_truth(rectangle(1, 1), SETTINGS), SETTINGS)
    for form in ("surface", "p2p", "density"):
        assert m[f"completion_ratio_{form}"] == 0.0 and m[f"fscore_{form}"] == 0.0
        assert m[f"accuracy_cm_{form}"] is m[f"completion_cm_{form}"] is m[f"precision_{form}"] is None


def test_equal_calls_give_equal_numbers():
    truth, other = rectangle(2, 1), rectangle(2, 1, z=0.02)
    first = surface_metrics(other, prepare_truth(truth, SETTINGS), SETTINGS)
    assert first == surface_metrics(other, prepare_truth(truth, SETTINGS), SETTINGS)


def test_bad_input_is_one_line():
    degenerate = TriangleMesh(np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.int32))
    with pytest.raises(InputError, match="no area"):
        prepare_truth(degenerate, SETTINGS)
    broken = rectangle(1, 1)
    broken.vertices[0, 0] = np.nan
    with pytest.raises(InputError, match="NaN"):
        prepare_truth(broken, SETTINGS)
    with pytest.raises(InputError, match="observable mask"):
        prepare_truth(rectangle(1, 1), SETTINGS, lambda points: np.ones(3, bool))


def test_mad_is_the_mean_absolute_sdf_in_cm():
    points = sample_surface(sphere(1.0), 5000, np.random.default_rng(1))
    def query(p):
        return np.linalg.norm(p, axis=1) - 1.03  # a field whose sphere is 3 cm too large
    assert mad_cm(query, points, batch=777) == pytest.approx(3.0, abs=0.05)
    assert mad_cm(query, points) == pytest.approx(mad_cm(query, points, batch=100), rel=1e-9)
    with pytest.raises(NumericalError):
        mad_cm(lambda p: np.full(len(p), np.nan), points)
