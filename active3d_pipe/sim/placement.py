"""What a scene file leaves open, found from its geometry: up axis, unit, bounds, floor height, start pose."""

from typing import Any

import numpy as np
from scipy import ndimage

from active3d_pipe.errors import InputError
from active3d_pipe.geometry import se3
from active3d_pipe.geometry.raycasting import SurfaceIndex

# Rotation from file axes to Z up, for every axis that may point up.
UP_AXES: dict[str, np.ndarray] = {
    "X": np.array([[0, 0, -1], [0, 1, 0], [1, 0, 0.0]]),
    "Y": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]]),
    "Z": np.eye(3),
    "-X": np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0.0]]),
    "-Y": np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0.0]]),
    "-Z": np.array([[1, 0, 0], [0, -1, 0], [0, 0, -1.0]]),
}
UNITS: dict[str, float] = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "inch": 0.0254, "foot": 0.3048}

CAMERA_HEIGHT_M = 1.3
_INDOOR_HEIGHT_M = (1.8, 14.0)  # height of a plausible scene, one to four storeys
_INDOOR_LENGTH_M = (1.5, 150.0)  # longest side of a plausible scene


def rotate_up(vertices: np.ndarray, up_axis: str) -> np.ndarray:
    """(V, 3) float64 vertices with `up_axis` of the file turned to +Z."""
    return np.asarray(vertices, dtype=np.float64) @ UP_AXES[up_axis].T


