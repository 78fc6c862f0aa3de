# mypy: ignore-errors
"""The field on a lattice: what the decoder's first layer gets from a plane is the same along a whole row of nodes.

OneBlob depends on one coordinate, a plane on two, and the first layer is linear. So its sum before the ReLU is a vector
for the node's x and y, one for x and z, one for y and z, and the dense grid's share, which alone is per node.
"""

import numpy as np
from numba import njit, prange

from active3d_pipe.field.kernels import CHUNK, F0, F1, ONE, THREE, TWO, _cell, _quartic_cdf


@njit(cache=True)
def mark_pairs(index, xy, xz, yz):
    """Set xy (X, Y), xz (X, Z) and yz (Y, Z) bool where a node of `index` (N,), flat in (X, Y, Z), lies."""
    ny, nz = np.uint32(yz.shape[0]), np.uint32(yz.shape[1])
    for p in range(index.shape[0]):
        flat = np.uint32(index[p])
        row = flat // nz
        k = flat - row * nz
        i = row // ny
        j = row - i * ny
        xy[i, j] = True
        xz[i, k] = True
        yz[j, k] = True


@njit(parallel=True, fastmath=True, cache=True)
def pair_terms(u, v, wanted, low_u, low_v, planes, layout, inv_res, weight, of_u, of_v, out):
    """First-layer sums of two axes: out[i, j] = of_u[i] + of_v[j] + features of the planes at (u_i, v_j) @ weight.

    u (U,), v (V,) coordinates, m; wanted (U, V) bool, where `out` (U, V, hidden) is filled; layout (L, 8), inv_res
    (L,): the planes of these two axes, as of `PlaneLayout`; weight (levels * channels, hidden); of_u (U, hidden),
    of_v (V, hidden).
    """
    channels, hidden = np.uintp(planes.shape[1]), np.uintp(weight.shape[1])
    for line in prange(u.shape[0]):
        i = np.uintp(line)
        f, h = np.empty(channels, np.float32), np.empty(hidden, np.float32)
        for j in range(np.uintp(v.shape[0])):
            j = np.uintp(j)
            if not wanted[i, j]:
                continue
            for c in range(hidden):
                c = np.uintp(c)
                h[c] = of_u[i, c] + of_v[j, c]
            for q in range(layout.shape[0]):
                nb = layout[q, 2]
                a, fa = _cell(u[i] - low_u, inv_res[q], layout[q, 6], layout[q, 1])
                b, fb = _cell(v[j] - low_v, inv_res[q], layout[q, 7], nb)
                n00 = np.uintp(layout[q, 0] + a * nb + b)
                n10 = n00 + np.uintp(nb)
                n01, n11 = n00 + ONE, n10 + ONE
                w11 = fa * fb
                w10 = fa - w11
                w01 = fb - w11
                w00 = F1 - fa - fb + w11
                for c in range(channels):
                    c = np.uintp(c)
                    f[c] = w00 * planes[n00, c] + w01 * planes[n01, c] + w10 * planes[n10, c] + w11 * planes[n11, c]
                row = np.uintp(layout[q, 5]) * channels
                for r in range(np.uintp(0), channels, np.uintp(4)):
                    r = np.uintp(r)
                    v0, v1, v2, v3 = f[r], f[r + ONE], f[r + TWO], f[r + THREE]
                    r = row + r
                    for c in range(hidden):
                        c = np.uintp(c)
                        h[c] += (
                            v0 * weight[r, c] + v1 * weight[r + ONE, c] + v2 * weight[r + TWO, c]
                            + v3 * weight[r + THREE, c]
                        )
            for c in range(hidden):
                c = np.uintp(c)
                out[i, j, c] = h[c]


@njit(fastmath=True, cache=True)
def axis_terms(x, blob_low, inv_extent, blob_weight, bias, low, inv, first, n, out, cells, shares):
    """Of coordinates x (N,), m, of one axis: first-layer sums, and where they lie in the dense grid.

    blob_low, inv_extent: of OneBlob on this axis, m and 1/m; blob_weight (bins, hidden) its weights; bias (columns,);
    low, inv, first, n: of the grid's nodes. out (N, columns), cells (N,) int64 lower nodes and shares (N,) fractions
    are filled.
    """
    bins, fbins = blob_weight.shape[0], np.float32(blob_weight.shape[0])
    for i in range(x.shape[0]):
        cells[i], shares[i] = _cell(x[i] - low, inv, first, n)
        out[i] = bias
        t = min(max((x[i] - blob_low) * inv_extent, F0), F1) * fbins
        before = _quartic_cdf(-t)
        for j in range(bins):
            after = _quartic_cdf(np.float32(j + 1) - t)
            for c in range(blob_weight.shape[1]):
                out[i, c] += (after - before) * blob_weight[j, c]
            before = after


@njit(parallel=True, fastmath=True, cache=True)
def decode_nodes(index, xy, xz, yz, cells, shares, grid, weight, w2, b2, out):
    """Values of the decoders at nodes of a lattice.

    index (N,) flat in (X, Y, Z); xy (X, Y, columns), xz, yz: `pair_terms`; cells, shares: a tuple of three,
    `axis_terms`; grid (., ., ., g), g a multiple of 4; weight (g, columns); w2 (columns,) second layer, an equal part
    for each output; b2 (outputs,); out (N, outputs).
    """
    n, outputs, columns = index.shape[0], out.shape[1], np.uintp(w2.shape[0])
    ny, nz, channels = np.uint32(yz.shape[0]), np.uint32(yz.shape[1]), np.uintp(grid.shape[3])
    width = columns // np.uintp(outputs)
    chunks = (n + CHUNK - 1) // CHUNK
    for part in prange(chunks):
        f = np.empty(channels, np.float32)
        for p in range(part * CHUNK, min(n, (part + 1) * CHUNK)):
            flat = np.uint32(index[p])
            row = flat // nz
            k = np.uintp(flat - row * nz)
            i = np.uintp(row // ny)
            j = np.uintp(row - row // ny * ny)
            gi, gj, gk = np.uintp(cells[0][i]), np.uintp(cells[1][j]), np.uintp(cells[2][k])
            fx, fy, fz = shares[0][i], shares[1][j], shares[2][k]
            for c in range(channels):
                f[np.uintp(c)] = F0
            for di in range(np.uintp(2)):
                wx = fx if di else F1 - fx
                for dj in range(np.uintp(2)):
                    wxy = wx * (fy if dj else F1 - fy)
                    w0, w1 = wxy * (F1 - fz), wxy * fz
                    a, b = gi + np.uintp(di), gj + np.uintp(dj)
                    for c in range(channels):
                        c = np.uintp(c)
                        f[c] += w0 * grid[a, b, gk, c] + w1 * grid[a, b, gk + ONE, c]
            for o in range(np.uintp(outputs)):
                s = b2[o]
                first = np.uintp(o) * width
                if channels == 4:
                    # One loop and no store: it is what every field has.
                    v0, v1, v2, v3 = f[0], f[1], f[2], f[3]
                    for c in range(first, first + width):
                        c = np.uintp(c)
                        h = xy[i, j, c] + xz[i, k, c] + yz[j, k, c] + (
                            v0 * weight[0, c] + v1 * weight[1, c] + v2 * weight[2, c] + v3 * weight[3, c]
                        )
                        s += max(h, F0) * w2[c]
                else:
                    for c in range(first, first + width):
                        h = xy[i, j, c] + xz[i, k, c] + yz[j, k, c]
                        for r in range(channels):
                            h += f[r] * weight[r, c]
                        s += max(h, F0) * w2[c]
                out[p, o] = s
