"""Images that are fitted to a face once: paintings, book spines, rugs, views from the window, screens, labels.

Painters take (rng, n) and return (n, n, 3) float32 display values in 0..1, first row on top.
"""

import math
from collections.abc import Sequence

import numpy as np

from active3d_pipe.sim.apartment_noise import Colour, blend, coordinates, noise, pick_hue, ramp, shade, smooth

SPINES = (4, 24)  # rows and columns of the atlas of book spines
PAINTINGS = (3, 3)
LABELS = (4, 4)


def cell_uv(atlas: tuple[int, int], index: int, *, margin: float = 0.04) -> np.ndarray:
    """Texture coordinates (4, 2), v up, counter-clockwise from lower left, of cell `index` of an atlas."""
    rows, cols = atlas
    row, col = divmod(index % (rows * cols), cols)
    u0, u1 = (col + margin) / cols, (col + 1 - margin) / cols
    v0, v1 = 1 - (row + 1 - margin) / rows, 1 - (row + margin) / rows
    return np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]])


def _hsv(h: float, s: float, v: float) -> np.ndarray:
    k = (np.array([5.0, 3.0, 1.0]) + h * 6) % 6
    return (v - v * s * np.clip(np.minimum(k, 4 - k), 0, 1)).astype(np.float32)


