"""Building blocks of generated scenes: triangles by material, with texture coordinates in metres.

Frames: pieces are built in a local frame (x along the wall, y away from the wall, z up, metres) and placed by
`MeshBuilder.placed`. Texture coordinates are metres over the material's period, v up (the GLB writer flips v).
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

Painter = Callable[[np.random.Generator, int], np.ndarray]
Vector = Sequence[float] | np.ndarray
Points = Sequence[Sequence[float]] | Sequence[np.ndarray] | np.ndarray


@dataclass(frozen=True, eq=False)
class Material:
    """A surface: `paint(rng, pixels)` gives an (n, n, 3) image of display values in 0..1.

    `metres` is the side of the square that one copy of the image covers (1 for images fitted to a face);
    `pixels` the side of the image at detail 1; `grain` turns u along the longest edge of a box.
    """

    name: str
    paint: Painter
    metres: float = 1.28
    pixels: int = 512
    grain: bool = False


@dataclass
class Part:
    """Triangles of one material."""

    material: Material
    vertices: list[np.ndarray] = field(default_factory=list)
    faces: list[np.ndarray] = field(default_factory=list)
    uv: list[np.ndarray] = field(default_factory=list)
    count: int = 0


_CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float64)
_QUAD = np.array([[0, 1, 2], [0, 2, 3]])
# The six faces of a box: axis of the normal, its sign, the two axes that span it.
_BOX_FACES = {
    "-x": (0, 0, 1, 2),
    "+x": (0, 1, 1, 2),
    "-y": (1, 0, 0, 2),
    "+y": (1, 1, 0, 2),
    "-z": (2, 0, 0, 1),
    "+z": (2, 1, 0, 1),
}


class MeshBuilder:
    """Collects triangles; `detail` scales the number of segments of curved surfaces."""

    def __init__(self, rng: np.random.Generator, detail: float = 1.0) -> None:
        self.parts: dict[str, Part] = {}
        self.detail = detail
        self._rng = rng
        self._transform = np.eye(4)
        self._shift = np.zeros(2)

    def segments(self, full: int, least: int = 4) -> int:
        """Number of segments of a curve that has `full` at detail 1."""
        return max(least, round(full * min(self.detail, 2.0) ** 0.5))

    @contextmanager
    def placed(
        self, x: float = 0.0, y: float = 0.0, z: float = 0.0, *, yaw: float = 0.0, tilt: float = 0.0, roll: float = 0.0
    ) -> Iterator[None]:
        """Nested frame: rotate by `tilt` about x, `roll` about y, then `yaw` about z (rad), and translate (m)."""
        before, shift = self._transform, self._shift
        cz, sz, cx, sx = math.cos(yaw), math.sin(yaw), math.cos(tilt), math.sin(tilt)
        cy, sy = math.cos(roll), math.sin(roll)
        turn = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
        turn = (
            turn @ np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]]) @ np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
        )
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = turn, (x, y, z)
        self._transform = before @ T
        self._shift = self._rng.random(2)
        try:
            yield
        finally:
            self._transform, self._shift = before, shift

    def add(
        self, material: Material, vertices: np.ndarray, faces: np.ndarray, uv_m: np.ndarray, *, fit: bool = False
    ) -> None:
        """Append triangles: vertices (V, 3) local m, faces (F, 3), uv (V, 2) in m, or in 0..1 when `fit`."""
        part = self.parts.setdefault(material.name, Part(material))
        part.vertices.append(vertices @ self._transform[:3, :3].T + self._transform[:3, 3])
        part.faces.append(faces + part.count)
        part.uv.append(uv_m if fit else uv_m / material.metres + self._shift)
        part.count += len(vertices)

    def quad(self, material: Material, corners: Points, uv: Points | None = None) -> None:
        """A rectangle from four corners, counter-clockwise from lower left; `uv` (4, 2) in 0..1 or None for metres."""
        points = np.asarray(corners, dtype=np.float64)
        if uv is None:
            size = np.linalg.norm(points[[1, 3]] - points[0], axis=1)
            self.add(material, points, _QUAD, _CORNERS * size)
        else:
            self.add(material, points, _QUAD, np.asarray(uv, dtype=np.float64), fit=True)

    def box(self, material: Material, low: Vector, high: Vector, *, skip: Sequence[str] = ()) -> None:
        """An axis-aligned box without the faces named in `skip` ("-x", "+z", ...); box mapping in metres."""
        ends = np.array([low, high], dtype=np.float64)
        size = ends[1] - ends[0]
        vertices: list[np.ndarray] = []
        uvs: list[np.ndarray] = []
        faces: list[np.ndarray] = []
        for name, (axis, side, a, b) in _BOX_FACES.items():
            if name in skip:
                continue
            p = np.empty((4, 3))
            p[:, axis] = ends[side, axis]
            p[:, a] = ends[0, a] + _CORNERS[:, 0] * size[a]
            p[:, b] = ends[0, b] + _CORNERS[:, 1] * size[b]
            uv = p[:, [a, b]] + 0.37 * axis + 0.21 * side
            uvs.append(uv[:, ::-1] if material.grain and size[b] > size[a] else uv)
            flip = (side == 1) == (axis == 1)
            faces.append((_QUAD[:, ::-1] if flip else _QUAD) + 4 * len(vertices))
            vertices.append(p)
        self.add(material, np.concatenate(vertices), np.concatenate(faces), np.concatenate(uvs))

    def grid(self, material: Material, points: np.ndarray, uv: np.ndarray | None = None) -> None:
        """A surface patch (n, m, 3); texture coordinates by arc length, or `uv` (n, m, 2) fitted to 0..1."""
        n, m = points.shape[:2]
        index = np.arange(n * m).reshape(n, m)
        a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
        faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
        if uv is not None:
            self.add(material, points.reshape(-1, 3), faces, uv.reshape(-1, 2), fit=True)
            return
        u = np.zeros((n, m))
        v = np.zeros((n, m))
        u[1:] = np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=2).max(axis=1))[:, None]
        v[:, 1:] = np.cumsum(np.linalg.norm(np.diff(points, axis=1), axis=2).max(axis=0))[None]
        self.add(material, points.reshape(-1, 3), faces, np.stack([u, v], -1).reshape(-1, 2))

    def revolve(
        self, material: Material, profile: Sequence[tuple[float, float]], *, segments: int = 24, aspect: float = 1.0
    ) -> None:
        """Surface of revolution about z: `profile` is (radius, z) m; `aspect` stretches y (ellipses)."""
        n = self.segments(segments, 6)
        p = np.asarray(profile, dtype=np.float64)
        angle = np.linspace(0, 2 * math.pi, n + 1)
        ring = np.stack([np.cos(angle), aspect * np.sin(angle)], -1)
        points = np.concatenate(
            [p[None, :, :1] * ring[:, None, :], np.broadcast_to(p[None, :, 1:], (n + 1, len(p), 1))], axis=-1
        )
        self.grid(material, points)

    def revolve_at(self, material: Material, position: Vector, profile: Sequence[tuple[float, float]]) -> None:
        """`revolve` about a vertical axis through `position`."""
        with self.placed(*(float(x) for x in position)):
            self.revolve(material, profile)

    def tube(self, material: Material, path: Points | Sequence[Vector], radius: float, *, segments: int = 8) -> None:
        """A round rod along a polyline (K, 3), capped by closing the end rings."""
        n = self.segments(segments, 5)
        p = np.asarray(path, dtype=np.float64)
        tangent = np.gradient(p, axis=0)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        helper = np.where(np.abs(tangent[:, 2:]) > 0.9, [[1.0, 0, 0]], [[0, 0, 1.0]])
        side = np.cross(tangent, helper)
        side /= np.linalg.norm(side, axis=1, keepdims=True)
        other = np.cross(tangent, side)
        angle = np.linspace(0, 2 * math.pi, n + 1)[:, None, None]
        points = p[None] + radius * (np.cos(angle) * side[None] - np.sin(angle) * other[None])
        ends = np.broadcast_to(p[[0, -1]], (n + 1, 2, 3))
        self.grid(material, np.concatenate([ends[:, :1], points, ends[:, 1:]], axis=1))

    def cushion(
        self, material: Material, low: Vector, high: Vector, *, radius: float = 0.05, bulge: float = 0.0, steps: int = 3
    ) -> None:
        """A box with rounded edges whose broad faces (normal = shortest axis) swell by `bulge` m."""
        low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
        size = high - low
        radius = min(radius, 0.49 * size.min())
        k = self.segments(steps, 2)
        arc = radius * (1 - np.tan(np.linspace(math.pi / 4, 0, k + 1)))
        axes = []
        for i in range(3):
            middle = np.linspace(radius, size[i] - radius, 2 + (k if bulge else 0))
            axes.append(low[i] + np.concatenate([arc[:-1], middle, size[i] - arc[-2::-1]]))
        broad = int(np.argmin(size))
        for axis, side, a, b in _BOX_FACES.values():
            pa, pb = np.meshgrid(axes[a], axes[b], indexing="ij")
            p = np.empty((*pa.shape, 3))
            p[..., a], p[..., b], p[..., axis] = pa, pb, (low, high)[side][axis]
            uv = p[..., [a, b]]
            inner = np.clip(p, low + radius, high - radius)
            out = p - inner
            out *= radius / np.maximum(np.linalg.norm(out, axis=-1, keepdims=True), 1e-12)
            p = inner + out
            if bulge:
                t = 2 * (p - low) / size - 1
                others = [i for i in range(3) if i != broad]
                swell = np.clip(1 - t[..., others] ** 2, 0, 1).prod(axis=-1)
                p[..., broad] += np.sign(t[..., broad]) * bulge * swell
            if (side == 1) == (axis == 1):
                p, uv = p[::-1], uv[::-1]
            shifted = uv / material.metres + self._shift + 0.37 * axis
            self.grid(material, p, shifted)