def face_areas(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Areas (F,), unit normals (F, 3) and centroids (F, 3), float64, of triangles."""
    a, b, c = (np.asarray(vertices, dtype=np.float64)[faces[:, i]] for i in range(3))
    cross = np.cross(b - a, c - a)
    length = np.linalg.norm(cross, axis=1)
    return 0.5 * length, cross / np.maximum(length, 1e-30)[:, None], (a + b + c) / 3


def find_up_axis(vertices: np.ndarray, faces: np.ndarray, prior: str) -> str:
    """The axis of the file that points up.

    Three clues: rooms are wider than high; floors, ceilings and table tops make the faces across the vertical
    outweigh those across a horizontal axis, in particular at the two ends of the extent; and furniture stands on the
    floor, so the area between floor and ceiling has its centre below the middle. `prior` (the format's
    habit) decides close calls.
    """
    area, normal, centroid = face_areas(vertices, faces)
    low, high = weighted_range(centroid, area, 0.001)
    total = area.sum()
    scores = np.zeros(3)
    for axis in range(3):
        level = np.abs(normal[:, axis]) > 0.98
        height = (centroid[:, axis] - low[axis]) / max(high[axis] - low[axis], 1e-12)
        bottom, top = area[level & (height < 0.15)].sum(), area[level & (height > 0.85)].sum()
        middle = area[level & (height >= 0.15) & (height <= 0.85)].sum()
        scores[axis] = (bottom + top + 0.5 * middle) / total
    scores /= np.maximum(high - low, 1e-12)
    scores["XYZ".index(prior[-1])] *= 1.2
    axis = int(np.argmax(scores))
    height = (centroid[:, axis] - low[axis]) / max(high[axis] - low[axis], 1e-12)
    inner = (height > 0.08) & (height < 0.92)
    mean = np.average(height[inner], weights=area[inner]) if area[inner].sum() > 0 else 0.5
    return ("" if mean < 0.52 else "-") + "XYZ"[axis]


def find_unit_scale(vertices: np.ndarray, where: str) -> float:
    """Metres per unit: the first of m, mm, cm, inch, foot that gives a plausible indoor height and length.

    `vertices` (V, 3) in file units with Z up. Raises InputError when none does.
    """
    extent = np.ptp(vertices, axis=0)
    for unit in ("m", "mm", "cm", "inch", "foot"):
        height, length = extent[2] * UNITS[unit], extent.max() * UNITS[unit]
        if _INDOOR_HEIGHT_M[0] <= height <= _INDOOR_HEIGHT_M[1] and length <= _INDOOR_LENGTH_M[1]:
            return UNITS[unit]
    size = " x ".join(f"{e:.3g}" for e in extent)
    raise InputError(
        f"{where}: an extent of {size} units fits no indoor scene in m, cm, mm, inch or foot; set scene.unit_scale"
    )


def check_extent(vertices: np.ndarray, where: str) -> None:
    """Raise InputError when a scene in metres is too small to be entered or too large to be mapped."""
    extent = np.ptp(np.asarray(vertices, dtype=np.float64), axis=0)
    if extent.max() < _INDOOR_LENGTH_M[0] or extent.min() <= 0.1 or extent.max() > 4 * _INDOOR_LENGTH_M[1]:
        size = " x ".join(f"{e:.3g}" for e in extent)
        raise InputError(
            f"{where}: {size} m is no indoor scene (expected {_INDOOR_LENGTH_M[0]} to "
            f"{4 * _INDOOR_LENGTH_M[1]:.0f} m); check scene.unit_scale"
        )


def weighted_range(points: np.ndarray, weights: np.ndarray, tail: float) -> tuple[np.ndarray, np.ndarray]:
    """(3,) low and high of points (N, 3) such that a share `tail` of the weight lies beyond each, per axis."""
    low, high = np.zeros(3), np.zeros(3)
    for axis in range(3):
        order = np.argsort(points[:, axis], kind="stable")
        values = points[order, axis]
        share = np.cumsum(weights[order])
        share /= share[-1]
        low[axis] = values[int(np.searchsorted(share, tail))]
        high[axis] = values[min(int(np.searchsorted(share, 1 - tail)), len(values) - 1)]
    return low, high


def find_bounds(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners (3,), (3,) of the explored volume: the bounding box, less far-off debris, with 5 cm around it.

    Debris is what lies more than 1 m outside the box that holds all but 0.05 % of the surface at either end.
    """
    area, _, centroid = face_areas(vertices, faces)
    size = np.linalg.norm(np.ptp(vertices[faces], axis=1), axis=1)
    core_low, core_high = weighted_range(centroid, area, 0.0005)
    near = ((centroid > core_low - 1.0 - size[:, None]) & (centroid < core_high + 1.0 + size[:, None])).all(axis=1)
    corners = vertices[faces[near]].reshape(-1, 3).astype(np.float64)
    return corners.min(axis=0) - 0.05, corners.max(axis=0) + 0.05


def find_floor(vertices: np.ndarray, faces: np.ndarray, low_z: float, high_z: float) -> float:
    """Height of the floor: the lowest level that carries at least half the area of the largest one below mid-height."""
    area, normal, centroid = face_areas(vertices, faces)
    level = np.abs(normal[:, 2]) > 0.95
    edges = np.arange(low_z, high_z + 0.05, 0.05)
    height = centroid[level, 2]
    histogram, _ = np.histogram(height, bins=edges, weights=area[level])
    lower = histogram[: max(len(histogram) // 2, 1)]
    if lower.max(initial=0) <= 0:
        return float(low_z)
    first = int(np.argmax(lower >= 0.5 * lower.max()))
    inside = level.copy()
    inside[level] = (height >= edges[first]) & (height <= edges[first + 1])
    return float(np.average(centroid[inside, 2], weights=area[inside]))


def given_start_pose(
    surface: SurfaceIndex, low: np.ndarray, high: np.ndarray, position: Any, target: Any, where: str
) -> np.ndarray:
    """T_world_camera at a given position; looks at `target` (3,), or, when None, where it is open.

    Raises InputError when the position lies outside the bounds or within 5 cm of a surface.
    """
    position = np.asarray(position, dtype=np.float64)
    if not ((position > low) & (position < high)).all():
        raise InputError(
            f"{where}: start position {np.round(position, 2).tolist()} lies outside the bounds "
            f"{np.round(low, 2).tolist()} .. {np.round(high, 2).tolist()}"
        )
    clearance = float(surface.distance(position[None])[0])
    if clearance < 0.05:
        raise InputError(
            f"{where}: start position {np.round(position, 2).tolist()} is {100 * clearance:.1f} cm from a surface; "
            "give one at least 5 cm away (scene.start_position), or none to have it found"
        )
    if target is None:
        target = open_direction(surface, position)
    if np.linalg.norm(np.asarray(target) - position) < 1e-6:
        raise InputError(f"{where}: scene.start_look_at equals the start position; give another point")
    return se3.look_at(position, target)


def find_start_pose(
    surface: SurfaceIndex, low: np.ndarray, high: np.ndarray, floor_z: float, where: str, look_at: Any = None
) -> tuple[np.ndarray, tuple[str, ...]]:
    """A start pose in the largest free component 1.3 m above the floor, far from surfaces, looking where it is open.

    Free is a place that has a floor below and a ceiling above; in a scene without ceilings a floor is enough, and a
    warning says so. Raises InputError when there is no free place.
    """
    notes: tuple[str, ...] = ()
    for height in (CAMERA_HEIGHT_M, 0.9, 0.5 * (high[2] - floor_z)):
        z = floor_z + height
        step = max(0.1, float(np.sqrt(np.prod(high[:2] - low[:2]) / 200_000)))
        xs, ys = (np.arange(low[i] + step / 2, high[i], step) for i in range(2))
        points = np.stack([*np.meshgrid(xs, ys, indexing="ij"), np.full((len(xs), len(ys)), z)], -1).astype(np.float32)
        shape = points.shape[:2]
        flat = points.reshape(-1, 3)
        clearance = surface.distance(flat).reshape(shape)
        down, up = (_reach(surface, flat, s).reshape(shape) for s in (-1.0, 1.0))
        free = (clearance > 0.25) & (down > 0.5 * height) & (down < height + 0.6)
        roofed = free & np.isfinite(up)
        if not roofed.any() and free.any():
            notes = ("no ceiling above the free space",)
            roofed = free
        if roofed.any():
            position = _most_open(points, clearance, roofed)
            target = open_direction(surface, position) if look_at is None else look_at
            return se3.look_at(position, target), notes
    raise InputError(f"{where}: no free space found above the floor at z = {floor_z:.2f} m; set scene.start_position")


def _reach(surface: SurfaceIndex, points: np.ndarray, direction_z: float) -> np.ndarray:
    """(N,) distance along +z or -z to the first surface, inf where there is none."""
    rays = np.concatenate([points, np.broadcast_to(np.array([0, 0, direction_z], np.float32), points.shape)], axis=1)
    return surface.cast(rays)[0]


def _most_open(points: np.ndarray, clearance: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Of the largest component of `free` (X, Y), the place nearest its centre among those with much clearance."""
    labels, count = ndimage.label(free)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    sizes[0] = 0
    member = labels == int(np.argmax(sizes))
    enough = member & (clearance >= min(0.8, 0.8 * float(clearance[member].max())))
    centre = points[member].mean(axis=0)
    candidates = points[enough]
    return candidates[int(np.argmin(((candidates - centre) ** 2).sum(axis=1)))].astype(np.float64)


def open_direction(surface: SurfaceIndex, position: np.ndarray) -> np.ndarray:
    """(3,) point to look at from `position`: the horizontal direction with the longest mean sight over 60 degrees."""
    yaw = np.arange(72) * (2 * np.pi / 72)
    directions = np.stack([np.cos(yaw), np.sin(yaw), np.full(72, -0.1)], axis=-1)
    rays = np.concatenate([np.broadcast_to(position, directions.shape), directions], axis=1)
    sight = np.minimum(surface.cast(rays)[0], 8.0)
    mean = ndimage.uniform_filter1d(sight, 13, mode="wrap")
    return position + directions[int(np.argmax(mean))]
