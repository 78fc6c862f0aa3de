"""Procedural, seamless textures with detail at all scales.

Every painter takes (rng, n) and returns an (n, n, 3) float32 image of display values in 0..1 that tiles in both
directions. Grain and weave run along u (columns).
"""

from collections.abc import Sequence

import numpy as np

from active3d_pipe.sim.apartment_noise import Colour, blend, coordinates, noise, ramp, shade, smooth, warp


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
    rng: np.random.Generator,
    n: int,
    *,
    dark: Colour,
    light: Colour,
    rows: int = 18,
    per_row: int = 2,
    contrast: float = 1.0,
) -> np.ndarray:
    """Floor boards along u: every board shows another piece of the log, another tone, dark joints and wear."""
    u, v = coordinates(n)
    row = np.floor(v * rows).astype(int)
    offset = rng.random(rows).astype(np.float32)[row]
    col = np.floor((u + offset) * per_row).astype(int) % per_row
    log = grain(rng, n)
    ju, jv = (
        _cells(row, col, rng.integers(0, n, (rows, per_row))),
        _cells(row, col, rng.integers(0, n, (rows, per_row))),
    )
    t = warp(log, ju, jv * (1 + 0 * ju)) + _cells(row, col, rng.normal(0, 0.16 * contrast, (rows, per_row)))
    image = ramp(np.clip(t, 0, 1), dark, light)
    image = shade(
        image, 1 + _cells(row, col, rng.normal(0, 0.07 * contrast, (rows, per_row))) + 0.03 * noise(rng, n, 1.5)
    )
    fv = np.abs((v * rows) % 1 - 0.5) * 2
    fu = np.abs(((u + offset) * per_row) % 1 - 0.5) * 2
    pixel_v, pixel_u = 2 * rows / n, 2 * per_row / n
    joint = np.maximum(
        smooth(1 - 2.2 * pixel_v, 1 - 0.6 * pixel_v, fv), smooth(1 - 2.2 * pixel_u, 1 - 0.6 * pixel_u, fu)
    )
    return blend(image, np.asarray(dark) * 0.35, 0.8 * joint)


def parquet(
    rng: np.random.Generator, n: int, *, dark: Colour, light: Colour, blocks: int = 8, strips: int = 5
) -> np.ndarray:
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
    edge = np.maximum(
        np.abs(across % 1 - 0.5) * 2, 1 - (1 - np.maximum(np.abs(fu - 0.5), np.abs(fv - 0.5)) * 2) * strips
    )
    pixel = 2 * blocks * strips / n
    return blend(image, np.asarray(dark) * 0.4, 0.75 * smooth(1 - 2 * pixel, 1 - 0.4 * pixel, edge))


def marble(rng: np.random.Generator, n: int, *, base: Colour, vein: Colour, scale: float = 2.0) -> np.ndarray:
    """Stone with warped veins at several widths."""
    a, b = noise(rng, n, 1.9, low=scale), noise(rng, n, 1.5, low=scale * 2)
    thick = np.exp(-(((a + 0.5 * b) * 9) ** 2) / 4)
    thin = np.exp(-(((b - 0.4 * a) * 14) ** 2) / 4)
    cloud = noise(rng, n, 1.2, low=scale)
    image = shade(
        np.broadcast_to(np.asarray(base, np.float32), (n, n, 3)), 1 + 0.05 * cloud + 0.02 * noise(rng, n, 0.3, low=20)
    )
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
    rng: np.random.Generator,
    n: int,
    *,
    face: Colour,
    other: Colour,
    grout: Colour,
    count: int = 8,
    layout: str = "square",
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
    vein = np.exp(
        -(((warp(noise(rng, n, 1.6, low=3), 0 * row, _cells(row, col, rng.integers(0, n, (rows, cols))))) * 8) ** 2)
    )
    t = _cells(row, col, pick) + 0.10 * cloud
    image = shade(
        ramp(np.clip(t, 0, 1), face, other), 1 + 0.03 * cloud - 0.16 * veins * vein + 0.02 * noise(rng, n, 0.3, low=30)
    )
    fu, fv = np.abs((uu * cols) % 1 - 0.5), np.abs((v * rows) % 1 - 0.5)
    width = 1.6
    line = np.maximum(
        smooth(0.5 - width * cols / n, 0.5 - 0.5 * width * cols / n, fu),
        smooth(0.5 - width * rows / n, 0.5 - 0.5 * width * rows / n, fv),
    )
    dirt = np.clip(1 + 0.12 * noise(rng, n, 0.9, low=4), 0.6, 1.3)
    return (
        image * (1 - line[..., None])
        + shade(np.broadcast_to(np.asarray(grout, np.float32), (n, n, 3)), dirt) * line[..., None]
    )


def plaster(rng: np.random.Generator, n: int, *, colour: Colour, strength: float = 1.0) -> np.ndarray:
    """Painted plaster: clouds, roller strokes and fine grain."""
    strokes = noise(rng, n, 1.0, stretch=(1, 5), low=5)
    field = (
        0.028 * noise(rng, n, 1.7)
        + 0.022 * strokes
        + 0.022 * noise(rng, n, 0.35, low=30)
        + 0.02 * noise(rng, n, 1.0, low=10)
    )
    image = shade(np.broadcast_to(np.asarray(colour, np.float32), (n, n, 3)), 1 + strength * field)
    pits = smooth(2.3, 2.9, noise(rng, n, 0.7, low=24))
    return shade(image, 1 - 0.13 * strength * pits)


def brushed(rng: np.random.Generator, n: int, *, colour: Colour) -> np.ndarray:
    """Brushed metal, strokes along u, with smudges."""
    strokes = noise(rng, n, 0.4, stretch=(40, 1), low=20)
    return shade(
        np.broadcast_to(np.asarray(colour, np.float32), (n, n, 3)), 1 + 0.09 * strokes + 0.05 * noise(rng, n, 1.6)
    )


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
