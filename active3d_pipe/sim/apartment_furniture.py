"""Furniture of a generated apartment: seats, tables, beds, storage.

Pieces stand with their back at y = 0 and their middle at x = 0, front towards +y, z up, metres. `width` is along x,
`depth` along y.
"""

import math

import numpy as np

from active3d_pipe.sim import apartment_decor as decor
from active3d_pipe.sim.apartment_look import Look
from active3d_pipe.sim.apartment_mesh import Material, MeshBuilder
from active3d_pipe.sim.apartment_storage import drawers, front, legs


def sofa(b: MeshBuilder, look: Look, rng: np.random.Generator, width: float, depth: float, seats: int) -> None:
    """Sofa or armchair with loose cushions."""
    arm, seat, back = 0.16, 0.42, float(rng.uniform(0.78, 0.88))
    legs(b, look.wood, width, depth, 0.12, thick=0.05, inset=0.07)
    b.cushion(look.fabric, (-width / 2, 0, 0.1), (width / 2, depth - 0.02, 0.3), radius=0.03)
    b.cushion(look.fabric, (-width / 2, 0, 0.28), (width / 2, 0.2, back), radius=0.06)
    for s in (-1, 1):
        low, high = sorted((s * width / 2, s * (width / 2 - arm)))
        b.cushion(look.fabric, (low, 0.02, 0.28), (high, depth - 0.02, 0.6), radius=0.06)
    each = (width - 2 * arm) / seats
    for k in range(seats):
        x = -width / 2 + arm + k * each
        with b.placed():
            b.cushion(
                look.fabric, (x + 0.005, 0.18, 0.29), (x + each - 0.005, depth, seat + 0.03), radius=0.05, bulge=0.02
            )
        with b.placed(x + each / 2, 0.19, seat + 0.02, tilt=-0.2):
            b.cushion(
                look.fabric, (-each / 2 + 0.01, 0, 0), (each / 2 - 0.01, 0.15, back - seat), radius=0.06, bulge=0.025
            )
    for k in range(max(1, seats)):
        x = float(rng.uniform(-0.5, 0.5)) * (width - 2 * arm - 0.35)
        with b.placed(x, 0.42, seat + 0.05, yaw=float(rng.normal(0, 0.25)), tilt=-0.45):
            b.cushion((look.fabric2, look.fabric3)[k % 2], (-0.2, -0.03, 0), (0.2, 0.04, 0.38), radius=0.03, bulge=0.05)
    if seats > 1 and rng.random() < 0.6:
        _throw(b, look.fabric3, -width / 2 - 0.012, -width / 2 + arm + 0.012, depth, rng)


def _throw(b: MeshBuilder, material: Material, x0: float, x1: float, depth: float, rng: np.random.Generator) -> None:
    """A blanket over a sofa's arm."""
    n = b.segments(10, 6)
    y = np.linspace(0.35, min(depth - 0.1, 0.8), n)
    path = np.array(
        [(x0, 0.2), (x0, 0.45), (x0 - 0.002, 0.6), (x0 + 0.03, 0.625), (x1 - 0.03, 0.625), (x1, 0.6), (x1, 0.47)]
    )
    wave = (
        0.012
        * np.sin(np.linspace(0, 9, n) + float(rng.uniform(0, 6)))[:, None]
        * np.array([1, 0.6, 0.1, 0, 0, 0.1, 0.3])[None]
    )
    points = np.stack(
        [path[None, :, 0] - np.abs(wave), np.broadcast_to(y[:, None], (n, 7)), path[None, :, 1] + 0.3 * np.abs(wave)],
        -1,
    )
    b.grid(material, points)


