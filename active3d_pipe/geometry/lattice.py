"""Points on a lattice, for functions of a place that may be worked out per axis and per plane of the lattice."""

from collections.abc import Callable
from typing import Any

import numpy as np

from active3d_pipe.errors import ConfigError
from active3d_pipe.geometry import kernels_points

MOST_NODES = 2**32  # of a lattice: kernels divide by its sides in 32 bits


class LatticePoints:
    """World points (N, 3) at chosen nodes of a lattice; `np.asarray` gives their coordinates, float32.

    Args:
        axes: coordinates of the nodes along x, y and z, m; (X,), (Y,) and (Z,).
        index: (N,) flat indices of the nodes in (X, Y, Z), C order.

    Raises:
        ConfigError: the lattice has too many nodes to be indexed.
    """

    def __init__(self, axes: tuple[np.ndarray, np.ndarray, np.ndarray], index: np.ndarray) -> None:
        x, y, z = (np.ascontiguousarray(axis, dtype=np.float32) for axis in axes)
        self.axes = x, y, z
        self.index = np.ascontiguousarray(index, dtype=np.int64)
        if len(x) * len(y) * len(z) > MOST_NODES:
            shape = f"{len(x)} x {len(y)} x {len(z)}"
            raise ConfigError(f"a lattice of {shape} nodes: expected at most 2^32; use larger cells")

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, chosen: np.ndarray) -> "LatticePoints":
        """The points that `chosen` picks, a mask (N,) or indices."""
        return LatticePoints(self.axes, self.index[chosen])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        points = np.empty((len(self.index), 3), np.float32)
        kernels_points.places(self.index, *self.axes, points)
        return points if dtype is None else points.astype(dtype, copy=False)


Points = np.ndarray | LatticePoints
SdfQuery = Callable[[Points], np.ndarray]
"""World points (N, 3), m -> (N,) float32 SDF, m, positive in free space."""
