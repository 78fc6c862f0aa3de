"""The dense voxel grid: sole owner of the relation between world coordinates and voxel indices."""

from dataclasses import dataclass

import numpy as np

from active3d_pipe.errors import ConfigError


@dataclass(frozen=True, slots=True, eq=False)
class VoxelGrid:
    """An axis-aligned box of cubic voxels.

    Centre of voxel (i, j, k) = origin + (ijk + 0.5) * voxel_size. Volumes on it are arrays [X, Y, Z].

    Attributes:
        origin: (3,) float64, world position of the box's lowest corner, m.
        voxel_size: edge of a voxel, m.
        shape: number of voxels (X, Y, Z).
    """

    origin: np.ndarray
    voxel_size: float
    shape: tuple[int, int, int]

    def __post_init__(self) -> None:
        object.__setattr__(self, "origin", np.asarray(self.origin, dtype=np.float64))
        object.__setattr__(self, "shape", tuple(int(n) for n in self.shape))
        if self.origin.shape != (3,) or not np.isfinite(self.origin).all():
            raise ConfigError(f"voxel grid origin {self.origin}: expected three finite numbers")
        if self.voxel_size <= 0 or min(self.shape) < 1:
            raise ConfigError(f"voxel grid {self.shape} of {self.voxel_size} m: expected positive numbers")

    @classmethod
    def from_bounds(cls, low: np.ndarray, high: np.ndarray, voxel_size: float) -> "VoxelGrid":
        """The smallest grid of `voxel_size` whose box covers [low, high] (world, m)."""
        low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
        if not (high > low).all():
            raise ConfigError(f"bounds {low.tolist()} .. {high.tolist()}: expected low < high on every axis")
        shape = np.maximum(np.ceil((high - low) / voxel_size - 1e-9), 1).astype(int)
        return cls(low, float(voxel_size), tuple(shape))

    @property
    def low(self) -> np.ndarray:
        """(3,) lowest corner of the box, world, m."""
        return self.origin

    @property
    def high(self) -> np.ndarray:
        """(3,) highest corner of the box, world, m."""
        return self.origin + self.voxel_size * np.asarray(self.shape)

    @property
    def size(self) -> int:
        """Number of voxels."""
        return int(np.prod(self.shape))

    def axis(self, i: int) -> np.ndarray:
        """World coordinates of the voxel centres along axis `i`, float64, m."""
        return self.origin[i] + (np.arange(self.shape[i]) + 0.5) * self.voxel_size

    def centres(self) -> np.ndarray:
        """(X, Y, Z, 3) float32 world positions of all voxel centres, m."""
        xyz = np.meshgrid(*(self.axis(i) for i in range(3)), indexing="ij")
        return np.stack(xyz, axis=-1).astype(np.float32)

    def index_of(self, points_world: np.ndarray) -> np.ndarray:
        """(..., 3) int64 voxel indices of world points; may lie outside, see `contains_index`."""
        return np.floor((np.asarray(points_world) - self.origin) / self.voxel_size).astype(np.int64)

    def contains_index(self, ijk: np.ndarray) -> np.ndarray:
        """(...) bool, whether indices lie inside the grid."""
        return np.asarray(((ijk >= 0) & (ijk < np.asarray(self.shape))).all(axis=-1))

    def centre_of(self, ijk: np.ndarray) -> np.ndarray:
        """(..., 3) float64 world positions of the centres of voxels `ijk`."""
        return self.origin + (np.asarray(ijk) + 0.5) * self.voxel_size
