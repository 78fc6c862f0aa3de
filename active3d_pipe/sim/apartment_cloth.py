"""Procedural wallpaper, cloth, leather, wicker and leaves; painters (rng, n) as in `apartment_textures`."""

import numpy as np

from active3d_pipe.sim.apartment_noise import Colour, blend, coordinates, noise, ramp, shade, smooth


def wallpaper(
    rng: np.random.Generator,
    n: int,
    *,
    ground: Colour,
    figure: Colour,
    accent: Colour,
    pattern: str = "damask",
    repeat: int = 5,
) -> np.ndarray:
    """Printed paper on a fine relief; pattern "damask", "stripes", "floral", "lattice" or "leaves"."""
    u, v = coordinates(n)
    m = n // repeat + 1
    if pattern == "stripes":
        wave = np.sin(2 * np.pi * u * 2 * repeat)
        ink, second = (
            smooth(0.1, 0.25, wave),
            smooth(0.02, 0.06, 0.12 - np.abs(np.sin(2 * np.pi * (u * 2 * repeat + 0.25)))),
        )
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
    rng: np.random.Generator,
    n: int,
    *,
    colour: Colour,
    second: Colour,
    pattern: str = "plain",
    threads: int = 96,
    repeat: int = 6,
) -> np.ndarray:
    """Cloth: threads over and under, slubs, wear; pattern "plain", "stripes", "plaid", "dots", "zigzag"."""
    u, v = coordinates(n)
    warp_thread, weft = np.sin(2 * np.pi * threads / 2 * u), np.sin(2 * np.pi * threads / 2 * v)
    over = 0.5 + 0.5 * np.sign(warp_thread * weft)
    lift = np.where(over > 0.5, np.abs(warp_thread), np.abs(weft))
    slub = 0.6 * noise(rng, n, 0.5, stretch=(12, 1), low=10) + 0.6 * noise(rng, n, 0.5, stretch=(1, 12), low=10)
    t: np.ndarray = np.zeros((n, n), dtype=np.float32)
    if pattern == "stripes":
        t = smooth(0.2, 0.35, np.sin(2 * np.pi * repeat * v)) + 0.6 * smooth(
            0.9, 0.95, np.sin(2 * np.pi * repeat * v + 3.6)
        )
    elif pattern == "plaid":
        bands = [
            smooth(0.3, 0.4, np.sin(phase)) + 0.8 * smooth(0.94, 0.97, np.sin(phase + 3.3))
            for phase in (2 * np.pi * repeat * u, 2 * np.pi * repeat * v)
        ]
        t = 0.5 * (bands[0] + bands[1])
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


def wicker(rng: np.random.Generator, n: int, *, dark: Colour, light: Colour, count: int = 24) -> np.ndarray:
    """Woven rods: over two, under two."""
    u, v = coordinates(n)
    row, col = np.floor(v * 2 * count).astype(int), np.floor(u * count).astype(int)
    fu, fv = (u * count + 0.5 * (row % 2)) % 1, (v * 2 * count) % 1
    height = np.sin(np.pi * fu) * np.sin(np.pi * fv)
    tone = rng.normal(0, 0.12, (2 * count, count))[row, col % count]
    return shade(
        ramp(np.clip(height + tone, 0, 1), np.asarray(dark) * 0.45, dark, light), 1 + 0.07 * noise(rng, n, 0.8, low=4)
    )


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
    return ramp(
        np.clip(0.5 + 0.2 * noise(rng, n, 0.6, low=6) + 0.12 * noise(rng, n, 1.6), 0, 1),
        (0.1, 0.06, 0.04),
        (0.36, 0.25, 0.17),
    )
