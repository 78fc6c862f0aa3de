# mypy: ignore-errors
"""Numba kernel of RRT*; `rrt_star.py` explains it."""

import numpy as np
from numba import njit

FAR = np.float32(1e30)


@njit(fastmath=True, cache=True)
def trilinear(volume, x, y, z):
    """Value between voxel centres at a point in voxel units, clamped to the grid."""
    nx, ny, nz = volume.shape
    x = min(max(x - np.float32(0.5), np.float32(0)), np.float32(nx - 1))
    y = min(max(y - np.float32(0.5), np.float32(0)), np.float32(ny - 1))
    z = min(max(z - np.float32(0.5), np.float32(0)), np.float32(nz - 1))
    i, j, k = min(int(x), max(nx - 2, 0)), min(int(y), max(ny - 2, 0)), min(int(z), max(nz - 2, 0))
    a, b, c = min(i + 1, nx - 1), min(j + 1, ny - 1), min(k + 1, nz - 1)
    u, v, w = x - np.float32(i), y - np.float32(j), z - np.float32(k)
    one = np.float32(1)
    low = (volume[i, j, k] * (one - w) + volume[i, j, c] * w) * (one - v) + (
        volume[i, b, k] * (one - w) + volume[i, b, c] * w
    ) * v
    high = (volume[a, j, k] * (one - w) + volume[a, j, c] * w) * (one - v) + (
        volume[a, b, k] * (one - w) + volume[a, b, c] * w
    ) * v
    return low * (one - u) + high * u


@njit(fastmath=True, cache=True)
def segment_cost(p, q, rate, clearance, required, escape, start, escape_radius, spacing):
    """Integral of `rate` along p -> q in voxels, or FAR where the clearance does not suffice.

    Sampled at the middles of pieces no longer than `spacing` voxels; the end q is checked as well. Within
    `escape_radius` voxels of `start` the clearance `escape` suffices.
    """
    a, b, c = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    length = np.sqrt(a * a + b * b + c * c)
    n = max(1, int(np.ceil(length / spacing)))
    total = np.float32(0)
    for m in range(n + 1):
        s = min((np.float32(m) + np.float32(0.5)) / np.float32(n), np.float32(1))
        x, y, z = p[0] + s * a, p[1] + s * b, p[2] + s * c
        near = (x - start[0]) ** 2 + (y - start[1]) ** 2 + (z - start[2]) ** 2 <= escape_radius * escape_radius
        need = min(required, escape) if near else required
        if trilinear(clearance, x, y, z) < need - np.float32(1e-4):
            return FAR
        if m < n:
            total += trilinear(rate, x, y, z)
    return total * length / np.float32(n)


@njit(cache=True)
def _distance(p, q):
    return np.sqrt((p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2)


@njit(cache=True)
def _shift_descendants(parent, cost, count, root, delta, stack):
    """Add `delta` to the cost of every descendant of `root`."""
    top = 1
    stack[0] = root
    while top > 0:
        top -= 1
        node = stack[top]
        for m in range(count):
            if parent[m] == node:
                cost[m] += delta
                stack[top] = m
                top += 1


@njit(cache=True)
def rrt_star(
    seed_path, seed_cost, samples, rate, clearance, required, escape, escape_radius, step, radius, least_rate,
    spacing,
):
    """Grow a tree from seed_path[0], which already holds the way to the goal seed_path[-1], and return the best way.

    seed_path (K, 3) voxel units, seed_cost (K - 1,) cost of its edges; samples (N, 3) points to steer to;
    step, radius, spacing in voxels; `least_rate` a lower bound of `rate`, which makes the search informed: a
    sample that cannot lie on a better path is skipped. Returns the path (M, 3), its cost in voxels, and how many
    places along edges were checked on the way.
    """
    k = seed_path.shape[0]
    capacity = k + samples.shape[0]
    pos = np.empty((capacity, 3), np.float32)
    parent = np.full(capacity, -1, np.int64)
    cost = np.zeros(capacity, np.float32)
    stack = np.empty(capacity, np.int64)
    edge = np.empty(capacity, np.float32)
    for m in range(k):
        pos[m] = seed_path[m]
        if m > 0:
            parent[m] = m - 1
            cost[m] = cost[m - 1] + seed_cost[m - 1]
    start, goal = pos[0].copy(), k - 1
    count = k
    checks = 0
    new = np.empty(3, np.float32)
    for s in range(samples.shape[0]):
        x = samples[s]
        if (_distance(start, x) + _distance(x, pos[goal])) * least_rate >= cost[goal]:
            continue
        near, best = 0, FAR
        for m in range(count):
            d = _distance(pos[m], x)
            if d < best:
                near, best = m, d
        if best < np.float32(1e-3):
            continue
        f = min(np.float32(1), step / best)
        for axis in range(3):
            new[axis] = pos[near, axis] + f * (x[axis] - pos[near, axis])
        # Best parent within the radius.
        chosen, chosen_cost = -1, FAR
        for m in range(count):
            edge[m] = FAR
            reach = _distance(pos[m], new)
            if m != near and reach > radius:
                continue
            checks += int(np.ceil(reach / spacing)) + 1
            edge[m] = segment_cost(
                pos[m], new, rate, clearance, required, escape, start, escape_radius, spacing
            )
            if edge[m] < FAR and cost[m] + edge[m] < chosen_cost:
                chosen, chosen_cost = m, cost[m] + edge[m]
        if chosen < 0:
            continue
        pos[count] = new
        parent[count] = chosen
        cost[count] = chosen_cost
        count += 1
        # Rewire: neighbours that are cheaper to reach through the new node.
        for m in range(1, count - 1):
            if edge[m] >= FAR or m == chosen:
                continue
            if chosen_cost + edge[m] < cost[m] - np.float32(1e-4):
                checks += int(np.ceil(_distance(new, pos[m]) / spacing)) + 1
                # The edge is re-measured in its true direction: near the start the rules are not symmetric.
                e = segment_cost(
                    new, pos[m], rate, clearance, required, escape, start, escape_radius, spacing
                )
                if chosen_cost + e < cost[m] - np.float32(1e-4):
                    delta = chosen_cost + e - cost[m]
                    parent[m] = count - 1
                    cost[m] += delta
                    _shift_descendants(parent, cost, count, m, delta, stack)
    n, m = 0, goal
    while m >= 0:
        stack[n] = m
        n += 1
        m = parent[m]
    path = np.empty((n, 3), np.float32)
    for m in range(n):
        path[m] = pos[stack[n - 1 - m]]
    return path, cost[goal], checks
