# mypy: ignore-errors
"""What logged frames say of a surface: which cells hold readings, which faces were seen, what colour vertices have.

Faces and vertices come in spatial order, so they are handled in chunks with a bounding sphere: a frame looks only at
the chunks that its frustum meets. Where frames only set marks they may come at the same time; colours are summed chunk
by chunk in the order of the frames.
`rotation` (3, 3) is camera -> world, `centre` (3,) m, `intrinsics` (fx, fy, cx, cy); all float32.
"""

import numpy as np
from numba import njit, prange

CHUNK = 1024  # faces or vertices that share a bounding sphere
SPLIT_MAX = 8  # marks between two neighbouring readings of one surface


@njit(cache=True)
def _cross(vertices, a, b, c, out):
    """(b - a) x (c - a) of three vertices."""
    for d in range(3):
        e, g = (d + 1) % 3, (d + 2) % 3
        out[d] = (vertices[b, e] - vertices[a, e]) * (vertices[c, g] - vertices[a, g]) - (
            vertices[b, g] - vertices[a, g]) * (vertices[c, e] - vertices[a, e])


@njit(parallel=True, cache=True)
def face_centres(vertices, faces, centroids, normals):
    """Centroids and unit normals (F, 3) float32 of faces (F, 3) over vertices (V, 3) float32; zero without area."""
    for f in prange(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        for d in range(3):
            centroids[f, d] = (vertices[a, d] + vertices[b, d] + vertices[c, d]) * np.float32(1 / 3)
        _cross(vertices, a, b, c, normals[f])
        length = np.sqrt(normals[f, 0] ** 2 + normals[f, 1] ** 2 + normals[f, 2] ** 2)
        for d in range(3):
            normals[f, d] /= max(length, np.float32(1e-30))


@njit(cache=True)
def sum_normals(vertices, faces, sums):
    """Add every face's normal, as long as twice its area, to sums (V, 3) float32 of its vertices."""
    normal = np.empty(3, np.float32)
    for f in range(faces.shape[0]):
        _cross(vertices, faces[f, 0], faces[f, 1], faces[f, 2], normal)
        for m in range(3):
            for d in range(3):
                sums[faces[f, m], d] += normal[d]


@njit(cache=True)
def bounding_sphere(points, sphere):
    """sphere (4,) float32: centre of the bounding box and radius of points (N, 3) float32, N > 0."""
    radius = np.float32(0)
    for d in range(3):
        low, high = points[0, d], points[0, d]
        for k in range(points.shape[0]):
            low, high = min(low, points[k, d]), max(high, points[k, d])
        sphere[d] = np.float32(0.5) * (low + high)
    for k in range(points.shape[0]):
        x, y, z = points[k, 0] - sphere[0], points[k, 1] - sphere[1], points[k, 2] - sphere[2]
        radius = max(radius, x * x + y * y + z * z)
    sphere[3] = np.sqrt(radius)


@njit(parallel=True, cache=True)
def bounding_spheres(points, spheres):
    """spheres (C, 4) float32: centre of the bounding box and radius of each chunk of points (N, 3) float32."""
    for c in prange(spheres.shape[0]):
        bounding_sphere(points[c * CHUNK : (c + 1) * CHUNK], spheres[c])


@njit(cache=True)
def meets_frustum(sphere, rotation, centre, intrinsics, width, height, far):
    """Whether a sphere (x, y, z, radius) reaches into what a frame sees up to `far` m."""
    dx, dy, dz = sphere[0] - centre[0], sphere[1] - centre[1], sphere[2] - centre[2]
    x = rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz
    y = rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz
    z = rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz
    r = sphere[3]
    if z < -r or z > far + r:
        return False
    # Tangents of the image's borders; a plane through the centre with tangent t has the normal (1, -t) / length.
    right, left = (width - intrinsics[2]) / intrinsics[0], intrinsics[2] / intrinsics[0]
    down, up = (height - intrinsics[3]) / intrinsics[1], intrinsics[3] / intrinsics[1]
    return (
        x - right * z <= r * np.sqrt(1 + right * right) and -x - left * z <= r * np.sqrt(1 + left * left)
        and y - down * z <= r * np.sqrt(1 + down * down) and -y - up * z <= r * np.sqrt(1 + up * up)
    )


@njit(nogil=True, fastmath=True, cache=True)
def mark_seen(
    spheres, centroids, normals, rotation, centre, intrinsics, depth, near, far, tolerance, cosine, done, seen
):
    """Set seen[k] for the faces that the frame sees; `view_fusion.cull_unseen` explains what that means.

    centroids, normals (F, 3) float32 world; depth (H, W) float32 m; seen (F,) bool; far: the deepest reading, m;
    done (C,) bool: chunks whose faces have all been seen. Frames may come at the same time: nothing is taken back.
    """
    height, width = depth.shape
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    for c in range(spheres.shape[0]):
        if done[c] or not meets_frustum(spheres[c], rotation, centre, intrinsics, width, height, far + tolerance):
            continue
        missing = False
        for k in range(c * CHUNK, min((c + 1) * CHUNK, centroids.shape[0])):
            if seen[k]:
                continue
            missing = True
            dx, dy, dz = centroids[k, 0] - centre[0], centroids[k, 1] - centre[1], centroids[k, 2] - centre[2]
            z = rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz
            if z <= near:
                continue
            u = fx * (rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz) / z + cx
            v = fy * (rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz) / z + cy
            if u < 0 or v < 0 or u >= width or v >= height:
                continue
            d = depth[int(v), int(u)]
            if d <= 0 or abs(z - d) > tolerance:
                continue
            towards = -(normals[k, 0] * dx + normals[k, 1] * dy + normals[k, 2] * dz)
            if towards >= cosine * np.sqrt(dx * dx + dy * dy + dz * dz):
                seen[k] = True
        if not missing:
            done[c] = True


@njit(cache=True)
def grow_faces(faces, rings, num_vertices, seen):
    """Add to seen (F,) bool the faces (F, 3) that touch it by a vertex, `rings` times."""
    touched = np.zeros(num_vertices, np.bool_)
    for _ in range(rings):
        for f in range(faces.shape[0]):
            if seen[f]:
                for m in range(3):
                    touched[faces[f, m]] = True
        for f in range(faces.shape[0]):
            seen[f] = touched[faces[f, 0]] or touched[faces[f, 1]] or touched[faces[f, 2]]


@njit(parallel=True, cache=True)
def widen(marks, reach, out):
    """out (A, B, C) bool: whether a mark at most `reach` places away along the middle axis is set."""
    length = marks.shape[1]
    for a in prange(marks.shape[0]):
        out[a] = marks[a]
        for b in range(length):
            for other in range(max(b - reach, 0), min(b + reach + 1, length)):
                if other != b:
                    for c in range(marks.shape[2]):
                        out[a, b, c] |= marks[a, other, c]


@njit(inline="always")
def to_cells(rotation, centre, low, inv_size):
    """Rotation and centre such that a camera point maps to cells, instead of metres, from the grid's corner."""
    turn, shift = np.empty((3, 3), np.float32), np.empty(3, np.float32)
    for m in range(3):
        shift[m] = (centre[m] - low[m]) * inv_size
        for n in range(3):
            turn[m, n] = rotation[m, n] * inv_size
    return turn, shift


@njit(inline="always")
def flat_cell(turn, shift, x, y, d, shape):
    """Flat cell of the reading d on the ray (x, y, 1); -1 outside the grid."""
    a = (turn[0, 0] * x + turn[0, 1] * y + turn[0, 2]) * d + shift[0]
    b = (turn[1, 0] * x + turn[1, 1] * y + turn[1, 2]) * d + shift[1]
    c = (turn[2, 0] * x + turn[2, 1] * y + turn[2, 2]) * d + shift[2]
    if a < 0 or b < 0 or c < 0 or a >= shape[0] or b >= shape[1] or c >= shape[2]:
        return np.int64(-1)
    return (np.int64(a) * shape[1] + np.int64(b)) * shape[2] + np.int64(c)


@njit(nogil=True, fastmath=True, cache=True)
def mark_readings(rotation, centre, intrinsics, depth, stride, join, low, inv_size, marks):
    """Mark the cells of `marks` (X, Y, Z) bool, lowest corner `low` (3,), that a depth reading lies in.

    Of `depth` (H, W) every `stride`-th pixel is read. Between neighbours whose depths differ by less than `join` of
    their mean the line is marked too, so that a surface seen at a grazing angle leaves no gaps. Frames may come at
    the same time.
    """
    height, width = depth.shape
    turn, shift = to_cells(rotation, centre, low, inv_size)
    flat, half = marks.reshape(-1), np.float32(0.5)
    inv_x, inv_y = np.float32(1) / intrinsics[0], np.float32(1) / intrinsics[1]
    for i in range(0, height, stride):
        for j in range(0, width, stride):
            d = depth[i, j]
            if d <= 0:
                continue
            x = (np.float32(j) + half - intrinsics[2]) * inv_x * d
            y = (np.float32(i) + half - intrinsics[3]) * inv_y * d
            cell = flat_cell(turn, shift, x / d, y / d, d, marks.shape)
            if cell >= 0:
                flat[cell] = True
            for side in range(2):
                i2, j2 = i + stride * side, j + stride * (1 - side)
                if i2 >= height or j2 >= width or abs(depth[i2, j2] - d) >= join * d or depth[i2, j2] <= 0:
                    continue
                d2 = depth[i2, j2]
                x2 = (np.float32(j2) + half - intrinsics[2]) * inv_x * d2
                y2 = (np.float32(i2) + half - intrinsics[3]) * inv_y * d2
                gap = np.sqrt((x2 - x) ** 2 + (y2 - y) ** 2 + (d2 - d) ** 2)
                pieces = min(1 + int(gap * inv_size), SPLIT_MAX)
                for p in range(1, pieces):
                    s = np.float32(p) / np.float32(pieces)
                    z = d + s * (d2 - d)
                    cell = flat_cell(turn, shift, (x + s * (x2 - x)) / z, (y + s * (y2 - y)) / z, z, marks.shape)
                    if cell >= 0:
                        flat[cell] = True


@njit(parallel=True, fastmath=True, cache=True)
def add_colours(
    spheres, vertices, normals, rotation, centre, intrinsics, depth, rgb, near, far, tolerance, min_cosine, footprint,
    reference, inv_variance, sums,
):
    """Add the frame's colours to `sums` (V, 4) float32: weighted r, g, b (0..255) and the weight.

    vertices, normals (V, 3) float32 world; depth (H, W) float32 m, rgb (H, W, 3) uint8; a vertex is seen where all
    four readings around it agree with its depth within `tolerance` (a share of the depth on top, for slanted surface)
    and its normal has at least `min_cosine` towards the camera. Its weight is (cosine / distance)^2. The colour is the
    mean of 2 x 2 bilinear samples over `footprint` m. With inv_variance > 0 a sample counts less the more it differs
    from `reference` (V, 3).
    """
    height, width = depth.shape
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    for c in prange(spheres.shape[0]):
        if not meets_frustum(spheres[c], rotation, centre, intrinsics, width, height, far + tolerance):
            continue
        for k in range(c * CHUNK, min((c + 1) * CHUNK, vertices.shape[0])):
            dx, dy, dz = vertices[k, 0] - centre[0], vertices[k, 1] - centre[1], vertices[k, 2] - centre[2]
            z = rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz
            if z <= near:
                continue
            u = fx * (rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz) / z + cx - np.float32(0.5)
            v = fy * (rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz) / z + cy - np.float32(0.5)
            if u < 0 or v < 0 or u >= width - 1 or v >= height - 1:
                continue
            distance = np.sqrt(dx * dx + dy * dy + dz * dz)
            cosine = -(normals[k, 0] * dx + normals[k, 1] * dy + normals[k, 2] * dz) / distance
            if cosine < min_cosine:
                continue
            i, j = int(v), int(u)
            allowed = tolerance + 2 * z / (fx * cosine)
            agree = True
            for m in range(4):
                d = depth[i + (m >> 1), j + (m & 1)]
                agree = agree and d > 0 and abs(d - z) <= allowed
            if not agree:
                continue
            reach = np.float32(0.25) * footprint * fx / z
            r = g = b = np.float32(0)
            for m in range(4):
                su = min(max(u + reach * (2 * (m & 1) - 1), np.float32(0)), np.float32(width) - np.float32(1.001))
                sv = min(max(v + reach * (2 * (m >> 1) - 1), np.float32(0)), np.float32(height) - np.float32(1.001))
                i, j = int(sv), int(su)
                a, e = sv - i, su - j
                for n in range(4):
                    w = (a if n >> 1 else 1 - a) * (e if n & 1 else 1 - e) * np.float32(0.25)
                    r += w * rgb[i + (n >> 1), j + (n & 1), 0]
                    g += w * rgb[i + (n >> 1), j + (n & 1), 1]
                    b += w * rgb[i + (n >> 1), j + (n & 1), 2]
            weight = (cosine / distance) ** 2
            if inv_variance > 0:
                e = (r - reference[k, 0]) ** 2 + (g - reference[k, 1]) ** 2 + (b - reference[k, 2]) ** 2
                weight /= (1 + e * inv_variance) ** 2
            sums[k, 0] += weight * r
            sums[k, 1] += weight * g
            sums[k, 2] += weight * b
            sums[k, 3] += weight