def chair(b: MeshBuilder, look: Look, rng: np.random.Generator, style: int) -> None:
    """Dining chair 0.44 x 0.46 m, back at y = 0; style 0 slats, 1 upholstered, 2 rungs."""
    del rng
    wood, w, d, seat = look.wood, 0.44, 0.46, 0.45
    for s in (-1, 1):
        x = s * (w / 2 - 0.025)
        b.tube(wood, [(x, d - 0.03, 0), (x * 0.98, d - 0.035, seat / 2), (x * 0.96, d - 0.04, seat)], 0.017)
        b.tube(wood, [(x, 0.0, 0), (x, 0.03, seat), (x, 0.015, 0.7), (x, -0.02, 0.92)], 0.017)
        b.tube(wood, [(x, 0.025, 0.2), (x, d / 2, 0.2), (x, d - 0.035, 0.2)], 0.009, segments=6)
    if style == 1:
        b.cushion(look.fabric2, (-w / 2, 0.02, seat - 0.02), (w / 2, d, seat + 0.05), radius=0.025, bulge=0.012)
        b.cushion(look.fabric2, (-w / 2 + 0.03, -0.02, 0.55), (w / 2 - 0.03, 0.03, 0.93), radius=0.02, bulge=0.008)
        return
    b.cushion(wood, (-w / 2, 0.015, seat - 0.02), (w / 2, d, seat + 0.012), radius=0.012)
    for z in (0.62, 0.75, 0.88) if style == 2 else (0.88,):
        b.box(
            wood,
            (-w / 2 + 0.03, -0.012 - 0.05 * (z - 0.7), z - 0.025),
            (w / 2 - 0.03, 0.008 - 0.05 * (z - 0.7), z + 0.03),
        )
    if style == 0:
        for x in np.linspace(-0.15, 0.15, 5):
            b.tube(wood, [(x, 0.03, seat), (x, 0.015, 0.7), (x, -0.01, 0.87)], 0.008, segments=6)


def table(
    b: MeshBuilder,
    look: Look,
    rng: np.random.Generator,
    width: float,
    depth: float,
    height: float,
    *,
    shelf: bool = False,
) -> None:
    """Rectangular table with thin legs and an apron; `shelf` adds a board below (coffee tables)."""
    legs(b, look.wood, width, depth, height - 0.03, thick=0.05, inset=0.045)
    b.cushion(look.wood, (-width / 2, 0, height - 0.03), (width / 2, depth, height), radius=0.01, steps=2)
    z = height - 0.1 if height > 0.6 else height - 0.075
    x0, x1, y0, y1 = -width / 2 + 0.06, width / 2 - 0.06, 0.06, depth - 0.06
    b.box(look.wood, (x0, y0 - 0.01, z), (x1, y0 + 0.01, height - 0.03))
    b.box(look.wood, (x0, y1 - 0.01, z), (x1, y1 + 0.01, height - 0.03))
    b.box(look.wood, (x0 - 0.01, y0, z), (x0 + 0.01, y1, height - 0.03))
    b.box(look.wood, (x1 - 0.01, y0, z), (x1 + 0.01, y1, height - 0.03))
    if shelf:
        b.box(look.wood2, (-width / 2 + 0.04, 0.04, 0.13), (width / 2 - 0.04, depth - 0.04, 0.15))
        with b.placed(-0.2 * width, depth / 2, 0.15):
            decor.book_stack(b, look, rng, 4)
    spots = [(-0.28, 0.4), (0.0, 0.55), (0.3, 0.45)]
    for fx, fy in spots:
        with b.placed(fx * width, fy * depth, height):
            table_top(b, look, rng)


def table_top(b: MeshBuilder, look: Look, rng: np.random.Generator) -> None:
    """Something that lies on a table."""
    kind = int(rng.integers(5))
    if kind == 0:
        decor.bowl(b, look, rng)
    elif kind == 1:
        decor.vase(b, look, rng, float(rng.uniform(0.16, 0.3)))
    elif kind == 2:
        decor.book_stack(b, look, rng, int(rng.integers(1, 4)))
    else:
        b.revolve(
            look.shared.vases[kind - 3],
            [(0, 0.004), (0.06, 0.004), (0.12, 0.016), (0.122, 0.02), (0.06, 0.009), (0, 0.009)],
        )
        with b.placed(0.17, 0.05):
            decor.mug(b, look, rng)


