# mypy: ignore-errors
"""Numba kernel: absolute colour and depth errors of a rendered frame, and their gradient images."""

import numpy as np
from numba import njit, prange

F = np.float32
ZERO = F(0)
BANDS = 32


@njit(parallel=True, fastmath=True, cache=True)
def absolute_errors(out, rgb, depth, mask, use_mask, weights, target, grad, sums):
    """Split the observation into planes and compare it with the rendered planes `out` (5, H, W).

    `weights` (2,) = factors of sign(colour error), sign(depth error) in `grad` (5, H, W); `target` (3, H, W)
    receives the observed colour, and the rendered one where `mask` (H, W) excludes the pixel; `sums` (BANDS, 3)
    partial sums of |colour|, colour^2, |depth|.
    """
    height, width = depth.shape
    for band in prange(BANDS):
        l1, l2, ld = 0.0, 0.0, 0.0
        for r in range(height * band // BANDS, height * (band + 1) // BANDS):
            row1, row2, rowd = ZERO, ZERO, ZERO
            for c in range(width):
                keep = not use_mask or mask[r, c]
                for p in range(3):
                    x = out[p, r, c]
                    y = rgb[r, c, p] if keep else x
                    target[p, r, c] = y
                    e = x - y
                    row1 += abs(e)
                    row2 += e * e
                    grad[p, r, c] = weights[0] * (F(e > ZERO) - F(e < ZERO))
                d = depth[r, c]
                e = out[3, r, c] - d if (d > ZERO and keep) else ZERO
                rowd += abs(e)
                grad[3, r, c] = weights[1] * (F(e > ZERO) - F(e < ZERO))
                grad[4, r, c] = ZERO
            l1 += row1
            l2 += row2
            ld += rowd
        sums[band, 0], sums[band, 1], sums[band, 2] = l1, l2, ld


@njit(parallel=True, cache=True)
def clear_masked(mask, grad):
    """Set the gradient (5, H, W) of the pixels outside `mask` (H, W) to zero."""
    height, width = mask.shape
    for r in prange(height):
        for c in range(width):
            if not mask[r, c]:
                for p in range(5):
                    grad[p, r, c] = ZERO
