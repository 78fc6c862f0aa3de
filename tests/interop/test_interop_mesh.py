"""The mesh opens in Open3D, and the Khronos validator finds no fault in the GLB."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from active3d_pipe.geometry.raycasting import import_open3d
from active3d_pipe.storage import meshes, splats

pytestmark = pytest.mark.interop


def test_open3d_reads_faces_and_colours(tiny_run: Path) -> None:
    open3d = import_open3d()
    path = tiny_run / "export" / "mesh.ply"
    ours, theirs = meshes.read_mesh(path), open3d.io.read_triangle_mesh(str(path))
    np.testing.assert_array_equal(np.asarray(theirs.triangles), ours.faces)
    np.testing.assert_allclose(np.asarray(theirs.vertices), ours.vertices, rtol=0, atol=1e-6)
    assert theirs.has_vertex_colors()
    np.testing.assert_allclose(np.asarray(theirs.vertex_colors) * 255, ours.colors, rtol=0, atol=0.01)
    assert len(ours.faces) > 500
    assert np.ptp(ours.colors.astype(int)) > 30  # not one flat colour


def test_open3d_reads_the_gaussians_as_points(tiny_run: Path) -> None:
    open3d = import_open3d()
    path = tiny_run / "export" / "gaussians.ply"
    cloud, model = open3d.t.io.read_point_cloud(str(path)), splats.read_splats(path)
    np.testing.assert_array_equal(cloud.point.positions.numpy(), model.means)
    np.testing.assert_array_equal(cloud.point["opacity"].numpy().ravel(), model.opacity_logits)


def test_gltf_validator_reports_no_errors(tiny_run: Path, node_script: Callable[..., Any]) -> None:
    report = node_script("validate_gltf.mjs", ["gltf-validator"], tiny_run / "export" / "mesh.glb")
    issues = report["issues"]
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues["messages"]
    mesh = meshes.read_mesh(tiny_run / "export" / "mesh.ply")
    assert report["info"]["totalTriangleCount"] == len(mesh.faces)
    assert report["info"]["totalVertexCount"] == len(mesh.vertices)