def bed(b: MeshBuilder, look: Look, rng: np.random.Generator, width: float, length: float) -> None:
    """Bed with headboard at y = 0, mattress, pillows, a blanket with folds and a turned-down edge."""
    x, top = width / 2, 0.5
    b.box(look.wood, (-x, 0.05, 0.14), (x, length, 0.3))
    legs(b, look.wood, width, length, 0.15, thick=0.07, inset=0.08)
    b.cushion(
        look.wood2 if rng.random() < 0.5 else look.fabric, (-x - 0.02, 0, 0.14), (x + 0.02, 0.06, 1.05), radius=0.025
    )
    panels = 4
    for k in range(panels):
        w = width / panels
        b.cushion(
            look.fabric,
            (-x + k * w + 0.008, 0.05, 0.5),
            (-x + (k + 1) * w - 0.008, 0.09, 1.0),
            radius=0.018,
            bulge=0.02,
        )
    b.cushion(look.shade, (-x + 0.02, 0.08, 0.29), (x - 0.02, length - 0.02, top), radius=0.05)
    count = 2 if width > 1.2 else 1
    for k in range(count):
        px = (k - (count - 1) / 2) * width / count
        with b.placed(px, 0.2, top + 0.05, yaw=float(rng.normal(0, 0.06)), tilt=0.28):
            b.cushion(look.shade, (-0.32, -0.03, -0.04), (0.32, 0.4, 0.08), radius=0.045, bulge=0.05)
        with b.placed(px, 0.22, top + 0.1, yaw=float(rng.normal(0, 0.12)), tilt=-0.5):
            b.cushion(look.fabric3, (-0.22, 0.02, 0), (0.22, 0.12, 0.36), radius=0.04, bulge=0.04)
    _blanket(b, look, rng, x, 0.62, length, top)


def _blanket(
    b: MeshBuilder, look: Look, rng: np.random.Generator, x: float, start: float, stop: float, top: float
) -> None:
    n, m = b.segments(44, 14), b.segments(48, 14)
    drop = 0.26
    s, t = np.linspace(-x - drop, x + drop, n), np.linspace(start, stop + drop, m)
    S, Y = np.meshgrid(s, t, indexing="ij")
    over_x, over_y = np.clip(np.abs(S) - x, 0, None), np.clip(Y - stop, 0, None)
    down = np.maximum(over_x, over_y)
    field = sum(
        a * np.sin(fx * S + fy * Y + p)
        for a, fx, fy, p in zip(
            (0.012, 0.009, 0.006, 0.004), rng.normal(0, 9, 4), rng.normal(0, 11, 4), rng.uniform(0, 6, 4)
        )
    )
    folds = 0.018 * np.sin(26 * (S + Y) + float(rng.uniform(0, 6)))
    bulge = 0.012 + np.abs(field) + np.where(down > 0, 0.012 + np.abs(folds) * np.clip(down / 0.15, 0, 1), 0)
    px = np.sign(S) * (np.minimum(np.abs(S), x) + np.where(over_x > 0, bulge, 0))
    py = np.minimum(Y, stop) + np.where(over_y > 0, bulge, 0)
    pz = top + np.where(down > 0, 0.012, 0.012 + np.abs(field)) - down
    b.grid(look.fabric2, np.stack([px, py, pz], -1))
    k = b.segments(14, 6)
    u = np.linspace(0, 1, k)
    profile = np.stack(
        [start - 0.01 + 0.26 * u, top + 0.03 + 0.035 * np.sin(math.pi * np.clip(u * 3, 0, 1) / 2) * (1 - 0.5 * u)], -1
    )
    px2 = np.linspace(-x - 0.015, x + 0.015, n)
    wave = 0.008 * np.sin(17 * px2 + 1)[:, None]
    fold = np.stack(
        [np.broadcast_to(px2[:, None], (n, k)), profile[None, :, 0] + wave, profile[None, :, 1] + 0.5 * np.abs(wave)],
        -1,
    )
    b.grid(look.shade, fold)


