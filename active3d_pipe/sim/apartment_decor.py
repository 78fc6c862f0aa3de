"""Small things and thin things of a generated apartment: books, lamps, vessels, plants, pictures, curtains, radiators.

Pieces stand with their back at y = 0 and their middle at x = 0, front towards +y, z up, metres; round ones have their
axis at the origin.
"""

import math

import numpy as np

from active3d_pipe.sim.apartment_artwork import LABELS, PAINTINGS, SPINES, cell_uv
from active3d_pipe.sim.apartment_look import Look
from active3d_pipe.sim.apartment_mesh import Material, MeshBuilder


def pick(rng: np.random.Generator, items: tuple) -> Material:
    """One of several materials."""
    return items[int(rng.integers(len(items)))]


def vessel(
    b: MeshBuilder, material: Material, outer: list[tuple[float, float]], *, wall: float = 0.006, segments: int = 24
) -> None:
    """A hollow body of revolution: outer profile (radius, z) from the foot to the rim, then down inside."""
    inner = [(max(r - wall, 0.0), max(z, outer[0][1] + wall)) for r, z in outer[::-1]]
    inner[0] = (max(outer[-1][0] - wall, 0.0), outer[-1][1])
    b.revolve(material, [(0.0, outer[0][1]), *outer, *inner, (0.0, outer[0][1] + wall)], segments=segments)


def vase(b: MeshBuilder, look: Look, rng: np.random.Generator, height: float = 0.25) -> None:
    """A vase with a belly and a neck."""
    belly, neck, at = rng.uniform(0.22, 0.36), rng.uniform(0.1, 0.17), rng.uniform(0.3, 0.5)
    t = np.linspace(0, 1, b.segments(14, 6))
    radius = neck + (belly - neck) * np.exp(-(((t - at) / 0.3) ** 2)) + 0.05 * np.clip(t - 0.85, 0, 1) * 4
    vessel(b, pick(rng, look.shared.vases), [(float(r * height), float(z * height)) for r, z in zip(radius, t)])


def bowl(b: MeshBuilder, look: Look, rng: np.random.Generator, radius: float = 0.13) -> None:
    """An open bowl, half of the time with fruit."""
    t = np.linspace(0.25, 1, b.segments(8, 4))
    vessel(
        b,
        pick(rng, look.shared.vases),
        [(float(radius * math.sin(x * 1.45)), float(radius * 0.55 * (x - 0.25) ** 1.6)) for x in t],
    )
    for _ in range(int(rng.integers(0, 5)) if b.detail > 0.5 else 0):
        angle, away = rng.uniform(0, 2 * math.pi), rng.uniform(0.3, 0.5) * radius
        with b.placed(away * math.cos(angle), away * math.sin(angle), 0.3 * radius):
            ball(b, pick(rng, look.shared.vases), 0.3 * radius)


def ball(b: MeshBuilder, material: Material, radius: float) -> None:
    """A sphere about the origin."""
    a = np.linspace(-math.pi / 2, math.pi / 2, b.segments(9, 5))
    b.revolve(material, [(float(radius * math.cos(x)), float(radius * math.sin(x))) for x in a], segments=14)


def basket(b: MeshBuilder, look: Look, rng: np.random.Generator, radius: float = 0.2, height: float = 0.35) -> None:
    """A wicker basket, open above."""
    del rng
    vessel(
        b,
        look.shared.wicker,
        [(radius * 0.78, 0.0), (radius * 0.9, height * 0.4), (radius, height * 0.95), (radius * 1.04, height)],
        wall=0.015,
    )


def mug(b: MeshBuilder, look: Look, rng: np.random.Generator) -> None:
    """A mug with a handle."""
    material = pick(rng, look.shared.vases)
    vessel(b, material, [(0.035, 0.0), (0.04, 0.05), (0.041, 0.095)], wall=0.004, segments=16)
    a = np.linspace(-1.4, 1.4, 7)
    b.tube(material, np.stack([0.038 + 0.028 * np.cos(a), 0 * a, 0.048 + 0.03 * np.sin(a)], -1), 0.005, segments=6)


