# mypy: ignore-errors
"""Numba kernels of the reward; `reference_reward.py` is their slow twin.

Points are in voxel units, directions unit vectors / voxel_size, ray parameters in metres (as in
`geometry.kernels_traversal`). `kind` is 0 seen free, 1 open, 2 surface (`information.gain`); `clear` and `open_bits`
are the cells of voxels of `kernels_sight`.
"""

import numpy as np
from numba import njit, prange

from active3d_pipe.geometry.kernels_traversal import cell_bit
from active3d_pipe.planning.kernels_sight import cast, cell_share, distance_to, surface_share

ZERO, ONE = np.float32(0.0), np.float32(1.0)
# A surface seen edge-on would cover a ray's whole solid angle many times over; below this the estimate is capped.
LEAST_COS = np.float32(0.2)
# A ray that got this thin can add nothing that matters.
LEAST_TRANSMITTANCE = np.float32(0.02)


@njit(parallel=True, fastmath=True, cache=True)
def sphere_gain(
    positions, directions, solid_angles, kind, skip, value, through, surface_value, quality, normal, clear, open_bits,
    cell_value, shape, voxel_size, max_range, enough, quality_range,
):
    """Expected reward that arrives at each position from each direction of a sphere of rays.

    A ray stands for its solid angle: marching in steps of one voxel it collects value * transmittance times the
    number of voxels that its cone holds there, r^2 dOmega ds / voxel^3. Near voxels are crossed by many rays and
    far ones by few, and each still counts once in the sum: no voxel is counted twice, and any set of directions
    adds up to the reward of the view made of them. An open cell has a quarter of a voxel's face.

    positions (P, 3), directions (M, 3) world, solid_angles (M,) sr, `skip` (flat uint8) the Chebyshev distance to
    the nearest voxel that is not seen free or that a ray ended in, `through` the transmittance of a voxel. Returns
    (P, M) float32.
    """
    nx, ny, nz = shape
    out = np.zeros((positions.shape[0], directions.shape[0]), np.float32)
    for p in prange(positions.shape[0]):
        for r in range(directions.shape[0]):
            dx, dy, dz = directions[r, 0], directions[r, 1], directions[r, 2]
            t = np.float32(0.5) * voxel_size
            total, transmittance = ZERO, ONE
            while t < max_range:
                x, y, z = positions[p, 0] + t * dx, positions[p, 1] + t * dy, positions[p, 2] + t * dz
                i, j, k = np.int32(np.floor(x)), np.int32(np.floor(y)), np.int32(np.floor(z))
                if i < 0 or j < 0 or k < 0 or i >= nx or j >= ny or k >= nz:
                    break
                v = (i * ny + j) * nz + k
                what = kind[v]
                if what == 0:
                    t += voxel_size * np.float32(max(1, skip[v]))
                    continue
                size = t / voxel_size
                area = solid_angles[r] * size * size
                if what == 2:
                    bit = np.uint8(0)
                    if clear[v] | open_bits[v]:
                        bit = cell_bit(x, y, z)
                        if clear[v] & bit:
                            t += np.float32(0.5) * voxel_size
                            continue
                    share, cos = surface_share(
                        normal, v, dx, dy, dz, voxel_size, t, quality, enough, quality_range
                    )
                    total += transmittance * surface_value[v] * share * area / max(cos, LEAST_COS)
                    if open_bits[v] & bit:
                        total += transmittance * cell_value[v] * np.float32(4) * area * cell_share(
                            t, enough, quality_range
                        )
                    break
                total += transmittance * value[v] * area
                transmittance *= through[v]
                if transmittance < LEAST_TRANSMITTANCE:
                    break
                t += voxel_size
            out[p, r] = total
    return out


