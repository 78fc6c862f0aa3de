# mypy: ignore-errors
"""Numba kernels: alpha blending of the records, tile by tile, forward and backward.

Backward walks front to back like forward and recomputes alpha, so nothing is stored per pixel: with S the
part of <gradient, output> that lies behind the current primitive, dL/dalpha = T val - S / (1 - alpha),
where val = <gradient, (colour, z, 1)>.

A tile's pixels live in one flat float32 buffer of planes, which stays in the L1 cache. Only the pixel rows
that a primitive reaches are walked.
"""

import math

import numpy as np
from llvmlite import ir
from numba import njit, prange, types
from numba.core import cgutils
from numba.extending import intrinsic

TW, TH = 16, 16
P = TW * TH
F = np.float32
ZERO, HALF, ONE = F(0), F(0.5), F(1)
ALPHA_MAX = F(0.99)
# exp(-s) = poly(-s / 8)^8, fitted on [-0.72, 0], relative error 8e-7; s never exceeds ln 255 = 5.54.
E1, E2, E3, E4, E5 = F(0.999993988), F(0.499888322), F(0.165975796), F(0.0397533720), F(0.00582640022)
EIGHTH, Y_MIN = F(-0.125), F(-0.75)
STOP_EVERY = 16
AHEAD = 2


@intrinsic
def _prefetch(typingctx, array, row):
    """Ask the cache for the line in which row `row` of a C-contiguous 2D array starts."""
    if not isinstance(array, types.Array):
        return None

    def codegen(context, builder, signature, args):
        ary = context.make_array(signature.args[0])(context, builder, args[0])
        index = context.cast(builder, args[1], signature.args[1], types.intp)
        strides = cgutils.unpack_tuple(builder, ary.strides)
        byte_ptr = builder.bitcast(ary.data, ir.IntType(8).as_pointer())
        address = builder.gep(byte_ptr, [builder.mul(index, strides[0])])
        i32 = ir.IntType(32)
        fn = cgutils.get_or_insert_function(
            builder.module,
            ir.FunctionType(ir.VoidType(), [ir.IntType(8).as_pointer(), i32, i32, i32]),
            "llvm.prefetch.p0",
        )
        builder.call(fn, [address, i32(0), i32(3), i32(1)])
        return context.get_dummy_value()

    return types.void(array, types.intp), codegen


