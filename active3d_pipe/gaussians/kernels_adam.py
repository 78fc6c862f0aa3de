# mypy: ignore-errors
"""Numba kernel: Adam over all parameters of all primitives in one sweep."""

import math

import numpy as np
from numba import njit, prange

F = np.float32
ZERO, ONE = F(0), F(1)
CHUNKS = 64
# The root mean square gradient below which steps shrink. Visible primitives have 1e-6 to 1e-3; with a smaller value
# those that are hidden behind others, whose gradients are noise of 1e-9, wander at the full rate.
EPSILON = F(1e-7)
# Moments of long unseen primitives decay into denormal numbers, which are slow; they are cut off here.
TINY = F(1e-30)


@njit(parallel=True, fastmath=True, cache=True)
def adam(values, moment1, moment2, steps, grad, rates, beta1, beta2, visible_only, visible):
    """One Adam step (Kingma & Ba 2015) on `values` (N, 14), in place.

    `steps` (N,) int32 counts the updates of each primitive, so that the bias correction fits those that were
    added later; `rates` (14,) learning rates; `visible` (N,) bool is read when `visible_only`.
    """
    n, width = values.shape
    one_less_1, one_less_2 = ONE - beta1, ONE - beta2
    # Powers by exp(t log beta): LLVM turns a power with a whole exponent into a call that Numba cannot link.
    log_beta1, log_beta2 = math.log(max(beta1, TINY)), math.log(max(beta2, TINY))
    for c in prange(CHUNKS):
        for i in range(n * c // CHUNKS, n * (c + 1) // CHUNKS):
            if visible_only and not visible[i]:
                continue
            steps[i] += 1
            t = F(steps[i])
            step = ONE / (ONE - math.exp(t * log_beta1))
            correct2 = ONE / math.sqrt(ONE - math.exp(t * log_beta2))
            for j in range(width):
                g = grad[i, j]
                m = beta1 * moment1[i, j] + one_less_1 * g
                v = beta2 * moment2[i, j] + one_less_2 * g * g
                m = m if abs(m) > TINY else ZERO
                moment1[i, j] = m
                moment2[i, j] = v
                values[i, j] -= rates[j] * step * m / (math.sqrt(v) * correct2 + EPSILON)