def _text(
    rng: np.random.Generator, image: np.ndarray, box: tuple[int, int, int, int], colour: Colour, *, height: int
) -> None:
    """Marks like lines of text, in place, inside box (row0, row1, col0, col1); words, ragged right."""
    r0, r1, c0, c1 = box
    step = max(2, height)
    for row in range(r0, r1 - step + 1, step + max(1, step // 2)):
        col, stop = c0, c1 - int(rng.integers(0, max(1, (c1 - c0) // 4)))
        while col + step // 2 < stop:
            width = max(1, int(step * rng.uniform(0.4, 0.8)))
            glyph = rng.random((step, width)) < 0.55
            target = image[row : row + step, col : col + width]
            target[glyph[: target.shape[0], : target.shape[1]]] = colour
            col += width + (step if rng.random() < 0.2 else max(1, step // 4))


def spines(rng: np.random.Generator, n: int) -> np.ndarray:
    """Atlas of book spines: cloth, bands, titles along the spine, publishers' marks."""
    rows, cols = SPINES
    image = np.zeros((n, n, 3), dtype=np.float32)
    cloth = 1 + 0.06 * noise(rng, n, 0.5, low=20) + 0.06 * noise(rng, n, 1.5)
    for k in range(rows * cols):
        row, col = divmod(k, cols)
        r0, r1, c0, c1 = row * n // rows, (row + 1) * n // rows, col * n // cols, (col + 1) * n // cols
        base = _hsv(pick_hue(rng), rng.uniform(0.08, 0.7), rng.uniform(0.22, 0.9))
        cell = image[r0:r1, c0:c1]
        cell[:] = base
        h, w = r1 - r0, c1 - c0
        ink = np.array([0.93, 0.88, 0.7]) if base.mean() < 0.5 else base * 0.25
        for at in rng.uniform(0.03, 0.97, int(rng.integers(0, 5))):
            cell[int(at * h) : int(at * h) + int(rng.integers(1, 5))] = ink
        if rng.random() < 0.4:
            a = rng.uniform(0.1, 0.5)
            cell[int(a * h) : int((a + 0.2) * h)] = _hsv(pick_hue(rng), 0.5, rng.uniform(0.3, 0.9))
        upright = np.ascontiguousarray(np.rot90(cell))  # titles run along the spine
        size = max(2, int(w * rng.uniform(0.2, 0.4)))
        _text(rng, upright, (int(w * 0.25), int(w * 0.85), int(h * 0.1), int(h * 0.75)), ink, height=size)
        cell[:] = np.rot90(upright, -1)
        curve = np.sin(np.pi * (np.arange(w) + 0.5) / w) ** 0.4
        cell *= (0.6 + 0.4 * curve)[None, :, None]
    return shade(image, cloth)


def _landscape(rng: np.random.Generator, n: int, *, town: bool = False) -> np.ndarray:
    _, v = coordinates(n)
    sky = ramp(v[:, :1] * 1.7, (0.25, 0.45, 0.78), (0.62, 0.78, 0.93), (0.95, 0.9, 0.8))
    image = np.broadcast_to(sky, (n, n, 3)).copy()
    cloud = smooth(0.2, 1.4, noise(rng, n, 1.5, stretch=(1, 2), low=2)) * smooth(0.65, 0.2, v)
    image = blend(image, (0.98, 0.97, 0.96), 0.9 * cloud)
    rough = noise(rng, n, 0.9, low=4)
    for k, base in enumerate((0.50, 0.58, 0.68, 0.8)):
        ridge = base + 0.07 * noise(rng, n, 1.5, low=1)[:1] - 0.02 * k
        far = 1 - k / 3.5
        colour = np.array([0.20, 0.36, 0.14]) * (1 - far) + np.array([0.50, 0.62, 0.72]) * far
        colour = colour * rng.uniform(0.85, 1.2, 3)
        layer = shade(np.broadcast_to(colour.astype(np.float32), (n, n, 3)), 1 + 0.22 * (1 - 0.6 * far) * rough)
        mask = smooth(0, 0.008, v - ridge)[..., None]
        image = image * (1 - mask) + layer * mask
        if town and k == 2:
            _houses(rng, image, ridge[0])
        rough = np.roll(rough, n // 3, axis=1)
    return image


def broadcast(rng: np.random.Generator, n: int) -> np.ndarray:
    """What is on television: a landscape with a caption."""
    image = _landscape(rng, n)
    image[int(0.82 * n) : int(0.93 * n), int(0.06 * n) : int(0.7 * n)] *= 0.3
    _text(rng, image, (int(0.84 * n), int(0.92 * n), int(0.08 * n), int(0.68 * n)), (0.95, 0.95, 0.9), height=n // 24)
    return image


def _houses(rng: np.random.Generator, image: np.ndarray, ridge: np.ndarray) -> None:
    """A row of houses with lit windows standing on the ridge line, in place."""
    n = image.shape[0]
    col = 0
    while col < n - n // 16:
        w, h = int(n * rng.uniform(0.05, 0.12)), int(n * rng.uniform(0.1, 0.32))
        bottom = int(np.clip(ridge[min(col, n - 1)] * n + 0.06 * n, 0, n))
        wall = _hsv(rng.uniform(0.02, 0.13), rng.uniform(0.1, 0.45), rng.uniform(0.5, 0.9))
        top = max(0, bottom - h)
        image[top:bottom, col : col + w] = wall * rng.uniform(0.96, 1.04, (bottom - top, min(w, n - col), 1))
        cell = max(4, n // 64)
        for r in range(top + cell // 2, bottom - cell, cell * 2):
            for c in range(col + cell // 2, min(col + w, n) - cell, cell * 2):
                image[r : r + cell + cell // 3, c : c + cell] = (
                    (0.95, 0.85, 0.5) if rng.random() < 0.3 else (0.2, 0.25, 0.32)
                )
        image[max(0, top - cell) : top, col : col + w] = (0.45, 0.22, 0.17)
        col += w + int(rng.uniform(0, 0.05) * n)


def view(rng: np.random.Generator, n: int) -> np.ndarray:
    """What one sees through a window: sky, clouds, hills, a town, trees."""
    image = _landscape(rng, n, town=True)
    u, v = coordinates(n)
    foliage = noise(rng, n, 1.0, low=6)
    for _ in range(int(rng.integers(2, 5))):
        cx, cy, r = rng.random(), rng.uniform(0.62, 0.85), rng.uniform(0.08, 0.2)
        trunk = (np.abs(u - cx) < 0.012) & (v > cy)
        image[trunk] = (0.25, 0.17, 0.11)
        mask = smooth(0, 0.03, r + 0.025 * foliage - np.hypot(u - cx, 0.9 * (v - cy)))
        tree = ramp(np.clip(0.45 + 0.25 * foliage, 0, 1), (0.06, 0.16, 0.05), (0.42, 0.55, 0.2))
        image = image * (1 - mask[..., None]) + tree * mask[..., None]
    return image


def _abstract(rng: np.random.Generator, n: int) -> np.ndarray:
    hues = pick_hue(rng) + np.array([0, 0.06, 0.5, 0.54, 0.1])
    image = np.broadcast_to(_hsv(hues[0] % 1, 0.15, 0.93), (n, n, 3))
    for k in range(6):
        colour = _hsv(hues[k % 5] % 1, rng.uniform(0.4, 0.9), rng.uniform(0.3, 0.95))
        image = blend(image, colour, 0.9 * smooth(0.3, 0.42, noise(rng, n, rng.uniform(1.4, 2.2), low=1 + k)))
    return shade(image, 1 + 0.09 * noise(rng, n, 0.7, stretch=(5, 1), low=6))


def _geometric(rng: np.random.Generator, n: int) -> np.ndarray:
    u, v = coordinates(n)
    image = np.broadcast_to(np.asarray((0.93, 0.89, 0.8), np.float32), (n, n, 3)).copy()
    hue = pick_hue(rng)
    for _ in range(9):
        colour = _hsv(
            (hue + float(rng.choice([0, 0.06, 0.5, 0.55]))) % 1, rng.uniform(0.3, 0.9), rng.uniform(0.25, 0.95)
        )
        cx, cy, r = rng.random(), rng.random(), rng.uniform(0.08, 0.3)
        kind = rng.integers(3)
        if kind == 0:
            mask = np.hypot(u - cx, v - cy) < r
        elif kind == 1:
            mask = (np.abs(u - cx) < r) & (np.abs(v - cy) < rng.uniform(0.03, 0.3))
        else:
            mask = np.abs((u - cx) * math.cos(9 * r) + (v - cy) * math.sin(9 * r)) < 0.015
        image[mask] = 0.8 * colour + 0.2 * image[mask]
    return shade(image, 1 + 0.05 * noise(rng, n, 0.5, low=12) + 0.04 * noise(rng, n, 1.5))


def _bouquet(rng: np.random.Generator, n: int) -> np.ndarray:
    u, v = coordinates(n)
    image = ramp(
        np.clip(0.5 + 0.2 * noise(rng, n, 1.7) + 0.4 * (v - 0.5), 0, 1),
        _hsv(pick_hue(rng), 0.35, 0.22),
        _hsv(pick_hue(rng), 0.3, 0.55),
    )
    vase = (np.abs(u - 0.5) < 0.09 + 0.05 * np.sin(9 * v)) & (v > 0.62) & (v < 0.93)
    image[vase] = _hsv(pick_hue(rng), 0.3, 0.75)
    for _ in range(26):
        cx, cy, r = rng.normal(0.5, 0.16), rng.normal(0.38, 0.12), rng.uniform(0.03, 0.09)
        petals = int(rng.integers(4, 8))
        colour = _hsv(
            float(rng.choice([0.0, 0.05, 0.12, 0.3, 0.33, 0.95])), rng.uniform(0.4, 0.85), rng.uniform(0.5, 0.97)
        )
        window = (
            slice(max(0, int((cy - r) * n)), max(0, int((cy + r) * n) + 1)),
            slice(max(0, int((cx - r) * n)), max(0, int((cx + r) * n) + 1)),
        )
        du, dv = u[window] - cx, v[window] - cy
        a, d = np.arctan2(dv, du), np.hypot(du, dv) / r
        flower = blend(
            image[window],
            colour,
            smooth(0, 0.1, 0.75 + 0.25 * np.cos(petals * a) - d) * (0.65 + 0.35 * np.clip(d, 0, 1)),
        )
        image[window] = blend(flower, colour * 0.4, smooth(0, 0.1, 0.25 - d))
    return shade(image, 1 + 0.08 * noise(rng, n, 0.6, stretch=(3, 1), low=8))


def paintings(rng: np.random.Generator, n: int) -> np.ndarray:
    """Atlas of paintings: landscapes, abstract, geometric, flowers."""
    rows, cols = PAINTINGS
    m = n // cols
    image = np.zeros((n, n, 3), dtype=np.float32)
    kinds = [_landscape, _abstract, _geometric, _bouquet]
    order = rng.permutation(rows * cols)
    for k in range(rows * cols):
        row, col = divmod(int(order[k]), cols)
        painted = kinds[k % 4](rng, m)
        canvas = 1 + 0.04 * noise(rng, m, 0.2, low=m / 5)
        image[row * m : (row + 1) * m, col * m : (col + 1) * m] = shade(painted, canvas)
    return image


def rug(rng: np.random.Generator, n: int, *, ground: Colour, figure: Colour, accent: Colour) -> np.ndarray:
    """Knotted rug: medallion, mirrored field, borders, knots."""
    u, v = coordinates(n)
    x, y = np.abs(u - 0.5) * 2, np.abs(v - 0.5) * 2
    field = noise(rng, n, 1.5, low=3)
    field = field + field[::-1]
    field = (field + field[:, ::-1]) * 0.7
    edge = np.maximum(x, y)
    image = np.broadcast_to(np.asarray(ground, np.float32), (n, n, 3))
    image = blend(image, figure, smooth(0.1, 0.2, np.sin(2.4 * field)))
    image = blend(image, accent, smooth(0.1, 0.2, 0.25 - np.abs(field - 0.8)))
    medal = np.hypot(x, y) - 0.45 - 0.06 * np.cos(12 * np.arctan2(v - 0.5, u - 0.5))
    image = blend(image, accent, smooth(0.03, 0.0, np.abs(medal)))
    image = blend(image, figure, smooth(0.0, 0.02, -medal - 0.15) * 0.6)
    image = blend(image, ground, smooth(0.2, 0.3, np.sin(3 * field) - 0.4) * (medal < -0.05))
    for low, high, colour in (
        (0.78, 0.8, accent),
        (0.8, 0.92, figure),
        (0.92, 0.94, accent),
        (0.94, 1.0, np.asarray(ground) * 0.5),
    ):
        image = blend(image, colour, ((edge >= low) & (edge < high)).astype(np.float32))
    along = np.where(x > y, v, u)
    zig = np.abs(((along * 28) % 1) - 0.5) * 0.2 + 0.81
    image = blend(image, ground, smooth(0.02, 0.01, np.abs(edge - zig)))
    knots = 1 + 0.1 * noise(rng, n, 0.1, low=n / 10) + 0.06 * noise(rng, n, 1.5) + 0.05 * np.sin(2 * np.pi * n / 4 * v)
    return shade(image, knots)


def screen(rng: np.random.Generator, n: int) -> np.ndarray:
    """A monitor with windows and lines of text."""
    image = _abstract(rng, n) * 0.6
    for _ in range(3):
        r, c = (int(x) for x in rng.integers(n // 16, n // 3, 2))
        h, w = (int(x) for x in rng.integers(n // 3, int(n * 0.6), 2))
        dark = rng.random() < 0.5
        image[r : r + h, c : c + w] = (0.12, 0.13, 0.17) if dark else (0.94, 0.95, 0.96)
        image[r : r + n // 32, c : c + w] = (0.3, 0.42, 0.62)
        for k in range(3):
            ink = _hsv(rng.random(), 0.5, 0.85 if dark else 0.35)
            top = r + n // 20 + k * h // 3
            _text(
                rng,
                image,
                (top, min(top + h // 3 - 4, r + h, n), c + n // 40, min(c + w, n)),
                ink,
                height=max(2, n // 90),
            )
    return image


def labels(rng: np.random.Generator, n: int) -> np.ndarray:
    """Atlas of printed labels: boxes, magazines, jars."""
    rows, cols = LABELS
    m = n // cols
    image = np.zeros((n, n, 3), dtype=np.float32)
    for k in range(rows * cols):
        row, col = divmod(k, cols)
        cell = image[row * m : (row + 1) * m, col * m : (col + 1) * m]
        hue = pick_hue(rng)
        cell[:] = _hsv(hue, rng.uniform(0.2, 0.8), rng.uniform(0.5, 0.95))
        motif: Sequence = (_bouquet, _abstract, _geometric)
        size = int(m * rng.uniform(0.45, 0.7))
        top, left = int(m * 0.32), (m - size) // 2
        cell[top : top + size, left : left + size] = motif[k % 3](rng, size)[: m - top]
        _text(
            rng,
            cell,
            (int(m * 0.06), int(m * 0.3), int(m * 0.08), int(m * 0.95)),
            _hsv((hue + 0.5) % 1, 0.7, 0.25),
            height=max(3, m // 9),
        )
        _text(rng, cell, (int(m * 0.86), m, int(m * 0.1), int(m * 0.9)), (0.1, 0.1, 0.1), height=max(2, m // 40))
    return shade(image, 1 + 0.05 * noise(rng, n, 1.0, low=6))
