"""Procedural, seamless textures with detail at all scales.

Every painter takes (rng, n) and returns an (n, n, 3) float32 image of display values in 0..1 that tiles in both
directions. Grain and weave run along u (columns).
"""

from collections.abc import Sequence

import numpy as np
from scipy import fft

Colour = Sequence[float] | np.ndarray

# Hues that go together in a home: brick, terracotta, sand, ochre, olive, sage, teal, petrol, slate, navy, dusty rose.
HUES = (0.01, 0.045, 0.085, 0.12, 0.19, 0.33, 0.47, 0.53, 0.58, 0.62, 0.965)


def pick_hue(rng: np.random.Generator) -> float:
    """One of HUES, a little moved."""
    return float(HUES[int(rng.integers(len(HUES)))] + rng.normal(0, 0.012)) % 1.0


def noise(
    rng: np.random.Generator, n: int, beta: float = 1.3, *, stretch: tuple[float, float] = (1.0, 1.0), low: float = 1.0
) -> np.ndarray:
    """Seamless fractal noise (n, n), zero mean, unit deviation: amplitude spectrum f^-beta from `low` cycles on.

    `stretch` = (along u, along v) elongates the features.
    """
    fv = np.fft.fftfreq(n, 1 / n).astype(np.float32)[:, None] * np.float32(stretch[1])
    fu = np.fft.rfftfreq(n, 1 / n).astype(np.float32)[None, :] * np.float32(stretch[0])
    f = np.hypot(fu, fv)
    amplitude = np.where(f < low * 0.999, 0, np.maximum(f, 1e-3) ** np.float32(-beta)).astype(np.float32)
    amplitude[0, 0] = 0
    draw = rng.standard_normal((2, *amplitude.shape), dtype=np.float32)
    field = fft.irfft2((draw[0] + 1j * draw[1]) * amplitude, s=(n, n))
    return (field / max(float(field.std()), 1e-9)).astype(np.float32)


def coordinates(n: int) -> tuple[np.ndarray, np.ndarray]:
    """u (columns) and v (rows) of pixel centres in 0..1, each (n, n) float32."""
    t = (np.arange(n, dtype=np.float32) + 0.5) / n
    return np.broadcast_to(t[None], (n, n)), np.broadcast_to(t[:, None], (n, n))


def ramp(t: np.ndarray, *colours: Colour) -> np.ndarray:
    """Interpolate between colours at t in 0..1; (..., 3) float32."""
    stops = np.linspace(0, 1, len(colours))
    c = np.asarray(colours, dtype=np.float32)
    return np.stack([np.interp(t, stops, c[:, i]) for i in range(3)], axis=-1).astype(np.float32)


