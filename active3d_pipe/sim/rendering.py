"""What all renderers share: shading, supersampled edges, the sensor, clearance. A backend adds visibility."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from active3d_pipe.geometry.raycasting import SurfaceIndex
from active3d_pipe.sim import kernels, kernels_edges, kernels_mesh, noise, shading
from active3d_pipe.sim.config import SensorSettings
from active3d_pipe.sim.scene import Scene
from active3d_pipe.structures import Camera, Frame, check_pose

# Colour steps, 0..255. Below the first an edge is not worth more samples (an unresolved edge of step s costs a variance
# of s^2 / 12 in its pixel); from the second on any change of face counts as an edge, for pictures that share a material
# with what surrounds them; a pixel whose first samples and centre differ by more than the third gets the others too.
_CONTRAST, _TEXTURE_CONTRAST, _SPREAD = 6.0, 32.0, 40.0
_CLEARANCE_STEP_M = 0.005


@dataclass(slots=True, eq=False)
class Hits:
    """First surfaces along N rays: `rays` (N, 6), `t` (N,), `face` (N,), `bary` (N, 2), see SurfaceIndex.cast."""

    rays: np.ndarray
    t: np.ndarray
    face: np.ndarray
    bary: np.ndarray


class SurfaceRenderer(ABC):
    """A `Simulator` over a triangle scene.

    Colour: one sample at the pixel centre with the texture filtered over the pixel's footprint; pixels at an edge of
    geometry or material are averaged over further samples instead, shaded once for every face among them. Depth: exact
    at the pixel centre.
    """

    _parts = 1  # in how many parts a backend takes the samples of an edge pixel; the later ones only where they differ

    def __init__(self, scene: Scene, camera: Camera, settings: SensorSettings, seed: int = 0) -> None:
        self._scene, self._camera, self._settings, self._seed = scene, camera, settings, seed
        self._surface = SurfaceIndex(scene.vertices, scene.faces)
        self._packed = shading.pack(scene, self._surface)
        self._centres = np.full((1, 2), 0.5)
        self._all_pixels = np.arange(camera.width * camera.height)

    @property
    def scene(self) -> Scene:
        """The scene."""
        return self._scene

    @property
    def camera(self) -> Camera:
        """Intrinsics of every frame."""
        return self._camera

    @property
    def surface(self) -> SurfaceIndex:
        """Ray and distance queries on the true surface."""
        return self._surface

    @property
    def seed(self) -> int:
        """Seed of the sensor's noise."""
        return self._seed

    @abstractmethod
    def _primary(self, T: np.ndarray) -> Hits:
        """Hits of the rays through all pixel centres, row by row."""

    @abstractmethod
    def _samples(self, T: np.ndarray, pixels: np.ndarray, part: int) -> tuple[np.ndarray, np.ndarray]:
        """Faces (P, K) uint32 at the K samples of a part of the pattern in each of `pixels` (flat), and where in a
        pixel (K, 2) they lie."""

    def render(self, T_world_camera: np.ndarray, *, step: int = 0, stamp_ns: int = 0) -> Frame:
        """See `Simulator.render`."""
        T = check_pose(T_world_camera, f"simulator, step {step}")
        camera = self._camera
        hits = self._primary(T)
        rgb = self._colours(T, hits)
        rgb8 = np.rint(rgb, out=rgb).astype(np.uint8).reshape(camera.height, camera.width, 3)
        rng = noise.frame_generator(self._seed, step)
        depth = noise.apply_depth_sensor(hits.t.reshape(camera.height, camera.width), camera, self._settings, rng)
        return Frame(step, stamp_ns, camera, T, rgb8, depth)

    def depth(self, T_world_camera: np.ndarray) -> np.ndarray:
        """See `Simulator.depth`."""
        camera = self._camera
        t = self._primary(check_pose(T_world_camera, "simulator")).t
        valid = np.isfinite(t) & (t >= camera.near) & (t <= camera.far)
        return np.where(valid, t, 0).astype(np.float32).reshape(camera.height, camera.width)

    def clearance(self, points: np.ndarray) -> np.ndarray:
        """See `Simulator.clearance`."""
        return self.surface.distance(np.asarray(points, dtype=np.float32).reshape(-1, 3))

    def segment_clearance(self, a: np.ndarray, b: np.ndarray) -> float:
        """See `Simulator.segment_clearance`; sampled every 5 mm."""
        a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
        length = float(np.linalg.norm(b - a))
        if length > 0 and bool(self.surface.occluded(a[None], b[None])[0]):
            return 0.0
        s = np.linspace(0, 1, int(np.ceil(length / _CLEARANCE_STEP_M)) + 1)[:, None]
        return float(self.clearance(a + s * (b - a)).min())

    def _colours(self, T: np.ndarray, hits: Hits) -> np.ndarray:
        """(H * W, 3) float32 anti-aliased colours 0..255."""
        camera = self._camera
        rgb, normal = self._shade(T, hits, 1.0)
        if self._settings.edge_samples == 0:
            return rgb
        contrast = np.empty((camera.height, camera.width), np.uint8)
        steps = np.empty((2, camera.height, camera.width), np.float32)
        kernels.edge_contrast(
            hits.rays, hits.t, hits.face, normal, rgb, self._packed.arrays[2], np.float32(_CONTRAST),
            np.float32(_TEXTURE_CONTRAST), steps, contrast,
        )
        self._blend_edges(T, contrast, rgb)
        return rgb

    def _blend_edges(self, T: np.ndarray, marked: np.ndarray, rgb: np.ndarray) -> None:
        """Replace the colours `rgb` (H * W, 3) of the pixels `marked` (H, W) by means over samples."""
        pixels = np.flatnonzero(marked)
        total, count = np.zeros((len(pixels), 3), np.float32), np.zeros(len(pixels), np.float32)
        centre, doubtful = rgb[pixels], np.arange(len(pixels))
        for part in range(self._parts):
            if len(doubtful) == 0:
                break
            seen, offsets = self._samples(T, pixels[doubtful], part)
            sums, spread = self._sum_faces(T, pixels[doubtful], seen, offsets, centre[doubtful])
            total[doubtful] += sums
            count[doubtful] += len(offsets)
            doubtful = doubtful[spread > _SPREAD]
        if len(pixels):
            rgb[pixels] = total / count[:, None]

    def _sum_faces(
        self, T: np.ndarray, pixels: np.ndarray, seen: np.ndarray, offsets: np.ndarray, centre: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Sum of the colours of the samples of each pixel (P, 3), every face shaded once, and their range (P,)."""
        camera, count = self._camera, len(pixels)
        groups, members = np.empty(count, np.int64), np.empty(seen.shape, np.uint32)
        places = np.empty((*seen.shape, 3), np.float32)
        kernels_edges.group_samples(seen, offsets, groups, members, places)
        ends = np.cumsum(groups)
        rays, face = np.empty((ends[-1], 6), np.float32), np.empty(ends[-1], np.uint32)
        kernels_edges.group_rays(
            pixels, ends, groups, members, places, camera.width, np.ascontiguousarray(T), 1 / camera.fx, 1 / camera.fy,
            camera.cx, camera.cy, rays, face,
        )
        colours, _ = self._shade(T, self._on_planes(rays, face), shading.GROUP_FOOTPRINT, shading.GROUP_PROBES)
        sums, spread = np.empty((count, 3), np.float32), np.empty(count, np.float32)
        kernels_edges.sum_groups(ends, groups, places, colours, len(offsets), centre, sums, spread)
        return sums, spread

    def _shade(
        self, T: np.ndarray, hits: Hits, footprint: float, probes: int = shading.MAX_PROBES,
        camera: Camera | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Colours and normals (N, 3) float32 of hits whose samples are `footprint` pixels wide."""
        camera = self._camera if camera is None else camera
        right = (T[:3, 0] * (footprint / camera.fx)).astype(np.float32)
        down = (T[:3, 1] * (footprint / camera.fy)).astype(np.float32)
        rgb = np.empty((len(hits.t), 3), np.float32)
        normal = np.empty((len(hits.t), 3), np.float32)
        kernels.shade(
            hits.rays, hits.t, hits.face, hits.bary, right, down, np.float32(shading.TEXTURE_BIAS), probes,
            rgb, normal, *self._packed.arrays,
        )
        return rgb, normal

    def _rays(
        self, T: np.ndarray, pixels: np.ndarray, offsets: np.ndarray, camera: Camera | None = None
    ) -> np.ndarray:
        """(P * K, 6) float32 rays through points `offsets` (K, 2) of `pixels` (P,)."""
        camera = self._camera if camera is None else camera
        rays = np.empty((len(pixels) * len(offsets), 6), np.float32)
        kernels.sample_rays(
            pixels, offsets, camera.width, np.ascontiguousarray(T), 1 / camera.fx, 1 / camera.fy, camera.cx, camera.cy,
            rays,
        )
        return rays

    def _holes(self, hits: Hits) -> np.ndarray:
        """(N,) bool, hits on holes of alpha masks."""
        a = self._packed.arrays
        out = np.empty(len(hits.face), np.bool_)
        kernels_mesh.holes(hits.face, hits.bary, a[2], self._packed.cutoff, a[3], a[7], a[8], self._packed.alphas, out)
        return out

    def _on_planes(self, rays: np.ndarray, face: np.ndarray) -> Hits:
        """Hits of rays (N, 6) on the faces (N,) that they are known to meet."""
        face = np.ascontiguousarray(face)
        t, bary = np.empty(len(face), np.float32), np.empty((len(face), 2), np.float32)
        kernels_mesh.plane_hits(rays, face, self._packed.arrays[0], self._packed.arrays[1], t, bary)
        return Hits(rays, t, face, bary)
