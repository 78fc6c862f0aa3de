# mypy: ignore-errors
"""Numba kernels: 3D Gaussians to screen-space records, and the chain rule back to their parameters.

A primitive is one row of `values` (N, 14) float32: mean 0:3, log-scale 3:6, quaternion wxyz 6:10,
opacity logit 10, colour 11:14. EWA projection (Zwicker 2001; Kerbl 2023) with the opacity compensation of
Mip-Splatting (Yu 2024): a 2D covariance S0 is dilated to S = S0 + d I and the opacity is multiplied by
rho = sqrt(det S0 / det S), so that a primitive below the pixel size dims instead of growing.

A record is 16 floats, one 64-byte cache line:
    0 u, 1 v, 2 A/2, 3 B, 4 C/2, 5 o, 6 smax, 7 hy, 8 r, 9 g, 10 b, 11 z, 12 hx, 13 opacity before compensation
where (A, B, C) is the inverse of S, o the compensated opacity, smax = ln(255 o) the exponent at which alpha
falls to 1/255, (hx, hy) the half sizes of the box around {exponent <= smax}.
"""

import math

import numpy as np
from numba import njit, prange

F = np.float32
ZERO, HALF, ONE, TWO = F(0), F(0.5), F(1), F(2)
ALPHA_MIN = F(1 / 255)
# sqrt(2 ln 255): no primitive reaches farther than this many standard deviations.
REACH = F(3.3290)


@njit(fastmath=True, cache=True)
def _rotation(w, x, y, z):
    """Rotation matrix of a unit quaternion, row by row."""
    return (
        ONE - TWO * (y * y + z * z), TWO * (x * y - w * z), TWO * (x * z + w * y),
        TWO * (x * y + w * z), ONE - TWO * (x * x + z * z), TWO * (y * z - w * x),
        TWO * (x * z - w * y), TWO * (y * z + w * x), ONE - TWO * (x * x + y * y),
    )


@njit(fastmath=True, cache=True)
def screen_bound(view, dilation):
    """(spread, margin): no primitive is drawn farther than spread * standard deviation / z + margin pixels away."""
    lim_x, lim_y = view[4], view[5]
    spread = REACH * max(view[0], view[1]) * math.sqrt(ONE + lim_x * lim_x + lim_y * lim_y)
    return spread, REACH * math.sqrt(dilation)


@njit(fastmath=True, cache=True)
def on_screen(mx, my, mz, widest, astray, R, t, view, spread, margin):
    """(whether the view may show a primitive, z, x / z, y / z of its mean), camera frame.

    `widest`: its largest standard deviation; `astray`: how far from (mx, my, mz) it may lie, m; the view as in
    `project`, with its `screen_bound`. Where it may not be shown the last two are 0.
    """
    z = R[2, 0] * mx + R[2, 1] * my + R[2, 2] * mz + t[2]
    if not z + astray > view[8]:
        return False, z, ZERO, ZERO
    iz = ONE / max(z, view[8])
    xz = (R[0, 0] * mx + R[0, 1] * my + R[0, 2] * mz + t[0]) * iz
    yz = (R[1, 0] * mx + R[1, 1] * my + R[1, 2] * mz + t[1]) * iz
    u, v = view[0] * xz + view[2], view[1] * yz + view[3]
    bound = spread * (widest + astray) * iz + margin
    shown = u + bound > ZERO and u - bound < view[6] and v + bound > ZERO and v - bound < view[7]
    return shown, z, xz, yz


