# mypy: ignore-errors
"""Window statistics of SSIM in one pass over the image; `image_metrics` explains the measure."""

import numpy as np
from numba import njit, prange


@njit(parallel=True, fastmath=True, cache=True)
def ssim_rows(a, b, mask, window, c1, c2, sums):
    """Sums over valid pixels whose window lies inside the image, row by row.

    a, b (C, H, W) float64; mask (H, W) float64 0 or 1; window (K,) float64, odd, sums to 1; sums (H, 2 C + 1) float64,
    zero: SSIM and its contrast-structure factor of every channel, and the number of pixels. Statistics are of the
    valid pixels of a window alone. Rows are independent; their sums are added up outside, in order.
    """
    channels, height, width = a.shape
    radius = window.shape[0] // 2
    for i in prange(radius, height - radius):
        weight = np.zeros(width)
        for k in range(window.shape[0]):
            for j in range(width):
                weight[j] += window[k] * mask[i + k - radius, j]
        total = np.zeros(width)
        for k in range(window.shape[0]):
            for j in range(radius, width - radius):
                total[j] += window[k] * weight[j + k - radius]
        column = np.empty((5, width))
        found = np.empty((5, width))
        for c in range(channels):
            column[:] = 0
            found[:] = 0
            for k in range(window.shape[0]):
                for j in range(width):
                    x, y = a[c, i + k - radius, j], b[c, i + k - radius, j]
                    w = window[k] * mask[i + k - radius, j]
                    column[0, j] += w * x
                    column[1, j] += w * y
                    column[2, j] += w * x * x
                    column[3, j] += w * y * y
                    column[4, j] += w * x * y
            for m in range(5):
                for k in range(window.shape[0]):
                    for j in range(radius, width - radius):
                        found[m, j] += window[k] * column[m, j + k - radius]
            for j in range(radius, width - radius):
                if mask[i, j] == 0:
                    continue
                scale = 1 / max(total[j], 1e-12)
                p, q = found[0, j] * scale, found[1, j] * scale
                cs = (2 * (found[4, j] * scale - p * q) + c2) / (
                    found[2, j] * scale - p * p + found[3, j] * scale - q * q + c2
                )
                sums[i, c] += (2 * p * q + c1) / (p * p + q * q + c1) * cs
                sums[i, channels + c] += cs
                if c == 0:
                    sums[i, 2 * channels] += 1
