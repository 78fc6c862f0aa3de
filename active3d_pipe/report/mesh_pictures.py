"""Pictures of a mesh by ray casting: vertex colours with a fixed shading, no graphics driver needed."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from active3d_pipe.geometry import projection, se3
from active3d_pipe.geometry.raycasting import NO_HIT, SurfaceIndex
from active3d_pipe.report.data import Picture
from active3d_pipe.structures import Camera, TriangleMesh

BACKGROUND = np.ones(3, np.float32)
BARE = np.array([0.78, 0.80, 0.83], np.float32)  # of a mesh without colours
LIGHT = np.array([0.35, 0.25, 0.90], np.float32) / np.linalg.norm([0.35, 0.25, 0.90])
SAMPLES = 2  # rays per pixel along each axis
MAX_LAYERS = 6  # back faces that a ray may pass


@dataclass(frozen=True, eq=False)
class MeshView:
    """How to look at a mesh.

    Attributes:
        caption: what it shows.
        rays: (H, W, 6) float32 origin and direction of every ray, world m; H and W are multiples of `SAMPLES`.
        see_through: pass faces that are seen from behind, so that walls do not hide the room behind them.
        cut_above_m: leave out faces whose centroid is higher than this, m; None = keep all.
    """

    caption: str
    rays: np.ndarray
    see_through: bool = False
    cut_above_m: float | None = None


def render_mesh(mesh: TriangleMesh, views: Sequence[MeshView]) -> list[Picture]:
    """One picture for every view, white where nothing is hit; nothing for a mesh without faces."""
    if len(mesh.faces) == 0:
        return []
    pictures, cut, index, part = [], object(), None, mesh
    for view in views:
        if view.cut_above_m != cut or index is None:
            cut, part = view.cut_above_m, _below(mesh, view.cut_above_m)
            index = SurfaceIndex(part.vertices, part.faces) if len(part.faces) else None
        rgb = np.broadcast_to(BACKGROUND, (*view.rays.shape[:2], 3))
        if index is not None:
            rgb = _shade(part, index, view.rays.reshape(-1, 6), view.see_through).reshape(rgb.shape)
        h, w = rgb.shape[0] // SAMPLES, rgb.shape[1] // SAMPLES
        mean = rgb.reshape(h, SAMPLES, w, SAMPLES, 3).mean(axis=(1, 3))
        pictures.append(Picture(view.caption, (np.clip(mean, 0, 1) * 255 + 0.5).astype(np.uint8)))
    return pictures


def _below(mesh: TriangleMesh, height_m: float | None) -> TriangleMesh:
    if height_m is None:
        return mesh
    keep = mesh.vertices[mesh.faces, 2].mean(axis=1) <= height_m
    return TriangleMesh(mesh.vertices, mesh.faces[keep], mesh.colors)


def _face_normals(mesh: TriangleMesh) -> np.ndarray:
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    n = np.cross(b - a, c - a)
    return n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-12)


def _shade(mesh: TriangleMesh, index: SurfaceIndex, rays: np.ndarray, see_through: bool) -> np.ndarray:
    """(N, 3) float colours of rays (N, 6)."""
    normals = _face_normals(mesh)
    face, bary = _first_face(index, rays, normals, see_through)
    hit = face != NO_HIT
    rgb = np.tile(BACKGROUND, (len(rays), 1))
    corners = mesh.faces[face[hit]]
    if mesh.colors is None:
        albedo = np.tile(BARE, (len(corners), 1))
    else:
        u, v = bary[hit, :1], bary[hit, 1:]
        c = mesh.colors[corners].astype(np.float32) / 255
        albedo = (1 - u - v) * c[:, 0] + u * c[:, 1] + v * c[:, 2]
    direction = rays[hit, 3:] / np.linalg.norm(rays[hit, 3:], axis=1, keepdims=True)
    n = normals[face[hit]]
    n = np.where((n * direction).sum(axis=1, keepdims=True) > 0, -n, n)
    # A light from above and one at the camera: every surface keeps some contrast. Colours captured under the scene's
    # own light are darkened by a third at most.
    strength = 0.66 + 0.2 * np.maximum(n @ LIGHT, 0) + 0.18 * np.abs((n * direction).sum(axis=1))
    rgb[hit] = albedo * strength[:, None]
    return rgb


def _first_face(
    index: SurfaceIndex, rays: np.ndarray, normals: np.ndarray, see_through: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Face (N,) and barycentric coordinates (N, 2) of what each ray shows."""
    t, face, bary = index.cast(rays)
    if not see_through:
        return face, bary
    face, bary, t = face.copy(), bary.copy(), t.copy()
    pending = np.arange(len(rays))
    for _ in range(MAX_LAYERS):
        hit = face[pending] != NO_HIT
        behind = np.zeros(len(pending), dtype=bool)
        facing = (normals[face[pending[hit]]] * rays[pending[hit], 3:]).sum(axis=1)
        behind[hit] = facing > 0
        pending = pending[behind]
        if len(pending) == 0:
            return face, bary
        onward = rays[pending].copy()
        onward[:, :3] += onward[:, 3:] * (t[pending, None] + 1e-3)
        step, face[pending], bary[pending] = index.cast(onward)
        t[pending] += step + 1e-3
    face[pending] = NO_HIT
    return face, bary


