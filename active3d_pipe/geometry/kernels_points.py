# mypy: ignore-errors
"""Numba kernel of `lattice`."""

import numpy as np
from numba import njit


@njit(cache=True)
def places(index, x, y, z, out):
    """Coordinates out (N, 3) of the nodes with flat indices (N,), C order, of a lattice with axes x, y and z."""
    ny, nz = np.uint32(y.shape[0]), np.uint32(z.shape[0])
    for p in range(index.shape[0]):
        flat = np.uint32(index[p])
        row = flat // nz
        i = row // ny
        out[p, 0] = x[i]
        out[p, 1] = y[row - i * ny]
        out[p, 2] = z[flat - row * nz]
