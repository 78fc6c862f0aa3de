"""Kitchen and bathroom fittings of a generated apartment, many of them concave.

Pieces stand with their back at y = 0 and their middle at x = 0, front towards +y, z up, metres.
"""

import math

import numpy as np

from active3d_pipe.sim import apartment_decor as decor
from active3d_pipe.sim.apartment_look import Look
from active3d_pipe.sim.apartment_mesh import Material, MeshBuilder
from active3d_pipe.sim.apartment_storage import front


def loft(
    b: MeshBuilder,
    material: Material,
    rings: list[tuple[float, float, float, float]],
    *,
    power: float = 4.0,
    segments: int = 32,
) -> None:
    """Skin over horizontal superellipses (half x, half y, z, shift in y) from below to above, or over a rim."""
    n = b.segments(segments, 12)
    a = np.linspace(0, 2 * math.pi, n + 1)
    c, s = np.cos(a), np.sin(a)
    x, y = np.sign(c) * np.abs(c) ** (2 / power), np.sign(s) * np.abs(s) ** (2 / power)
    points = np.stack([np.stack([x * rx, y * ry + dy, np.full(n + 1, z)], -1) for rx, ry, z, dy in rings], axis=1)
    b.grid(material, points)


def faucet(b: MeshBuilder, look: Look, height: float = 0.24, reach: float = 0.18) -> None:
    """Tap with an arched spout towards +y; foot at the origin."""
    metal = look.shared.metal
    b.revolve(metal, [(0, 0), (0.028, 0), (0.026, 0.03), (0.016, 0.05)], segments=12)
    t = np.linspace(0, math.pi, b.segments(9, 5))
    arc = np.stack([0 * t, reach / 2 * (1 - np.cos(t)), height + 0.07 * np.sin(t)], -1)
    b.tube(metal, [(0, 0, 0.02), (0, 0, height * 0.6), *arc, (0, reach, height - 0.04)], 0.012)
    for s in (-1, 1):
        b.tube(metal, [(0, 0, 0.05), (s * 0.06, 0, 0.06), (s * 0.08, 0, 0.1)], 0.008, segments=6)


def kitchen_counter(b: MeshBuilder, look: Look, rng: np.random.Generator, width: float) -> None:
    """Base cabinets with a worktop, a sink, an oven with a hob; wall cupboards, shelf and hood above."""
    depth, top = 0.6, 0.9
    body, steel = look.paint, look.shared.metal
    b.box(look.shared.black, (-width / 2, 0, 0), (width / 2, depth - 0.08, 0.1))
    b.box(body, (-width / 2, 0, 0.1), (width / 2, depth - 0.03, top - 0.04), skip=("+z",))
    count = max(3, round(width / 0.55))
    w = width / count
    sink, hob = (0, count - 1) if rng.random() < 0.5 else (count - 1, 0)
    for k in range(count):
        x = -width / 2 + k * w
        if k == hob:
            _oven(b, look, x, w, depth - 0.03, top)
        elif k == sink or k % 2:
            front(b, body, steel, (x, 0.11), (x + w, top - 0.05), depth - 0.03, knob="left")
        else:
            for z in (0.11, 0.37, 0.62):
                front(b, body, steel, (x, z), (x + w, z + 0.25), depth - 0.03)
    _worktop(b, look, width, depth, top, -width / 2 + (sink + 0.5) * w, min(0.5, w - 0.08))
    x_hob = -width / 2 + (hob + 0.5) * w
    with b.placed(x_hob, 0.3, top + 0.001):
        b.box(look.shared.black, (-w / 2 + 0.03, -0.24, 0), (w / 2 - 0.03, 0.24, 0.008))
        for px, py in ((-0.12, -0.11), (0.12, -0.11), (-0.12, 0.12), (0.12, 0.12)):
            with b.placed(px, py, 0.008):
                b.revolve(look.shared.iron, [(0.085, 0), (0.085, 0.012), (0.06, 0.012), (0.06, 0)], segments=20)
        with b.placed(-0.12, -0.11, 0.02):
            decor.vessel(b, steel, [(0.085, 0), (0.09, 0.02), (0.09, 0.13), (0.095, 0.135)], wall=0.004)
            b.tube(look.shared.black, [(0.09, 0, 0.11), (0.16, 0.02, 0.115), (0.24, 0.04, 0.12)], 0.01)
    for k in range(count):
        if k not in (sink, hob):
            with b.placed(
                -width / 2 + (k + 0.5) * w + float(rng.uniform(-0.1, 0.1)), float(rng.uniform(0.16, 0.3)), top
            ):
                _worktop_thing(b, look, rng)