def book(b: MeshBuilder, look: Look, index: int, width: float, depth: float, height: float) -> None:
    """An upright book: back of the spine at y = depth, block of pages recessed above."""
    cell = cell_uv(SPINES, index)
    plain = cell.mean(axis=0) + (cell - cell.mean(axis=0)) * [0.5, 1.0]
    spines, x, d, h = look.shared.spines, width / 2, depth, height
    b.quad(spines, [(x, d, 0), (-x, d, 0), (-x, d, h), (x, d, h)], cell)
    b.quad(spines, [(-x, d, 0), (-x, 0, 0), (-x, 0, h), (-x, d, h)], plain)
    b.quad(spines, [(x, 0, 0), (x, d, 0), (x, d, h), (x, 0, h)], plain)
    b.quad(look.shared.paper, [(-x, 0, h - 0.004), (x, 0, h - 0.004), (x, d, h - 0.004), (-x, d, h - 0.004)])
    b.quad(look.shared.paper, [(-x, 0.003, 0), (x, 0.003, 0), (x, 0.003, h), (-x, 0.003, h)])


def book_row(
    b: MeshBuilder, look: Look, rng: np.random.Generator, start: float, stop: float, depth: float, height: float
) -> None:
    """Upright books from x = start to stop on z = 0, the last ones leaning; spines at about y = depth."""
    x = start
    while True:
        width = float(rng.uniform(0.016, 0.05)) / min(b.detail, 1.0) ** 0.5
        tall = float(np.clip(rng.normal(0.8, 0.1), 0.55, 0.97)) * height
        lean = float(rng.uniform(0.08, 0.2)) if rng.random() < 0.07 else 0.0
        if x + width + tall * math.sin(lean) > stop:
            return
        with b.placed(x + width / 2, 0.0, 0.0, roll=lean):
            book(b, look, int(rng.integers(SPINES[0] * SPINES[1])), width, depth * float(rng.uniform(0.75, 1.0)), tall)
        x += width + tall * math.sin(lean) + 0.001


def book_stack(b: MeshBuilder, look: Look, rng: np.random.Generator, count: int = 4) -> None:
    """Books lying on each other."""
    z = 0.0
    for _ in range(count):
        thick, length, wide = (float(x) for x in rng.uniform((0.015, 0.2, 0.14), (0.04, 0.27, 0.2)))
        with b.placed(float(rng.normal(0, 0.008)), 0.0, z, yaw=float(rng.normal(0, 0.12))):
            cell = cell_uv(LABELS, int(rng.integers(LABELS[0] * LABELS[1])))
            x, y = length / 2, wide / 2
            b.box(look.shared.paper, (-x + 0.004, -y + 0.004, 0.002), (x - 0.004, y - 0.004, thick - 0.002))
            b.quad(look.shared.labels, [(-x, -y, thick), (x, -y, thick), (x, y, thick), (-x, y, thick)], cell)
            b.quad(look.shared.labels, [(-x, -y, 0.001), (x, -y, 0.001), (x, y, 0.001), (-x, y, 0.001)], cell)
            spine = np.roll(cell_uv(SPINES, int(rng.integers(96))), 1, axis=0)
            b.quad(look.shared.spines, [(-x, y, 0.001), (x, y, 0.001), (x, y, thick), (-x, y, thick)], spine)
        z += thick


def carton(b: MeshBuilder, look: Look, rng: np.random.Generator, width: float, depth: float, height: float) -> None:
    """A printed box."""
    x, uv = width / 2, cell_uv(LABELS, int(rng.integers(LABELS[0] * LABELS[1])))
    for p, q in (((-x, 0), (x, 0)), ((x, 0), (x, depth)), ((x, depth), (-x, depth)), ((-x, depth), (-x, 0))):
        b.quad(look.shared.labels, [(*p, 0), (*q, 0), (*q, height), (*p, height)], uv)
    b.quad(look.shared.labels, [(-x, 0, height), (x, 0, height), (x, depth, height), (-x, depth, height)], uv)


