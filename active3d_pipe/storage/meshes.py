"""Triangle meshes as PLY and GLB."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from active3d_pipe.errors import ArtifactError
from active3d_pipe.storage.files import reading, write_bytes
from active3d_pipe.structures import TriangleMesh

if TYPE_CHECKING:
    import trimesh

# glTF is Y up: x -> x, y -> -z, z -> y, so that viewers show the scene upright.
Y_UP_FROM_Z_UP = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], dtype=np.float64)


def write_mesh_ply(path: Path, mesh: TriangleMesh) -> None:
    """Binary PLY with vertex colours, world frame (Z up, m)."""
    write_bytes(path, cast("bytes", _to_trimesh(mesh).export(file_type="ply")))


def write_mesh_glb(path: Path, mesh: TriangleMesh) -> None:
    """GLB with vertex colours, turned to glTF's Y-up frame by the scene's root transform."""
    import trimesh

    scene = trimesh.Scene()
    scene.add_geometry(_to_trimesh(mesh), node_name="mesh", geom_name="mesh", transform=Y_UP_FROM_Z_UP)
    write_bytes(path, cast("bytes", scene.export(file_type="glb")))


def read_mesh(path: Path) -> TriangleMesh:
    """Read a PLY mesh written by `write_mesh_ply`; one without faces has no vertices either."""
    import trimesh

    with reading(path, "a PLY mesh"):
        if not path.is_file():
            raise FileNotFoundError(path)
        if b"element face 0\n" in _header(path):
            return TriangleMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.uint8))
        mesh: Any = trimesh.load(path, process=False)
        if not isinstance(mesh, trimesh.Trimesh):
            raise ArtifactError(f"{path}: holds no triangles")
        visual: Any = mesh.visual
        colors = np.asarray(visual.vertex_colors)[:, :3].astype(np.uint8)
        return TriangleMesh(np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32), colors)


def _header(path: Path) -> bytes:
    with open(path, "rb") as f:
        return f.read(1024).partition(b"end_header")[0]


def _to_trimesh(mesh: TriangleMesh) -> "trimesh.Trimesh":
    import trimesh

    return trimesh.Trimesh(
        vertices=mesh.vertices, faces=mesh.faces, vertex_colors=mesh.colors, process=False, validate=False
    )
