"""A coloured triangle mesh as plain arrays."""

from dataclasses import dataclass

import numpy as np

from active3d_pipe.errors import InputError


@dataclass(frozen=True, slots=True, eq=False)
class TriangleMesh:
    """Vertices (V, 3) float32 world m; faces (F, 3) int32; colors (V, 3) uint8 or None."""

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray | None = None

    def __post_init__(self) -> None:
        if self.vertices.ndim != 2 or self.vertices.shape[1] != 3:
            raise InputError(f"mesh: vertices are {self.vertices.shape}, expected (V, 3)")
        if self.faces.ndim != 2 or self.faces.shape[1] != 3:
            raise InputError(f"mesh: faces are {self.faces.shape}, expected (F, 3)")
        if self.colors is not None and self.colors.shape != self.vertices.shape:
            raise InputError(f"mesh: colors are {self.colors.shape}, expected {self.vertices.shape}")

    @property
    def area_m2(self) -> float:
        """Total surface area, m2."""
        a, b, c = (self.vertices[self.faces[:, i]].astype(np.float64) for i in range(3))
        return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
