"""`scene check`: what was understood of a scene file, in numbers and pictures."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from active3d_pipe.errors import InputError
from active3d_pipe.geometry import se3
from active3d_pipe.sim.config import CameraSettings, SceneSettings, SensorSettings
from active3d_pipe.sim.observable import FreeSpace, reachable_space
from active3d_pipe.sim.placement import face_areas
from active3d_pipe.sim.raycast import RaycastSimulator
from active3d_pipe.sim.scene import Scene, load_scene

_CUT_HEIGHT_M = 1.9  # above the floor: under lintels and lamps, over furniture
_OPEN_WARNING = 0.02
_SMALL_VOLUME_M3 = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class SceneCheck:
    """Summary as JSON values, and pictures (H, W, 3) uint8 by name."""

    summary: dict[str, Any]
    pictures: dict[str, np.ndarray]


def check_scene(
    settings: SceneSettings, camera: CameraSettings | None = None, agent_radius_m: float = 0.2
) -> SceneCheck:
    """Load a scene and report axes, units, bounds, size, free space, start pose and what looks wrong.

    Raises:
        InputError: the scene cannot be loaded at all.
    """
    scene = load_scene(settings)
    sim = RaycastSimulator(scene, (camera or CameraSettings.model_validate({})).camera(),
                           SensorSettings.model_validate({}))
    warnings = list(scene.warnings)
    space = None
    try:
        space = reachable_space(sim, agent_radius_m)
    except InputError as error:
        warnings.append(str(error))
    open_share = _open_share(sim)
    warnings += _warnings(scene, space, open_share)
    return SceneCheck(_summary(settings, sim, space, open_share, warnings), _pictures(sim))


def _summary(
    settings: SceneSettings, sim: RaycastSimulator, space: FreeSpace | None, open_share: float, warnings: list[str]
) -> dict[str, Any]:
    scene = sim.scene
    area, _, _ = face_areas(scene.vertices, scene.faces)
    textured = np.array([len(m.mips) > 0 for m in scene.materials])
    start = scene.start_pose
    return {
        "name": scene.name,
        "file": settings.file,
        "source_digest": scene.source_digest,
        "up_axis": scene.up_axis,
        "unit_scale": scene.unit_scale,
        "bounds": [_numbers(scene.bounds_low), _numbers(scene.bounds_high)],
        "extent_m": _numbers(scene.bounds_high - scene.bounds_low),
        "triangles": len(scene.faces),
        "vertices": len(scene.vertices),
        "materials": len(scene.materials),
        "textured_materials": int(textured.sum()),
        "textured_area_share": round(float(area[textured[scene.face_material]].sum() / area.sum()), 3),
        "vertex_colors": scene.vertex_colors is not None,
        "surface_area_m2": round(float(area.sum()), 1),
        "floor_z": round(scene.floor_z, 3),
        "floor_area_m2": round(_floor_area(sim), 1),
        "reachable_floor_area_m2": None if space is None else round(space.floor_area_m2, 1),
        "reachable_volume_m3": None if space is None else round(space.volume_m3, 1),
        "start_position": _numbers(start[:3, 3]),
        "start_look_at": _numbers(start[:3, 3] + start[:3, 2]),
        "start_clearance_m": round(float(sim.clearance(start[None, :3, 3])[0]), 3),
        "open_share": round(open_share, 4),
        "warnings": warnings,
    }


def _numbers(values: np.ndarray) -> list[float]:
    return [round(float(v), 3) for v in values]


def _open_share(sim: RaycastSimulator) -> float:
    """Share of directions from the start in which no surface is met."""
    rng = np.random.default_rng(0)
    directions = rng.standard_normal((4096, 3))
    position = np.broadcast_to(sim.scene.start_pose[:3, 3], directions.shape)
    t, _, _ = sim.surface.cast(np.concatenate([position, directions], axis=1))
    return float((~np.isfinite(t)).mean())


def _floor_area(sim: RaycastSimulator) -> float:
    """Area, m2, of the places with a surface below and one above, asked at 1.3 m (or half height) over the floor."""
    scene, step = sim.scene, 0.1
    height = min(1.3, 0.5 * (scene.bounds_high[2] - scene.floor_z))
    xs, ys = (np.arange(scene.bounds_low[i] + step / 2, scene.bounds_high[i], step) for i in range(2))
    flat = np.stack([*np.meshgrid(xs, ys, indexing="ij")], axis=-1).reshape(-1, 2)
    points = np.concatenate([flat, np.full((len(flat), 1), scene.floor_z + height)], axis=1)
    enclosed = np.ones(len(points), bool)
    for direction in (-1.0, 1.0):
        rays = np.concatenate([points, np.broadcast_to([0, 0, direction], points.shape)], axis=1)
        enclosed &= np.isfinite(sim.surface.cast(rays)[0])
    return float(enclosed.sum()) * step**2


def _warnings(scene: Scene, space: FreeSpace | None, open_share: float) -> list[str]:
    out = []
    if open_share > _OPEN_WARNING:
        out.append(f"{100 * open_share:.0f} % of directions from the start meet no surface: the scene is not closed")
    if space is not None and space.volume_m3 < _SMALL_VOLUME_M3:
        out.append(f"only {space.volume_m3:.1f} m3 can be reached from the start; check unit_scale and start_position")
    colors = {tuple(np.round(m.base_color, 2)) for m in scene.materials}
    if scene.vertex_colors is None and not any(m.mips for m in scene.materials) and len(colors) == 1:
        out.append("no textures, vertex colours or base colours: surfaces differ by shading alone")
    return out


def _pictures(sim: RaycastSimulator) -> dict[str, np.ndarray]:
    """Four views from the start, a quarter turn apart, and a view from above with everything over 1.9 m cut off."""
    yaw, _ = se3.yaw_pitch(sim.scene.start_pose)
    position = sim.scene.start_pose[:3, 3]
    pictures = {}
    for i, name in enumerate(("start", "start_left", "start_back", "start_right")):
        pictures[name] = sim.render(se3.pose_from_yaw_pitch(position, yaw + i * np.pi / 2, -0.1)).rgb
    scene = sim.scene
    cut = min(scene.floor_z + _CUT_HEIGHT_M, scene.floor_z + 0.75 * (scene.bounds_high[2] - scene.floor_z))
    pictures["top"] = sim.top_view(cut)
    return pictures
