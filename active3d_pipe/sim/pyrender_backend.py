"""The second renderer: OpenGL by pyrender (EGL, software or hardware).

The rasteriser answers one question, which face is seen where: every face is drawn in a colour that is its number,
at three times the resolution, so that the middle one of a pixel's 3 x 3 samples lies on the pixel's centre. Depth,
shading and filtering then follow exactly as in the ray caster.
"""

import functools
import os
from typing import Any

import numpy as np

from active3d_pipe.errors import Active3dError, ConfigError
from active3d_pipe.sim import kernels
from active3d_pipe.sim.config import SensorSettings
from active3d_pipe.sim.rendering import Hits, SurfaceRenderer
from active3d_pipe.sim.scene import Scene
from active3d_pipe.structures import Camera

_GRID = 3
_MAX_FACES = (1 << 24) - 1
_NEAR_M, _FAR_M = 0.01, 200.0
# pyrender's camera looks along -z with y up; ours along +z with y down.
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def import_pyrender() -> Any:
    """Import pyrender with EGL unless PYOPENGL_PLATFORM says otherwise, mended for today's NumPy and without MSAA.

    pyrender 0.1.45 uses `np.infty`, which NumPy 2 dropped, and always multisamples, which moves the point at which a
    pixel's depth is taken and would mix face numbers.
    """
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    if not hasattr(np, "infty"):
        setattr(np, "infty", np.inf)  # noqa: B010
    try:
        import pyrender
        import pyrender.renderer
    except (ImportError, AttributeError, OSError) as error:
        raise Active3dError(f"pyrender cannot be imported ({error}); use sensor.backend = 'raycast'") from error
    module = pyrender.renderer
    if not getattr(module, "_active3d_single_sample", False):
        original = module.glRenderbufferStorageMultisample

        def single_sample(target: Any, samples: Any, *rest: Any) -> Any:
            return original(target, 0, *rest)

        module.glRenderbufferStorageMultisample = single_sample
        module._active3d_single_sample = True
    return pyrender


@functools.cache
def _process_renderer() -> Any:
    pyrender = import_pyrender()
    try:
        return pyrender.OffscreenRenderer(64, 64)
    except Exception as error:  # PyOpenGL raises many classes for the one fact that there is no context
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise Active3dError(
            f"pyrender cannot make an OpenGL context ({reason}); install libegl1 and libegl-mesa0, "
            "or use sensor.backend = 'raycast'"
        ) from error


def shared_renderer(width: int, height: int) -> Any:
    """The process's one offscreen renderer, set to an image size: closing one pyrender context ends all others.

    Raises:
        Active3dError: the machine can make no OpenGL context.
    """
    renderer = _process_renderer()
    if (renderer.viewport_width, renderer.viewport_height) != (width, height):
        renderer.viewport_width, renderer.viewport_height = width, height
    return renderer


class PyrenderSimulator(SurfaceRenderer):
    """A `Simulator` on pyrender. Alpha masks: behind a hole the nearest surface without holes is seen."""

    def __init__(self, scene: Scene, camera: Camera, settings: SensorSettings, seed: int = 0) -> None:
        if len(scene.faces) > _MAX_FACES:
            raise ConfigError(f"pyrender draws at most {_MAX_FACES} faces, not {len(scene.faces)}; use raycast")
        super().__init__(scene, camera, settings, seed)
        self._pyrender = import_pyrender()
        self._size = (_GRID * camera.width, _GRID * camera.height)
        shared_renderer(*self._size)  # fails now rather than at the first frame
        everything = np.arange(len(scene.faces))
        self._gl_scene = self._pyrender.Scene(bg_color=(0.0, 0.0, 0.0, 0.0))
        self._passes = [self._face_mesh(everything)]
        solid = everything[self._packed.cutoff[scene.face_material] < 0]
        if 0 < len(solid) < len(everything):
            self._passes.append(self._face_mesh(solid))
        self._lens = self._gl_scene.add(
            self._pyrender.IntrinsicsCamera(
                _GRID * camera.fx, _GRID * camera.fy, _GRID * camera.cx, _GRID * camera.cy, znear=_NEAR_M, zfar=_FAR_M
            )
        )
        self._offsets = np.stack(np.meshgrid(*2 * [(np.arange(_GRID) + 0.5) / _GRID]), axis=-1).reshape(-1, 2)
        self._last: tuple[bytes, list[np.ndarray]] = (b"", [])

    def _face_mesh(self, faces: np.ndarray) -> Any:
        """A pyrender mesh of some faces, each in the colour of its number + 1."""
        pr = self._pyrender
        number = faces + 1
        color = np.stack([number & 255, (number >> 8) & 255, (number >> 16) & 255, np.full(len(faces), 255)], axis=-1)
        primitive = pr.Primitive(
            positions=self._scene.vertices[self._scene.faces[faces]].reshape(-1, 3),
            color_0=np.repeat(color.astype(np.float32) / 255, 3, axis=0), mode=4,
            material=pr.MetallicRoughnessMaterial(baseColorFactor=(1.0, 1.0, 1.0, 1.0), doubleSided=True),
        )
        mesh = pr.Mesh([primitive])
        self._gl_scene.add(mesh)
        return mesh

    def _faces_seen(self, T: np.ndarray) -> list[np.ndarray]:
        """Per pass the face (3 H, 3 W) uint32 at every sample of the image; the last pose is remembered."""
        if self._last[0] == T.tobytes():
            return self._last[1]
        flags = self._pyrender.RenderFlags
        seen = []
        renderer = shared_renderer(*self._size)
        self._gl_scene.set_pose(self._lens, T @ _FLIP)
        for shown in self._passes:
            for mesh in self._passes:
                mesh.is_visible = mesh is shown
            image, _ = renderer.render(self._gl_scene, flags=flags.FLAT | flags.SKIP_CULL_FACES)
            number = image[..., :3].astype(np.uint32) @ np.array([1, 1 << 8, 1 << 16], np.uint32)
            seen.append(number - np.uint32(1))  # 0 = background wraps round to NO_HIT
        self._last = (T.tobytes(), seen)
        return seen

    def _primary(self, T: np.ndarray) -> Hits:
        faces = [seen[_GRID // 2 :: _GRID, _GRID // 2 :: _GRID].reshape(-1) for seen in self._faces_seen(T)]
        return self._resolve(self._rays(T, self._all_pixels, self._centres), faces)

    def _samples(self, T: np.ndarray, pixels: np.ndarray, part: int) -> tuple[np.ndarray, np.ndarray]:
        height, width = self._camera.height, self._camera.width
        faces = [
            seen.reshape(height, _GRID, width, _GRID).transpose(0, 2, 1, 3).reshape(-1, _GRID**2)[pixels].reshape(-1)
            for seen in self._faces_seen(T)
        ]
        hits = self._resolve(self._rays(T, pixels, self._offsets), faces)
        return hits.face.reshape(len(pixels), -1), self._offsets

    def _resolve(self, rays: np.ndarray, faces: list[np.ndarray]) -> Hits:
        """Hits of rays whose faces the rasteriser found: of the first pass, and of the second where that is a hole."""
        hits = self._on_planes(rays, faces[0])
        if self._packed.has_holes:
            hole = self._holes(hits)
            behind = faces[1] if len(faces) > 1 else np.full_like(faces[0], kernels.NO_HIT)
            hits = self._on_planes(rays, np.where(hole, behind, faces[0]))
        return hits