def _oven(b: MeshBuilder, look: Look, x: float, w: float, y: float, top: float) -> None:
    b.box(look.shared.metal, (x + 0.005, y - 0.02, 0.11), (x + w - 0.005, y + 0.02, top - 0.045))
    b.box(look.shared.black, (x + 0.06, y + 0.02, 0.2), (x + w - 0.06, y + 0.026, 0.62))
    b.tube(
        look.shared.iron,
        [
            (x + 0.07, y + 0.02, 0.68),
            (x + 0.07, y + 0.06, 0.68),
            (x + w - 0.07, y + 0.06, 0.68),
            (x + w - 0.07, y + 0.02, 0.68),
        ],
        0.008,
    )
    for k in range(4):
        with b.placed(x + (k + 0.5) * w / 4, y + 0.02, 0.77, tilt=-math.pi / 2):
            b.revolve(look.shared.black, [(0.024, 0), (0.02, 0.025), (0, 0.025)], segments=12)


def _worktop(b: MeshBuilder, look: Look, width: float, depth: float, top: float, sink_x: float, sink_w: float) -> None:
    """Worktop of four slabs around the hole of the sink, the basin in it, tap and splashback."""
    stone, z0 = look.shared.marble, top - 0.04
    y0, y1, x0, x1 = 0.12, 0.5, sink_x - sink_w / 2, sink_x + sink_w / 2
    b.box(stone, (-width / 2, 0, z0), (x0, depth, top))
    b.box(stone, (x1, 0, z0), (width / 2, depth, top))
    b.box(stone, (x0, 0, z0), (x1, y0, top))
    b.box(stone, (x0, y1, z0), (x1, depth, top))
    with b.placed(sink_x, (y0 + y1) / 2, top):
        rx, ry = sink_w / 2, (y1 - y0) / 2
        loft(
            b,
            look.shared.metal,
            [
                (rx + 0.012, ry + 0.012, 0.001, 0),
                (rx + 0.012, ry + 0.012, 0.005, 0),
                (rx - 0.005, ry - 0.005, 0.004, 0),
                (rx - 0.02, ry - 0.02, -0.05, 0),
                (rx - 0.03, ry - 0.03, -0.15, 0),
                (rx - 0.07, ry - 0.07, -0.175, 0),
                (0.03, 0.03, -0.18, 0),
                (0, 0, -0.19, 0),
            ],
            power=7,
        )
    with b.placed(sink_x, 0.07, top):
        faucet(b, look)
    b.box(stone, (-width / 2, 0, top), (width / 2, 0.015, top + 0.1))


def _worktop_thing(b: MeshBuilder, look: Look, rng: np.random.Generator) -> None:
    kind = int(rng.integers(4))
    if kind == 0:
        decor.bowl(b, look, rng, 0.15)
    elif kind == 1:
        for k in range(4):
            with b.placed(0.1 * (k - 1.5), 0.03 * (k % 2)):
                decor.jar(b, look, rng)
    elif kind == 2:
        with b.placed(0, -0.12, 0):
            decor.carton(b, look, rng, 0.2, 0.08, 0.28)
        with b.placed(0.17, 0.02):
            decor.mug(b, look, rng)
    else:
        b.cushion(look.wood, (-0.2, -0.13, 0), (0.2, 0.13, 0.022), radius=0.01, steps=2)
        with b.placed(0.05, 0.0, 0.022):
            decor.bowl(b, look, rng, 0.08)