def desk(b: MeshBuilder, look: Look, rng: np.random.Generator, width: float, depth: float) -> None:
    """Desk with drawers on one side, monitor, keyboard, lamp and papers."""
    h = 0.74
    b.cushion(look.wood, (-width / 2, 0, h - 0.03), (width / 2, depth, h), radius=0.01, steps=2)
    for y in (0.05, depth - 0.05):
        b.tube(
            look.shared.iron,
            [(-width / 2 + 0.05, y, 0), (-width / 2 + 0.05, y, h / 2), (-width / 2 + 0.05, y, h - 0.03)],
            0.018,
        )
    x0, x1 = width / 2 - 0.42, width / 2 - 0.02
    b.box(look.paint, (x0, 0.03, 0.06), (x1, depth - 0.05, h - 0.03))
    for k in range(3):
        z = 0.08 + 0.21 * k
        front(b, look.paint, look.shared.metal, (x0, z), (x1, z + 0.21), depth - 0.05)
    with b.placed(-0.08 * width, 0.2, h):
        monitor(b, look, look.shared.screen, 0.56, 0.34, 0.11)
    b.box(look.shared.black, (-0.08 * width - 0.21, depth - 0.24, h), (-0.08 * width + 0.21, depth - 0.1, h + 0.016))
    for row in range(4):
        for col in range(12 if b.detail > 0.5 else 0):
            kx, ky = -0.08 * width - 0.195 + col * 0.033, depth - 0.135 - row * 0.031
            b.box(look.shared.paper, (kx, ky, h + 0.016), (kx + 0.027, ky + 0.025, h + 0.022), skip=("-z",))
    with b.placed(0.3 * width, 0.18, h):
        decor.book_stack(b, look, rng, 3)
    with b.placed(0.36 * width, depth - 0.16, h):
        decor.mug(b, look, rng)
    x, y = -width / 2 + 0.14, 0.14
    b.revolve_at(look.shared.iron, (x, y, h), [(0, 0), (0.075, 0), (0.075, 0.015), (0, 0.02)])
    arm = [
        (x, y, h),
        (x + 0.02, y, h + 0.2),
        (x - 0.02, y + 0.02, h + 0.36),
        (x + 0.08, y + 0.12, h + 0.46),
        (x + 0.16, y + 0.2, h + 0.44),
    ]
    b.tube(look.shared.iron, arm, 0.008)
    b.revolve_at(
        look.paint,
        (x + 0.16, y + 0.2, h + 0.36),
        [(0.085, 0), (0.05, 0.07), (0.02, 0.1), (0.016, 0.096), (0.046, 0.066), (0.081, 0)],
    )
    with b.placed(-0.33 * width, depth - 0.2, h, yaw=float(rng.normal(0, 0.3))):
        b.quad(
            look.shared.labels,
            [(-0.1, -0.14, 0.002), (0.1, -0.14, 0.002), (0.1, 0.14, 0.002), (-0.1, 0.14, 0.002)],
            decor.cell_uv(decor.LABELS, int(rng.integers(16))),
        )


def monitor(b: MeshBuilder, look: Look, image: Material, width: float, height: float, lift: float) -> None:
    """Screen that faces +y on a stand; its foot at the origin."""
    b.cushion(look.shared.black, (-0.12, -0.09, 0), (0.12, 0.09, 0.015), radius=0.006, steps=2)
    b.box(look.shared.black, (-0.02, -0.03, 0.01), (0.02, -0.01, lift + 0.5 * height))
    x, z0, z1 = width / 2, lift, lift + height
    b.box(look.shared.black, (-x, -0.012, z0), (x, 0.018, z1))
    x, z0, z1, y = x - 0.012, z0 + 0.014, z1 - 0.012, 0.019
    b.quad(image, [(x, y, z0), (-x, y, z0), (-x, y, z1), (x, y, z1)], [(0, 0), (1, 0), (1, 1), (0, 1)])


def office_chair(b: MeshBuilder, look: Look) -> None:
    """Swivel chair about the origin, back towards -y."""
    iron = look.shared.iron
    for k in range(5):
        a = 2 * math.pi * k / 5 + 0.3
        c, s = math.cos(a), math.sin(a)
        b.tube(iron, [(0, 0, 0.12), (0.14 * c, 0.14 * s, 0.1), (0.27 * c, 0.27 * s, 0.065)], 0.015, segments=6)
        with b.placed(0.27 * c, 0.27 * s, 0.03):
            decor.ball(b, look.shared.black, 0.03)
    b.tube(iron, [(0, 0, 0.1), (0, 0, 0.25), (0, 0, 0.43)], 0.025)
    b.cushion(look.fabric, (-0.24, -0.22, 0.42), (0.24, 0.25, 0.5), radius=0.035, bulge=0.015)
    b.tube(iron, [(0, -0.15, 0.43), (0, -0.25, 0.47), (0, -0.27, 0.65)], 0.014)
    with b.placed(0, -0.25, 0.55, tilt=0.12):
        b.cushion(look.fabric, (-0.22, -0.03, 0), (0.22, 0.035, 0.46), radius=0.03, bulge=0.02)


def tv_unit(b: MeshBuilder, look: Look, rng: np.random.Generator, width: float, depth: float) -> None:
    """Low board with a television, an open bay with things."""
    h = 0.46
    drawers(b, look, look.wood, width, depth, h, rows=1, cols=3)
    with b.placed(0, 0.16, h):
        monitor(b, look, look.shared.television, min(1.15, 0.8 * width), 0.64, 0.06)
    for s in (-1, 1):
        with b.placed(s * (width / 2 - 0.12), depth / 2, h):
            decor.ornament(b, look, rng, 0.26)