@njit(parallel=True, fastmath=True, cache=True)
def forward(rec, entries, tile_start, tile_ids, bounds, tiles_x, t_stop, out, used):
    """Blend the tiles `tile_ids`; thread part p owns tiles bounds[p] : bounds[p + 1].

    `out` (5, H, W) receives r, g, b, sum w z, alpha; `used` how many entries of each tile counted before its
    largest transmittance fell under `t_stop`. Tiles that are not listed keep what `out` held.
    """
    height, width = out.shape[1], out.shape[2]
    for part in prange(bounds.shape[0] - 1):
        buf = np.empty(7 * P, np.float32)
        T, CR, CG, CB, CZ, PX, PY = 0, P, 2 * P, 3 * P, 4 * P, 5 * P, 6 * P
        for k in range(P):
            buf[PX + k] = F(k % TW) + HALF
            buf[PY + k] = F(k // TW) + HALF
        for slot in range(bounds[part], bounds[part + 1]):
            tile = tile_ids[slot]
            x0, y0 = (tile % tiles_x) * TW, (tile // tiles_x) * TH
            w, h = min(TW, width - x0), min(TH, height - y0)
            for k in range(P):
                buf[k] = ONE if (k % TW < w and k // TW < h) else ZERO
            for k in range(CR, PX):
                buf[k] = ZERO
            start, stop = tile_start[slot], tile_start[slot + 1]
            count = 0
            fx0, fy0 = F(x0), F(y0)
            for e in range(start, stop):
                if e + AHEAD < stop:
                    _prefetch(rec, entries[e + AHEAD, 0])
                r = entries[e, 0]
                u, v = rec[r, 0] - fx0, rec[r, 1] - fy0
                a, b, c = rec[r, 2], rec[r, 3], rec[r, 4]
                o, smax, hy = rec[r, 5], rec[r, 6], rec[r, 7]
                cr, cg, cb, cz = rec[r, 8], rec[r, 9], rec[r, 10], rec[r, 11]
                r0 = max(0, math.ceil(v - hy - HALF))
                r1 = min(h, math.floor(v + hy - HALF) + 1)
                for k in range(np.uint64(max(r0, 0) * TW), np.uint64(max(r1, 0) * TW)):
                    dx, dy = buf[np.uint64(PX) + k] - u, buf[np.uint64(PY) + k] - v
                    s = dx * (a * dx + b * dy) + c * dy * dy
                    y = max(s * EIGHTH, Y_MIN)
                    p = ONE + y * (E1 + y * (E2 + y * (E3 + y * (E4 + y * E5))))
                    p = p * p
                    p = p * p
                    p = p * p
                    alpha = min(o * p, ALPHA_MAX)
                    alpha = alpha if s <= smax else ZERO
                    trans = buf[k]
                    weight = alpha * trans
                    buf[k] = trans - weight
                    buf[np.uint64(CR) + k] += weight * cr
                    buf[np.uint64(CG) + k] += weight * cg
                    buf[np.uint64(CB) + k] += weight * cb
                    buf[np.uint64(CZ) + k] += weight * cz
                count += 1
                if count % STOP_EVERY == 0:
                    top = ZERO
                    for k in range(P):
                        top = max(top, buf[T + k])
                    if top < t_stop:
                        break
            used[slot] = count
            for j in range(h):
                for i in range(w):
                    k = j * TW + i
                    out[0, y0 + j, x0 + i] = buf[CR + k]
                    out[1, y0 + j, x0 + i] = buf[CG + k]
                    out[2, y0 + j, x0 + i] = buf[CB + k]
                    out[3, y0 + j, x0 + i] = buf[CZ + k]
                    out[4, y0 + j, x0 + i] = ONE - buf[T + k]


@njit(parallel=True, fastmath=True, cache=True)
def backward(rec, entries, tile_start, tile_ids, bounds, tiles_x, used, out, out_grad, entry_grad):
    """Write the row of `entry_grad` (E, 12) of every entry of the drawn tiles; see `chain_rule` for its columns.

    `out`, `out_grad` (5, H, W): forward's result and dL/dout.
    """
    height, width = out.shape[1], out.shape[2]
    for part in prange(bounds.shape[0] - 1):
        buf = np.empty(9 * P, np.float32)
        S, GR, GG, GB, GZ, GA = P, 2 * P, 3 * P, 4 * P, 5 * P, 6 * P
        PX, PY = 7 * P, 8 * P
        for k in range(P):
            buf[PX + k] = F(k % TW) + HALF
            buf[PY + k] = F(k // TW) + HALF
        for slot in range(bounds[part], bounds[part + 1]):
            tile = tile_ids[slot]
            x0, y0 = (tile % tiles_x) * TW, (tile // tiles_x) * TH
            w, h = min(TW, width - x0), min(TH, height - y0)
            for k in range(7 * P):
                buf[k] = ZERO
            for j in range(h):
                for i in range(w):
                    k = j * TW + i
                    gr, gg = out_grad[0, y0 + j, x0 + i], out_grad[1, y0 + j, x0 + i]
                    gb, gz = out_grad[2, y0 + j, x0 + i], out_grad[3, y0 + j, x0 + i]
                    ga = out_grad[4, y0 + j, x0 + i]
                    buf[k] = ONE
                    buf[GR + k], buf[GG + k], buf[GB + k], buf[GZ + k], buf[GA + k] = gr, gg, gb, gz, ga
                    buf[S + k] = (
                        gr * out[0, y0 + j, x0 + i] + gg * out[1, y0 + j, x0 + i] + gb * out[2, y0 + j, x0 + i]
                        + gz * out[3, y0 + j, x0 + i] + ga * out[4, y0 + j, x0 + i]
                    )
            start = tile_start[slot]
            stop = start + used[slot]
            fx0, fy0 = F(x0), F(y0)
            for e in range(start, stop):
                if e + AHEAD < stop:
                    _prefetch(rec, entries[e + AHEAD, 0])
                    _prefetch(entry_grad, entries[e + AHEAD, 1])
                r = entries[e, 0]
                u, v = rec[r, 0] - fx0, rec[r, 1] - fy0
                a, b, c = rec[r, 2], rec[r, 3], rec[r, 4]
                o, smax, hy = rec[r, 5], rec[r, 6], rec[r, 7]
                cr, cg, cb, cz = rec[r, 8], rec[r, 9], rec[r, 10], rec[r, 11]
                r0 = max(0, math.ceil(v - hy - HALF))
                r1 = min(h, math.floor(v + hy - HALF) + 1)
                m0, mx, my, mxx, mxy, myy = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
                sr, sg, sb, sz = ZERO, ZERO, ZERO, ZERO
                for k in range(np.uint64(max(r0, 0) * TW), np.uint64(max(r1, 0) * TW)):
                    dx, dy = buf[np.uint64(PX) + k] - u, buf[np.uint64(PY) + k] - v
                    s = dx * (a * dx + b * dy) + c * dy * dy
                    y = max(s * EIGHTH, Y_MIN)
                    p = ONE + y * (E1 + y * (E2 + y * (E3 + y * (E4 + y * E5))))
                    p = p * p
                    p = p * p
                    p = p * p
                    raw = o * p
                    raw = raw if s <= smax else ZERO
                    alpha = min(raw, ALPHA_MAX)
                    trans = buf[k]
                    weight = alpha * trans
                    gr, gg = buf[np.uint64(GR) + k], buf[np.uint64(GG) + k]
                    gb, gz = buf[np.uint64(GB) + k], buf[np.uint64(GZ) + k]
                    val = gr * cr + gg * cg + gb * cb + gz * cz + buf[np.uint64(GA) + k]
                    behind = buf[np.uint64(S) + k] - weight * val
                    buf[np.uint64(S) + k] = behind
                    buf[k] = trans - weight
                    q = (trans * val - behind / (ONE - alpha)) * raw
                    q = q if raw < ALPHA_MAX else ZERO
                    m0 += q
                    qx, qy = q * dx, q * dy
                    mx += qx
                    my += qy
                    mxx += qx * dx
                    mxy += qx * dy
                    myy += qy * dy
                    sr += weight * gr
                    sg += weight * gg
                    sb += weight * gb
                    sz += weight * gz
                row = entries[e, 1]
                entry_grad[row, 0], entry_grad[row, 1], entry_grad[row, 2] = m0, mx, my
                entry_grad[row, 3], entry_grad[row, 4], entry_grad[row, 5] = mxx, mxy, myy
                entry_grad[row, 6], entry_grad[row, 7], entry_grad[row, 8], entry_grad[row, 9] = sr, sg, sb, sz
            for e in range(stop, tile_start[slot + 1]):
                row = entries[e, 1]
                for j in range(10):
                    entry_grad[row, j] = ZERO
