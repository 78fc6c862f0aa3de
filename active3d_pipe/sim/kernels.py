"""Numba kernels of the renderer: shading with filtered textures, edge detection, rays. Slow twins: `reference.py`.

Every output element is written by one iteration of a parallel loop and depends on inputs alone, so the same input
gives the same bytes. Layouts of the packed scene are documented at `shading.PackedScene`.
"""
# mypy: ignore-errors

import math

import numpy as np
from numba import njit, prange

NO_HIT = np.uint32(0xFFFFFFFF)
_CHUNK = 512
# Layout of a texel, int64: red from bit 0, green from bit 21, blue from bit 42.
_FIELD, _GREEN, _BLUE = np.int64(0x1FFFFF), np.int64(21), np.int64(42)
_UNIT_WEIGHT = np.float32(1 / 4096)
_SINGLE_LEVEL = np.float32(0.06)  # so near to a mip level the other one is not read
_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)


@njit(inline="always")
def _bilinear(texels, offset, width, height, u, v):
    """RGB in 0..255 at (u, v) in 0..1 of one mip level that repeats."""
    x, y = u * np.float32(width) - _HALF, v * np.float32(height) - _HALF
    fx, fy = np.floor(x), np.floor(y)
    ax, ay = x - fx, y - fy
    # u - floor(u) may round up to 1, so both ends are guarded.
    x0, y0 = np.int64(np.int32(fx)), np.int64(np.int32(fy))
    x1, y1 = x0 + 1, y0 + 1
    x0, x1 = x0 + width if x0 < 0 else x0, x1 - width if x1 >= width else x1
    y0, y1 = y0 + height if y0 < 0 else y0, y1 - height if y1 >= height else y1
    x0, y0 = min(x0, width - 1), min(y0, height - 1)
    row0, row1 = offset + y0 * width, offset + y1 * width
    # Unsigned indices spare the test for negative ones. The three channels are blended along x at once, each in 21 bits
    # of one integer: 8 bits of value times 12 bits of weight.
    w1 = np.int64(np.int32(ax * np.float32(4096) + _HALF))
    w0 = np.int64(4096) - w1
    top = texels[np.uint64(row0 + x0)] * w0 + texels[np.uint64(row0 + x1)] * w1
    low = texels[np.uint64(row1 + x0)] * w0 + texels[np.uint64(row1 + x1)] * w1
    v0, v1 = (_ONE - ay) * _UNIT_WEIGHT, ay * _UNIT_WEIGHT
    r = v0 * np.float32(np.int32(top & _FIELD)) + v1 * np.float32(np.int32(low & _FIELD))
    g = v0 * np.float32(np.int32((top >> _GREEN) & _FIELD)) + v1 * np.float32(np.int32((low >> _GREEN) & _FIELD))
    b = v0 * np.float32(np.int32((top >> _BLUE) & _FIELD)) + v1 * np.float32(np.int32((low >> _BLUE) & _FIELD))
    return r, g, b


