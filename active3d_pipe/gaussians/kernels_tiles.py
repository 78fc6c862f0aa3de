# mypy: ignore-errors
"""Numba kernels: alpha blending of the records, tile by tile, forward and backward.

Backward walks front to back like forward and recomputes alpha, so nothing is stored per pixel: with S the
part of <gradient, output> that lies behind the current primitive, dL/dalpha = T val - S / (1 - alpha),
where val = <gradient, (colour, z, 1, off)>, off = min(|z - seen|, SIGHT_LIMIT_M) the distance from an observed depth.

A tile's pixels live in one flat float32 buffer that stays in the L1 cache, in groups of 8 neighbours of a row:
group (strip, row) holds its planes one after the other, 8 floats each. A primitive walks only the rows and
8-pixel-wide strips that it reaches. The walk is written in LLVM vectors of 8 lanes (`_blend`, `_unblend`): within a
strip dx is constant per lane, which keeps the ten sums of backward in few registers; a loop left to the automatic
vectoriser takes about half as long again.
"""

import math

import numpy as np
from llvmlite import ir
from numba import njit, prange, types
from numba.core import cgutils
from numba.extending import intrinsic

from active3d_pipe.gaussians.kernels_lanes import FLOAT, LANES, VECTOR, Lanes, arranged, lane_order

TW, TH = 16, 16
STRIPS = TW // LANES
F = np.float32
_float, _vector, _i64 = FLOAT, VECTOR, ir.IntType(64)
ZERO, HALF, ONE = F(0), F(0.5), F(1)
ALPHA_MAX = 0.99
# Farther than this from the observed depth a primitive costs no more: depth edges, and what glass lets through.
SIGHT_LIMIT_M = 0.3
STOP_EVERY = 16
AHEAD = 4
# Planes of a group, forward: transmittance, r, g, b, z, off, the observed depth; backward: transmittance, S, the
# gradients of r, g, b, z, alpha and off, the observed depth.
FORWARD_PLANES, BACKWARD_PLANES = 7, 9
FORWARD_GROUP, BACKWARD_GROUP = FORWARD_PLANES * LANES, BACKWARD_PLANES * LANES
# exp(-s) = poly(-s / 8)^8, fitted on [-0.72, 0], relative error 8e-7; s never exceeds ln 255 = 5.54.
EXP_POLY = (0.00582640022, 0.0397533720, 0.165975796, 0.499888322, 0.999993988, 1.0)
Y_MIN = -0.75



