# mypy: ignore-errors
"""Marching cubes on the marked cells of one block, and what surrounds it: gathering nodes, connected pieces.

A cell's corner c lies at (c & 1, c >> 1 & 1, c >> 2 & 1); corners with a negative value are solid. The case table is
derived here instead of being written down: on every face of the cube each run of solid corners is cut off from the
rest by one segment, directed so that the segments of all faces close to loops with one orientation. The rule looks at
one face's corners alone, so that neighbouring cells always agree and the surface has no cracks.
Method: Lorensen and Cline, Marching cubes, 1987.
"""

import numpy as np
from numba import njit

# Corners of each face, counter-clockwise seen from outside of the cube.
FACES = ((0, 4, 6, 2), (1, 3, 7, 5), (0, 1, 5, 4), (2, 6, 7, 3), (0, 2, 3, 1), (4, 5, 7, 6))
EDGES = tuple((c, c | bit) for axis, bit in enumerate((1, 2, 4)) for c in range(8) if not c & bit)
EDGE_MARGIN = np.float32(1e-3)  # vertices keep this share of an edge away from its nodes: no triangle degenerates


def _loops(case: int) -> list[list[int]]:
    """Closed loops of cut edges of a case, in order."""
    solid = [bool(case >> c & 1) for c in range(8)]
    index = {edge: i for i, edge in enumerate(EDGES)}
    follow: dict[int, int] = {}
    for face in FACES:
        entered = [(k, (k + 1) % 4) for k in range(4) if not solid[face[k]] and solid[face[(k + 1) % 4]]]
        for a, b in entered:
            end = b
            while solid[face[(end + 1) % 4]]:
                end = (end + 1) % 4
            edge_in = index[tuple(sorted((face[a], face[b])))]
            edge_out = index[tuple(sorted((face[end], face[(end + 1) % 4])))]
            follow[edge_in] = edge_out
    loops = []
    while follow:
        first, at = min(follow), follow.pop(min(follow))
        loop = [first]
        while at != first:
            loop.append(at)
            at = follow.pop(at)
        loops.append(loop)
    return loops


def _case_table() -> tuple[np.ndarray, np.ndarray]:
    """(256,) triangles of every case and (256, most, 3) their edges."""
    found = []
    for case in range(256):
        found.append([(loop[0], loop[k], loop[k + 1]) for loop in _loops(case) for k in range(1, len(loop) - 1)])
    table = np.zeros((256, max(map(len, found)), 3), np.int32)
    for case, triangles in enumerate(found):
        table[case, : len(triangles)] = np.array(triangles, np.int32).reshape(-1, 3)
    return np.array([len(t) for t in found], np.int32), table


TRIANGLE_COUNT, TRIANGLE_EDGES = _case_table()
EDGE_CORNER = np.array([c for c, _ in EDGES], np.int32)
EDGE_AXIS = np.array([0] * 4 + [1] * 4 + [2] * 4, np.int32)


@njit(cache=True)
def gather_nodes(cells, known, nodes):
    """Flat indices of the nodes of the marked cells that are not known yet; returns their number.

    cells (X, Y, Z) bool; known (X + 1, Y + 1, Z + 1) bool, set for every node that is returned; nodes (N,) int64 is
    filled.
    """
    count = 0
    ny, nz = known.shape[1], known.shape[2]
    for i in range(cells.shape[0]):
        for j in range(cells.shape[1]):
            for k in range(cells.shape[2]):
                if not cells[i, j, k]:
                    continue
                for c in range(8):
                    x, y, z = i + (c & 1), j + (c >> 1 & 1), k + (c >> 2 & 1)
                    if known[x, y, z]:
                        continue
                    known[x, y, z] = True
                    nodes[count] = (x * ny + y) * nz + z
                    count += 1
    return count


@njit(cache=True)
def refine(coarse, values, limit, fine, sdf, known):
    """Mark the eight fine cells of every coarse cell that a surface may pass; copy what is known of their nodes.

    coarse (X, Y, Z) bool, values (X + 1, ...) their nodes' SDF, m; a cell stays when its signs differ or a corner is
    within `limit` m. fine (2X, 2Y, 2Z) bool, sdf and known (2X + 1, ...) are written. Returns the number of cells.
    """
    count = 0
    for i in range(coarse.shape[0]):
        for j in range(coarse.shape[1]):
            for k in range(coarse.shape[2]):
                if not coarse[i, j, k]:
                    continue
                least, most, nearest = np.inf, -np.inf, np.inf
                for c in range(8):
                    v = values[i + (c & 1), j + (c >> 1 & 1), k + (c >> 2 & 1)]
                    least, most, nearest = min(least, v), max(most, v), min(nearest, abs(v))
                if nearest > limit and (least >= 0 or most < 0):
                    continue
                count += 1
                for c in range(8):
                    x, y, z = c & 1, c >> 1 & 1, c >> 2 & 1
                    fine[2 * i + x, 2 * j + y, 2 * k + z] = True
                    sdf[2 * (i + x), 2 * (j + y), 2 * (k + z)] = values[i + x, j + y, k + z]
                    known[2 * (i + x), 2 * (j + y), 2 * (k + z)] = True
    return count


