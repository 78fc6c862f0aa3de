"""Where in a pixel the samples lie."""

import numpy as np


def low_discrepancy_offsets(count: int) -> np.ndarray:
    """(count, 2) float64 points in the unit square: a rank-1 lattice, every row and column of count cells hit once.

    The generator is the odd step that spreads the points best (largest smallest distance on the torus).
    """
    if count <= 0:
        return np.zeros((0, 2))
    i = np.arange(count)
    best, widest = np.zeros((count, 2)), -1.0
    for step in range(1, count + 1):
        if np.gcd(step, count) != 1:
            continue
        points = np.stack([(i + 0.5) / count, ((i * step) % count + 0.5) / count], axis=-1)
        delta = np.abs(points[:, None] - points[None])
        distance = np.linalg.norm(np.minimum(delta, 1 - delta), axis=-1) + 2 * np.eye(count)
        if distance.min() > widest:
            best, widest = points, float(distance.min())
    return best
