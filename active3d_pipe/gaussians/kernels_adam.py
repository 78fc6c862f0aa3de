# mypy: ignore-errors
"""Numba kernels: Adam over the primitives that an image shows, and the steps that the others owe.

Adam moves a parameter on after its gradient has gone, by its momentum; with momentum cut off for what an image does
not show, fewer images are fitted well (docs/findings/optimisation.md). But a primitive that is not looked at need not
be moved in every iteration: `near` takes all the steps that it owes at once, when it may be seen again.
"""

import math

import numpy as np
from numba import njit, prange

from active3d_pipe.gaussians.kernels_projection import on_screen, screen_bound

F = np.float32
ZERO, ONE = F(0), F(1)
CHUNKS = 64
# The root mean square gradient below which steps shrink. Visible primitives have 1e-6 to 1e-3; with a smaller value
# those that are hidden behind others, whose gradients are noise of 1e-9, wander at the full rate.
EPSILON = F(1e-7)
# Moments of long unseen primitives decay into denormal numbers, which are slow; they are cut off here.
TINY = F(1e-30)
# Steps after which the corrections of Adam's bias change so evenly that those in the middle may stand for all.
EVEN = 20
# Momentum that is so many steps old moves nothing any more.
SPENT = 80
# How far the steps that are owed may take a primitive from where its record says it is, m, and how much larger.
ASTRAY_M, LARGER = F(0.01), F(1.6)


@njit(fastmath=True, cache=True)
def _settle(values, i, places, largest):
    """Keep the log-scales of primitive i below `largest`, then `_measure` it."""
    for j in range(3, 6):
        values[i, j] = min(values[i, j], largest)
    _measure(values, i, places)


@njit(fastmath=True, cache=True)
def _measure(values, i, places):
    """places[i] = mean and largest standard deviation of primitive i."""
    places[i, 0], places[i, 1], places[i, 2] = values[i, 0], values[i, 1], values[i, 2]
    places[i, 3] = math.exp(max(values[i, 3], max(values[i, 4], values[i, 5])))


