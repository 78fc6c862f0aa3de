# mypy: ignore-errors
"""Numba kernels of the reward; `reference_reward.py` is their slow twin.

Points are in voxel units, directions unit vectors / voxel_size, ray parameters in metres (as in
`geometry.kernels_traversal`). `kind` is 0 seen free, 1 open, 2 surface (`information.gain`).
"""

import numpy as np
from numba import njit, prange

from active3d_pipe.geometry.kernels_traversal import walk_ray

ZERO, ONE = np.float32(0.0), np.float32(1.0)
# A surface seen edge-on would cover a ray's whole solid angle many times over; below this the estimate is capped.
LEAST_COS = np.float32(0.2)
# A ray that got this thin can add nothing that matters.
LEAST_TRANSMITTANCE = np.float32(0.02)


@njit(fastmath=True, cache=True)
def surface_share(normal, v, dx, dy, dz, voxel_size, t, quality, enough, quality_range):
    """(share of the improvement to `enough` that this look brings, |cos| of its incidence angle).

    `normal` holds components * 127; where it is zero the surface has no clear side and is taken at 45 degrees.
    """
    a, b, c = np.float32(normal[v, 0]), np.float32(normal[v, 1]), np.float32(normal[v, 2])
    norm = np.sqrt(a * a + b * b + c * c)
    cos = np.float32(0.7)
    if norm > np.float32(1.0):
        cos = min(ONE, abs(a * dx + b * dy + c * dz) * voxel_size / norm)
    new = cos * min(ONE, quality_range / max(t, np.float32(1e-3)))
    return max(ZERO, min(new, enough) - quality[v]) / enough, cos


@njit(fastmath=True, cache=True, inline="always")
def heading(dx, dy, dz):
    """Bit of the octant that a ray heads into: above and below, left and right are told apart."""
    return np.uint8(1 << ((dx > 0) + 2 * (dy > 0) + 4 * (dz > 0)))


@njit(fastmath=True, cache=True, inline="always")
def side_share(sides, v, dx, dy, dz, t, enough, quality_range, side_weight):
    """What a look at a surface voxel from an octant that it was not seen from is worth, full up to enough distance."""
    if sides[v] & heading(dx, dy, dz):
        return ZERO
    return side_weight * min(ONE, quality_range / (max(t, np.float32(1e-3)) * enough))