def shade(image: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """Multiply an image (..., 3) by a gain (...)."""
    return image * gain[..., None].astype(np.float32)


def blend(a: np.ndarray, b: Colour, weight: np.ndarray) -> np.ndarray:
    """a where weight = 0, b where weight = 1."""
    out = np.asarray(b, dtype=np.float32) - a
    out *= weight[..., None].astype(np.float32)
    out += a
    return out


def smooth(edge0: float, edge1: float, t: np.ndarray) -> np.ndarray:
    """Cubic step from 0 at edge0 to 1 at edge1."""
    x = np.clip((t - edge0) / (edge1 - edge0), 0, 1)
    return x * x * (3 - 2 * x)


def warp(image: np.ndarray, du: np.ndarray, dv: np.ndarray) -> np.ndarray:
    """Look up `image` (n, n) displaced by (du, dv) pixels, wrapping around; nearest pixel."""
    n = image.shape[0]
    i = (np.arange(n)[:, None] + np.rint(dv).astype(np.int64)) % n
    j = (np.arange(n)[None, :] + np.rint(du).astype(np.int64)) % n
    return image[i, j]


def grain(rng: np.random.Generator, n: int) -> np.ndarray:
    """Wood grain along u in 0..1: growth rings, fibres, pores."""
    _, v = coordinates(n)
    bend = noise(rng, n, 2.2, stretch=(6, 1))
    rings = np.sin(2 * np.pi * (v * int(rng.integers(7, 12)) + 0.55 * bend))
    fibres = noise(rng, n, 0.7, stretch=(30, 1), low=8)
    pores = noise(rng, n, 0.2, stretch=(18, 1), low=40)
    pores = np.minimum(pores + 1.6, 0)
    return np.clip(0.5 + 0.2 * rings * (0.7 + 0.3 * bend) + 0.11 * fibres + 0.16 * pores, 0, 1)


def wood(rng: np.random.Generator, n: int, *, dark: Colour, light: Colour) -> np.ndarray:
    """Veneer with grain along u."""
    return shade(ramp(grain(rng, n), dark, light), 1 + 0.05 * noise(rng, n, 1.6))


def _cells(rows: np.ndarray, cols: np.ndarray, table: np.ndarray) -> np.ndarray:
    return table[rows % table.shape[0], cols % table.shape[1]]


def planks(
    rng: np.random.Generator, n: int, *, dark: Colour, light: Colour, rows: int = 18, per_row: int = 2, contrast: float = 1.0
) -> np.ndarray:
    """Floor boards along u: every board shows another piece of the log, another tone, dark joints and wear."""
    u, v = coordinates(n)
    row = np.floor(v * rows).astype(int)
    offset = rng.random(rows).astype(np.float32)[row]
    col = np.floor((u + offset) * per_row).astype(int) % per_row
    log = grain(rng, n)
    ju, jv = _cells(row, col, rng.integers(0, n, (rows, per_row))), _cells(row, col, rng.integers(0, n, (rows, per_row)))
    t = warp(log, ju, jv * (1 + 0 * ju)) + _cells(row, col, rng.normal(0, 0.16 * contrast, (rows, per_row)))
    image = ramp(np.clip(t, 0, 1), dark, light)
    image = shade(image, 1 + _cells(row, col, rng.normal(0, 0.07 * contrast, (rows, per_row))) + 0.03 * noise(rng, n, 1.5))
    fv = np.abs((v * rows) % 1 - 0.5) * 2
    fu = np.abs(((u + offset) * per_row) % 1 - 0.5) * 2
    pixel_v, pixel_u = 2 * rows / n, 2 * per_row / n
    joint = np.maximum(smooth(1 - 2.2 * pixel_v, 1 - 0.6 * pixel_v, fv), smooth(1 - 2.2 * pixel_u, 1 - 0.6 * pixel_u, fu))
    return blend(image, np.asarray(dark) * 0.35, 0.8 * joint)


def parquet(rng: np.random.Generator, n: int, *, dark: Colour, light: Colour, blocks: int = 8, strips: int = 5) -> np.ndarray:
    """Basket parquet: squares of strips, turned alternately."""
    u, v = coordinates(n)
    bu, bv = np.floor(u * blocks).astype(int), np.floor(v * blocks).astype(int)
    turned = (bu + bv) % 2 == 1
    fu, fv = (u * blocks) % 1, (v * blocks) % 1
    across = np.where(turned, fu, fv) * strips
    strip = np.floor(across).astype(int)
    key = (bu * 31 + bv * 17 * blocks + strip * 7) % 997
    log = grain(rng, n)
    shift = rng.integers(0, n, 997)[key]
    t = np.where(turned, warp(log.T, shift, shift[::-1]), warp(log, shift, shift[::-1]))
    t = t + rng.normal(0, 0.15, 997)[key]
    image = shade(ramp(np.clip(t, 0, 1), dark, light), 1 + rng.normal(0, 0.06, 997)[key] + 0.03 * noise(rng, n, 1.5))
    edge = np.maximum(np.abs(across % 1 - 0.5) * 2, 1 - (1 - np.maximum(np.abs(fu - 0.5), np.abs(fv - 0.5)) * 2) * strips)
    pixel = 2 * blocks * strips / n
    return blend(image, np.asarray(dark) * 0.4, 0.75 * smooth(1 - 2 * pixel, 1 - 0.4 * pixel, edge))


def marble(rng: np.random.Generator, n: int, *, base: Colour, vein: Colour, scale: float = 2.0) -> np.ndarray:
    """Stone with warped veins at several widths."""
    a, b = noise(rng, n, 1.9, low=scale), noise(rng, n, 1.5, low=scale * 2)
    thick = np.exp(-((a + 0.5 * b) * 9) ** 2 / 4)
    thin = np.exp(-((b - 0.4 * a) * 14) ** 2 / 4)
    cloud = noise(rng, n, 1.2, low=scale)
    image = shade(np.broadcast_to(np.asarray(base, np.float32), (n, n, 3)), 1 + 0.05 * cloud + 0.02 * noise(rng, n, 0.3, low=20))
    return blend(image, vein, np.clip(0.75 * thick + 0.45 * thin * (cloud > -0.3), 0, 0.9))


def terrazzo(rng: np.random.Generator, n: int, *, base: Colour, chips: Sequence[Colour]) -> np.ndarray:
    """Chips of stone in a ground."""
    image = shade(np.broadcast_to(np.asarray(base, np.float32), (n, n, 3)), 1 + 0.03 * noise(rng, n, 0.6, low=6))
    for k, low in enumerate((10, 16, 26, 40)):
        field = noise(rng, n, 1.6, low=low)
        colour = chips[k % len(chips)]
        image = blend(image, colour, smooth(1.25, 1.35, field))
    return shade(image, 1 + 0.04 * noise(rng, n, 1.2))


def tiles(
    rng: np.random.Generator, n: int, *, face: Colour, other: Colour, grout: Colour, count: int = 8, layout: str = "square",
    veins: float = 0.5,
) -> np.ndarray:
    """Ceramic tiles with glaze clouds and grout; layout "square", "checker", "brick" or "mosaic"."""
    u, v = coordinates(n)
    rows, cols = {"brick": (2 * count, count), "mosaic": (4 * count, 4 * count)}.get(layout, (count, count))
    row = np.floor(v * rows).astype(int)
    uu = u + (0.5 / cols) * (row % 2) if layout == "brick" else u
    col = np.floor(uu * cols).astype(int) % cols
    pick = rng.random((rows, cols))
    if layout == "checker":
        pick = (np.add.outer(np.arange(rows), np.arange(cols)) % 2) * 0.9 + 0.05
    elif layout != "mosaic":
        pick = pick * 0.35
    cloud = warp(noise(rng, n, 1.5, low=2), _cells(row, col, rng.integers(0, n, (rows, cols))), 0 * row)
    vein = np.exp(-((warp(noise(rng, n, 1.6, low=3), 0 * row, _cells(row, col, rng.integers(0, n, (rows, cols))))) * 8) ** 2)
    t = _cells(row, col, pick) + 0.10 * cloud
    image = shade(ramp(np.clip(t, 0, 1), face, other), 1 + 0.03 * cloud - 0.16 * veins * vein + 0.02 * noise(rng, n, 0.3, low=30))
    fu, fv = np.abs((uu * cols) % 1 - 0.5), np.abs((v * rows) % 1 - 0.5)
    width = 1.6
    line = np.maximum(smooth(0.5 - width * cols / n, 0.5 - 0.5 * width * cols / n, fu),
                      smooth(0.5 - width * rows / n, 0.5 - 0.5 * width * rows / n, fv))
    dirt = np.clip(1 + 0.12 * noise(rng, n, 0.9, low=4), 0.6, 1.3)
    return image * (1 - line[..., None]) + shade(np.broadcast_to(np.asarray(grout, np.float32), (n, n, 3)), dirt) * line[..., None]


def plaster(rng: np.random.Generator, n: int, *, colour: Colour, strength: float = 1.0) -> np.ndarray:
    """Painted plaster: clouds, roller strokes and fine grain."""
    strokes = noise(rng, n, 1.0, stretch=(1, 5), low=5)
    field = 0.028 * noise(rng, n, 1.7) + 0.022 * strokes + 0.022 * noise(rng, n, 0.35, low=30) + 0.02 * noise(rng, n, 1.0, low=10)
    image = shade(np.broadcast_to(np.asarray(colour, np.float32), (n, n, 3)), 1 + strength * field)
    pits = smooth(2.3, 2.9, noise(rng, n, 0.7, low=24))
    return shade(image, 1 - 0.13 * strength * pits)


def wallpaper(
    rng: np.random.Generator, n: int, *, ground: Colour, figure: Colour, accent: Colour, pattern: str = "damask", repeat: int = 5
) -> np.ndarray:
    """Printed paper on a fine relief; pattern "damask", "stripes", "floral", "lattice" or "leaves"."""
    u, v = coordinates(n)
    m = n // repeat + 1
    if pattern == "stripes":
        wave = np.sin(2 * np.pi * u * 2 * repeat)
        ink, second = smooth(0.1, 0.25, wave), smooth(0.02, 0.06, 0.12 - np.abs(np.sin(2 * np.pi * (u * 2 * repeat + 0.25))))
    elif pattern == "lattice":
        a, b = np.abs(np.sin(np.pi * repeat * (u + v))), np.abs(np.sin(np.pi * repeat * (u - v)))
        ink = 1 - smooth(0.05, 0.12, np.minimum(a, b))
        second = smooth(0.80, 0.9, np.cos(2 * np.pi * repeat * u) * np.cos(2 * np.pi * repeat * v))
    else:
        ink, second = _motif(rng, n, m, repeat, pattern)
    image = np.broadcast_to(np.asarray(ground, np.float32), (n, n, 3))
    worn = np.clip(0.9 + 0.1 * noise(rng, n, 0.8, low=8), 0, 1)
    image = blend(blend(image, figure, ink * worn), accent, second * worn)
    relief = 0.03 * noise(rng, n, 0.4, stretch=(1, 4), low=30) + 0.025 * noise(rng, n, 1.7)
    return shade(image, 1 + relief)


def _motif(rng: np.random.Generator, n: int, m: int, repeat: int, pattern: str) -> tuple[np.ndarray, np.ndarray]:
    """Ink of two prints, (n, n): one motif, mirrored or drawn petal by petal, in half-drop repeat."""
    s = np.linspace(-1, 1, 256, dtype=np.float32)
    x, y = np.meshgrid(s, s)
    ink, second = np.zeros_like(x), np.zeros_like(x)
    if pattern == "damask":
        field = noise(rng, 256, 1.9, low=2)
        field = field + field[:, ::-1] + 0.5 * (field + field[:, ::-1])[::-1]
        window = 1.15 - np.hypot(1.25 * x, 0.95 * y)
        ink = smooth(0.0, 0.12, np.sin(2.2 * field) * 0.6 + window - 0.55)
        second = smooth(0.0, 0.1, 0.35 - np.abs(field)) * smooth(0.25, 0.4, window)
    else:
        count = 6 if pattern == "floral" else 11
        for _ in range(count):
            cx, cy, size = rng.uniform(-0.62, 0.62), rng.uniform(-0.62, 0.62), rng.uniform(0.14, 0.3)
            turn = rng.uniform(0, 2 * np.pi)
            r, a = np.hypot(x - cx, y - cy) / size, np.arctan2(y - cy, x - cx) + turn
            if pattern == "floral":
                petals = 0.72 + 0.28 * np.cos(5 * a)
                ink = np.maximum(ink, smooth(0.0, 0.12, petals - r) * (0.55 + 0.45 * np.abs(np.sin(5 * a + 3 * r))))
                second = np.maximum(second, smooth(0, 0.1, 0.24 - r))
            else:
                lx, ly = r * np.cos(a), r * np.sin(a)
                blade = 0.42 * np.clip(1 - lx * lx, 0, 1) - np.abs(ly)
                ink = np.maximum(ink, smooth(0, 0.06, blade))
                second = np.maximum(second, smooth(0, 0.02, 0.03 - np.abs(ly)) * (np.abs(lx) < 1))
    u, v = coordinates(n)
    column = np.floor(u * repeat).astype(int)
    # Half-drop; with an odd number of repeats two equal columns meet at the seam, which no one sees.
    fu, fv = (u * repeat) % 1, (v * repeat + 0.5 * (column % 2)) % 1
    i, j = np.minimum((fv * 256).astype(int), 255), np.minimum((fu * 256).astype(int), 255)
    return ink[i, j], second[i, j]


def weave(
    rng: np.random.Generator, n: int, *, colour: Colour, second: Colour, pattern: str = "plain", threads: int = 96, repeat: int = 6
) -> np.ndarray:
    """Cloth: threads over and under, slubs, wear; pattern "plain", "stripes", "plaid", "dots", "zigzag"."""
    u, v = coordinates(n)
    warp_thread, weft = np.sin(2 * np.pi * threads / 2 * u), np.sin(2 * np.pi * threads / 2 * v)
    over = 0.5 + 0.5 * np.sign(warp_thread * weft)
    lift = np.where(over > 0.5, np.abs(warp_thread), np.abs(weft))
    slub = 0.6 * noise(rng, n, 0.5, stretch=(12, 1), low=10) + 0.6 * noise(rng, n, 0.5, stretch=(1, 12), low=10)
    t = np.zeros((n, n), dtype=np.float32)
    if pattern == "stripes":
        t = smooth(0.2, 0.35, np.sin(2 * np.pi * repeat * v)) + 0.6 * smooth(0.9, 0.95, np.sin(2 * np.pi * repeat * v + 3.6))
    elif pattern == "plaid":
        band = lambda s: smooth(0.3, 0.4, np.sin(2 * np.pi * repeat * s)) + 0.8 * smooth(0.94, 0.97, np.sin(2 * np.pi * repeat * s + 3.3))  # noqa: E731
        t = 0.5 * band(u) + 0.5 * band(v)
    elif pattern == "dots":
        fu, fv = (2 * repeat * u) % 1 - 0.5, (2 * repeat * v + 0.5 * (np.floor(2 * repeat * u) % 2)) % 1 - 0.5
        t = 1 - smooth(0.2, 0.26, np.hypot(fu, fv))
    elif pattern == "zigzag":
        t = smooth(-0.15, 0.15, np.sin(2 * np.pi * (repeat * v + 0.35 * np.abs(((2 * repeat * u) % 1) * 2 - 1))))
    image = ramp(np.clip(t, 0, 1), colour, second)
    return shade(image, 0.86 + 0.2 * lift + 0.06 * slub + 0.05 * noise(rng, n, 1.7))


def carpet(rng: np.random.Generator, n: int, *, colour: Colour, second: Colour) -> np.ndarray:
    """Cut pile: tufts, trodden patches, flecks of a second yarn."""
    tufts = noise(rng, n, 0.1, low=n / 12)
    patches = noise(rng, n, 1.9)
    flecks = smooth(0.7, 1.3, noise(rng, n, 0.6, low=n / 16))
    image = blend(np.broadcast_to(np.asarray(colour, np.float32), (n, n, 3)), second, 0.6 * flecks)
    return shade(image, 1 + 0.11 * tufts + 0.07 * patches + 0.05 * noise(rng, n, 1.0, low=12))


def leather(rng: np.random.Generator, n: int, *, colour: Colour) -> np.ndarray:
    """Hide with creases and pores."""
    crease = np.abs(noise(rng, n, 1.1, low=24))
    image = shade(np.broadcast_to(np.asarray(colour, np.float32), (n, n, 3)), 0.82 + 0.2 * np.minimum(crease * 2, 1))
    return shade(image, 1 + 0.09 * noise(rng, n, 1.6) + 0.04 * noise(rng, n, 0.2, low=40))


def brushed(rng: np.random.Generator, n: int, *, colour: Colour) -> np.ndarray:
    """Brushed metal, strokes along u, with smudges."""
    strokes = noise(rng, n, 0.4, stretch=(40, 1), low=20)
    return shade(np.broadcast_to(np.asarray(colour, np.float32), (n, n, 3)), 1 + 0.09 * strokes + 0.05 * noise(rng, n, 1.6))


def lacquer(rng: np.random.Generator, n: int, *, colour: Colour, strength: float = 1.0) -> np.ndarray:
    """Painted wood: faint grain under the paint, brush marks, chips."""
    field = 0.05 * (grain(rng, n) - 0.5) * 2 + 0.025 * noise(rng, n, 1.5) + 0.02 * noise(rng, n, 0.3, low=30)
    chips = smooth(2.5, 3.0, noise(rng, n, 1.1, low=12))
    return shade(np.broadcast_to(np.asarray(colour, np.float32), (n, n, 3)), 1 + strength * field - 0.2 * chips)


def glaze(rng: np.random.Generator, n: int, *, colour: Colour, second: Colour, bands: int = 8) -> np.ndarray:
    """Ceramic: painted bands along v with a running edge, speckles."""
    _, v = coordinates(n)
    edge = 0.25 * noise(rng, n, 1.8, low=3)
    t = smooth(0.0, 0.25, np.sin(2 * np.pi * bands * v + edge * 3) - 0.15)
    image = ramp(t, colour, second)
    speckle = smooth(2.0, 2.5, noise(rng, n, 0.6, low=20))
    return shade(blend(image, np.asarray(second) * 0.4, 0.8 * speckle), 1 + 0.06 * noise(rng, n, 1.3))


def wicker(rng: np.random.Generator, n: int, *, dark: Colour, light: Colour, count: int = 24) -> np.ndarray:
    """Woven rods: over two, under two."""
    u, v = coordinates(n)
    row, col = np.floor(v * 2 * count).astype(int), np.floor(u * count).astype(int)
    fu, fv = (u * count + 0.5 * (row % 2)) % 1, (v * 2 * count) % 1
    height = np.sin(np.pi * fu) * np.sin(np.pi * fv)
    tone = rng.normal(0, 0.12, (2 * count, count))[row, col % count]
    return shade(ramp(np.clip(height + tone, 0, 1), np.asarray(dark) * 0.45, dark, light), 1 + 0.07 * noise(rng, n, 0.8, low=4))


def leaf(rng: np.random.Generator, n: int, *, dark: Colour, light: Colour) -> np.ndarray:
    """Leaf blade along v with midrib and side veins; fitted to 0..1."""
    u, v = coordinates(n)
    across = np.abs(u - 0.5) * 2
    veins = np.abs(np.sin(np.pi * 9 * (v + 0.35 * across)))
    t = 0.45 + 0.2 * noise(rng, n, 1.3) + 0.2 * across
    image = ramp(np.clip(t, 0, 1), dark, light)
    line = np.maximum(1 - smooth(0.03, 0.09, across), 0.7 * (1 - smooth(0.05, 0.2, veins)))
    return blend(image, np.asarray(light) * 1.15, 0.6 * line)


def earth(rng: np.random.Generator, n: int) -> np.ndarray:
    """Potting soil."""
    return ramp(np.clip(0.5 + 0.2 * noise(rng, n, 0.6, low=6) + 0.12 * noise(rng, n, 1.6), 0, 1), (0.1, 0.06, 0.04), (0.36, 0.25, 0.17))