@njit(inline="always")
def filtered_texture(texels, levels, first, last, u, v, ux, vx, uy, vy, bias, max_probes):
    """RGB (0..255) of a texture averaged over a pixel's footprint.

    `levels` (L, 3) int64: offset into `texels`, width, height; rows first..last - 1 are this texture's. (ux, vx),
    (uy, vy): change of (u, v) over one pixel to the right and downwards. Trilinear mip lookups at probes along the
    footprint's long axis; the level fits its short axis (Heckbert 1989, McCormack et al. 1999).
    """
    width, height = np.float32(levels[first, 1]), np.float32(levels[first, 2])
    ax, ay = ux * width, vx * height
    bx, by = uy * width, vy * height
    if max_probes <= 1:
        # One lookup: the level whose texels have the footprint's area.
        area = abs(ax * by - ay * bx)
        k = np.int64(_HALF * np.float32(math.log2(max(area, _ONE))) + bias + _HALF)
        k = first + min(max(k, 0), last - first - 1)
        return _bilinear(texels, levels[k, 0], levels[k, 1], levels[k, 2], u - np.floor(u), v - np.floor(v))
    # Axes of the ellipse J (unit disc), J = [a b]: eigen-decomposition of J J^T.
    e, f, g = ax * ax + bx * bx, ax * ay + bx * by, ay * ay + by * by
    mean, diff = _HALF * (e + g), _HALF * (e - g)
    root = math.sqrt(diff * diff + f * f)
    long2, short2 = mean + root, max(mean - root, np.float32(1e-12))
    long, short = math.sqrt(long2), math.sqrt(short2)
    if long <= _ONE:
        return _bilinear(
            texels, levels[first, 0], levels[first, 1], levels[first, 2], u - np.floor(u), v - np.floor(v))
    probes = min(np.int64(math.ceil(long / max(short, _ONE) - np.float32(1e-3))), max_probes)
    probes = max(probes, 1)
    extent = max(short, long / np.float32(probes), _ONE)
    lod = min(max(np.float32(math.log2(extent)) + bias, _ZERO), np.float32(last - first - 1))
    level = np.int64(lod)
    blend = lod - np.float32(level)
    if blend > _ONE - _SINGLE_LEVEL:
        level, blend = level + 1, _ZERO
    level += first
    # Direction of the long axis in texels, then in (u, v).
    if root > np.float32(1e-9):
        cx, cy = f, long2 - e
        if diff > _ZERO:
            cx, cy = long2 - g, f
        norm = math.sqrt(cx * cx + cy * cy)
        cx, cy = cx / norm, cy / norm
    else:
        cx, cy = _ONE, _ZERO
    su, sv = cx * long / width, cy * long / height
    r, gr, b = _ZERO, _ZERO, _ZERO
    inv = _ONE / np.float32(probes)
    offset, across, tall = levels[level, 0], levels[level, 1], levels[level, 2]
    for i in range(probes):
        s = (np.float32(i) + _HALF) * inv - _HALF
        pu, pv = u + s * su, v + s * sv
        pu, pv = pu - np.floor(pu), pv - np.floor(pv)
        r0, g0, b0 = _bilinear(texels, offset, across, tall, pu, pv)
        if blend > _SINGLE_LEVEL:
            k = level + 1
            r1, g1, b1 = _bilinear(texels, levels[k, 0], levels[k, 1], levels[k, 2], pu, pv)
            r0, g0, b0 = r0 + blend * (r1 - r0), g0 + blend * (g1 - g0), b0 + blend * (b1 - b0)
        r, gr, b = r + r0, gr + g0, b + b0
    return r * inv, gr * inv, b * inv


@njit(inline="always")
def _grid_value(grid, origin, inv_voxel, x, y, z):
    """Trilinear value at a world point of a volume given at voxel centres, clamped at its borders."""
    nx, ny, nz = grid.shape
    gx = min(max((x - origin[0]) * inv_voxel - _HALF, _ZERO), np.float32(nx) - np.float32(1.001))
    gy = min(max((y - origin[1]) * inv_voxel - _HALF, _ZERO), np.float32(ny) - np.float32(1.001))
    gz = min(max((z - origin[2]) * inv_voxel - _HALF, _ZERO), np.float32(nz) - np.float32(1.001))
    i, j, k = np.int32(gx), np.int32(gy), np.int32(gz)
    a, b, c = gx - np.float32(i), gy - np.float32(j), gz - np.float32(k)
    # Unsigned indices spare the test for negative ones.
    i, j, k = np.uint64(i), np.uint64(j), np.uint64(k)
    i1, j1, k1 = i + np.uint64(1), j + np.uint64(1), k + np.uint64(1)
    low = (grid[i, j, k] * (_ONE - a) + grid[i1, j, k] * a) * (_ONE - b) + (
        grid[i, j1, k] * (_ONE - a) + grid[i1, j1, k] * a) * b
    high = (grid[i, j, k1] * (_ONE - a) + grid[i1, j, k1] * a) * (_ONE - b) + (
        grid[i, j1, k1] * (_ONE - a) + grid[i1, j1, k1] * a) * b
    return low * (_ONE - c) + high * c


@njit(inline="always")
def _brightness(px, py, pz, nx, ny, nz, lights, occlusion, grid, origin, inv_voxel):
    """Fixed light on a surface point with unit normal towards the viewer: see `shading.LIGHTS`, `shading.OCCLUSION`."""
    light = lights[0, 3]
    for i in range(1, len(lights)):
        light += lights[i, 3] * (nx * lights[i, 0] + ny * lights[i, 1] + nz * lights[i, 2])
    shadow = _ZERO
    for i in range(len(occlusion)):
        h = occlusion[i, 0]
        d = _grid_value(grid, origin, inv_voxel, px + h * nx, py + h * ny, pz + h * nz)
        shadow += occlusion[i, 1] * max(_ONE - d / h, _ZERO)
    return light * (_ONE - shadow)