@njit(cache=True)
def _case(sdf, i, j, k):
    case = 0
    for c in range(8):
        if sdf[i + (c & 1), j + (c >> 1 & 1), k + (c >> 2 & 1)] < 0:
            case |= 1 << c
    return case


@njit(cache=True)
def count_triangles(cells, sdf, count):
    """Number of triangles in the marked cells (X, Y, Z) of the nodes' SDF (X + 1, Y + 1, Z + 1)."""
    total = 0
    for i in range(cells.shape[0]):
        for j in range(cells.shape[1]):
            for k in range(cells.shape[2]):
                if cells[i, j, k]:
                    total += count[_case(sdf, i, j, k)]
    return total


@njit(cache=True)
def triangulate(cells, sdf, count, table, corner_of, axis_of, base, at_edge, vertices, keys, faces):
    """Triangles of the marked cells; returns the number of vertices.

    count, table, corner_of, axis_of: the case table; base (3,) int64 lattice index of node 0; at_edge
    (X + 1, Y + 1, Z + 1, 3) int32 filled with -1; vertices (N, 3) float64 in lattice units, keys (N, 4) int64 lattice
    index of the edge's lower node and its axis, faces (F, 3) int32 are written.
    """
    made, face = 0, 0
    corner = np.empty(3, np.int64)
    for i in range(cells.shape[0]):
        for j in range(cells.shape[1]):
            for k in range(cells.shape[2]):
                if not cells[i, j, k]:
                    continue
                case = _case(sdf, i, j, k)
                for t in range(count[case]):
                    for m in range(3):
                        edge = table[case, t, m]
                        c, axis = corner_of[edge], axis_of[edge]
                        corner[0], corner[1], corner[2] = i + (c & 1), j + (c >> 1 & 1), k + (c >> 2 & 1)
                        vertex = at_edge[corner[0], corner[1], corner[2], axis]
                        if vertex < 0:
                            vertex = made
                            at_edge[corner[0], corner[1], corner[2], axis] = made
                            a = sdf[corner[0], corner[1], corner[2]]
                            x, y, z = corner[0] + (axis == 0), corner[1] + (axis == 1), corner[2] + (axis == 2)
                            share = a / (a - sdf[x, y, z])
                            for d in range(3):
                                keys[made, d] = base[d] + corner[d]
                                vertices[made, d] = keys[made, d]
                            keys[made, 3] = axis
                            vertices[made, axis] += min(max(share, EDGE_MARGIN), 1 - EDGE_MARGIN)
                            made += 1
                        faces[face, m] = vertex
                    face += 1
    return made


@njit(cache=True)
def component_labels(faces, labels):
    """Label vertices by connected piece: labels (V,) int64 becomes the least vertex of the piece."""
    for v in range(labels.shape[0]):
        labels[v] = v
    for f in range(faces.shape[0]):
        for m in range(2):
            a, b = np.int64(faces[f, m]), np.int64(faces[f, m + 1])
            while labels[a] != a:
                labels[a] = labels[labels[a]]
                a = labels[a]
            while labels[b] != b:
                labels[b] = labels[labels[b]]
                b = labels[b]
            if a < b:
                labels[b] = a
            else:
                labels[a] = b
    for v in range(labels.shape[0]):
        labels[v] = labels[labels[v]]


@njit(cache=True)
def component_areas(vertices, faces, labels, areas):
    """Add the area of every face (F, 3), m2, to `areas` float64 at the label of its first vertex."""
    a, b = np.empty(3), np.empty(3)
    for f in range(faces.shape[0]):
        for d in range(3):
            origin = np.float64(vertices[faces[f, 0], d])
            a[d] = vertices[faces[f, 1], d] - origin
            b[d] = vertices[faces[f, 2], d] - origin
        x, y, z = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
        areas[labels[faces[f, 0]]] += 0.5 * np.sqrt(x * x + y * y + z * z)


@njit(cache=True)
def keep_faces(faces, keep, numbers, kept):
    """Renumber what stays: numbers (V,) int32 = -1 gets the new number of every used vertex, in the old order.

    kept (F', 3) int32 gets the faces (F, 3) with `keep` (F,) bool.
    """
    count = 0
    for f in range(len(faces)):
        if keep[f]:
            for m in range(3):
                kept[count, m] = faces[f, m]
                numbers[faces[f, m]] = 0
            count += 1
    used = 0
    for v in range(len(numbers)):
        if numbers[v] == 0:
            numbers[v] = used
            used += 1
    for f in range(count):
        for m in range(3):
            kept[f, m] = numbers[kept[f, m]]
