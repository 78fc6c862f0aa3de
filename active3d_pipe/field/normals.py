"""Normals of a signed distance field."""

from collections.abc import Callable

import numpy as np

CORNERS = np.array([[1, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]], np.float32)


def unit_gradients(query: Callable[[np.ndarray], np.ndarray], points: np.ndarray, step_m: float) -> np.ndarray:
    """(N, 3) float32 unit gradients at points (N, 3) float32, m, pointing into free space.

    Differences over a tetrahedron of edge vectors (+-1, +-1, +-1) * step_m; zero where the field is flat. `query` gives
    (M,) values at (M, 3) points, positive in free space, in any unit.
    """
    at = points[None] + np.float32(step_m) * CORNERS[:, None]
    gradient = np.einsum("kn,kc->nc", query(at.reshape(-1, 3)).reshape(4, -1), CORNERS)
    norm = np.linalg.norm(gradient, axis=1, keepdims=True)
    return np.divide(gradient, norm, out=np.zeros_like(gradient), where=norm > 1e-8)