def perspective_rays(camera: Camera, T_world_camera: np.ndarray) -> np.ndarray:
    """(2H, 2W, 6) rays of a pinhole view, several a pixel."""
    directions = projection.pixel_rays(camera.scaled(SAMPLES)) @ T_world_camera[:3, :3].T
    origins = np.broadcast_to(T_world_camera[:3, 3], directions.shape)
    return np.concatenate([origins, directions], axis=-1).astype(np.float32)


def top_rays(low: np.ndarray, high: np.ndarray, width_px: int) -> np.ndarray:
    """Parallel rays downwards over the box [low, high] (world m), x to the right and y up in the picture."""
    margin = 0.02 * float(max(high[:2] - low[:2]))
    x0, y0 = low[:2] - margin
    x1, y1 = high[:2] + margin
    height_px = max(1, round(width_px * (y1 - y0) / (x1 - x0)))
    columns, rows = width_px * SAMPLES, height_px * SAMPLES
    x = x0 + (np.arange(columns) + 0.5) / columns * (x1 - x0)
    y = y1 - (np.arange(rows) + 0.5) / rows * (y1 - y0)
    gx, gy = np.meshgrid(x, y)
    origins = np.stack([gx, gy, np.full_like(gx, high[2] + 1.0)], axis=-1)
    down = np.broadcast_to(np.array([0.0, 0.0, -1.0]), origins.shape)
    return np.concatenate([origins, down], axis=-1).astype(np.float32)


def default_views(mesh: TriangleMesh, poses: np.ndarray | None, width_px: int = 720) -> list[MeshView]:
    """Top view with the ceiling cut, two views from outside, and one from a pose inside.

    `poses` (M, 4, 4) T_world_camera are the run's own; they tell which side of a face is the room and give the
    inside view. Without them the inside view is left out.
    """
    if len(mesh.faces) == 0:
        return []
    low, high = _bounds(mesh)
    cut = float(low[2] + 0.75 * (high[2] - low[2]))
    camera = Camera.from_fov(width_px, round(width_px * 0.72), 50)
    see_through = poses is None or _normals_face_the_room(mesh, poses)
    views = [MeshView("from above, ceiling cut", top_rays(low, high, width_px), see_through, cut)]
    for azimuth, name in ((-125.0, "from outside, south-west"), (55.0, "from outside, north-east")):
        a = np.radians(azimuth)
        towards = np.array([np.cos(a), np.sin(a), 0.85])
        pose = _fit(camera, low, np.array([*high[:2], cut]), towards / np.linalg.norm(towards))
        views.append(MeshView(name, perspective_rays(camera, pose), see_through, cut))
    if poses is not None and len(poses):
        inside = Camera.from_fov(width_px, round(width_px * 0.72), 90)
        pose = poses[_most_open(mesh, poses)]
        views.append(MeshView("from a pose of the run", perspective_rays(inside, pose), False, None))
    return views


def _fit(camera: Camera, low: np.ndarray, high: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """T_world_camera that looks from direction `towards` at a box and just holds all of it."""
    centre = 0.5 * (low + high)
    corners = np.array(np.meshgrid(*zip(low, high))).reshape(3, -1).T
    pose = se3.look_at(centre + towards, centre)
    p = (corners - centre) @ pose[:3, :3]  # camera axes, origin at the box's centre
    across = np.maximum(np.abs(p[:, 0]) * camera.fx / camera.cx, np.abs(p[:, 1]) * camera.fy / camera.cy)
    distance = float((across - p[:, 2]).max()) * 1.03
    return se3.look_at(centre + distance * towards, centre)


def _bounds(mesh: TriangleMesh) -> tuple[np.ndarray, np.ndarray]:
    """Box of the used vertices without the outermost thousandth, which stray pieces would stretch."""
    points = mesh.vertices[np.unique(mesh.faces)].astype(np.float64)
    return np.percentile(points, 0.1, axis=0), np.percentile(points, 99.9, axis=0)


def _probe(mesh: TriangleMesh, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance (M, R) and facing (M, R) of the surfaces around a coarse fan of rays from every pose."""
    fan = projection.pixel_rays(Camera.from_fov(16, 12, 80)).reshape(-1, 3)
    directions = np.einsum("mij,rj->mri", np.asarray(poses)[:, :3, :3], fan)
    origins = np.broadcast_to(np.asarray(poses)[:, None, :3, 3], directions.shape)
    rays = np.concatenate([origins, directions], axis=-1).reshape(-1, 6).astype(np.float32)
    t, face, _ = SurfaceIndex(mesh.vertices, mesh.faces).cast(rays)
    hit = face != NO_HIT
    facing = np.zeros(len(rays))
    facing[hit] = -np.sign((_face_normals(mesh)[face[hit]] * rays[hit, 3:]).sum(axis=1))
    return t.reshape(len(poses), -1), facing.reshape(len(poses), -1)


def _normals_face_the_room(mesh: TriangleMesh, poses: np.ndarray) -> bool:
    return float(_probe(mesh, poses[:: max(1, len(poses) // 20)])[1].mean()) > 0.3


def _most_open(mesh: TriangleMesh, poses: np.ndarray) -> int:
    """The pose, of about forty, that sees farthest on the median."""
    places = np.arange(0, len(poses), max(1, len(poses) // 40))
    t = _probe(mesh, poses[places])[0]
    return int(places[np.argmax(np.median(np.where(np.isfinite(t), t, 0.0), axis=1))])