@njit(parallel=True, fastmath=True, cache=True)
def frustum_gain(
    origins, rotations, fan, opaque, skip, kind, value, log_through, surface_value, quality, normal, clear, open_bits,
    cell_value, gain_imp, gain_exp, shape, voxel_size, max_range, enough, quality_range,
):
    """Exact sums over the unique visible voxels of every candidate view.

    origins (C, 3), rotations (C, 3, 3) camera to world, fan (M, 3) unit camera rays. A voxel counts at the first
    ray of the fan that crosses it, with that ray's transmittance; marks keep it from counting twice, and so for open
    cells. Returns (C, 6) float64: reward, surface part, gain_imp, gain_exp, number visible (seen free ones do not
    count), number open.
    """
    size = shape[0] * shape[1] * shape[2]
    count = origins.shape[0]
    out = np.zeros((count, 6), np.float64)
    chunks = min(4, count)
    for chunk in prange(chunks):
        # Small marks that are taken back after every view: a volume of numbers of views is four times as much memory.
        seen, cells, met = np.zeros(size, np.uint8), np.zeros(size, np.uint8), np.empty(size, np.int32)
        ids = np.empty(shape[0] + shape[1] + shape[2] + 3, np.int32)
        for c in range(chunk, count, chunks):
            num_met = 0
            for r in range(fan.shape[0]):
                n, bit, (dx, dy, dz), piece = cast(
                    opaque, clear, skip, origins[c], rotations[c], fan[r], voxel_size, max_range, shape, ids
                )
                transmittance, depth = ONE, ZERO
                for m in range(n):
                    v = ids[m]
                    if kind[v] == 0:
                        continue
                    if not seen[v]:
                        seen[v] = 1
                        met[num_met] = v
                        num_met += 1
                        out[c, 4] += transmittance
                        if kind[v] == 1:
                            out[c, 0] += transmittance * value[v]
                            out[c, 2] += transmittance * gain_imp[v]
                            out[c, 3] += transmittance * gain_exp[v]
                            out[c, 5] += transmittance
                        elif kind[v] == 2:
                            t = distance_to(origins[c], v, shape, voxel_size)
                            share, _ = surface_share(
                                normal, v, dx, dy, dz, voxel_size, t, quality, enough, quality_range
                            )
                            out[c, 0] += transmittance * surface_value[v] * share
                            out[c, 1] += transmittance * surface_value[v] * share
                            if quality[v] < enough:
                                # gain_* hold what a perfect look would bring; this one brings a part of it.
                                part = transmittance * share / (ONE - quality[v] / enough)
                                out[c, 2] += part * gain_imp[v]
                                out[c, 3] += part * gain_exp[v]
                    if kind[v] == 2 and open_bits[v] & bit and not cells[v] & bit:
                        cells[v] |= bit
                        t = distance_to(origins[c], v, shape, voxel_size)
                        worth = transmittance * cell_value[v] * cell_share(t, enough, quality_range)
                        out[c, 0] += worth
                        out[c, 1] += worth
                    if kind[v] == 1:
                        # A transmittance belongs to the length of one voxel.
                        depth += log_through[v] * piece
                        transmittance = np.exp(depth)
                        if transmittance < LEAST_TRANSMITTANCE:
                            break
            for m in range(num_met):
                seen[met[m]] = cells[met[m]] = 0
    return out


@njit(parallel=True, fastmath=True, cache=True)
def path_gain(
    origins, rotations, fan, opaque, skip, kind, log_through, quality, normal, clear, gain_imp, gain_exp, shape,
    voxel_size, max_range, enough, quality_range,
):
    """(gain_imp, gain_exp) of all poses together, float64: every voxel once, at the best of its looks.

    Arguments as of `frustum_gain`.
    """
    size, chunks = shape[0] * shape[1] * shape[2], 2
    best = np.zeros((chunks, size), np.float32)
    for chunk in prange(chunks):
        ids = np.empty(shape[0] + shape[1] + shape[2] + 3, np.int32)
        for c in range(chunk, origins.shape[0], chunks):
            for r in range(fan.shape[0]):
                n, _, (dx, dy, dz), piece = cast(
                    opaque, clear, skip, origins[c], rotations[c], fan[r], voxel_size, max_range, shape, ids
                )
                transmittance, depth = ONE, ZERO
                for m in range(n):
                    v = ids[m]
                    if kind[v] == 0:
                        continue
                    if kind[v] == 1:
                        best[chunk, v] = max(best[chunk, v], transmittance)
                    elif quality[v] < enough:
                        t = distance_to(origins[c], v, shape, voxel_size)
                        share, _ = surface_share(normal, v, dx, dy, dz, voxel_size, t, quality, enough, quality_range)
                        best[chunk, v] = max(best[chunk, v], transmittance * share / (ONE - quality[v] / enough))
                    depth += log_through[v] * (piece if kind[v] == 1 else ONE)
                    transmittance = np.exp(depth)
                    if transmittance < LEAST_TRANSMITTANCE:
                        break
    out = np.zeros(2, np.float64)
    for v in range(size):
        share = max(best[0, v], best[1, v])
        if share > ZERO:
            out[0] += share * gain_imp[v]
            out[1] += share * gain_exp[v]
    return out