def jar(b: MeshBuilder, look: Look, rng: np.random.Generator) -> None:
    """A bottle or a jar with a lid."""
    h, r = float(rng.uniform(0.12, 0.28)), float(rng.uniform(0.03, 0.045))
    body = pick(rng, look.shared.vases)
    if rng.random() < 0.5:
        b.revolve(body, [(0, 0), (r, 0), (r, 0.6 * h), (0.35 * r, 0.78 * h), (0.35 * r, h), (0, h)], segments=14)
    else:
        b.revolve(body, [(0, 0), (r, 0), (r, 0.7 * h), (0.85 * r, 0.75 * h)], segments=14)
        b.revolve(look.wood, [(0.9 * r, 0.74 * h), (0.9 * r, 0.85 * h), (0, 0.85 * h)], segments=14)


def lamp(b: MeshBuilder, look: Look, rng: np.random.Generator, height: float = 1.55) -> None:
    """Floor or table lamp: foot, thin stand, shade open above and below, bulb."""
    top = height
    tall = 0.22 * height**0.5
    wide, narrow = 0.17 * height**0.4, float(rng.uniform(0.09, 0.15)) * height**0.4
    foot = 0.14 * height**0.5
    if height > 1:
        b.revolve(look.shared.iron, [(0, 0), (foot, 0), (foot, 0.015), (0.03, 0.03), (0, 0.03)])
        b.tube(look.shared.iron, [(0, 0, 0.02), (0, 0, height / 2), (0, 0, top - tall * 0.5)], 0.011)
    else:
        with b.placed():
            vase(b, look, rng, top - tall)
        b.tube(look.shared.iron, [(0, 0, 0.6 * (top - tall)), (0, 0, top - tall * 0.5)], 0.008)
    low = top - tall
    b.revolve(
        look.shade, [(wide, low), (narrow, top), (narrow - 0.004, top), (wide - 0.004, low), (wide, low)], segments=32
    )
    with b.placed(0, 0, top - tall * 0.5):
        ball(b, look.shared.ceramic, 0.035)
    for k in range(3):
        a = 2 * math.pi * k / 3
        b.tube(
            look.shared.iron,
            [(0, 0, top - 0.03), (narrow * math.cos(a), narrow * math.sin(a), top - 0.01)],
            0.003,
            segments=5,
        )


def pendant(b: MeshBuilder, look: Look, rng: np.random.Generator, ceiling: float, bottom: float) -> None:
    """Ceiling lamp on a cord, shade open below."""
    radius, height = float(rng.uniform(0.18, 0.28)), float(rng.uniform(0.16, 0.26))
    material = look.shade if rng.random() < 0.5 else look.paint
    b.revolve(look.shared.iron, [(0, ceiling - 0.03), (0.05, ceiling - 0.03), (0.055, ceiling)], segments=16)
    b.tube(look.shared.iron, [(0, 0, ceiling), (0, 0, bottom + height)], 0.006, segments=6)
    t = np.linspace(0, 1, b.segments(8, 4))
    outer = [(float(radius * (1 - x**2.2) + 0.03), float(bottom + x * height)) for x in t]
    b.revolve(material, [*outer, *[(max(r - 0.006, 0), z - 0.004) for r, z in outer[::-1]]], segments=32)
    with b.placed(0, 0, bottom + 0.45 * height):
        ball(b, look.shared.ceramic, 0.05)