def wall_cupboards(b: MeshBuilder, look: Look, rng: np.random.Generator, width: float, *, bottom: float = 1.45) -> None:
    """Wall cupboards with an open bay of plates and jars."""
    depth, top = 0.33, 2.2
    count = max(2, round(width / 0.55))
    w, gap = width / count, int(rng.integers(count))
    for k in range(count):
        x = -width / 2 + k * w
        if k != gap:
            b.box(look.paint, (x, 0, bottom), (x + w, depth - 0.022, top))
            front(
                b,
                look.paint,
                look.shared.metal,
                (x, bottom),
                (x + w, top),
                depth - 0.022,
                knob="right" if k % 2 else "left",
            )
            continue
        for z in (bottom, (bottom + top) / 2, top - 0.02):
            b.box(look.wood, (x, 0, z), (x + w, depth - 0.03, z + 0.02))
        for z in (bottom + 0.02, (bottom + top) / 2 + 0.02):
            for px in np.arange(x + 0.08, x + w - 0.06, 0.12):
                with b.placed(float(px), 0.15, z):
                    (decor.jar if rng.random() < 0.6 else decor.mug)(b, look, rng)


def fridge(b: MeshBuilder, look: Look, rng: np.random.Generator) -> None:
    """Fridge 0.6 x 0.64 x 1.8 m with magnets."""
    steel = look.shared.metal if rng.random() < 0.5 else look.shared.ceramic
    b.cushion(steel, (-0.3, 0, 0.03), (0.3, 0.58, 1.8), radius=0.012, steps=2)
    for z0, z1 in ((0.05, 0.68), (0.695, 1.79)):
        b.cushion(steel, (-0.298, 0.57, z0), (0.298, 0.635, z1), radius=0.015, steps=2)
        b.tube(
            look.shared.iron,
            [(-0.24, 0.63, z1 - 0.42), (-0.24, 0.67, z1 - 0.42), (-0.24, 0.67, z1 - 0.08), (-0.24, 0.63, z1 - 0.08)],
            0.009,
        )
    for _ in range(5):
        x, z, s = float(rng.uniform(-0.12, 0.22)), float(rng.uniform(1.05, 1.6)), float(rng.uniform(0.04, 0.09))
        y = 0.637
        b.quad(
            look.shared.labels,
            [(x + s, y, z), (x, y, z), (x, y, z + s), (x + s, y, z + s)],
            decor.cell_uv(decor.LABELS, int(rng.integers(16))),
        )


def bathtub(b: MeshBuilder, look: Look, rng: np.random.Generator, width: float, depth: float) -> None:
    """Bathtub along the wall in a tiled apron, with tap and towel."""
    del rng
    x, y, h = width / 2, depth / 2, 0.58
    b.box(look.accent_wall, (-x, 0, 0), (x, depth, h - 0.03), skip=("+z",))
    with b.placed(0, y):
        white = look.shared.ceramic
        loft(b, white, [(x + 0.01, y + 0.005, h - 0.03, 0), (x + 0.01, y + 0.005, h, 0)], power=60, segments=48)
        rings = [
            (x + 0.01, y + 0.005, h, 60.0),
            (x - 0.06, y - 0.06, h + 0.004, 5.0),
            (x - 0.09, y - 0.09, h - 0.04, 4.0),
            (x - 0.15, y - 0.12, 0.25, 3.5),
            (x - 0.28, y - 0.18, 0.14, 3.0),
            (0.02, 0.02, 0.13, 2.0),
        ]
        n = b.segments(48, 16)
        a = np.linspace(0, 2 * math.pi, n + 1)
        c, s = np.cos(a), np.sin(a)
        points = np.stack(
            [
                np.stack(
                    [np.sign(c) * np.abs(c) ** (2 / p) * rx, np.sign(s) * np.abs(s) ** (2 / p) * ry, np.full(n + 1, z)],
                    -1,
                )
                for rx, ry, z, p in rings
            ],
            axis=1,
        )
        b.grid(white, points)
    with b.placed(-x + 0.16, 0.03, h):
        faucet(b, look, 0.14, 0.16)
    with b.placed(0.2 * width, depth, h + 0.01):
        decor.towel(b, look, look.fabric2, 0.4, 0.4)