@njit(parallel=True, fastmath=True, cache=True)
def project(values, which, R, t, view, tile_size, tile_grid, chunks, dilation, compensate, rec, ids, box, counts):
    """Write the records of the visible ones of `which` (L,) int32; chunk c fills rec[L c // chunks :][: counts[c]].

    `R` (3, 3), `t` (3,) map world to camera; `view` (9,) = fx, fy, cx, cy, clamp of x/z, clamp of y/z, W, H,
    near; `ids` index of the primitive behind every record; `box` (L, 4) int16 tile range x0, x1, y0, y1.
    """
    n = which.shape[0]
    fx, fy, cx, cy, lim_x, lim_y = view[0], view[1], view[2], view[3], view[4], view[5]
    width, height = view[6], view[7]
    tw, th = F(tile_size[0]), F(tile_size[1])
    spread, margin = screen_bound(view, dilation)
    for c in prange(chunks):
        k = n * c // chunks
        first = k
        for place in range(n * c // chunks, n * (c + 1) // chunks):
            i = which[place]
            widest = math.exp(max(values[i, 3], max(values[i, 4], values[i, 5])))
            shown, z, xz, yz = on_screen(
                values[i, 0], values[i, 1], values[i, 2], widest, ZERO, R, t, view, spread, margin
            )
            if not shown:
                continue
            iz = ONE / z
            u, v = fx * xz + cx, fy * yz + cy
            opacity = ONE / (ONE + math.exp(-values[i, 10]))
            if opacity <= ALPHA_MIN:
                continue
            qw, qx, qy, qz = values[i, 6], values[i, 7], values[i, 8], values[i, 9]
            qn = ONE / math.sqrt(qw * qw + qx * qx + qy * qy + qz * qz + F(1e-30))
            r = _rotation(qw * qn, qx * qn, qy * qn, qz * qn)
            s0, s1, s2 = math.exp(values[i, 3]), math.exp(values[i, 4]), math.exp(values[i, 5])
            px, py = min(max(xz, -lim_x), lim_x), min(max(yz, -lim_y), lim_y)
            j00, j01, j02 = (
                fx * iz * (R[0, 0] - px * R[2, 0]),
                fx * iz * (R[0, 1] - px * R[2, 1]),
                fx * iz * (R[0, 2] - px * R[2, 2]),
            )
            j10, j11, j12 = (
                fy * iz * (R[1, 0] - py * R[2, 0]),
                fy * iz * (R[1, 1] - py * R[2, 1]),
                fy * iz * (R[1, 2] - py * R[2, 2]),
            )
            v00 = (j00 * r[0] + j01 * r[3] + j02 * r[6]) * s0
            v01 = (j00 * r[1] + j01 * r[4] + j02 * r[7]) * s1
            v02 = (j00 * r[2] + j01 * r[5] + j02 * r[8]) * s2
            v10 = (j10 * r[0] + j11 * r[3] + j12 * r[6]) * s0
            v11 = (j10 * r[1] + j11 * r[4] + j12 * r[7]) * s1
            v12 = (j10 * r[2] + j11 * r[5] + j12 * r[8]) * s2
            a0 = v00 * v00 + v01 * v01 + v02 * v02
            b = v00 * v10 + v01 * v11 + v02 * v12
            c0 = v10 * v10 + v11 * v11 + v12 * v12
            # det S0 by the 2x2 minors: a0 c0 - b b cancels for discs seen edge-on.
            m0, m1, m2 = v01 * v12 - v02 * v11, v02 * v10 - v00 * v12, v00 * v11 - v01 * v10
            det0 = m0 * m0 + m1 * m1 + m2 * m2
            det = det0 + dilation * (a0 + c0) + dilation * dilation
            o = opacity
            if compensate:
                o *= math.sqrt(det0 / det)
            # This also guards the gradient of the compensation: survivors have det0 / det > 1.5e-5.
            if not o > ALPHA_MIN:
                continue
            smax = math.log(F(255) * o)
            hx, hy = math.sqrt(TWO * smax * (a0 + dilation)), math.sqrt(TWO * smax * (c0 + dilation))
            # First and last pixel centre inside the box.
            x_lo, x_hi = max(u - hx, ZERO), min(u + hx, width)
            y_lo, y_hi = max(v - hy, ZERO), min(v + hy, height)
            if not (x_lo < x_hi and y_lo < y_hi):
                continue
            bx0, by0 = int(x_lo / tw), int(y_lo / th)
            bx1 = min(int(x_hi / tw) + 1, tile_grid[0])
            by1 = min(int(y_hi / th) + 1, tile_grid[1])
            if bx0 >= bx1 or by0 >= by1:
                continue
            inv = ONE / det
            rec[k, 0], rec[k, 1] = u, v
            rec[k, 2], rec[k, 3], rec[k, 4] = HALF * (c0 + dilation) * inv, -b * inv, HALF * (a0 + dilation) * inv
            rec[k, 5], rec[k, 6], rec[k, 7] = o, smax, hy
            rec[k, 8], rec[k, 9], rec[k, 10] = values[i, 11], values[i, 12], values[i, 13]
            rec[k, 11], rec[k, 12], rec[k, 13] = z, hx, opacity
            box[k, 0], box[k, 1], box[k, 2], box[k, 3] = bx0, bx1, by0, by1
            ids[k] = i
            k += 1
        counts[c] = k - first


@njit(parallel=True, fastmath=True, cache=True)
def may_be_seen(values, Rs, ts, views, chunks, dilation, out):
    """out (N,) bool: whether one of the views may show the primitive, by the first and widest bound of `project`.

    `Rs` (V, 3, 3), `ts` (V, 3), `views` (V, 9) as in `project`, of V views.
    """
    n = values.shape[0]
    bounds = np.empty((len(views), 2), np.float32)
    for v in range(len(views)):
        bounds[v] = screen_bound(views[v], dilation)
    for c in prange(chunks):
        for i in range(n * c // chunks, n * (c + 1) // chunks):
            mx, my, mz = values[i, 0], values[i, 1], values[i, 2]
            widest = math.exp(max(values[i, 3], max(values[i, 4], values[i, 5])))
            seen = False
            for v in range(len(views)):
                if on_screen(mx, my, mz, widest, ZERO, Rs[v], ts[v], views[v], bounds[v, 0], bounds[v, 1])[0]:
                    seen = True
                    break
            out[i] = seen


@njit(parallel=True, fastmath=True, cache=True)
def chain_rule(
    values, n, R, t, view, chunks, dilation, compensate, rec, ids, counts, first_entry, entry_grad, rows, grad
):
    """Sum the entry gradients of every record and carry them to the parameters.

    `n`: number of primitives that were asked about (L of `project`).
    `entry_grad` (E, 12): sums over the pixels of one tile of q, q dx, q dy, q dx dx, q dx dy, q dy dy, w g_r,
    w g_g, w g_b, w g_z, with q = dL/d ln alpha; the entries of record k are first_entry[k] : first_entry[k + 1].
    `grad` (M, 14) receives dL/dvalues of the visible primitives `rows` (M,), ascending as in `project`. Summed in a
    fixed order: the same bytes for any number of threads.
    """
    fx, fy, lim_x, lim_y = view[0], view[1], view[4], view[5]
    for c in prange(chunks):
        before = 0
        for b in range(c):
            before += counts[b]
        start = n * c // chunks
        for k in range(start, start + counts[c]):
            i, out = ids[k], before + k - start
            rows[out] = i
            g0, gx, gy, gxx, gxy = ZERO, ZERO, ZERO, ZERO, ZERO
            gyy, gr, gg, gb, gz = ZERO, ZERO, ZERO, ZERO, ZERO
            for e in range(first_entry[k], first_entry[k + 1]):
                g0 += entry_grad[e, 0]
                gx += entry_grad[e, 1]
                gy += entry_grad[e, 2]
                gxx += entry_grad[e, 3]
                gxy += entry_grad[e, 4]
                gyy += entry_grad[e, 5]
                gr += entry_grad[e, 6]
                gg += entry_grad[e, 7]
                gb += entry_grad[e, 8]
                gz += entry_grad[e, 9]
            mx, my, mz = values[i, 0], values[i, 1], values[i, 2]
            z = rec[k, 11]
            iz = ONE / z
            xz = (R[0, 0] * mx + R[0, 1] * my + R[0, 2] * mz + t[0]) * iz
            yz = (R[1, 0] * mx + R[1, 1] * my + R[1, 2] * mz + t[1]) * iz
            qw, qx, qy, qz = values[i, 6], values[i, 7], values[i, 8], values[i, 9]
            qn = ONE / math.sqrt(qw * qw + qx * qx + qy * qy + qz * qz + F(1e-30))
            qw, qx, qy, qz = qw * qn, qx * qn, qy * qn, qz * qn
            r = _rotation(qw, qx, qy, qz)
            s0, s1, s2 = math.exp(values[i, 3]), math.exp(values[i, 4]), math.exp(values[i, 5])
            px, py = min(max(xz, -lim_x), lim_x), min(max(yz, -lim_y), lim_y)
            fxz, fyz = fx * iz, fy * iz
            j00, j01, j02 = (
                fxz * (R[0, 0] - px * R[2, 0]), fxz * (R[0, 1] - px * R[2, 1]), fxz * (R[0, 2] - px * R[2, 2])
            )
            j10, j11, j12 = (
                fyz * (R[1, 0] - py * R[2, 0]), fyz * (R[1, 1] - py * R[2, 1]), fyz * (R[1, 2] - py * R[2, 2])
            )
            v00 = (j00 * r[0] + j01 * r[3] + j02 * r[6]) * s0
            v01 = (j00 * r[1] + j01 * r[4] + j02 * r[7]) * s1
            v02 = (j00 * r[2] + j01 * r[5] + j02 * r[8]) * s2
            v10 = (j10 * r[0] + j11 * r[3] + j12 * r[6]) * s0
            v11 = (j10 * r[1] + j11 * r[4] + j12 * r[7]) * s1
            v12 = (j10 * r[2] + j11 * r[5] + j12 * r[8]) * s2

            ka, kb, kc = TWO * rec[k, 2], rec[k, 3], TWO * rec[k, 4]
            du, dv = ka * gx + kb * gy, kb * gx + kc * gy
            # dL/dV = Q V, Q = K M K + [compensation] m0 (S0^-1 - K); M holds the second moments.
            p00, p01 = ka * gxx + kb * gxy, ka * gxy + kb * gyy
            p10, p11 = kb * gxx + kc * gxy, kb * gxy + kc * gyy
            q00, q01, q11 = p00 * ka + p01 * kb, p00 * kb + p01 * kc, p10 * kb + p11 * kc
            if compensate:
                a0 = v00 * v00 + v01 * v01 + v02 * v02
                b = v00 * v10 + v01 * v11 + v02 * v12
                c0 = v10 * v10 + v11 * v11 + v12 * v12
                m0, m1, m2 = v01 * v12 - v02 * v11, v02 * v10 - v00 * v12, v00 * v11 - v01 * v10
                inv0 = ONE / (m0 * m0 + m1 * m1 + m2 * m2)
                q00 += g0 * (c0 * inv0 - ka)
                q01 += g0 * (-b * inv0 - kb)
                q11 += g0 * (a0 * inv0 - kc)
            d00, d01, d02 = q00 * v00 + q01 * v10, q00 * v01 + q01 * v11, q00 * v02 + q01 * v12
            d10, d11, d12 = q01 * v00 + q11 * v10, q01 * v01 + q11 * v11, q01 * v02 + q11 * v12
            grad[out, 3], grad[out, 4] = d00 * v00 + d10 * v10, d01 * v01 + d11 * v11
            grad[out, 5] = d02 * v02 + d12 * v12
            d00, d01, d02, d10, d11, d12 = d00 * s0, d01 * s1, d02 * s2, d10 * s0, d11 * s1, d12 * s2

            # Rotation: dRq = (J R)^T dE, then to the quaternion, without its radial part.
            r00, r01, r02 = j00 * d00 + j10 * d10, j00 * d01 + j10 * d11, j00 * d02 + j10 * d12
            r10, r11, r12 = j01 * d00 + j11 * d10, j01 * d01 + j11 * d11, j01 * d02 + j11 * d12
            r20, r21, r22 = j02 * d00 + j12 * d10, j02 * d01 + j12 * d11, j02 * d02 + j12 * d12
            hw = TWO * (qz * (r10 - r01) + qy * (r02 - r20) + qx * (r21 - r12))
            hx = TWO * (qy * (r01 + r10) + qz * (r02 + r20) + qw * (r21 - r12) - TWO * qx * (r11 + r22))
            hy = TWO * (qx * (r01 + r10) + qz * (r12 + r21) + qw * (r02 - r20) - TWO * qy * (r00 + r22))
            hz = TWO * (qx * (r02 + r20) + qy * (r12 + r21) + qw * (r10 - r01) - TWO * qz * (r00 + r11))
            radial = hw * qw + hx * qx + hy * qy + hz * qz
            grad[out, 6], grad[out, 7] = (hw - radial * qw) * qn, (hx - radial * qx) * qn
            grad[out, 8], grad[out, 9] = (hy - radial * qy) * qn, (hz - radial * qz) * qn

            # Mean, in the camera frame first: through u, v, the depth channel and the Jacobian J.
            e00, e01, e02 = d00 * r[0] + d01 * r[1] + d02 * r[2], d00 * r[3] + d01 * r[4] + d02 * r[5], \
                d00 * r[6] + d01 * r[7] + d02 * r[8]
            e10, e11, e12 = d10 * r[0] + d11 * r[1] + d12 * r[2], d10 * r[3] + d11 * r[4] + d12 * r[5], \
                d10 * r[6] + d11 * r[7] + d12 * r[8]
            h00 = e00 * R[0, 0] + e01 * R[0, 1] + e02 * R[0, 2]
            h02 = e00 * R[2, 0] + e01 * R[2, 1] + e02 * R[2, 2]
            h11 = e10 * R[1, 0] + e11 * R[1, 1] + e12 * R[1, 2]
            h12 = e10 * R[2, 0] + e11 * R[2, 1] + e12 * R[2, 2]
            dpx, dpy = fxz * du, fyz * dv
            dpz = gz - fxz * (xz * du + iz * h00) - fyz * (yz * dv + iz * h11)
            if px == xz:
                dpx -= fxz * iz * h02
                dpz += TWO * fxz * iz * px * h02
            else:
                dpz += fxz * iz * px * h02
            if py == yz:
                dpy -= fyz * iz * h12
                dpz += TWO * fyz * iz * py * h12
            else:
                dpz += fyz * iz * py * h12
            grad[out, 0] = R[0, 0] * dpx + R[1, 0] * dpy + R[2, 0] * dpz
            grad[out, 1] = R[0, 1] * dpx + R[1, 1] * dpy + R[2, 1] * dpz
            grad[out, 2] = R[0, 2] * dpx + R[1, 2] * dpy + R[2, 2] * dpz
            grad[out, 10] = g0 * (ONE - rec[k, 13])
            grad[out, 11], grad[out, 12], grad[out, 13] = gr, gg, gb
