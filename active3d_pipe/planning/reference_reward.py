"""Slow, obvious twins of `kernels_reward.py`, float64; what the tests compare the kernels against."""

import numpy as np

from active3d_pipe.geometry.reference_traversal import traverse
from active3d_pipe.information.gain import FREE, OPEN, SURFACE, GainTerms, view_quality
from active3d_pipe.planning.reward import RewardField

LEAST_COS = 0.2
LEAST_TRANSMITTANCE = 0.02


def surface_share(field: RewardField, v: int, direction: np.ndarray, distance_m: float) -> tuple[float, float]:
    """(share of the improvement of surface voxel `v` that a look brings, |cos| of its incidence angle)."""
    normal = field.normal[v].astype(float)
    norm = np.linalg.norm(normal)
    cos = min(1.0, float(abs(normal @ direction) / norm)) if norm > 1 else 0.7
    enough = field.enough_quality
    new = float(view_quality(cos, distance_m, field.quality_range_m))
    return max(0.0, min(new, enough) - float(field.quality[v])) / enough, cos


def side_share(field: RewardField, v: int, direction: np.ndarray, distance_m: float) -> float:
    """What a look from a side that surface voxel `v` was not seen from is worth."""
    octant = sum(2**axis for axis in range(3) if direction[axis] > 0)
    if field.sides[v] & 2**octant:
        return 0.0
    return field.side_weight * min(1.0, field.quality_range_m / (distance_m * field.enough_quality))


def exact_terms(field: RewardField, T_world_camera: np.ndarray, fan: np.ndarray) -> GainTerms:
    """Gain of one view over its unique visible voxels; fan (M, 3) unit rays in the camera frame."""
    grid = field.grid
    origin = (T_world_camera[:3, 3] - grid.origin) / grid.voxel_size
    opaque = field.opaque.reshape(grid.shape).astype(bool)
    seen: set[int] = set()
    reward = surface = imp = exp = visible = unsettled = 0.0
    for ray in fan:
        direction = T_world_camera[:3, :3] @ ray
        transmittance = 1.0
        for ijk in traverse(opaque, origin, direction, field.max_range_m / grid.voxel_size):
            v = int(np.ravel_multi_index(ijk, grid.shape))
            if v not in seen:
                seen.add(v)
                visible += transmittance
                if field.kind[v] == OPEN:
                    reward += transmittance * field.value[v]
                    imp += transmittance * field.gain_imp[v]
                    exp += transmittance * field.gain_exp[v]
                    unsettled += transmittance
                elif field.kind[v] == SURFACE:
                    distance = grid.voxel_size * float(np.linalg.norm(np.asarray(ijk) + 0.5 - origin))
                    share, _ = surface_share(field, v, direction, distance)
                    side = side_share(field, v, direction, distance)
                    surface += transmittance * field.surface_value[v] * (share + side)
                    left = 1 - field.quality[v] / field.enough_quality
                    if left > 0:
                        imp += transmittance * share / left * field.gain_imp[v]
                        exp += transmittance * share / left * field.gain_exp[v]
            if field.kind[v] == OPEN:
                transmittance *= float(field.through[v]) ** (1 / np.abs(direction).sum())
                if transmittance < LEAST_TRANSMITTANCE:
                    break
    return GainTerms(
        float(reward + surface), float(surface), float(imp), float(exp), round(visible), round(unsettled)
    )


def sphere_gain(field: RewardField, position: np.ndarray, rays: np.ndarray, solid_angles: np.ndarray) -> np.ndarray:
    """Reward per ray of a sphere (M,), without jumping over free space; position in voxel units."""
    grid, size = field.grid, field.grid.voxel_size
    out = np.zeros(len(rays))
    for r, (direction, angle) in enumerate(zip(rays, solid_angles, strict=True)):
        transmittance, t = 1.0, 0.5 * size
        while t < field.max_range_m:
            ijk = np.floor(position + t * direction / size).astype(int)
            if not grid.contains_index(ijk):
                break
            v = int(np.ravel_multi_index(tuple(ijk), grid.shape))
            area = angle * (t / size) ** 2
            if field.kind[v] == SURFACE:
                share, cos = surface_share(field, v, direction, t)
                share += side_share(field, v, direction, t)
                out[r] += transmittance * field.surface_value[v] * share * area / max(cos, LEAST_COS)
                break
            if field.kind[v] != FREE:
                out[r] += transmittance * field.value[v] * area
                transmittance *= field.through[v]
                if transmittance < LEAST_TRANSMITTANCE:
                    break
            t += size
    return out