def washstand(b: MeshBuilder, look: Look, rng: np.random.Generator, width: float) -> None:
    """Vanity with a basin, tap, bottles and a cabinet above."""
    depth, top = 0.46, 0.82
    b.box(look.paint, (-width / 2, 0, 0.25), (width / 2, depth - 0.03, top - 0.03))
    for s in (-1, 1):
        b.tube(
            look.shared.metal,
            [
                (s * (width / 2 - 0.05), 0.4, 0),
                (s * (width / 2 - 0.05), 0.4, 0.12),
                (s * (width / 2 - 0.05), 0.4, 0.25),
            ],
            0.015,
        )
        low, high = sorted((0.0, s * width / 2))
        front(
            b,
            look.paint,
            look.shared.metal,
            (low, 0.26),
            (high, top - 0.04),
            depth - 0.03,
            knob="right" if s < 0 else "left",
        )
    b.box(look.shared.marble, (-width / 2 - 0.01, 0, top - 0.03), (width / 2 + 0.01, depth, top))
    with b.placed(0, 0.25, top):
        loft(
            b,
            look.shared.ceramic,
            [
                (0.12, 0.1, 0, 0),
                (0.2, 0.15, 0.06, 0),
                (0.23, 0.18, 0.13, 0),
                (0.22, 0.17, 0.134, 0),
                (0.185, 0.135, 0.06, 0),
                (0.1, 0.08, 0.02, 0),
                (0, 0, 0.015, 0),
            ],
            power=2.4,
        )
    with b.placed(0, 0.04, top):
        faucet(b, look, 0.24, 0.16)
    for x in (-width / 2 + 0.06, width / 2 - 0.07):
        with b.placed(x, 0.12, top):
            decor.jar(b, look, rng)
    b.box(look.wood, (-width / 2, 0, 1.35), (width / 2, 0.13, 1.95))
    for k in (-1, 1):
        low, high = sorted((0.0, k * width / 2))
        front(b, look.wood, look.shared.metal, (low, 1.35), (high, 1.95), 0.13, knob="right" if k < 0 else "left")


def toilet(b: MeshBuilder, look: Look) -> None:
    """Toilet 0.38 x 0.68 m with cistern and an open bowl."""
    white = look.shared.ceramic
    b.cushion(white, (-0.19, 0, 0.36), (0.19, 0.17, 0.76), radius=0.025)
    b.cushion(white, (-0.2, -0.005, 0.76), (0.2, 0.18, 0.79), radius=0.012, steps=2)
    with b.placed(0, 0.42):
        loft(
            b,
            white,
            [
                (0.11, 0.2, 0, -0.05),
                (0.1, 0.17, 0.15, -0.06),
                (0.16, 0.22, 0.33, -0.01),
                (0.19, 0.25, 0.4, 0),
                (0.185, 0.245, 0.42, 0),
                (0.12, 0.17, 0.42, 0.02),
                (0.11, 0.15, 0.38, 0.02),
                (0.06, 0.08, 0.25, 0),
                (0, 0, 0.23, 0),
            ],
            power=2.3,
        )
    with b.placed(0, 0.17, 0.42, tilt=0.12):
        b.cushion(look.wood, (-0.17, 0, 0), (0.17, 0.022, 0.4), radius=0.01, steps=2)


def towel_rail(b: MeshBuilder, look: Look, width: float) -> None:
    """Heated rail on the wall with towels."""
    metal = look.shared.metal
    for s in (-1, 1):
        b.tube(metal, [(s * width / 2, 0.06, 0.7), (s * width / 2, 0.06, 1.1), (s * width / 2, 0.06, 1.7)], 0.014)
        for z in (0.75, 1.65):
            b.tube(metal, [(s * width / 2, 0, z), (s * width / 2, 0.06, z)], 0.01)
    for z in np.linspace(0.75, 1.65, 9):
        b.tube(metal, [(-width / 2, 0.06, z), (0, 0.06, z), (width / 2, 0.06, z)], 0.009)
    for z, material in ((1.65, look.fabric2), (1.09, look.fabric3)):
        with b.placed(0, 0.06, z):
            decor.towel(b, look, material, 0.7 * width, 0.42)