class _Walk:
    """The part that forward and backward share: strips and rows of one primitive, and alpha of 8 pixels."""

    def __init__(self, builder, group, scalars):
        self.lanes = Lanes(builder)
        self.builder = builder
        self.group = group
        (self.base, self.r0, self.r1, self.u, self.v, self.hx, self.a, self.b, self.c, self.o, self.smax) = scalars

    def strips(self, carried, body):
        """Emit, for every strip that the primitive reaches, a loop over its rows.

        `carried` = (number of state vectors, number of totals, fold). `body(row_base, dy, raw, state)`, with
        raw = o exp(-s) or 0 outside the cut-off, returns the new state, which starts at zero in every strip;
        `fold(dx, state, totals)` adds the state of a finished strip to the totals. Returns the totals.
        """
        b, ln = self.builder, self.lanes
        num_state, num_totals, fold = carried
        totals = [ln.constant(0.0)] * num_totals
        o, smax = ln.splat(self.o), ln.splat(self.smax)
        for strip in range(STRIPS):
            centre = strip * LANES
            left = b.fcmp_ordered("<", b.fsub(self.u, self.hx), _float(centre + LANES - 0.5))
            right = b.fcmp_ordered(">", b.fadd(self.u, self.hx), _float(centre + 0.5))
            reached = b.and_(b.and_(left, right), b.icmp_signed("<", self.r0, self.r1))
            entry = b.block
            loop, done = b.append_basic_block("rows"), b.append_basic_block("strip_done")
            lane_x = ln.constant([centre + i + 0.5 for i in range(LANES)])
            dx = ln.sub(lane_x, ln.splat(self.u))
            adx2, bdx = ln.mul(ln.mul(ln.splat(self.a), dx), dx), ln.mul(ln.splat(self.b), dx)
            b.cbranch(reached, loop, done)
            b.position_at_end(loop)
            row = b.phi(_i64)
            row.add_incoming(self.r0, entry)
            state = [b.phi(_vector) for _ in range(num_state)]
            for phi in state:
                phi.add_incoming(ln.constant(0.0), entry)
            offset = b.mul(b.add(row, _i64(strip * TH)), _i64(self.group))
            row_base = b.gep(self.base, [offset])
            dy = b.fsub(b.fadd(b.sitofp(row, _float), _float(0.5)), self.v, flags=("fast",))
            cdy2 = b.fmul(b.fmul(self.c, dy, flags=("fast",)), dy, flags=("fast",))
            dy = ln.splat(dy)
            s = ln.mul_add(dy, bdx, ln.add(adx2, ln.splat(cdy2)))
            raw = self._falloff(s, o)
            raw = ln.where("<=", s, smax, raw, ln.constant(0.0))
            new_state = body(row_base, dy, raw, state)
            after = b.add(row, _i64(1))
            row.add_incoming(after, b.block)
            for phi, value in zip(state, new_state):
                phi.add_incoming(value, b.block)
            more = b.icmp_signed("<", after, self.r1)
            folded_block = b.append_basic_block("fold")
            b.cbranch(more, loop, folded_block)
            b.position_at_end(folded_block)
            folded = fold(dx, new_state, totals) if fold else []
            b.branch(done)
            b.position_at_end(done)
            merged = []
            for before, value in zip(totals, folded):
                phi = b.phi(_vector)
                phi.add_incoming(before, entry)
                phi.add_incoming(value, folded_block)
                merged.append(phi)
            totals = merged
        return totals

    def off(self, z, seen):
        """min(|z - seen|, SIGHT_LIMIT_M), and its derivative with respect to z."""
        ln = self.lanes
        zero, limit = ln.constant(0.0), ln.constant(SIGHT_LIMIT_M)
        farther = ln.sub(z, seen)
        distance = ln.where(">", farther, zero, farther, ln.sub(zero, farther))
        side = ln.where(">", farther, zero, ln.constant(1.0), ln.constant(-1.0))
        within = ln.where("<", distance, limit, distance, limit)
        return within, ln.where("<", distance, limit, side, zero)

    def _falloff(self, s, o):
        """o exp(-s)."""
        ln = self.lanes
        y = ln.mul(s, ln.constant(-0.125))
        y = ln.where(">", y, ln.constant(Y_MIN), y, ln.constant(Y_MIN))
        p = ln.constant(EXP_POLY[0])
        for coefficient in EXP_POLY[1:]:
            p = ln.mul_add(p, y, ln.constant(coefficient))
        for _ in range(3):
            p = ln.mul(p, p)
        return ln.mul(o, p)


def _float_pointer(context, builder, array_type, array, index):
    """Pointer to element `index` of a contiguous float32 array, counted in floats."""
    ary = context.make_array(array_type)(context, builder, array)
    return builder.gep(builder.bitcast(ary.data, _float.as_pointer()), [index])


@intrinsic
def _blend(typingctx, buf, r0, r1, u, v, hx, a, b, c, o, smax, cr, cg, cb, cz):
    """Blend one primitive onto rows r0 : r1 of the forward buffer."""
    scalars = [types.int64] * 2 + [types.float32] * 12

    def codegen(context, builder, signature, args):
        base = _float_pointer(context, builder, signature.args[0], args[0], _i64(0))
        walk = _Walk(builder, FORWARD_GROUP, (base, *args[1:11]))
        ln = walk.lanes
        colour = [ln.splat(x) for x in args[11:15]]

        def body(row_base, dy, raw, state):
            alpha = ln.where("<", raw, ln.constant(ALPHA_MAX), raw, ln.constant(ALPHA_MAX))
            trans = ln.load(row_base, 0)
            weight = ln.mul(alpha, trans)
            ln.store(ln.sub(trans, weight), row_base, 0)
            for plane, channel in enumerate(colour, 1):
                ln.store(ln.mul_add(weight, channel, ln.load(row_base, plane)), row_base, plane)
            off, _ = walk.off(colour[3], ln.load(row_base, 6))
            ln.store(ln.mul_add(weight, off, ln.load(row_base, 5)), row_base, 5)
            return []

        walk.strips((0, 0, None), body)
        return context.get_dummy_value()

    return types.void(buf, *scalars), codegen