@njit(parallel=True, cache=True)
def measure(values, places):
    """Fill `places` (N, 4) float32, all that `near` needs of most primitives, a quarter of what `values` holds."""
    n = len(values)
    for c in prange(CHUNKS):
        for i in range(n * c // CHUNKS, n * (c + 1) // CHUNKS):
            _measure(values, i, places)


@njit(parallel=True, fastmath=True, cache=True)
def adam(values, moment1, moment2, steps, places, rows, grad, rates, beta1, beta2, largest):
    """One Adam step (Kingma & Ba 2015) on the rows `rows` (M,) of `values` (N, 14) with `grad` (M, 14), in place.

    `places` (N, 4) is kept as `measure` makes it. `steps` (N,) int32 counts the updates of each primitive, so that the
    bias correction fits those that were added later; `rates` (14,) learning rates, `largest` log-scale allowed.
    """
    n, width = grad.shape
    one_less_1, one_less_2 = ONE - beta1, ONE - beta2
    # Powers by exp(t log beta): LLVM turns a power with a whole exponent into a call that Numba cannot link.
    log_beta1, log_beta2 = math.log(max(beta1, TINY)), math.log(max(beta2, TINY))
    for c in prange(CHUNKS):
        for r in range(n * c // CHUNKS, n * (c + 1) // CHUNKS):
            i = rows[r]
            steps[i] += 1
            t = F(steps[i])
            step = ONE / (ONE - math.exp(t * log_beta1))
            correct2 = ONE / math.sqrt(ONE - math.exp(t * log_beta2))
            for j in range(width):
                g = grad[r, j]
                m = beta1 * moment1[i, j] + one_less_1 * g
                v = beta2 * moment2[i, j] + one_less_2 * g * g
                m = m if abs(m) > TINY else ZERO
                moment1[i, j] = m
                moment2[i, j] = v
                values[i, j] -= rates[j] * step * m / (math.sqrt(v) * correct2 + EPSILON)
            _settle(values, i, places, largest)


@njit(fastmath=True, cache=True)
def _go_on(values, moment1, moment2, steps, places, i, missed, rates, beta1, beta2, largest):
    """Take `missed` steps of zero gradient at once on primitive i.

    The denominators of these steps differ by their bias correction only. It is taken along, but for the share that
    EPSILON has in them, which is that of the first; after EVEN steps it is that of the steps' centre of gravity.
    """
    log_beta1, log_beta2 = math.log(max(beta1, TINY)), math.log(max(beta2, TINY))
    t = F(steps[i])
    steps[i] += missed
    if t == ZERO:  # no moments yet
        return
    decay1, decay2 = math.exp(F(missed) * log_beta1), math.exp(F(missed) * log_beta2)
    first = math.sqrt((ONE - math.exp((t + ONE) * log_beta2)) / max(beta2, TINY))
    whole = ZERO
    if t > EVEN:
        middle = ONE / (ONE - beta1) - F(missed) * decay1 / (ONE - decay1)
        bias1, bias2 = math.exp((t + middle) * log_beta1), math.exp((t + middle) * log_beta2)
        whole = beta1 * (ONE - decay1) / (ONE - beta1) / (ONE - bias1)
        whole *= math.sqrt((ONE - bias2) / math.exp(middle * log_beta2))
    else:
        bias1, bias2, power1, power2 = math.exp(t * log_beta1), math.exp(t * log_beta2), ONE, ONE
        for _ in range(min(missed, SPENT)):
            bias1, bias2, power1, power2 = bias1 * beta1, bias2 * beta2, power1 * beta1, power2 * beta2
            whole += power1 / (ONE - bias1) * math.sqrt((ONE - bias2) / max(power2, TINY))
    for j in range(values.shape[1]):
        m = moment1[i, j]
        if m == ZERO:
            moment2[i, j] *= decay2
            continue
        values[i, j] -= rates[j] * whole * m / (math.sqrt(moment2[i, j]) + EPSILON * first)
        m *= decay1
        moment1[i, j] = m if abs(m) > TINY else ZERO
        moment2[i, j] *= decay2
    _settle(values, i, places, largest)


@njit(parallel=True, fastmath=True, cache=True)
def near(
    values, moment1, moment2, steps, places, done, now, rates, beta1, beta2, largest, R, t, view, dilation, chunks,
    which, counts,
):
    """Find the primitives that a view may show, and take the steps that these owe.

    `done` (N,) int32 is the iteration that each primitive has come to, `now` the one that the others have. The view is
    given as in `project`; chunk c fills which[N c // chunks :][: counts[c]] with indices, ascending.
    """
    n = values.shape[0]
    spread, margin = screen_bound(view, dilation)
    for c in prange(chunks):
        first = n * c // chunks
        k = first
        for i in range(first, n * (c + 1) // chunks):
            missed = now - done[i]
            larger, astray = (LARGER, ASTRAY_M) if missed > 0 else (ONE, ZERO)
            if not on_screen(
                places[i, 0], places[i, 1], places[i, 2], larger * places[i, 3], astray, R, t, view, spread, margin
            )[0]:
                continue
            if missed > 0:
                _go_on(values, moment1, moment2, steps, places, i, missed, rates, beta1, beta2, largest)
                done[i] = now
            which[k] = i
            k += 1
        counts[c] = k - first


@njit(parallel=True, fastmath=True, cache=True)
def catch_up(values, moment1, moment2, steps, places, done, now, rows, rates, beta1, beta2, largest):
    """Take the steps that the primitives `rows` (M,) owe; see `near`."""
    n = len(rows)
    for c in prange(CHUNKS):
        for r in range(n * c // CHUNKS, n * (c + 1) // CHUNKS):
            i = rows[r]
            missed = now - done[i]
            if missed > 0:
                _go_on(values, moment1, moment2, steps, places, i, missed, rates, beta1, beta2, largest)
                done[i] = now
