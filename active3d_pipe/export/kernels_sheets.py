# mypy: ignore-errors
"""Depth readings that no face explains: where they lie, what else the frames say there, and faces through them.

`rotation` (3, 3) is camera -> world, `centre` (3,) m, `intrinsics` (fx, fy, cx, cy); all float32. `marks` (X, Y, Z)
uint8 on cells of 1 / inv_size m from `low` (3,) up: OPEN, or EXPLAINED (the lowest bit is set: near a face).
"""

import numpy as np
from numba import njit, prange

from active3d_pipe.export.kernels_views import flat_cell, to_cells

OPEN, EXPLAINED = np.uint8(0), np.uint8(1)
_DONE = np.uint8(3)  # explained, and so are the cells around it
EVEN = np.float32(0.25)  # how much the slope of a plane may seem to change from one pixel to the next


@njit(parallel=True, cache=True)
def mark_faces(vertices, faces, low, inv_size, marks):
    """Set EXPLAINED in the cells of all vertices and face centres, and in the 26 around each.

    Tasks may write to one cell at a time: whoever comes last, its lowest bit is set.
    """
    nx, ny, nz = marks.shape
    third = np.float32(1 / 3)
    for f in prange(len(vertices) + len(faces)):
        if f < len(vertices):
            x, y, z = vertices[f, 0], vertices[f, 1], vertices[f, 2]
        else:
            a, b, c = faces[f - len(vertices), 0], faces[f - len(vertices), 1], faces[f - len(vertices), 2]
            x = (vertices[a, 0] + vertices[b, 0] + vertices[c, 0]) * third
            y = (vertices[a, 1] + vertices[b, 1] + vertices[c, 1]) * third
            z = (vertices[a, 2] + vertices[b, 2] + vertices[c, 2]) * third
        i, j, k = int((x - low[0]) * inv_size), int((y - low[1]) * inv_size), int((z - low[2]) * inv_size)
        if i < 1 or j < 1 or k < 1 or i >= nx - 1 or j >= ny - 1 or k >= nz - 1 or marks[i, j, k] == _DONE:
            continue
        for u in range(i - 1, i + 2):
            for v in range(j - 1, j + 2):
                for w in range(k - 1, k + 2):
                    if marks[u, v, w] == OPEN:
                        marks[u, v, w] = EXPLAINED
        marks[i, j, k] = _DONE


@njit(nogil=True, fastmath=True, cache=True)
def reading_cells(rotation, centre, intrinsics, depth, near, low, inv_size, marks, cells):
    """cells (H, W) int64: flat cell of every reading that lies in a cell that is not EXPLAINED; -1 elsewhere."""
    turn, shift = to_cells(rotation, centre, low, inv_size)
    flat, half = marks.reshape(-1), np.float32(0.5)
    inv_x, inv_y = np.float32(1) / intrinsics[0], np.float32(1) / intrinsics[1]
    for row in range(depth.shape[0]):
        y = (np.float32(row) + half - intrinsics[3]) * inv_y
        for column in range(depth.shape[1]):
            d, cell = depth[row, column], np.int64(-1)
            if d > near:
                x = (np.float32(column) + half - intrinsics[2]) * inv_x
                cell = flat_cell(turn, shift, x, y, d, marks.shape)
                if cell >= 0 and flat[cell] & 1:
                    cell = -1
            cells[row, column] = cell


@njit(nogil=True, fastmath=True, cache=True)
def open_pixels(rotation, centre, intrinsics, depth, stride, near, low, inv_size, marks, cells, pixels):
    """Of every `stride`-th pixel those whose reading lies in a cell that is not EXPLAINED; returns how many.

    cells (N,) int64 gets their flat cells, pixels (N,) int32 their place in depth (H, W), row by row.
    """
    turn, shift = to_cells(rotation, centre, low, inv_size)
    flat, half, count = marks.reshape(-1), np.float32(0.5), 0
    inv_x, inv_y = np.float32(1) / intrinsics[0], np.float32(1) / intrinsics[1]
    for row in range(0, depth.shape[0], stride):
        y = (np.float32(row) + half - intrinsics[3]) * inv_y
        for column in range(0, depth.shape[1], stride):
            d = depth[row, column]
            if d > near:
                x = (np.float32(column) + half - intrinsics[2]) * inv_x
                cell = flat_cell(turn, shift, x, y, d, marks.shape)
                if cell >= 0 and not flat[cell] & 1:
                    cells[count], pixels[count] = cell, row * depth.shape[1] + column
                    count += 1
    return count