@intrinsic
def _unblend(typingctx, buf, r0, r1, u, v, hx, a, b, c, o, smax, cr, cg, cb, cz, sums, row):
    """Walk one primitive over the backward buffer; write its ten sums to row `row` of `sums` (E, 12)."""
    scalars = [types.int64] * 2 + [types.float32] * 12

    def codegen(context, builder, signature, args):
        base = _float_pointer(context, builder, signature.args[0], args[0], _i64(0))
        walk = _Walk(builder, BACKWARD_GROUP, (base, *args[1:11]))
        ln = walk.lanes
        colour = [ln.splat(x) for x in args[11:15]]
        zero, one, top = ln.constant(0.0), ln.constant(1.0), ln.constant(ALPHA_MAX)

        def body(row_base, dy, raw, state):
            alpha = ln.where("<", raw, top, raw, top)
            trans = ln.load(row_base, 0)
            weight = ln.mul(alpha, trans)
            grads = [ln.load(row_base, plane) for plane in range(2, 6)]
            val = ln.load(row_base, 6)
            for g, channel in zip(grads, colour):
                val = ln.mul_add(g, channel, val)
            g_off = ln.load(row_base, 7)
            off, slope = walk.off(colour[3], ln.load(row_base, 8))
            val = ln.mul_add(g_off, off, val)
            grads[3] = ln.mul_add(g_off, slope, grads[3])
            behind = ln.sub(ln.load(row_base, 1), ln.mul(weight, val))
            ln.store(behind, row_base, 1)
            ln.store(ln.sub(trans, weight), row_base, 0)
            d_alpha = ln.sub(ln.mul(trans, val), ln.div(behind, ln.sub(one, alpha)))
            q = ln.where("<", raw, top, ln.mul(d_alpha, raw), zero)
            q_dy = ln.mul(q, dy)
            new = [q, q_dy, ln.mul(q_dy, dy), *(ln.mul(weight, g) for g in grads)]
            return [ln.add(old, value) for old, value in zip(state, new)]

        def fold(dx, state, totals):
            q, q_dy, q_dy2, *weighted = state
            q_dx = ln.mul(q, dx)
            new = [q, q_dx, q_dy, ln.mul(q_dx, dx), ln.mul(q_dy, dx), q_dy2, *weighted]
            return [ln.add(old, value) for old, value in zip(totals, new)]

        totals = walk.strips((7, 10, fold), body)
        start = builder.mul(args[16], _i64(12))
        out = _float_pointer(context, builder, signature.args[15], args[15], start)
        order = lane_order()
        ln.store(ln.sums([totals[i] for i in arranged(order)]), out, 0)
        rest = ln.sums([totals[8], totals[9], *[zero] * 6])
        for column, lane in ((8, order.index(0)), (9, order.index(1))):
            value = builder.extract_element(rest, ir.Constant(ir.IntType(32), lane))
            builder.store(value, builder.gep(out, [_i64(column)]))
        return context.get_dummy_value()

    return types.void(buf, *scalars, sums, types.int64), codegen


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
def forward(rec, entries, tile_start, tile_ids, bounds, tiles_x, t_stop, seen, out, used):
    """Blend the tiles `tile_ids`; thread part p owns tiles bounds[p] : bounds[p + 1].

    `out` (5, H, W) receives r, g, b, sum w z, alpha; with six planes also sum w min(|z - seen|, SIGHT_LIMIT_M) for the
    observed depth `seen` (H, W). `used` receives how many entries of each tile counted before its largest transmittance
    fell under `t_stop`. Tiles that are not listed keep what `out` held.
    """
    height, width = out.shape[1], out.shape[2]
    observed = out.shape[0] == 6
    for part in prange(bounds.shape[0] - 1):
        buf = np.empty(STRIPS * TH * FORWARD_GROUP, np.float32)
        for slot in range(bounds[part], bounds[part + 1]):
            tile = tile_ids[slot]
            x0, y0 = (tile % tiles_x) * TW, (tile // tiles_x) * TH
            w, h = min(TW, width - x0), min(TH, height - y0)
            buf[:] = ZERO
            for j in range(h):
                for i in range(w):
                    # Pixels outside the image stay opaque, so that they do not hold up the early stop.
                    k = ((i // LANES) * TH + j) * FORWARD_GROUP + i % LANES
                    buf[k] = ONE
                    if observed:
                        buf[k + 6 * LANES] = seen[y0 + j, x0 + i]
            start, stop = tile_start[slot], tile_start[slot + 1]
            count = 0
            fx0, fy0 = F(x0), F(y0)
            for e in range(start, stop):
                if e + AHEAD < stop:
                    _prefetch(rec, entries[e + AHEAD, 0])
                r = entries[e, 0]
                v, hy = rec[r, 1] - fy0, rec[r, 7]
                r0 = max(0, math.ceil(v - hy - HALF))
                r1 = min(h, math.floor(v + hy - HALF) + 1)
                _blend(
                    buf, r0, r1, rec[r, 0] - fx0, v, rec[r, 12], rec[r, 2], rec[r, 3], rec[r, 4], rec[r, 5],
                    rec[r, 6], rec[r, 8], rec[r, 9], rec[r, 10], rec[r, 11],
                )
                count += 1
                if count % STOP_EVERY == 0:
                    top = ZERO
                    for g in range(STRIPS * TH):
                        for i in range(LANES):
                            top = max(top, buf[g * FORWARD_GROUP + i])
                    if top < t_stop:
                        break
            used[slot] = count
            for j in range(h):
                for i in range(w):
                    k = ((i // LANES) * TH + j) * FORWARD_GROUP + i % LANES
                    out[0, y0 + j, x0 + i] = buf[k + LANES]
                    out[1, y0 + j, x0 + i] = buf[k + 2 * LANES]
                    out[2, y0 + j, x0 + i] = buf[k + 3 * LANES]
                    out[3, y0 + j, x0 + i] = buf[k + 4 * LANES]
                    out[4, y0 + j, x0 + i] = ONE - buf[k]
                    if observed:
                        out[5, y0 + j, x0 + i] = buf[k + 5 * LANES]


@njit(parallel=True, fastmath=True, cache=True)
def backward(rec, entries, tile_start, tile_ids, bounds, tiles_x, used, seen, out, out_grad, entry_grad):
    """Write the row of `entry_grad` (E, 12) of every entry of the drawn tiles; see `chain_rule` for its columns.

    `out`, `out_grad` (5 or 6, H, W): forward's result and dL/dout; `seen` as in `forward`.
    """
    height, width = out.shape[1], out.shape[2]
    observed = out.shape[0] == 6
    for part in prange(bounds.shape[0] - 1):
        buf = np.empty(STRIPS * TH * BACKWARD_GROUP, np.float32)
        for slot in range(bounds[part], bounds[part + 1]):
            tile = tile_ids[slot]
            x0, y0 = (tile % tiles_x) * TW, (tile // tiles_x) * TH
            w, h = min(TW, width - x0), min(TH, height - y0)
            buf[:] = ZERO
            for j in range(h):
                for i in range(w):
                    k = ((i // LANES) * TH + j) * BACKWARD_GROUP + i % LANES
                    total = ZERO
                    for p in range(out.shape[0]):
                        g = out_grad[p, y0 + j, x0 + i]
                        buf[k + (p + 2) * LANES] = g
                        total += g * out[p, y0 + j, x0 + i]
                    if observed:
                        buf[k + 8 * LANES] = seen[y0 + j, x0 + i]
                    buf[k], buf[k + LANES] = ONE, total
            start = tile_start[slot]
            stop = start + used[slot]
            fx0, fy0 = F(x0), F(y0)
            for e in range(start, stop):
                if e + AHEAD < stop:
                    _prefetch(rec, entries[e + AHEAD, 0])
                    _prefetch(entry_grad, entries[e + AHEAD, 1])
                r = entries[e, 0]
                v, hy = rec[r, 1] - fy0, rec[r, 7]
                r0 = max(0, math.ceil(v - hy - HALF))
                r1 = min(h, math.floor(v + hy - HALF) + 1)
                _unblend(
                    buf, r0, r1, rec[r, 0] - fx0, v, rec[r, 12], rec[r, 2], rec[r, 3], rec[r, 4], rec[r, 5],
                    rec[r, 6], rec[r, 8], rec[r, 9], rec[r, 10], rec[r, 11], entry_grad, entries[e, 1],
                )
            for e in range(stop, tile_start[slot + 1]):
                row = entries[e, 1]
                for j in range(10):
                    entry_grad[row, j] = ZERO