@njit(fastmath=True, cache=True)
def mark_seen(origin, R, fan, opaque, skip, clear, shape, voxel_size, max_range, seen, cells):
    """seen = 1 in every voxel of interest that a view meets, cells |= bits of the cells that its rays end in; flat."""
    ids = np.empty(shape[0] + shape[1] + shape[2] + 3, np.int32)
    for r in range(fan.shape[0]):
        n, bit, _, _ = cast(opaque, clear, skip, origin, R, fan[r], voxel_size, max_range, shape, ids)
        for m in range(n):
            seen[ids[m]] = 1
        if n > 0:
            cells[ids[n - 1]] |= bit


@njit(parallel=True, fastmath=True, cache=True)
def count_looks(
    origins, rotations, weights, fan, stops, skip, kind, quality, normal, clear, open_bits, shape, voxel_size,
    max_range, enough, quality_range,
):
    """How many of the past views looked at each voxel, and at open cells of it, in vain; (2, size) float32.

    View c counts for weights[c] looks.
    `stops` (flat uint8) holds every voxel in which any ray ever ended. An open voxel on the way there should have
    been settled by the ray: had it returned, it would have passed or ended there. A surface voxel that it meets
    should have come up to the quality of its distance and angle; half of that is demanded. An open cell in which it
    ends should be open no more.
    """
    size, count, chunks = shape[0] * shape[1] * shape[2], origins.shape[0], 2
    looks = np.zeros((chunks, 2, size), np.float32)
    for chunk in prange(chunks):
        # 1: the voxel counted for this view, 2: its open cells did.
        mark, met = np.zeros(size, np.uint8), np.empty(size, np.int32)
        ids = np.empty(shape[0] + shape[1] + shape[2] + 3, np.int32)
        for c in range(chunk, count, chunks):
            num_met = 0
            for r in range(fan.shape[0]):
                n, bit, (dx, dy, dz), _ = cast(
                    stops, clear, skip, origins[c], rotations[c], fan[r], voxel_size, max_range, shape, ids
                )
                for m in range(n):
                    v = ids[m]
                    if kind[v] == 0:
                        continue
                    before = mark[v]
                    if not mark[v] & 1:
                        promised = kind[v] == 1 and stops[v] == 0
                        if kind[v] == 2:
                            t = distance_to(origins[c], v, shape, voxel_size)
                            share, _ = surface_share(
                                normal, v, dx, dy, dz, voxel_size, t, quality, enough, quality_range
                            )
                            promised = share > np.float32(0.5) * (ONE - quality[v] / enough)
                        if promised:
                            mark[v] |= 1
                            looks[chunk, 0, v] += weights[c]
                    if kind[v] == 2 and open_bits[v] & bit and not mark[v] & 2:
                        t = distance_to(origins[c], v, shape, voxel_size)
                        if cell_share(t, enough, quality_range) >= ONE:
                            mark[v] |= 2
                            looks[chunk, 1, v] += weights[c]
                    if before == 0 and mark[v]:
                        met[num_met] = v
                        num_met += 1
            for m in range(num_met):
                mark[met[m]] = 0
    for chunk in range(1, chunks):
        for kind_of_look in range(2):
            for v in prange(size):
                looks[0, kind_of_look, v] += looks[chunk, kind_of_look, v]
    return looks[0]
