"""The risk field: observed occupancy joined with the field's SDF, and the collision risk that follows.

Paper, appendix "Risking Filed and Planning": the occupancy alone has gaps, the SDF alone invents structure. Where
many rays went, observation decides and phantom structure of the SDF is dropped; where few went, the SDF fills in.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from active3d_pipe.planning import kernels_volumes as kernels
from active3d_pipe.planning.config import PlanningSettings
from active3d_pipe.structures.voxel_grid import VoxelGrid


def joint_occupancy(arrays: Mapping[str, np.ndarray], settings: PlanningSettings) -> np.ndarray:
    """Probability in [0, 1] that a voxel is solid, float32 [X, Y, Z]; 1 where nothing was ever observed.

    p = c O + (1 - c) P(SDF < 0) with c = n / (n + sdf_trust_rays) for n rays that met the voxel.
    """
    free, hit, occupancy, sdf = (arrays[name] for name in ("free_evidence", "hit_evidence", "occupancy", "sdf"))
    out = np.empty(free.shape, np.float32)
    kernels.joint_occupancy(
        free, hit, occupancy, sdf, np.float32(settings.sdf_trust_rays), np.float32(settings.sdf_softness_m), out
    )
    return out


@dataclass(frozen=True, slots=True, eq=False)
class RiskField:
    """What the path planner asks about places.

    Attributes:
        grid: the voxel grid of all volumes.
        occupancy: joint occupancy probability.
        clearance_m: distance from a voxel's centre to the nearest face of a voxel that is not known to be free,
            m, truncated; 0 in such voxels.
        risk: C_risk in [0, 1], 1 up to the agent's radius from anything not known to be free, falling smoothly
            to 0 at the preferred clearance.
    """

    grid: VoxelGrid
    occupancy: np.ndarray
    clearance_m: np.ndarray
    risk: np.ndarray

    def at(self, points_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(risk, clearance m) at world points (..., 3), trilinear; outside the grid risk 1, clearance 0."""
        return (
            interpolate(self.risk, self.grid, points_world, outside=1.0),
            interpolate(self.clearance_m, self.grid, points_world, outside=0.0),
        )


def build_risk_field(
    grid: VoxelGrid, occupancy: np.ndarray, clearance_m: np.ndarray, radius_m: float, preferred_m: float
) -> RiskField:
    """Risk from clearance: a smooth step between the agent's radius and the preferred clearance."""
    width = max(preferred_m - radius_m, 1e-3)
    risk = np.empty(clearance_m.shape, np.float32)
    kernels.risk(clearance_m, np.float32(preferred_m), np.float32(width), risk)
    return RiskField(grid, occupancy, clearance_m, risk)


def interpolate(volume: np.ndarray, grid: VoxelGrid, points_world: np.ndarray, *, outside: float) -> np.ndarray:
    """Trilinear interpolation of a volume between voxel centres; `outside` beyond the grid's box.

    Between the outermost centres and the faces of the box the outermost value holds.
    """
    points = np.asarray(points_world, dtype=np.float64)
    x = (points - grid.origin) / grid.voxel_size
    inside = ((x >= 0) & (x <= np.asarray(grid.shape))).all(axis=-1)
    x = np.clip(x - 0.5, 0, np.asarray(grid.shape) - 1.0)
    low = np.minimum(x.astype(np.int64), np.maximum(np.asarray(grid.shape) - 2, 0))
    f = x - low
    high = np.minimum(low + 1, np.asarray(grid.shape) - 1)
    out = np.zeros(points.shape[:-1])
    for corner in range(8):
        index, weight = [], np.ones(points.shape[:-1])
        for axis in range(3):
            upper = corner >> axis & 1
            index.append((high if upper else low)[..., axis])
            weight = weight * (f[..., axis] if upper else 1 - f[..., axis])
        out += weight * volume[tuple(index)]
    return np.where(inside, out, outside)