@njit(fastmath=True, cache=True)
def _shade_range(begin, end, rays, t, face, bary, right, down, bias, max_probes, rgb, normal,
                 vertices, faces, face_material, uv, corner_normal, vertex_colors, base_color, mip_range, levels,
                 texels, lights, occlusion, grid, origin, inv_voxel):
    for n in range(begin, end):
        f = face[n]
        if f == NO_HIT:
            for c in range(3):
                rgb[n, c] = _ZERO
                normal[n, c] = _ZERO
            continue
        ox, oy, oz = rays[n, 0], rays[n, 1], rays[n, 2]
        dx, dy, dz = rays[n, 3], rays[n, 4], rays[n, 5]
        i0, i1, i2 = faces[f, 0], faces[f, 1], faces[f, 2]
        e1x, e1y, e1z = (vertices[i1, 0] - vertices[i0, 0], vertices[i1, 1] - vertices[i0, 1],
                         vertices[i1, 2] - vertices[i0, 2])
        e2x, e2y, e2z = (vertices[i2, 0] - vertices[i0, 0], vertices[i2, 1] - vertices[i0, 1],
                         vertices[i2, 2] - vertices[i0, 2])
        gx, gy, gz = e1y * e2z - e1z * e2y, e1z * e2x - e1x * e2z, e1x * e2y - e1y * e2x
        b1, b2 = bary[n, 0], bary[n, 1]
        b0 = _ONE - b1 - b2
        # Shading normal, on the viewer's side of the face.
        q = np.float32(1.0 / 32767.0)
        nx = q * (b0 * corner_normal[f, 0, 0] + b1 * corner_normal[f, 1, 0] + b2 * corner_normal[f, 2, 0])
        ny = q * (b0 * corner_normal[f, 0, 1] + b1 * corner_normal[f, 1, 1] + b2 * corner_normal[f, 2, 1])
        nz = q * (b0 * corner_normal[f, 0, 2] + b1 * corner_normal[f, 1, 2] + b2 * corner_normal[f, 2, 2])
        facing = gx * dx + gy * dy + gz * dz
        scale = _ONE / max(math.sqrt(nx * nx + ny * ny + nz * nz), np.float32(1e-12))
        if facing > _ZERO:
            scale = -scale
        nx, ny, nz = nx * scale, ny * scale, nz * scale
        normal[n, 0], normal[n, 1], normal[n, 2] = nx, ny, nz

        m = face_material[f]
        r, g, b = base_color[m, 0], base_color[m, 1], base_color[m, 2]
        if mip_range[m, 1] > mip_range[m, 0]:
            # Ray differentials on the face's plane (Igehy 1999): the footprint of one pixel in (u, v).
            g2 = gx * gx + gy * gy + gz * gz
            length = math.sqrt(g2)
            least = np.float32(1e-3) * length
            if abs(facing) < least:
                facing = least
            tt = t[n]
            kx = (gx * right[0] + gy * right[1] + gz * right[2]) / facing
            ky = (gx * down[0] + gy * down[1] + gz * down[2]) / facing
            px, py, pz = tt * (right[0] - kx * dx), tt * (right[1] - kx * dy), tt * (right[2] - kx * dz)
            sx, sy, sz = tt * (down[0] - ky * dx), tt * (down[1] - ky * dy), tt * (down[2] - ky * dz)
            inv = _ONE / max(g2, np.float32(1e-30))
            c1x, c1y, c1z = (e2y * gz - e2z * gy) * inv, (e2z * gx - e2x * gz) * inv, (e2x * gy - e2y * gx) * inv
            c2x, c2y, c2z = (gy * e1z - gz * e1y) * inv, (gz * e1x - gx * e1z) * inv, (gx * e1y - gy * e1x) * inv
            p1, p2 = c1x * px + c1y * py + c1z * pz, c2x * px + c2y * py + c2z * pz
            s1, s2 = c1x * sx + c1y * sy + c1z * sz, c2x * sx + c2y * sy + c2z * sz
            u0, v0 = uv[f, 0, 0], uv[f, 0, 1]
            du1, dv1 = uv[f, 1, 0] - u0, uv[f, 1, 1] - v0
            du2, dv2 = uv[f, 2, 0] - u0, uv[f, 2, 1] - v0
            tr, tg, tb = filtered_texture(
                texels, levels, mip_range[m, 0], mip_range[m, 1], u0 + b1 * du1 + b2 * du2, v0 + b1 * dv1 + b2 * dv2,
                p1 * du1 + p2 * du2, p1 * dv1 + p2 * dv2, s1 * du1 + s2 * du2, s1 * dv1 + s2 * dv2, bias, max_probes)
            r, g, b = r * tr, g * tg, b * tb
        else:
            r, g, b = r * np.float32(255), g * np.float32(255), b * np.float32(255)
        if len(vertex_colors) > 0:
            q = np.float32(1.0 / 255.0)
            r *= q * (b0 * vertex_colors[i0, 0] + b1 * vertex_colors[i1, 0] + b2 * vertex_colors[i2, 0])
            g *= q * (b0 * vertex_colors[i0, 1] + b1 * vertex_colors[i1, 1] + b2 * vertex_colors[i2, 1])
            b *= q * (b0 * vertex_colors[i0, 2] + b1 * vertex_colors[i1, 2] + b2 * vertex_colors[i2, 2])
        k = _brightness(ox + t[n] * dx, oy + t[n] * dy, oz + t[n] * dz, nx, ny, nz, lights, occlusion, grid, origin,
                        inv_voxel)
        rgb[n, 0] = min(r * k, np.float32(255))
        rgb[n, 1] = min(g * k, np.float32(255))
        rgb[n, 2] = min(b * k, np.float32(255))


