"""Storage of a generated apartment: fronts, chests, wardrobes, shelves.

Pieces stand with their back at y = 0 and their middle at x = 0, front towards +y, z up, metres.
"""

import numpy as np

from active3d_pipe.sim import apartment_decor as decor
from active3d_pipe.sim.apartment_look import Look
from active3d_pipe.sim.apartment_mesh import Material, MeshBuilder


def legs(
    b: MeshBuilder,
    material: Material,
    width: float,
    depth: float,
    height: float,
    *,
    thick: float = 0.04,
    inset: float = 0.03,
) -> None:
    """Four tapered round legs under a plate (width, depth) whose back edge is y = 0."""
    for sx in (-1, 1):
        for y in (inset, depth - inset):
            with b.placed(sx * (width / 2 - inset), y):
                b.revolve(material, [(0, 0), (0.35 * thick, 0), (0.5 * thick, height)], segments=10)


def front(
    b: MeshBuilder,
    material: Material,
    handle: Material,
    low: tuple[float, float],
    high: tuple[float, float],
    y: float,
    *,
    knob: str = "bar",
) -> None:
    """A door or drawer front on the plane y from (x, z) low to high: raised frame around a recess, and a handle."""
    (x0, z0), (x1, z1) = low, high
    g = 0.004
    x0, x1, z0, z1 = x0 + g, x1 - g, z0 + g, z1 - g
    b.box(material, (x0, y, z0), (x1, y + 0.012, z1), skip=("-y",))
    f = min(0.06, 0.22 * min(x1 - x0, z1 - z0))
    for lo, hi in (
        ((x0, z0), (x1, z0 + f)),
        ((x0, z1 - f), (x1, z1)),
        ((x0, z0 + f), (x0 + f, z1 - f)),
        ((x1 - f, z0 + f), (x1, z1 - f)),
    ):
        b.box(material, (lo[0], y + 0.012, lo[1]), (hi[0], y + 0.022, hi[1]), skip=("-y",))
    xm, zm = (x0 + x1) / 2, (z0 + z1) / 2
    if knob == "bar":
        b.tube(
            handle,
            [
                (xm - 0.06, y + 0.02, z1 - f / 2),
                (xm - 0.06, y + 0.045, z1 - f / 2),
                (xm + 0.06, y + 0.045, z1 - f / 2),
                (xm + 0.06, y + 0.02, z1 - f / 2),
            ],
            0.005,
            segments=6,
        )
        return
    x = {"left": x0 + f / 2, "right": x1 - f / 2}.get(knob, xm)
    with b.placed(x, y + 0.038, zm):
        decor.ball(b, handle, 0.016)


def drawers(
    b: MeshBuilder, look: Look, body: Material, width: float, depth: float, height: float, rows: int, cols: int = 1
) -> None:
    """Chest of drawers on short legs."""
    legs(b, look.wood2, width, depth, 0.1, thick=0.045, inset=0.05)
    b.box(body, (-width / 2, 0, 0.1), (width / 2, depth - 0.025, height - 0.025))
    b.cushion(
        look.wood2, (-width / 2 - 0.012, 0, height - 0.025), (width / 2 + 0.012, depth, height), radius=0.008, steps=2
    )
    dx, dz = (width - 0.02) / cols, (height - 0.15) / rows
    for i in range(cols):
        for j in range(rows):
            x, z = -width / 2 + 0.01 + i * dx, 0.115 + j * dz
            front(b, body, look.shared.metal, (x, z), (x + dx, z + dz), depth - 0.025)


def wardrobe(b: MeshBuilder, look: Look, width: float, depth: float, height: float) -> None:
    """Wardrobe with panelled doors, plinth and cornice."""
    body = look.paint
    b.box(body, (-width / 2, 0, 0.07), (width / 2, depth - 0.03, height - 0.05))
    b.box(look.wood, (-width / 2 + 0.02, 0, 0), (width / 2 - 0.02, depth - 0.06, 0.07))
    b.cushion(
        look.wood,
        (-width / 2 - 0.03, 0, height - 0.05),
        (width / 2 + 0.03, depth + 0.02, height),
        radius=0.015,
        steps=2,
    )
    count = max(2, round(width / 0.5))
    w = width / count
    for k in range(count):
        x = -width / 2 + k * w
        knob = "right" if k % 2 == 0 else "left"
        front(b, body, look.shared.metal, (x, 0.6), (x + w, height - 0.06), depth - 0.03, knob=knob)
        front(b, body, look.shared.metal, (x, 0.08), (x + w, 0.6), depth - 0.03)


def bookshelf(
    b: MeshBuilder,
    look: Look,
    rng: np.random.Generator,
    width: float,
    depth: float,
    height: float,
    boards: int,
    books: bool = True,
) -> None:
    """Open shelf with books (unless `books` is False) and things; back panel, sides, boards."""
    wood, t = look.wood, 0.022
    b.box(wood, (-width / 2, 0, 0), (width / 2, 0.012, height))
    for s in (-1, 1):
        low, high = sorted((s * width / 2, s * (width / 2 - t)))
        b.box(wood, (low, 0, 0), (high, depth, height))
    pitch = (height - 0.08 - t) / boards
    for k in range(boards + 1):
        z = 0.06 + k * pitch
        b.box(wood, (-width / 2 + t, 0.012, z), (width / 2 - t, depth - 0.005, z + t))
        if k == boards:
            break
        clear = pitch - t - 0.02
        x0, x1 = -width / 2 + t + 0.005, width / 2 - t - 0.005
        if not books:
            for x in np.linspace(x0, x1, 4)[1:3]:
                with b.placed(float(x), depth / 2, z + t):
                    (decor.jar if rng.random() < 0.7 else decor.ornament)(b, look, rng)
            continue
        cut = x0 + float(rng.choice([0.45, 0.65, 1.0, 1.0])) * (x1 - x0)
        books_left = bool(rng.random() < 0.5)
        lo, hi = (x0, cut) if books_left else (x1 - (cut - x0), x1)
        with b.placed(0, 0.04, z + t):
            decor.book_row(b, look, rng, lo, hi, depth - 0.09, clear)
        gap = (hi, x1) if books_left else (x0, lo)
        if gap[1] - gap[0] > 0.2:
            with b.placed((gap[0] + gap[1]) / 2, depth / 2, z + t):
                decor.ornament(b, look, rng, clear)
    for x in (-0.25 * width, 0.22 * width):
        with b.placed(x, depth / 2, 0.06 + boards * pitch + t):
            decor.ornament(b, look, rng, 0.28)
