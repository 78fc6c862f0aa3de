"""The slow twin of `kernels_volumes.py`: the same formulas over whole volumes."""

import numpy as np

from active3d_pipe.information.gain import FREE, OPEN
from active3d_pipe.planning.kernels_volumes import LEAST

# Bits of the cells in the lower and the upper half of a voxel, along x, y, z.
HALVES = ((0x0F, 0xF0), (0x33, 0xCC), (0x55, 0xAA))


def joint_occupancy(
    free: np.ndarray, hit: np.ndarray, occupancy: np.ndarray, sdf: np.ndarray, trust_rays: float, softness: float
) -> np.ndarray:
    """p = c O + (1 - c) P(SDF < 0) with c = n / (n + trust_rays) for n rays; 1 where there was none."""
    rays = free + hit
    trust = rays / (rays + np.float32(trust_rays))
    p_imp = 1 / (1 + np.exp(np.clip(sdf / np.float32(softness), -30, 30)))
    return np.where(rays > 0, trust * occupancy + (1 - trust) * p_imp, np.float32(1)).astype(np.float32)


def free_by_rays(
    free: np.ndarray, hit: np.ndarray, occupancy: np.ndarray, least_rays: float, most_occupancy: float
) -> np.ndarray:
    """(X, Y, Z) bool."""
    return (free >= least_rays) & (occupancy <= np.float32(most_occupancy)) & (hit < 2 + np.float32(0.02) * free)


def drop_half_seen(free: np.ndarray, passed: np.ndarray) -> np.ndarray:
    """`free` without voxels whose half towards a neighbour that is not free was passed by no ray."""
    blocked, cells_of, out = ~free, passed.astype(np.uint8), free.copy()
    for axis, (lower, upper) in enumerate(HALVES):
        kept, beside, cells = (np.moveaxis(a, axis, 0) for a in (out, blocked, cells_of))
        kept[1:] &= ~(beside[:-1] & (cells[1:] & lower == 0))
        kept[:-1] &= ~(beside[1:] & (cells[:-1] & upper == 0))
    return out


def risk(clearance: np.ndarray, preferred: float, width: float) -> np.ndarray:
    """Smooth step of the clearance."""
    s = np.clip((preferred - clearance) / width, 0, 1)
    return (s * s * (3 - 2 * s)).astype(np.float32)


def sight(
    kind: np.ndarray, hit: np.ndarray, occupancy: np.ndarray, passed: np.ndarray, ended: np.ndarray, passes: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Transmittance, its logarithm, bits of clear cells, bits of cells that no ray met."""
    by, at = passed.astype(np.uint8), ended.astype(np.uint8)
    solid = np.clip(2 - 2 * occupancy, 0, 1)
    through = np.where(kind == OPEN, passes * solid, np.where(kind == FREE, 1, 0)).astype(np.float32)
    clear = np.where((kind == FREE) & (hit == 0), np.uint8(255), by & ~at)
    return through, np.log(np.maximum(through, LEAST)), clear, ~(by | at)


def half_seen(kind: np.ndarray, passed: np.ndarray) -> np.ndarray:
    """(X, Y, Z) bool, voxels that count as seen free though some half of them was passed by no ray."""
    cells = passed.astype(np.uint8)
    unmet = np.zeros(kind.shape, bool)
    for half in (mask for halves in HALVES for mask in halves):
        unmet |= cells & np.uint8(half) == 0
    out = unmet & (kind == FREE) & (cells > 0)
    for axis in range(3):
        kept, beside = np.moveaxis(out, axis, 0), np.moveaxis(kind, axis, 0) == OPEN
        kept[1:] &= ~beside[:-1]
        kept[:-1] &= ~beside[1:]
    return out