def plant(b: MeshBuilder, look: Look, rng: np.random.Generator, height: float = 1.1) -> None:
    """Potted plant: vessel, soil, arching stems with thin folded leaves."""
    pot = 0.26 * height
    r = 0.16 * height**0.6 if height < 0.6 else 0.17
    material = look.shared.wicker if rng.random() < 0.3 else pick(rng, look.shared.vases)
    vessel(
        b,
        material,
        [(0.7 * r, 0), (0.85 * r, 0.5 * pot), (r, 0.92 * pot), (1.06 * r, 0.93 * pot), (1.06 * r, pot)],
        wall=0.012,
    )
    b.revolve(look.shared.soil, [(0.97 * r, 0.88 * pot), (0, 0.9 * pot)], segments=16)
    leaf_material = look.shared.leaf if rng.random() < 0.6 else look.shared.leaf2
    palm = rng.random() < 0.4
    count = max(5, int((26 if height > 0.6 else 16) * b.detail**0.5))
    for k in range(count):
        turn = 2.4 * k + float(rng.normal(0, 0.2))
        rise = float(rng.uniform(0.35, 1.0)) * (height - pot)
        reach = float(rng.uniform(0.10, 0.20)) * height**0.7
        with b.placed(0, 0, 0.88 * pot, yaw=turn):
            if palm:
                _blade(b, leaf_material, (0.01, 0.0), (reach * 1.6, rise), width=0.035 + 0.02 * height, length=1.0)
            else:
                b.tube(
                    leaf_material,
                    [(0.01, 0, 0), (0.35 * reach, 0, 0.6 * rise), (0.75 * reach, 0, 0.92 * rise)],
                    0.004,
                    segments=5,
                )
                _blade(
                    b,
                    leaf_material,
                    (0.75 * reach, 0.92 * rise),
                    (0.75 * reach + 0.2 * height**0.6, 0.92 * rise),
                    width=float(rng.uniform(0.05, 0.09)) * height**0.5,
                    length=0.5,
                )


def _blade(
    b: MeshBuilder,
    material: Material,
    start: tuple[float, float],
    end: tuple[float, float],
    *,
    width: float,
    length: float,
) -> None:
    """One leaf in the x-z plane from start to end, arched, folded along its midrib."""
    n = b.segments(7, 4)
    t = np.linspace(0, 1, n)
    x = start[0] + (end[0] - start[0]) * t ** (1.0 if length < 1 else 1.5)
    z = (
        start[1]
        + (end[1] - start[1]) * np.sin(t * math.pi / 2)
        + (0.10 * np.sin(t * 3.3) - 0.12 * t * t) * (0.6 if length < 1 else 2) * 0.5
    )
    half = width * np.sqrt(np.clip(np.sin(math.pi * (0.04 + 0.94 * t)), 0, 1))
    points = np.stack([np.stack([x, s * half, z + 0.35 * abs(s) * half], -1) for s in (-1, 0, 1)])
    uv = np.stack([np.stack([np.full(n, u), t], -1) for u in (0.02, 0.5, 0.98)])
    b.grid(material, points, uv)


def picture(b: MeshBuilder, look: Look, rng: np.random.Generator, index: int, width: float, height: float) -> None:
    """Framed painting on the wall plane y = 0, centred at the origin."""
    frame, depth = float(rng.uniform(0.02, 0.045)), float(rng.uniform(0.018, 0.032))
    material = look.wood2 if rng.random() < 0.6 else look.shared.iron
    x, z = width / 2, height / 2
    b.box(material, (-x, 0, z - frame), (x, depth, z))
    b.box(material, (-x, 0, -z), (x, depth, -z + frame))
    b.box(material, (-x, 0, -z + frame), (-x + frame, depth, z - frame))
    b.box(material, (x - frame, 0, -z + frame), (x, depth, z - frame))
    x, z, y = x - frame, z - frame, 0.4 * depth
    b.quad(look.shared.paper, [(x, y, -z), (-x, y, -z), (-x, y, z), (x, y, z)])
    border = 0.0 if rng.random() < 0.4 else 0.12 * min(width, height)
    x, z, y = x - border, z - border, y + 0.002
    b.quad(
        look.shared.paintings, [(x, y, -z), (-x, y, -z), (-x, y, z), (x, y, z)], cell_uv(PAINTINGS, index, margin=0.02)
    )


def curtain(b: MeshBuilder, look: Look, rng: np.random.Generator, width: float, height: float) -> None:
    """A wavy curtain hanging from z = height to just above z = 0, in front of y = 0.05."""
    folds = max(3, round(width / 0.085))
    n, m = folds * b.segments(8, 4) + 1, b.segments(6, 2)
    s, t = np.linspace(0, 1, n), np.linspace(0, 1, m)
    phase = 2 * math.pi * folds * s + 0.5 * np.sin(9 * s + float(rng.uniform(0, 6)))
    depth = 0.055 + (0.018 + 0.02 * (1 - t[None])) * np.sin(phase)[:, None]
    spread = 1 + 0.10 * (1 - t[None]) * 0.5
    x = (s[:, None] - 0.5) * width * spread
    z = np.broadcast_to(0.03 + t[None] * (height - 0.03), (n, m))
    points = np.stack([np.broadcast_to(x, (n, m)), depth, z], -1)
    b.grid(look.curtain, points)


