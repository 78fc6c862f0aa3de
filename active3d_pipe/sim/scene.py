"""A scene: triangles with materials in the world frame (metres, Z up), where it ends and where the agent starts."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from active3d_pipe.errors import InputError
from active3d_pipe.geometry.raycasting import SurfaceIndex
from active3d_pipe.sim import placement, readers
from active3d_pipe.sim.config import SceneSettings
from active3d_pipe.sim.digest import scene_name, source_digest
from active3d_pipe.sim.materials import Material
from active3d_pipe.structures import TriangleMesh, check_pose


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A triangle soup with display colours, both sides of every face visible.

    Attributes:
        name: name of the file's folder if the file is called `scene.*`, else of the file.
        vertices: (V, 3) float32 world, m.
        faces: (F, 3) int32 vertex indices.
        face_material: (F,) int32 index into `materials`.
        uv: (F, 3, 2) float32 texture coordinates of each face corner, v downwards (row direction), or None when no
            material has a texture; 1 = one repetition of the image.
        vertex_colors: (V, 3) uint8 display values that multiply the material's colour, or None = white.
        materials: at least one.
        bounds_low, bounds_high: (3,) float64 corners of the explored volume, world, m.
        start_pose: (4, 4) T_world_camera of step 0.
        floor_z: height of the floor, world, m.
        source_digest: sha256 (hex) of the files that the scene was read from.
        up_axis, unit_scale: how the file's axes and units were understood.
        warnings: what was odd about the file, one line each.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    face_material: np.ndarray
    uv: np.ndarray | None
    vertex_colors: np.ndarray | None
    materials: tuple[Material, ...]
    bounds_low: np.ndarray
    bounds_high: np.ndarray
    start_pose: np.ndarray
    floor_z: float
    source_digest: str
    up_axis: str = "Z"
    unit_scale: float = 1.0
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_pose(self.start_pose, f"scene {self.name}: start pose")

    @property
    def surface(self) -> TriangleMesh:
        """The bare triangles: what a reconstruction is compared with. World, m."""
        return TriangleMesh(self.vertices, self.faces)


def load_scene(settings: SceneSettings) -> Scene:
    """Read a scene file and find, or take from `settings`, its up axis, unit, bounds and start pose.

    What `settings` leave open comes from a `scene.json` beside the file (keys `units`, `up_axis`, `start_pose`), and
    what that leaves open from the geometry.

    Raises:
        InputError: the file is missing, malformed, has no faces, or has an extent that no indoor scene has.
    """
    path = readers.scene_path(settings.file)
    soup = readers.read_soup(path)
    sidecar = read_sidecar(path)
    where = f"scene {path}"

    up_axis: str = settings.up_axis
    if up_axis == "auto":
        up_axis = _sidecar_axis(sidecar, path) or placement.find_up_axis(
            soup.vertices, soup.faces, prior="Z" if path.suffix.lower() == ".ply" else "Y"
        )
    vertices = placement.rotate_up(soup.vertices, up_axis)
    scale = settings.unit_scale
    if scale == "auto":
        scale = _sidecar_scale(sidecar, path) or placement.find_unit_scale(vertices, where)
    vertices = (vertices * scale).astype(np.float32)
    placement.check_extent(vertices, where)

    if isinstance(settings.bounds, str):  # "auto" too: simulator and evaluation know the scene, the map does not
        low, high = placement.find_bounds(vertices, soup.faces)
    else:
        low, high = (np.asarray(corner, dtype=np.float64) for corner in settings.bounds)
    if not (high > low).all():
        raise InputError(f"{where}: scene.bounds {low.tolist()} .. {high.tolist()}, expected low < high on every axis")
    floor_z = placement.find_floor(vertices, soup.faces, low[2], high[2])
    start, notes = _start_pose(settings, sidecar, SurfaceIndex(vertices, soup.faces), low, high, floor_z, where)
    return Scene(
        name=scene_name(path), vertices=vertices, faces=soup.faces, face_material=soup.face_material, uv=soup.uv,
        vertex_colors=soup.vertex_colors, materials=soup.materials, bounds_low=low, bounds_high=high, start_pose=start,
        floor_z=floor_z, source_digest=source_digest(str(path)), up_axis=up_axis, unit_scale=float(scale),
        warnings=(*soup.warnings, *notes),
    )


def _start_pose(
    settings: SceneSettings, sidecar: dict[str, Any], surface: SurfaceIndex, low: np.ndarray, high: np.ndarray,
    floor_z: float, where: str,
) -> tuple[np.ndarray, tuple[str, ...]]:
    position: Sequence[float] | None = settings.start_position
    target: Sequence[float] | None = settings.start_look_at
    given = sidecar.get("start_pose")
    if position is None and given is not None:
        try:
            position = [float(given["position"][i]) for i in range(3)]
            target = target or [float(given["look_at"][i]) for i in range(3)]
        except (KeyError, TypeError, ValueError, IndexError) as error:
            expected = "position and look_at of 3 numbers each"
            raise InputError(f"{where}: start_pose in scene.json needs {expected}") from error
    if position is None:
        return placement.find_start_pose(surface, low, high, floor_z, where, look_at=target)
    return placement.given_start_pose(surface, low, high, position, target, where), ()


def read_sidecar(path: Path) -> dict[str, Any]:
    """The `scene.json` beside a scene file, or an empty dictionary when there is none or it is of another file.

    Raises InputError when it cannot be read.
    """
    sidecar = path.with_name("scene.json")
    if not sidecar.is_file():
        return {}
    try:
        document = json.loads(sidecar.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{sidecar}: not readable as JSON ({error}); repair or remove it") from error
    if not isinstance(document, dict):
        raise InputError(f"{sidecar}: expected a JSON object; repair or remove it")
    named = document.get("file")
    return {} if named not in (None, path.name) else document


def _sidecar_axis(sidecar: dict[str, Any], path: Path) -> str | None:
    axis = sidecar.get("up_axis")
    if axis is not None and axis not in placement.UP_AXES:
        raise InputError(f"scene {path}: up_axis in scene.json is {axis!r}, expected one of {list(placement.UP_AXES)}")
    return axis


def _sidecar_scale(sidecar: dict[str, Any], path: Path) -> float | None:
    units = sidecar.get("units")
    if units is None:
        return None
    if isinstance(units, int | float) and units > 0:
        return float(units)
    if units not in placement.UNITS:
        raise InputError(f"scene {path}: units in scene.json is {units!r}, expected one of {list(placement.UNITS)}")
    return placement.UNITS[units]
