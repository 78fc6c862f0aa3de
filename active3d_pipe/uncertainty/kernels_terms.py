"""What is computed voxel by voxel, in one pass over the volume; `reference_terms.py` is the slow twin.

The formulas are those of `occupancy`, `implicit` and `temporal`, where they are explained. Most voxels of a volume were
never seen or are surely free, and need little of them; whole arrays would pass through memory many times.
"""

# mypy: disable-error-code=no-untyped-def

import math
from typing import NamedTuple

import numpy as np
from numba import njit, prange

# From here on a share is full, and a normal variable surely below, to float32.
FULL, FAR = 20.0, 6.5


class TermConstants(NamedTuple):
    """Settings that the pass needs (`UncertaintySettings` says what they are), and the voxel's edge, m."""

    voxel_size_m: float
    observation_rays: float
    free_log_odds: float
    hit_log_odds: float
    free_log_odds_max: float
    hit_log_odds_max: float
    gaussian_log_odds: float
    sdf_log_odds_max: float
    vain_keep: float
    sigma_scale_m: float
    surface_rays: float
    sigma_floor_m: float
    beta_1: float
    beta_2: float
    sdf_range_m: float
    tau_s_m: float
    tau_n_m: float
    tau_c_m: float
    tau_f_m: float
    temporal_decay: float


@njit(cache=True, inline="always")
def _ray_log_odds(free, hit, c):
    return min(hit * c.hit_log_odds, c.hit_log_odds_max) - min(free * c.free_log_odds, c.free_log_odds_max)


@njit(cache=True, inline="always")
def _share(count, scale):
    """1 - exp(-count / scale)."""
    return -math.expm1(-count / scale) if count < FULL * scale else 1.0


@njit(cache=True, inline="always")
def _logistic(log_odds):
    return 1.0 / (1.0 + math.exp(-log_odds))


@njit(cache=True, inline="always")
def _below(z):
    """P(standard normal variable > z)."""
    return 0.5 * math.erfc(z * math.sqrt(0.5)) if abs(z) < FAR else (0.0 if z > 0.0 else 1.0)


@njit(cache=True, inline="always")
def _attention(log_odds):
    return 1.0 if log_odds >= 0.0 else 2.0 * _logistic(log_odds)


@njit(cache=True, inline="always")
def _entropy(p):
    q = 1.0 - p
    return -(p * math.log2(p) + q * math.log2(q)) if p > 0.0 and q > 0.0 else 0.0


@njit(cache=True, inline="always")
def _slope(sdf, i, j, k, axis):
    """|difference| of the SDF along one axis a voxel, central, one-sided at the border, 0 in a grid of one layer."""
    n, at = sdf.shape[axis], (i, j, k)[axis]
    low, high = max(at - 1, 0), min(at + 1, n - 1)
    if low == high:
        return 0.0
    a = sdf[low, j, k] if axis == 0 else (sdf[i, low, k] if axis == 1 else sdf[i, j, low])
    b = sdf[high, j, k] if axis == 0 else (sdf[i, high, k] if axis == 1 else sdf[i, j, high])
    return abs(np.float64(b) - np.float64(a)) / (high - low)


@njit(cache=True, inline="always")
def _support(sdf, i, j, k, size):
    """Distance from a voxel's centre to its border towards the surface, m (`implicit.cube_support`)."""
    x, y, z = _slope(sdf, i, j, k, 0), _slope(sdf, i, j, k, 1), _slope(sdf, i, j, k, 2)
    norm = math.sqrt(x * x + y * y + z * z)
    return 0.5 * size * ((x + y + z) / norm if norm > 1e-6 * size else 1.0)


@njit(cache=True, inline="always")
def _integral(z, table, reach):
    """Linear interpolation in an integral tabulated evenly over [-reach, reach]."""
    last = table.size - 1
    x = min(max(z + reach, 0.0), 2.0 * reach) * (last / (2.0 * reach))
    i = min(int(x), last - 1)
    return table[i] + (x - i) * (table[i + 1] - table[i])


@njit(cache=True, inline="always")
def _change(now, before, c):
    """beta_1 |S_t - S_{t-1}| / range + beta_2 [M_focus] of one voxel (`temporal`)."""
    bound = c.sdf_range_m
    now, before = min(max(now, -bound), bound), min(max(before, -bound), bound)
    change = now - before
    focus = (
        (0.0 <= now <= c.tau_s_m and change > c.tau_n_m) or abs(change) > c.tau_c_m
        or (now > c.tau_f_m and before < -c.tau_f_m)
    )
    return c.beta_1 * min(abs(change) / bound, 1.0) + (c.beta_2 if focus else 0.0)