def curtain_rod(b: MeshBuilder, look: Look, width: float, z: float) -> None:
    """Rod with knobs and brackets."""
    x = width / 2
    b.tube(look.shared.iron, [(-x, 0.055, z), (0, 0.055, z), (x, 0.055, z)], 0.012)
    for s in (-1, 1):
        with b.placed(s * x, 0.055, z):
            ball(b, look.shared.iron, 0.024)
        b.tube(look.shared.iron, [(s * 0.9 * x, 0, z - 0.01), (s * 0.9 * x, 0.055, z)], 0.008, segments=6)


def radiator(b: MeshBuilder, look: Look, width: float, height: float) -> None:
    """Column radiator: thin fins, pipes, valve; stands off the wall."""
    fins = max(4, round(width / (0.05 / min(b.detail, 1.0) ** 0.5)))
    step = width / fins
    for k in range(fins):
        x = -width / 2 + (k + 0.5) * step
        b.box(look.shared.trim, (x - 0.3 * step, 0.03, 0.12), (x + 0.3 * step, 0.11, height))
    for z in (0.16, height - 0.06):
        b.tube(look.shared.trim, [(-width / 2 - 0.02, 0.07, z), (0, 0.07, z), (width / 2 + 0.02, 0.07, z)], 0.016)
    x = width / 2 + 0.05
    b.tube(look.shared.metal, [(width / 2, 0.07, 0.16), (x, 0.07, 0.16), (x, 0.07, 0.08), (x, 0.07, 0.0)], 0.009)
    with b.placed(x, 0.07, 0.16):
        ball(b, look.shared.ceramic, 0.028)


def towel(b: MeshBuilder, look: Look, material: Material, width: float, length: float) -> None:
    """A towel over a rod at the origin along x: hangs down on both sides."""
    del look
    t = np.linspace(-1, 1, b.segments(18, 8))
    s = np.linspace(-0.5, 0.5, b.segments(12, 5))
    over = np.clip(np.abs(t) - 0.12, 0, 1)
    y = np.sign(t) * (0.012 + 0.012 * over) * np.clip(np.abs(t) / 0.12, 0, 1)
    z = 0.016 - over * np.where(t > 0, length, 0.7 * length)
    wave = 0.006 * np.sin(14 * s)[:, None] * over[None] * np.sign(t)[None]
    points = np.stack(
        [
            np.broadcast_to(s[:, None] * width, (len(s), len(t))),
            y[None] + wave,
            np.broadcast_to(z[None], (len(s), len(t))),
        ],
        -1,
    )
    b.grid(material, points)


def ornament(b: MeshBuilder, look: Look, rng: np.random.Generator, room: float = 0.28) -> None:
    """Something for a shelf board of depth ~0.2 m and free height `room`."""
    kind = int(rng.integers(6))
    if kind == 0:
        vase(b, look, rng, float(rng.uniform(0.55, 0.9)) * room)
    elif kind == 1:
        bowl(b, look, rng, 0.09)
    elif kind == 2:
        book_stack(b, look, rng, int(rng.integers(2, 5)))
    elif kind == 3:
        with b.placed(0, -0.07):
            carton(b, look, rng, 0.16, 0.14, 0.55 * room)
    elif kind == 4:
        plant(b, look, rng, 0.95 * room)
    else:
        b.revolve(look.wood2, [(0, 0), (0.05, 0), (0.045, 0.02), (0.012, 0.03), (0.012, 0.06)], segments=16)
        with b.placed(0, 0, 0.06 + 0.3 * room):
            ball(b, pick(rng, look.shared.vases), 0.3 * room)
