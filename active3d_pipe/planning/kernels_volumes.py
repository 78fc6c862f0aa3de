# mypy: ignore-errors
"""Numba kernels: what a decision asks of every voxel, in a few passes; `reference_volumes.py` is their slow twin.

Bits of the eight half-size cells of a voxel are those of `kernels_sight`; kinds are those of `information.gain`.
"""

import math

import numpy as np
from numba import njit, prange

F = np.float32
ZERO, ONE = F(0), F(1)
# Transmittances count as this at least where their logarithm is taken.
LEAST = F(1e-6)
# Bits of the cells in the lower and the upper half of a voxel, along x, y, z.
LOW_X, HIGH_X, LOW_Y, HIGH_Y, LOW_Z, HIGH_Z = 0x0F, 0xF0, 0x33, 0xCC, 0x55, 0xAA


@njit(parallel=True, cache=True)
def joint_occupancy(free, hit, occupancy, sdf, trust_rays, softness, out):
    """out (X, Y, Z) f32: probability that a voxel is solid, by rays and field (`risk_field.joint_occupancy`)."""
    nx, ny, nz = free.shape
    for i in prange(nx):
        for j in range(ny):
            for k in range(nz):
                rays = free[i, j, k] + hit[i, j, k]
                if not rays > ZERO:
                    out[i, j, k] = ONE
                    continue
                trust = rays / (rays + trust_rays)
                x = min(max(sdf[i, j, k] / softness, F(-30)), F(30))
                out[i, j, k] = trust * occupancy[i, j, k] + (ONE - trust) / (ONE + math.exp(x))


@njit(parallel=True, cache=True)
def free_by_rays(free, hit, occupancy, least_rays, most_occupancy, out):
    """out (X, Y, Z) bool: rays passed, none of weight ended, and O is low."""
    nx, ny, nz = free.shape
    for i in prange(nx):
        for j in range(ny):
            for k in range(nz):
                f = free[i, j, k]
                out[i, j, k] = f >= least_rays and occupancy[i, j, k] <= most_occupancy and (
                    hit[i, j, k] < F(2) + F(0.02) * f
                )


@njit(parallel=True, cache=True)
def drop_half_seen(free, passed, out):
    """out (X, Y, Z) bool = free, but where the half towards a neighbour that is not was passed by no ray.

    `passed` (X, Y, Z) f32 holds bits.
    """
    nx, ny, nz = free.shape
    for i in prange(nx):
        for j in range(ny):
            for k in range(nz):
                out[i, j, k] = free[i, j, k]
                bits = int(passed[i, j, k])
                if not free[i, j, k] or bits == 255:
                    continue
                if (
                    (not bits & LOW_X and i > 0 and not free[i - 1, j, k])
                    or (not bits & HIGH_X and i + 1 < nx and not free[i + 1, j, k])
                    or (not bits & LOW_Y and j > 0 and not free[i, j - 1, k])
                    or (not bits & HIGH_Y and j + 1 < ny and not free[i, j + 1, k])
                    or (not bits & LOW_Z and k > 0 and not free[i, j, k - 1])
                    or (not bits & HIGH_Z and k + 1 < nz and not free[i, j, k + 1])
                ):
                    out[i, j, k] = False


@njit(parallel=True, cache=True)
def risk(clearance, preferred, width, out):
    """out (X, Y, Z) f32: smooth step from 0 at the preferred clearance to 1, `width` m nearer."""
    nx, ny, nz = clearance.shape
    for i in prange(nx):
        for j in range(ny):
            for k in range(nz):
                s = min(max((preferred - clearance[i, j, k]) / width, ZERO), ONE)
                out[i, j, k] = s * s * (F(3) - F(2) * s)


@njit(parallel=True, cache=True)
def sight(kind, hit, occupancy, passed, ended, passes, through, log_through, clear, unmet):
    """Fill the last four (X, Y, Z): transmittance and its logarithm f32, u8 bits of clear cells and of unmet ones.

    `passed`, `ended` (X, Y, Z) f32 hold bits; `passes`: share of rays that an unseen voxel lets through.
    """
    nx, ny, nz = kind.shape
    log_passes = math.log(max(passes, LEAST))
    for i in prange(nx):
        for j in range(ny):
            for k in range(nz):
                what = kind[i, j, k]
                by, at = np.uint8(passed[i, j, k]), np.uint8(ended[i, j, k])
                unmet[i, j, k] = ~(by | at)
                share, log_share = ONE, ZERO
                if what == 1:
                    # Less where the field believes in something solid.
                    share = passes * min(max(F(2) - F(2) * occupancy[i, j, k], ZERO), ONE)
                    log_share = log_passes if share == passes else math.log(max(share, LEAST))
                elif what == 2:
                    share, log_share = ZERO, math.log(LEAST)
                through[i, j, k], log_through[i, j, k] = share, log_share
                clear[i, j, k] = np.uint8(255) if what == 0 and hit[i, j, k] == ZERO else by & ~at


@njit(parallel=True, cache=True)
def half_seen(kind, passed, out):
    """out (X, Y, Z) u8 = 1: seen free, though some half was passed by no ray, and no face shared with an open one."""
    nx, ny, nz = kind.shape
    for i in prange(nx):
        for j in range(ny):
            for k in range(nz):
                bits = int(passed[i, j, k])
                out[i, j, k] = 0
                if kind[i, j, k] != 0 or bits == 0 or bits == 255:
                    continue
                if (
                    bits & LOW_X and bits & HIGH_X and bits & LOW_Y and bits & HIGH_Y and bits & LOW_Z and bits & HIGH_Z
                ):
                    continue
                beside_open = (
                    (i > 0 and kind[i - 1, j, k] == 1) or (i + 1 < nx and kind[i + 1, j, k] == 1)
                    or (j > 0 and kind[i, j - 1, k] == 1) or (j + 1 < ny and kind[i, j + 1, k] == 1)
                    or (k > 0 and kind[i, j, k - 1] == 1) or (k + 1 < nz and kind[i, j, k + 1] == 1)
                )
                out[i, j, k] = not beside_open


@njit(parallel=True, cache=True)
def open_half_seen(half, hit, kind, of_interest, opaque):
    """kind = open where `half`; then of_interest u8 = 1 where not seen free or hit, opaque u8 = 1 at surface."""
    nx, ny, nz = kind.shape
    for i in prange(nx):
        for j in range(ny):
            for k in range(nz):
                if half[i, j, k]:
                    kind[i, j, k] = 1
                of_interest[i, j, k] = kind[i, j, k] != 0 or hit[i, j, k] > ZERO
                opaque[i, j, k] = kind[i, j, k] == 2


@njit(cache=True)
def powers(base, exponent):
    """base ** exponent of a flat float32 array that is mostly zero; float32."""
    out = np.ones(exponent.size, np.float32)
    for v in range(exponent.size):
        if exponent[v] != ZERO:
            out[v] = base ** exponent[v]
    return out
