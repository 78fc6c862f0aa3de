# mypy: ignore-errors
"""Code generation for the vector kernels: arithmetic on 8 float32 lanes as LLVM instructions.

Narrower machines split a vector, wider ones use half. Numba's cache does not see changes in this file: after an
edit, delete the `__pycache__` of this folder.
"""

import numpy as np
from llvmlite import ir

LANES = 8
FLOAT, VECTOR = ir.FloatType(), ir.VectorType(ir.FloatType(), LANES)


class Lanes:
    """Arithmetic on <8 x float> values with a readable notation; one instance per emitted function."""

    def __init__(self, builder):
        self.builder = builder

    def constant(self, values):
        """Vector of one or of eight numbers known now."""
        values = [values] * LANES if np.isscalar(values) else values
        return ir.Constant(VECTOR, [ir.Constant(FLOAT, float(np.float32(v))) for v in values])

    def splat(self, scalar):
        """Vector with the run-time scalar in every lane."""
        b = self.builder
        first = b.insert_element(ir.Constant(VECTOR, ir.Undefined), scalar, ir.Constant(ir.IntType(32), 0))
        zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
        return b.shuffle_vector(first, ir.Constant(VECTOR, ir.Undefined), zeros)

    def add(self, x, y):
        """x + y."""
        return self.builder.fadd(x, y, flags=("fast",))

    def sub(self, x, y):
        """x - y."""
        return self.builder.fsub(x, y, flags=("fast",))

    def mul(self, x, y):
        """x y."""
        return self.builder.fmul(x, y, flags=("fast",))

    def div(self, x, y):
        """x / y."""
        return self.builder.fdiv(x, y, flags=("fast",))

    def mul_add(self, x, y, z):
        """x y + z."""
        return self.add(self.mul(x, y), z)

    def where(self, comparison, x, y, yes, no):
        """Lanes of `yes` where x (comparison) y holds, else of `no`."""
        return self.builder.select(self.builder.fcmp_ordered(comparison, x, y), yes, no)

    def load(self, base, plane):
        """Plane of the pixel group at pointer `base`."""
        return self.builder.load(self._address(base, plane), align=4)

    def store(self, value, base, plane):
        """Write a plane of the pixel group at pointer `base`."""
        self.builder.store(value, self._address(base, plane), align=4)

    def _address(self, base, plane):
        pointer = self.builder.gep(base, [ir.IntType(64)(plane * LANES)])
        return self.builder.bitcast(pointer, VECTOR.as_pointer())

    def sums(self, vectors):
        """One vector whose lane i is the sum over the lanes of vectors[i]; eight vectors."""
        b = self.builder
        for width in (4, 2, 1):
            paired = []
            for x, y in zip(vectors[: len(vectors) // 2], vectors[len(vectors) // 2 :]):
                # Blocks of `width` lanes: even blocks of x and y into one vector, odd blocks into the other.
                even, odd = [], []
                for block in range(0, LANES, 2 * width):
                    even += list(range(block, block + width)) + list(range(LANES + block, LANES + block + width))
                    odd += [i + width for i in even[-2 * width :]]
                kind = ir.VectorType(ir.IntType(32), LANES)
                low = b.shuffle_vector(x, y, ir.Constant(kind, even))
                high = b.shuffle_vector(x, y, ir.Constant(kind, odd))
                paired.append(self.add(low, high))
            vectors = paired
        return vectors[0]


def lane_order():
    """Which of its eight inputs each lane of `Lanes.sums` ends up with."""
    lanes = [[i] * LANES for i in range(LANES)]
    for width in (4, 2, 1):
        paired = []
        for x, y in zip(lanes[: len(lanes) // 2], lanes[len(lanes) // 2 :]):
            low = []
            for block in range(0, LANES, 2 * width):
                low += x[block : block + width] + y[block : block + width]
            paired.append(low)
        lanes = paired
    return lanes[0]


def arranged(order):
    """Arrangement of the inputs of `Lanes.sums` so that lane i holds the sum of input i."""
    inputs = [0] * LANES
    for lane, source in enumerate(order):
        inputs[source] = lane
    return inputs