@njit(parallel=True, fastmath=True, cache=True)
def vote(points, rotation, centre, intrinsics, depth, near, tolerance, hidden, agree, other):
    """Count, for points (N, 3), the frame's reading where they project, in agree or other (N,) int32.

    It agrees within `tolerance` m of them. Behind them it is other, and so it is before them up to `hidden` m:
    scatter around a surface that is nearer. A reading still nearer is of something that hides them, and says nothing.
    """
    height, width = depth.shape
    for n in prange(len(points)):
        dx, dy, dz = points[n, 0] - centre[0], points[n, 1] - centre[1], points[n, 2] - centre[2]
        z = rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz
        if z <= near:
            continue
        u = intrinsics[0] * (rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz) / z + intrinsics[2]
        v = intrinsics[1] * (rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz) / z + intrinsics[3]
        if u < 0 or v < 0 or u >= width or v >= height:
            continue
        d = depth[int(v), int(u)]
        if d <= 0:
            continue
        if abs(d - z) <= tolerance:
            agree[n] += 1
        elif d > z - hidden:
            other[n] += 1


@njit(inline="always")
def _one_plane(depth, i, j, down, across, step, longest):
    """Whether the readings of pixel (i, j) and of the next one, (i + down, j + across), lie on one surface.

    Their depths differ by at most `step` times the depth; or by more, up to `longest`, on a plane seen at a slant:
    along it the inverse depth changes evenly from pixel to pixel, and so it must on one side of the two.
    """
    height, width = depth.shape
    a, b = depth[i, j], depth[i + down, j + across]
    apart, nearest = abs(a - b), min(a, b)
    if apart <= step * nearest:
        return True
    if apart > longest * nearest:
        return False
    slope = np.float32(1) / b - np.float32(1) / a
    u, v = i - down, j - across
    if u >= 0 and v >= 0 and depth[u, v] > 0:
        before = np.float32(1) / a - np.float32(1) / depth[u, v]
        if abs(before - slope) <= EVEN * abs(slope):
            return True
    u, v = i + 2 * down, j + 2 * across
    if u < height and v < width and depth[u, v] > 0:
        after = np.float32(1) / depth[u, v] - np.float32(1) / b
        return abs(after - slope) <= EVEN * abs(slope)
    return False


@njit(nogil=True, cache=True)
def sheet_faces(cells, own, depth, step, longest, numbers, faces):
    """Faces over a frame's pixels, and their number; `numbers` (H, W) int32 gets the vertex of a pixel, or -1.

    own (H, W) bool: the pixel's cell is to be covered from this frame. Two triangles join four neighbouring
    pixels that all have unexplained readings, of which the first is the frame's own, and that lie on one surface
    (`_one_plane`, steps relative to the depth). `faces` (F, 3) int32 has room for all.
    """
    height, width = depth.shape
    num_vertices = num_faces = 0
    numbers[:] = -1
    for i in range(height - 1):
        for j in range(width - 1):
            if not own[i, j]:
                continue
            if cells[i, j] < 0 or cells[i, j + 1] < 0 or cells[i + 1, j] < 0 or cells[i + 1, j + 1] < 0:
                continue
            if not (
                _one_plane(depth, i, j, 0, 1, step, longest) and _one_plane(depth, i + 1, j, 0, 1, step, longest)
                and _one_plane(depth, i, j, 1, 0, step, longest) and _one_plane(depth, i, j + 1, 1, 0, step, longest)
            ):
                continue
            for m in range(4):
                if numbers[i + (m >> 1), j + (m & 1)] < 0:
                    numbers[i + (m >> 1), j + (m & 1)] = num_vertices
                    num_vertices += 1
            a, b, c, d = numbers[i, j], numbers[i, j + 1], numbers[i + 1, j], numbers[i + 1, j + 1]
            # Counter-clockwise for who looks along +z with y downwards: normals point at the camera.
            faces[num_faces, 0], faces[num_faces, 1], faces[num_faces, 2] = a, c, b
            faces[num_faces + 1, 0], faces[num_faces + 1, 1], faces[num_faces + 1, 2] = b, c, d
            num_faces += 2
    return num_faces