@njit(parallel=True, fastmath=True, cache=True)
def shade(rays, t, face, bary, right, down, bias, max_probes, rgb, normal,
          vertices, faces, face_material, uv, corner_normal, vertex_colors, base_color, mip_range, levels,
          texels, lights, occlusion, grid, origin, inv_voxel):
    """Colours (N, 3) float32 0..255 and viewer-facing unit normals (N, 3) of ray hits.

    `rays` (N, 6), `t` (N,), `face` (N,) uint32, `bary` (N, 2) as `SurfaceIndex.cast` returns them; `right`, `down` (3,)
    world change of a ray's direction over one footprint; from `vertices` on the fields of `PackedScene.arrays`.
    """
    count = len(t)
    for chunk in prange((count + _CHUNK - 1) // _CHUNK):
        _shade_range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, count),
                     rays, t, face, bary, right, down, bias, max_probes, rgb, normal,
                     vertices, faces, face_material, uv, corner_normal, vertex_colors, base_color,
                     mip_range, levels, texels, lights, occlusion, grid, origin, inv_voxel)


@njit(inline="always")
def _edge_step(a, b, rays, t, face, normal, rgb, face_material, contrast, texture_contrast):
    """Colour step (0..255) between pixels a and b if an edge of at least `contrast` lies between them, else 0."""
    fa, fb = face[a], face[b]
    if fa == fb:
        return _ZERO
    step = max(abs(rgb[a, 0] - rgb[b, 0]), abs(rgb[a, 1] - rgb[b, 1]), abs(rgb[a, 2] - rgb[b, 2]))
    if step < contrast:
        return _ZERO
    if step >= texture_contrast or fa == NO_HIT or fb == NO_HIT or face_material[fa] != face_material[fb]:
        return step
    dot = normal[a, 0] * normal[b, 0] + normal[a, 1] * normal[b, 1] + normal[a, 2] * normal[b, 2]
    if dot < np.float32(0.97):
        return step
    # Distance of b's point from a's tangent plane: a step in depth.
    off = _ZERO
    for c in range(3):
        off += normal[a, c] * (t[b] * rays[b, 3 + c] - t[a] * rays[a, 3 + c])
    return step if abs(off) > np.float32(0.01) * t[a] else _ZERO


@njit(parallel=True, fastmath=True, cache=True)
def edge_contrast(rays, t, face, normal, rgb, face_material, contrast, texture_contrast, steps, marked):
    """Contrast (0..255, rounded) of the strongest edge between each pixel and its four neighbours; 0 = no edge.

    An edge is a colour step of at least `contrast` where also surface, material, normal or depth changes, or one of
    at least `texture_contrast` between any two faces. `steps` (2, H, W) float32 is scratch; `marked` (H, W) uint8.
    """
    height, width = marked.shape
    for i in prange(height):
        for j in range(width):
            n = i * width + j
            steps[0, i, j] = _ZERO if j + 1 == width else _edge_step(
                n, n + 1, rays, t, face, normal, rgb, face_material, contrast, texture_contrast)
            steps[1, i, j] = _ZERO if i + 1 == height else _edge_step(
                n, n + width, rays, t, face, normal, rgb, face_material, contrast, texture_contrast)
    for i in prange(height):
        for j in range(width):
            step = max(steps[0, i, j], steps[1, i, j])
            if j > 0:
                step = max(step, steps[0, i, j - 1])
            if i > 0:
                step = max(step, steps[1, i - 1, j])
            marked[i, j] = np.uint8(step)


@njit(parallel=True, cache=True)
def sample_rays(pixels, offsets, width, T, inv_fx, inv_fy, cx, cy, rays):
    """Rays (P * K, 6) float32 through points `offsets` (K, 2) of the pixels (P,) flat indices, depth per unit t.

    `T` (4, 4) float64 T_world_camera; offsets are (x, y) in 0..1 from the pixel's top left corner.
    """
    k = len(offsets)
    for p in prange(len(pixels)):
        i, j = pixels[p] // width, pixels[p] % width
        for s in range(k):
            x = (j + offsets[s, 0] - cx) * inv_fx
            y = (i + offsets[s, 1] - cy) * inv_fy
            n = p * k + s
            for c in range(3):
                rays[n, c] = T[c, 3]
                rays[n, 3 + c] = T[c, 0] * x + T[c, 1] * y + T[c, 2]
