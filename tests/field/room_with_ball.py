"""An analytic scene: a closed room with a ball in it."""

import numpy as np

from active3d_pipe.geometry.projection import in_image, pixel_rays, project
from active3d_pipe.structures import Frame

LOW, HIGH = np.array([-1.0, -1.2, 0.0]), np.array([1.0, 1.2, 1.6])
SPHERE, RADIUS = np.array([0.2, -0.1, 0.7]), 0.35


def scene_sdf(points):
    """A closed room with a ball in it: exact distance to the nearest surface, m."""
    walls = np.minimum(points - LOW, HIGH - points).min(axis=-1)
    return np.minimum(walls, np.linalg.norm(points - SPHERE, axis=-1) - RADIUS)


def scene_color(points):
    ball = np.linalg.norm(points - SPHERE, axis=-1) < RADIUS + 0.02
    return np.where(ball[..., None], [0.9, 0.2, 0.1], [0.2, 0.5, 0.8])


def render(camera, T, step=0):
    """Exact depth of the room with the ball, by intersection."""
    d = pixel_rays(camera).astype(np.float64) @ T[:3, :3].T
    o = T[:3, 3]
    with np.errstate(divide="ignore"):
        t = np.maximum((LOW - o) / d, (HIGH - o) / d).min(axis=-1)
    a, b, c = (d * d).sum(-1), d @ (o - SPHERE), ((o - SPHERE) ** 2).sum() - RADIUS**2
    disc = b * b - a * c
    hit = (-b - np.sqrt(np.maximum(disc, 0))) / a
    z = np.where((disc > 0) & (hit > 0), np.minimum(t, hit), t)
    rgb = (255 * scene_color(o + z[..., None] * d)).astype(np.uint8)
    return Frame(step, step, camera, T, rgb, z.astype(np.float32))


def seen_by(frames, points):
    """(N,) bool, surface points that at least one frame shows."""
    seen = np.zeros(len(points), bool)
    for f in frames:
        uv, z = project(points, f.T_world_camera, f.camera)
        at = np.flatnonzero(in_image(uv, z, f.camera))
        j, i = uv[at].astype(int).T
        seen[at] |= np.abs(z[at] - f.depth[i, j]) < 0.03
    return seen