@njit(parallel=True, cache=True)
def voxel_terms(
    free, hit, fresh_free, fresh_hit, vain, mass, sdf, sigma, last_sdf, last_u_time, later, c, table, reach, attention,
    u_imp, u_time, occupancy, entropy_imp, entropy_exp,
):
    """Fill the last six from the others, all (X, Y, Z) f32.

    `free`, `hit` count all rays, `fresh_*` those of this round. `later`: whether there was a round before. `table` is
    the integral of `implicit.implicit_entropy` over [-reach, reach].
    """
    nx, ny, nz = free.shape
    solid = math.tanh(0.5 * c.sdf_log_odds_max)  # |2 p - 1| where |logit(p)| reaches its bound
    for i in prange(nx):
        # Free space that many rays passed is all alike: what follows from the same number is not computed again.
        same_rays, same_attention, same_bits = 0.0, 1.0, 1.0
        same_solid, same_occupancy = 0.0, 0.5
        for j in range(ny):
            for k in range(nz):
                f, h = np.float64(free[i, j, k]), np.float64(hit[i, j, k])
                unseen_left = c.vain_keep ** np.float64(vain[i, j, k]) if vain[i, j, k] > 0 else 1.0
                faded = c.temporal_decay * last_u_time[i, j, k] if later else 0.0
                if f + h == 0.0:
                    attention[i, j, k] = u_imp[i, j, k] = unseen_left
                    entropy_imp[i, j, k] = entropy_exp[i, j, k] = unseen_left
                    occupancy[i, j, k], u_time[i, j, k] = 0.5, faded
                    continue
                observed = _share(f + h, c.observation_rays)
                left = 1.0 - (1.0 - observed) * (1.0 - unseen_left)
                rays = _ray_log_odds(f, h, c)
                if rays != same_rays:
                    same_rays, same_attention, same_bits = rays, _attention(rays), _entropy(_logistic(rays))
                a, log_odds, bits = left * same_attention, rays, same_bits
                if mass[i, j, k] > 0:
                    log_odds += c.gaussian_log_odds * _share(np.float64(mass[i, j, k]), 1.0)
                    bits = _entropy(_logistic(log_odds))
                attention[i, j, k], entropy_exp[i, j, k] = a, left * bits

                s, support = np.float64(sdf[i, j, k]), _support(sdf, i, j, k, c.voxel_size_m)
                scale = max(np.float64(sigma[i, j, k]), c.sigma_floor_m)
                low, high = (s - support) / scale, (s + support) / scale
                p = 0.5 + observed * (_below(low) - 0.5)
                from_field = c.sdf_log_odds_max * (1.0 if p > 0.5 else -1.0)
                if abs(2.0 * p - 1.0) < solid:
                    from_field = math.log(p / (1.0 - p))
                if log_odds + from_field != same_solid:
                    same_solid, same_occupancy = log_odds + from_field, _logistic(log_odds + from_field)
                occupancy[i, j, k] = same_occupancy
                bits = (_integral(high, table, reach) - _integral(low, table, reach)) / (high - low)
                entropy_imp[i, j, k] = a * (1.0 - observed * (1.0 - min(max(bits, 0.0), 1.0)))

                known = observed * (_share(h, c.surface_rays) if h > 0.0 else 1.0)
                if sigma[i, j, k] > 0:
                    known *= math.exp(-np.float64(sigma[i, j, k]) / c.sigma_scale_m)
                u_imp[i, j, k] = a * (1.0 - known)
                changed = _change(s, np.float64(last_sdf[i, j, k]), c) if later else 0.0
                if changed > 0.0:
                    f_new, h_new = np.float64(fresh_free[i, j, k]), np.float64(fresh_hit[i, j, k])
                    then = _ray_log_odds(f - f_new, h - h_new, c)
                    relevant = same_attention if then == same_rays else _attention(then)
                    if f_new + h_new > 0.0:
                        relevant = max(relevant, _attention(_ray_log_odds(f_new, h_new, c)))
                    changed *= observed * relevant
                u_time[i, j, k] = max(changed, faded)


@njit(parallel=True, cache=True)
def near_open_space(free, hit, c, least_log_odds, out):
    """out (X, Y, Z) u8 = 1 where the 3 x 3 x 3 voxels around hold one that rays met, and one not surely free.

    Surely free: log-odds by rays below `least_log_odds`.
    """
    nx, ny, nz = free.shape
    along = np.zeros((nx, ny, nz), np.uint8)  # bit 1: met, bit 2: not surely free, of the neighbours in z
    for i in prange(nx):
        row = np.zeros(nz + 2, np.uint8)
        for j in range(ny):
            for k in range(nz):
                f, h = np.float64(free[i, j, k]), np.float64(hit[i, j, k])
                row[k + 1] = (1 if f + h > 0.0 else 0) | (2 if _ray_log_odds(f, h, c) >= least_log_odds else 0)
            for k in range(nz):
                along[i, j, k] = row[k] | row[k + 1] | row[k + 2]
    for i in prange(nx):
        row = np.zeros(nz, np.uint8)
        for j in range(ny):
            row[:] = 0
            for a in range(max(i - 1, 0), min(i + 2, nx)):
                for b in range(max(j - 1, 0), min(j + 2, ny)):
                    for k in range(nz):
                        row[k] |= along[a, b, k]
            for k in range(nz):
                out[i, j, k] = row[k] == 3


@njit(parallel=True, cache=True)
def due(asked, late, fresh_free, fresh_hit, turn, turns, out):
    """out (X, Y, Z) u8 = 1 where a voxel of `asked` is `late`, near a ray of this round, or in a block in its turn.

    Blocks of 8 x 8 x 8 voxels, so that the SDF's differences between neighbours are mostly of one round.
    """
    nx, ny, nz = asked.shape
    for i in prange(nx):
        for j in range(ny):
            for k in range(nz):
                if not asked[i, j, k]:
                    continue
                if late[i, j, k] or ((i >> 3) + (j >> 3) + (k >> 3) + turn) % turns == 0:
                    out[i, j, k] = 1
                    continue
                for a in range(max(i - 1, 0), min(i + 2, nx)):
                    for b in range(max(j - 1, 0), min(j + 2, ny)):
                        for c in range(max(k - 1, 0), min(k + 2, nz)):
                            if fresh_free[a, b, c] + fresh_hit[a, b, c] > 0:
                                out[i, j, k] = 1
