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


def cell_share(field: RewardField, distance_m: float) -> float:
    """What a look at an open cell is worth of its value."""
    return min(1.0, field.quality_range_m / (distance_m * field.enough_quality))


def cell_bit(point: np.ndarray) -> int:
    """Bit of the half-size cell in which a point lies, voxel units."""
    upper = np.floor(2 * np.asarray(point)).astype(int) % 2
    return int(1 << (4 * upper[0] + 2 * upper[1] + upper[2]))


def sight(field: RewardField, origin: np.ndarray, direction: np.ndarray) -> tuple[list[tuple[int, int, int]], int]:
    """Voxels that a ray crosses, without surface voxels that it passes, and the bit of the cell that stops it."""
    grid = field.grid
    length = field.max_range_m / grid.voxel_size
    out: list[tuple[int, int, int]] = []
    for ijk in traverse(np.zeros(grid.shape, bool), origin, direction, length):
        v = int(np.ravel_multi_index(ijk, grid.shape))
        if field.kind[v] != SURFACE:
            out.append(ijk)
            continue
        with np.errstate(divide="ignore"):
            faces = (np.asarray(ijk)[None] + [[0, 0, 0], [1, 1, 1]] - origin) / direction
        t0, t1 = max(0.0, faces.min(axis=0).max()), faces.max(axis=0).min()
        bits = [cell_bit(origin + (t0 + f * (t1 - t0)) * direction) for f in (1 / 6, 3 / 6, 5 / 6)]
        blocked = [bit for bit in bits if not field.clear[v] & bit]
        if blocked:
            return [*out, ijk], blocked[0]
    return out, 0


def exact_terms(field: RewardField, T_world_camera: np.ndarray, fan: np.ndarray) -> GainTerms:
    """Gain of one view over its unique visible voxels; fan (M, 3) unit rays in the camera frame."""
    grid = field.grid
    origin = (T_world_camera[:3, 3] - grid.origin) / grid.voxel_size
    seen: set[int] = set()
    seen_cells: set[tuple[int, int]] = set()
    reward = surface = imp = exp = visible = unsettled = 0.0
    for ray in fan:
        direction = T_world_camera[:3, :3] @ ray
        transmittance = 1.0
        voxels, bit = sight(field, origin, direction)
        for ijk in voxels:
            v = int(np.ravel_multi_index(ijk, grid.shape))
            distance = grid.voxel_size * float(np.linalg.norm(np.asarray(ijk) + 0.5 - origin))
            if field.kind[v] == SURFACE and field.open_bits[v] & bit and (v, bit) not in seen_cells:
                seen_cells.add((v, bit))
                surface += transmittance * field.cell_value[v] * cell_share(field, distance)
            if v not in seen:
                seen.add(v)
                visible += transmittance * (field.kind[v] != FREE)
                if field.kind[v] == OPEN:
                    reward += transmittance * field.value[v]
                    imp += transmittance * field.gain_imp[v]
                    exp += transmittance * field.gain_exp[v]
                    unsettled += transmittance
                elif field.kind[v] == SURFACE:
                    share, _ = surface_share(field, v, direction, distance)
                    surface += transmittance * field.surface_value[v] * share
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
            point = position + t * direction / size
            ijk = np.floor(point).astype(int)
            if not grid.contains_index(ijk):
                break
            v = int(np.ravel_multi_index(tuple(ijk), grid.shape))
            area = angle * (t / size) ** 2
            if field.kind[v] == SURFACE:
                bit = cell_bit(point)
                if field.clear[v] & bit:
                    t += 0.5 * size
                    continue
                share, cos = surface_share(field, v, direction, t)
                if field.open_bits[v] & bit:
                    out[r] += transmittance * field.cell_value[v] * 4 * area * cell_share(field, t)
                out[r] += transmittance * field.surface_value[v] * share * area / max(cos, LEAST_COS)
                break
            if field.kind[v] != FREE:
                out[r] += transmittance * field.value[v] * area
                transmittance *= field.through[v]
                if transmittance < LEAST_TRANSMITTANCE:
                    break
            t += size
    return out
