"""Which part of a mesh the run's own cameras saw, with occlusion."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from active3d_pipe.evaluation.config import EvaluationSettings
from active3d_pipe.geometry import projection
from active3d_pipe.geometry.raycasting import SurfaceIndex
from active3d_pipe.structures import Camera, TriangleMesh


@dataclass(frozen=True, eq=False)
class SeenBy:
    """The cameras of a run: one camera, poses T_world_camera (M, 4, 4), and optionally their depth maps.

    `depths[i]` (H, W) float32, m along the optical axis, 0 = no return. Without them the mesh's own rendered
    depth decides what hides what.
    """

    camera: Camera
    poses: np.ndarray
    depths: Sequence[np.ndarray] | None = None


def render_depth(index: SurfaceIndex, camera: Camera, T_world_camera: np.ndarray) -> np.ndarray:
    """(H, W) float32 z-depth of a mesh, m; infinite where the ray meets nothing."""
    directions = projection.pixel_rays(camera).reshape(-1, 3) @ T_world_camera[:3, :3].T
    origins = np.broadcast_to(T_world_camera[:3, 3], directions.shape)
    # The rays have z = 1 in the camera frame, so the ray parameter is the z-depth.
    t = index.cast(np.concatenate([origins, directions], axis=1).astype(np.float32))[0]
    return t.reshape(camera.height, camera.width)


def seen_vertices(mesh: TriangleMesh, seen_by: SeenBy, settings: EvaluationSettings) -> np.ndarray:
    """(V,) bool, vertices that at least one camera saw: in the image, within range, and not hidden.

    Hidden means more than `cull_eps_m` behind the farthest depth of the pixel and its eight neighbours (a slanted
    surface spans a range of depths within a pixel).
    """
    own = seen_by.depths is None
    camera = seen_by.camera.scaled(settings.cull_scale) if own else seen_by.camera
    index = SurfaceIndex(mesh.vertices, mesh.faces) if own and len(mesh.faces) else None
    seen = np.zeros(len(mesh.vertices), dtype=bool)
    pending = np.arange(len(mesh.vertices))
    for i in range(0, len(seen_by.poses), settings.cull_stride):
        if len(pending) == 0:
            break
        T = seen_by.poses[i]
        uv, z = projection.project(mesh.vertices[pending], T, camera)
        inside = projection.in_image(uv, z, camera) & (z <= camera.far)
        if not inside.any():
            continue
        if seen_by.depths is not None:
            depth = seen_by.depths[i]
        elif index is not None:
            depth = render_depth(index, camera, T)
        else:
            break
        column, row = np.floor(uv[inside]).astype(np.int64).T
        visible = z[inside] <= _farthest_neighbour(depth)[row, column] + settings.cull_eps_m
        hit = pending[inside][visible]
        seen[hit] = True
        pending = pending[~seen[pending]]
    return seen


def _farthest_neighbour(depth: np.ndarray) -> np.ndarray:
    padded = np.pad(depth, 1, mode="edge")
    rows = np.maximum(np.maximum(padded[:-2], padded[1:-1]), padded[2:])
    return np.maximum(np.maximum(rows[:, :-2], rows[:, 1:-1]), rows[:, 2:])


def cull_unseen(mesh: TriangleMesh, seen_by: SeenBy, settings: EvaluationSettings) -> TriangleMesh:
    """The faces of which at least one vertex was seen, with unused vertices dropped."""
    seen = seen_vertices(mesh, seen_by, settings)
    return submesh(mesh, seen[mesh.faces].any(axis=1))


def submesh(mesh: TriangleMesh, keep: np.ndarray) -> TriangleMesh:
    """The faces chosen by `keep` (F,) bool, re-indexed; colours follow their vertices."""
    faces = mesh.faces[keep]
    used = np.zeros(len(mesh.vertices), dtype=bool)
    used[faces.ravel()] = True
    renumber = (np.cumsum(used) - 1).astype(np.int32)
    colors = None if mesh.colors is None else mesh.colors[used]
    return TriangleMesh(mesh.vertices[used], renumber[faces], colors)