@njit(parallel=True, fastmath=True, cache=True)
def sphere_gain(
    positions, directions, solid_angles, kind, skip, value, through, surface_value, quality, normal, sides, shape,
    voxel_size, max_range, enough, quality_range, side_weight,
):
    """Expected reward that arrives at each position from each direction of a sphere of rays.

    A ray stands for its solid angle: marching in steps of one voxel it collects value * transmittance times the
    number of voxels that its cone holds there, r^2 dOmega ds / voxel^3. Near voxels are crossed by many rays and
    far ones by few, and each still counts once in the sum: no voxel is counted twice, and any set of directions
    adds up to the reward of the view made of them.

    positions (P, 3), directions (M, 3) world, solid_angles (M,) sr, `skip` (flat uint8) the Chebyshev distance to
    the nearest voxel that is not seen free, `through` the transmittance of a voxel. Returns (P, M) float32.
    """
    nx, ny, nz = shape
    out = np.zeros((positions.shape[0], directions.shape[0]), np.float32)
    for p in prange(positions.shape[0]):
        for r in range(directions.shape[0]):
            dx, dy, dz = directions[r, 0], directions[r, 1], directions[r, 2]
            t = np.float32(0.5) * voxel_size
            total, transmittance = ZERO, ONE
            while t < max_range:
                i = np.int32(np.floor(positions[p, 0] + t * dx))
                j = np.int32(np.floor(positions[p, 1] + t * dy))
                k = np.int32(np.floor(positions[p, 2] + t * dz))
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
                    share, cos = surface_share(
                        normal, v, dx, dy, dz, voxel_size, t, quality, enough, quality_range
                    )
                    share += side_share(sides, v, dx, dy, dz, t, enough, quality_range, side_weight)
                    total += transmittance * surface_value[v] * share * area / max(cos, LEAST_COS)
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
    origins, rotations, fan, opaque, kind, value, log_through, surface_value, quality, normal, sides, gain_imp,
    gain_exp, shape, voxel_size, max_range, enough, quality_range, side_weight,
):
    """Exact sums over the unique visible voxels of every candidate view.

    origins (C, 3), rotations (C, 3, 3) camera to world, fan (M, 3) unit camera rays. A voxel counts at the first
    ray of the fan that crosses it, with that ray's transmittance; stamps keep it from counting twice. Returns
    (C, 6) float64: reward, surface part, gain_imp, gain_exp, number visible, number open.
    """
    nx, ny, nz = shape
    count = origins.shape[0]
    out = np.zeros((count, 6), np.float64)
    chunks = min(4, count)
    for chunk in prange(chunks):
        stamp = np.full(nx * ny * nz, -1, np.int32)
        ids = np.empty(nx + ny + nz + 3, np.int32)
        for c in range(chunk, count, chunks):
            R = rotations[c]
            ox, oy, oz = origins[c, 0], origins[c, 1], origins[c, 2]
            for r in range(fan.shape[0]):
                x, y, z = fan[r, 0], fan[r, 1], fan[r, 2]
                dx = (R[0, 0] * x + R[0, 1] * y + R[0, 2] * z) / voxel_size
                dy = (R[1, 0] * x + R[1, 1] * y + R[1, 2] * z) / voxel_size
                dz = (R[2, 0] * x + R[2, 1] * y + R[2, 2] * z) / voxel_size
                n = walk_ray(opaque, ox, oy, oz, dx, dy, dz, max_range, nx, ny, nz, ids)
                transmittance, depth = ONE, ZERO
                # A transmittance belongs to the length of one voxel; a slanted ray crosses more, in shorter pieces.
                piece = ONE / (voxel_size * (abs(dx) + abs(dy) + abs(dz)))
                for m in range(n):
                    v = ids[m]
                    if stamp[v] != c:
                        stamp[v] = c
                        out[c, 4] += transmittance
                        if kind[v] == 1:
                            out[c, 0] += transmittance * value[v]
                            out[c, 2] += transmittance * gain_imp[v]
                            out[c, 3] += transmittance * gain_exp[v]
                            out[c, 5] += transmittance
                        elif kind[v] == 2:
                            a = np.float32(v // (ny * nz)) + np.float32(0.5) - ox
                            b = np.float32((v // nz) % ny) + np.float32(0.5) - oy
                            d = np.float32(v % nz) + np.float32(0.5) - oz
                            t = voxel_size * np.sqrt(a * a + b * b + d * d)
                            share, _ = surface_share(
                                normal, v, dx, dy, dz, voxel_size, t, quality, enough, quality_range
                            )
                            side = side_share(sides, v, dx, dy, dz, t, enough, quality_range, side_weight)
                            out[c, 0] += transmittance * surface_value[v] * (share + side)
                            out[c, 1] += transmittance * surface_value[v] * (share + side)
                            if quality[v] < enough:
                                # gain_* hold what a perfect look would bring; this one brings a part of it.
                                part = transmittance * share / (ONE - quality[v] / enough)
                                out[c, 2] += part * gain_imp[v]
                                out[c, 3] += part * gain_exp[v]
                    if kind[v] == 1:
                        depth += log_through[v] * piece
                        transmittance = np.exp(depth)
                        if transmittance < LEAST_TRANSMITTANCE:
                            break
    return out


@njit(parallel=True, fastmath=True, cache=True)
def path_gain(
    origins, rotations, fan, opaque, kind, log_through, quality, normal, gain_imp, gain_exp, shape, voxel_size,
    max_range, enough, quality_range,
):
    """(gain_imp, gain_exp) of all poses together, float64: every voxel once, at the best of its looks.

    Arguments as of `frustum_gain`.
    """
    nx, ny, nz = shape
    chunks = 2
    best = np.zeros((chunks, nx * ny * nz), np.float32)
    for chunk in prange(chunks):
        ids = np.empty(nx + ny + nz + 3, np.int32)
        for c in range(chunk, origins.shape[0], chunks):
            R = rotations[c]
            ox, oy, oz = origins[c, 0], origins[c, 1], origins[c, 2]
            for r in range(fan.shape[0]):
                x, y, z = fan[r, 0], fan[r, 1], fan[r, 2]
                dx = (R[0, 0] * x + R[0, 1] * y + R[0, 2] * z) / voxel_size
                dy = (R[1, 0] * x + R[1, 1] * y + R[1, 2] * z) / voxel_size
                dz = (R[2, 0] * x + R[2, 1] * y + R[2, 2] * z) / voxel_size
                n = walk_ray(opaque, ox, oy, oz, dx, dy, dz, max_range, nx, ny, nz, ids)
                transmittance, depth = ONE, ZERO
                piece = ONE / (voxel_size * (abs(dx) + abs(dy) + abs(dz)))
                for m in range(n):
                    v = ids[m]
                    if kind[v] == 0:
                        continue
                    if kind[v] == 1:
                        best[chunk, v] = max(best[chunk, v], transmittance)
                    elif quality[v] < enough:
                        a = np.float32(v // (ny * nz)) + np.float32(0.5) - ox
                        b = np.float32((v // nz) % ny) + np.float32(0.5) - oy
                        d = np.float32(v % nz) + np.float32(0.5) - oz
                        t = voxel_size * np.sqrt(a * a + b * b + d * d)
                        share, _ = surface_share(normal, v, dx, dy, dz, voxel_size, t, quality, enough, quality_range)
                        best[chunk, v] = max(best[chunk, v], transmittance * share / (ONE - quality[v] / enough))
                    depth += log_through[v] * (piece if kind[v] == 1 else ONE)
                    transmittance = np.exp(depth)
                    if transmittance < LEAST_TRANSMITTANCE:
                        break
    out = np.zeros(2, np.float64)
    for v in range(nx * ny * nz):
        share = max(best[0, v], best[1, v])
        if share > ZERO:
            out[0] += share * gain_imp[v]
            out[1] += share * gain_exp[v]
    return out


@njit(parallel=True, fastmath=True, cache=True)
def mark_sides(origins, rotations, fan, kind, skip, shape, voxel_size, max_range):
    """Octants (`heading`) that rays of past views came in by at the surface voxel they ended in, (size,) uint8."""
    nx, ny, nz = shape
    chunks = 2
    seen = np.zeros((chunks, nx * ny * nz), np.uint8)
    for chunk in prange(chunks):
        for c in range(chunk, origins.shape[0], chunks):
            R = rotations[c]
            ox, oy, oz = origins[c, 0], origins[c, 1], origins[c, 2]
            for r in range(fan.shape[0]):
                x, y, z = fan[r, 0], fan[r, 1], fan[r, 2]
                dx = (R[0, 0] * x + R[0, 1] * y + R[0, 2] * z) / voxel_size
                dy = (R[1, 0] * x + R[1, 1] * y + R[1, 2] * z) / voxel_size
                dz = (R[2, 0] * x + R[2, 1] * y + R[2, 2] * z) / voxel_size
                t = np.float32(0.5) * voxel_size
                while t < max_range:
                    i = np.int32(np.floor(ox + t * dx))
                    j = np.int32(np.floor(oy + t * dy))
                    k = np.int32(np.floor(oz + t * dz))
                    if i < 0 or j < 0 or k < 0 or i >= nx or j >= ny or k >= nz:
                        break
                    v = (i * ny + j) * nz + k
                    if kind[v] == 2:
                        seen[chunk, v] |= heading(dx, dy, dz)
                        break
                    t += voxel_size * np.float32(max(1, skip[v]) if kind[v] == 0 else 1)
    return seen[0] | seen[1]


@njit(parallel=True, cache=True)
def surface_normals(kind, out):
    """Direction from each surface voxel towards its seen-free neighbours, components * 127, int8 [X, Y, Z, 3]."""
    nx, ny, nz = kind.shape
    for i in prange(nx):
        for j in range(ny):
            for k in range(nz):
                if kind[i, j, k] != 2:
                    continue
                x = y = z = np.float32(0.0)
                for a in range(max(0, i - 2), min(nx, i + 3)):
                    for b in range(max(0, j - 2), min(ny, j + 3)):
                        for c in range(max(0, k - 2), min(nz, k + 3)):
                            if kind[a, b, c] == 0:
                                u, v, w = np.float32(a - i), np.float32(b - j), np.float32(c - k)
                                n = np.sqrt(u * u + v * v + w * w)
                                x += u / n
                                y += v / n
                                z += w / n
                n = np.sqrt(x * x + y * y + z * z)
                if n > np.float32(1e-3):
                    out[i, j, k, 0] = np.int8(np.round(np.float32(127) * x / n))
                    out[i, j, k, 1] = np.int8(np.round(np.float32(127) * y / n))
                    out[i, j, k, 2] = np.int8(np.round(np.float32(127) * z / n))


@njit(parallel=True, fastmath=True, cache=True)
def count_looks(
    origins, rotations, fan, stops, kind, quality, normal, shape, voxel_size, max_range, enough, quality_range
):
    """How many of the past views looked at each voxel without the result that they promised, (size,) int32.

    `stops` (flat uint8) holds every voxel in which any ray ever ended. An open voxel on the way there should have
    been settled by the ray: had it returned, it would have passed or ended there. A surface voxel that it meets
    should have come up to the quality of its distance and angle; half of that is demanded.
    """
    nx, ny, nz = shape
    count, chunks = origins.shape[0], 2
    looks = np.zeros((chunks, nx * ny * nz), np.int32)
    for chunk in prange(chunks):
        stamp = np.full(nx * ny * nz, -1, np.int32)
        ids = np.empty(nx + ny + nz + 3, np.int32)
        for c in range(chunk, count, chunks):
            R = rotations[c]
            ox, oy, oz = origins[c, 0], origins[c, 1], origins[c, 2]
            for r in range(fan.shape[0]):
                x, y, z = fan[r, 0], fan[r, 1], fan[r, 2]
                dx = (R[0, 0] * x + R[0, 1] * y + R[0, 2] * z) / voxel_size
                dy = (R[1, 0] * x + R[1, 1] * y + R[1, 2] * z) / voxel_size
                dz = (R[2, 0] * x + R[2, 1] * y + R[2, 2] * z) / voxel_size
                n = walk_ray(stops, ox, oy, oz, dx, dy, dz, max_range, nx, ny, nz, ids)
                for m in range(n):
                    v = ids[m]
                    if kind[v] == 0:
                        continue
                    if stamp[v] != c:
                        promised = kind[v] == 1 and stops[v] == 0
                        if kind[v] == 2:
                            a = np.float32(v // (ny * nz)) + np.float32(0.5) - ox
                            b = np.float32((v // nz) % ny) + np.float32(0.5) - oy
                            d = np.float32(v % nz) + np.float32(0.5) - oz
                            t = voxel_size * np.sqrt(a * a + b * b + d * d)
                            share, _ = surface_share(
                                normal, v, dx, dy, dz, voxel_size, t, quality, enough, quality_range
                            )
                            promised = share > np.float32(0.5) * (ONE - quality[v] / enough)
                        if promised:
                            stamp[v] = c
                            looks[chunk, v] += 1
    return looks[0] + looks[1]
