# mypy: ignore-errors
"""Numba kernels: structural similarity (Wang 2004) with an 11x11 Gaussian window, value and gradient.

Only windows that lie wholly inside the image count, as in the usual metric. With the sum s = E[x^2 + y^2] in
place of both second moments, four maps are filtered forward and three backward.
"""

import numpy as np
from numba import njit, prange

F = np.float32
ZERO, ONE, TWO = F(0), F(1), F(2)
RADIUS, WINDOW = 5, 11
_taps = np.exp(-0.5 * (np.arange(WINDOW) - RADIUS) ** 2 / 1.5**2)
_taps = (_taps / _taps.sum()).astype(np.float32)
W0, W1, W2, W3, W4, W5 = (F(w) for w in _taps[: RADIUS + 1])
C1, C2 = F(0.01**2), F(0.03**2)
BANDS = 16


@njit(fastmath=True, cache=True)
def _down(planes, p, row, first, last, out):
    """out[c] = vertical filter of rows row : row + 11 of planes[p], for columns first : last."""
    for c in range(first, last):
        out[c] = (
            W0 * (planes[p, row, c] + planes[p, row + 10, c]) + W1 * (planes[p, row + 1, c] + planes[p, row + 9, c])
            + W2 * (planes[p, row + 2, c] + planes[p, row + 8, c])
            + W3 * (planes[p, row + 3, c] + planes[p, row + 7, c])
            + W4 * (planes[p, row + 4, c] + planes[p, row + 6, c]) + W5 * planes[p, row + 5, c]
        )


@njit(fastmath=True, cache=True)
def _across(line, n, out):
    """out[c] = horizontal filter of line[c : c + 11], c < n."""
    for c in range(n):
        out[c] = (
            W0 * (line[c] + line[c + 10]) + W1 * (line[c + 1] + line[c + 9]) + W2 * (line[c + 2] + line[c + 8])
            + W3 * (line[c + 3] + line[c + 7]) + W4 * (line[c + 4] + line[c + 6]) + W5 * line[c + 5]
        )


@njit(parallel=True, fastmath=True, cache=True)
def products(x, y, moments):
    """`moments` (2 C, H, W) receives x^2 + y^2 and x y of the planes `x`, `y` (C, H, W)."""
    planes, height, width = x.shape
    for band in prange(planes * BANDS):
        p = band // BANDS
        b = band % BANDS
        for r in range(height * b // BANDS, height * (b + 1) // BANDS):
            for c in range(width):
                moments[2 * p, r, c] = x[p, r, c] * x[p, r, c] + y[p, r, c] * y[p, r, c]
                moments[2 * p + 1, r, c] = x[p, r, c] * y[p, r, c]


@njit(parallel=True, fastmath=True, cache=True)
def similarity(x, y, moments, slopes, sums):
    """SSIM of every window and its derivatives with respect to the filtered maps.

    `x`, `y` (C, H, W); `slopes` (3 C, H + 10, W + 10) receives d ssim / d (mean of x, E[x^2 + y^2], E[x y]) of the
    window with top-left corner (r, c) at [r + 10, c + 10], zero around; `sums` (C, BANDS) partial sums of ssim.
    """
    planes, height, width = x.shape
    rows, columns = height - 2 * RADIUS, width - 2 * RADIUS
    for band in prange(planes * BANDS):
        p, b = band // BANDS, band % BANDS
        line = np.empty(width, np.float32)
        mu_x, mu_y = np.empty(columns, np.float32), np.empty(columns, np.float32)
        e_ss, e_xy = np.empty(columns, np.float32), np.empty(columns, np.float32)
        total = 0.0
        for padded in range((height + 10) * b // BANDS, (height + 10) * (b + 1) // BANDS):
            r = padded - 2 * RADIUS
            if r < 0 or r >= rows:
                for m in range(3 * p, 3 * p + 3):
                    for c in range(width + 10):
                        slopes[m, padded, c] = ZERO
                continue
            _down(x, p, r, 0, width, line)
            _across(line, columns, mu_x)
            _down(y, p, r, 0, width, line)
            _across(line, columns, mu_y)
            _down(moments, 2 * p, r, 0, width, line)
            _across(line, columns, e_ss)
            _down(moments, 2 * p + 1, r, 0, width, line)
            _across(line, columns, e_xy)
            for m in range(3 * p, 3 * p + 3):
                for c in range(2 * RADIUS):
                    slopes[m, padded, c] = ZERO
                    slopes[m, padded, width + c] = ZERO
            row_total = ZERO
            for c in range(columns):
                mx, my = mu_x[c], mu_y[c]
                squares = mx * mx + my * my
                n1, n2 = TWO * mx * my + C1, TWO * (e_xy[c] - mx * my) + C2
                d1, d2 = squares + C1, e_ss[c] - squares + C2
                inv1, inv2 = ONE / d1, ONE / d2
                inv = inv1 * inv2
                s = n1 * n2 * inv
                row_total += s
                slopes[3 * p, padded, c + 2 * RADIUS] = TWO * (my * inv * (n2 - n1) + s * mx * (inv2 - inv1))
                slopes[3 * p + 1, padded, c + 2 * RADIUS] = -s * inv2
                slopes[3 * p + 2, padded, c + 2 * RADIUS] = TWO * n1 * inv
            total += row_total
        sums[p, b] = total


@njit(parallel=True, fastmath=True, cache=True)
def add_gradient(x, y, slopes, scale, grad):
    """grad (at least C, H, W) += scale * d(sum of ssim)/dx."""
    planes, height, width = x.shape
    for band in prange(planes * BANDS):
        p, b = band // BANDS, band % BANDS
        line = np.empty(width + 10, np.float32)
        g_mu, g_ss = np.empty(width, np.float32), np.empty(width, np.float32)
        g_xy = np.empty(width, np.float32)
        for r in range(height * b // BANDS, height * (b + 1) // BANDS):
            _down(slopes, 3 * p, r, 0, width + 10, line)
            _across(line, width, g_mu)
            _down(slopes, 3 * p + 1, r, 0, width + 10, line)
            _across(line, width, g_ss)
            _down(slopes, 3 * p + 2, r, 0, width + 10, line)
            _across(line, width, g_xy)
            for c in range(width):
                grad[p, r, c] += scale * (g_mu[c] + TWO * x[p, r, c] * g_ss[c] + y[p, r, c] * g_xy[c])
