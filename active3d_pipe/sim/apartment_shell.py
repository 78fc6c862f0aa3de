"""Walls, floors, ceilings, doors and windows of a generated apartment.

Everything on a wall is built in the frame of its side: x along the wall, y into the room, the inner face at y = 0.
"""

import math

import numpy as np

from active3d_pipe.sim import apartment_decor as decor
from active3d_pipe.sim.apartment_layout import DOOR_HEIGHT, DOOR_WIDTH, HALF_WALL, HEIGHT, OUTER, Opening, Room
from active3d_pipe.sim.apartment_look import Look, Shared
from active3d_pipe.sim.apartment_mesh import Material, MeshBuilder

WINDOW_DEPTH = OUTER + HALF_WALL - 0.02  # m, from the inner face of an outside wall to the pane
SLAB = 0.15  # m, thickness of floor and roof slabs


def build_room_shell(
    b: MeshBuilder, index: int, room: Room, look: Look, accent_side: int, rng: np.random.Generator
) -> None:
    """Floor, ceiling, four walls with their openings, skirting and cornice of one room."""
    x0, y0, x1, y1 = room.inner
    b.quad(look.floor, [(x0, y0, 0), (x1, y0, 0), (x1, y1, 0), (x0, y1, 0)])
    b.quad(look.shared.ceiling, [(x0, y1, HEIGHT), (x1, y1, HEIGHT), (x1, y0, HEIGHT), (x0, y0, HEIGHT)])
    for side in range(4):
        x, y, yaw, length = room.side(side)
        with b.placed(x, y, yaw=yaw):
            openings = sorted(room.openings[side], key=lambda o: o.start)
            _wall(b, look.accent_wall if side == accent_side else look.wall, length, openings)
            _strips(b, look, length, openings)
            for o in openings:
                if o.kind == "window":
                    _window(b, look, o, rng, bath=room.kind == "bath")
                else:
                    _door_frame(b, look, o)
                    if index < o.other:
                        _passage(b, look, o)
                    if o.leaf:
                        _door_leaf(b, look.shared, o, rng)


def _wall(b: MeshBuilder, material: Material, length: float, openings: list[Opening]) -> None:
    """The inner face of a wall with rectangular holes; texture coordinates run through."""
    x = 0.0

    def panel(x0: float, x1: float, z0: float, z1: float) -> None:
        if x1 - x0 > 1e-6 and z1 - z0 > 1e-6:
            corners = np.array([(x0, 0, z0), (x0, 0, z1), (x1, 0, z1), (x1, 0, z0)])
            b.add(material, corners, np.array([[0, 1, 2], [0, 2, 3]]), corners[:, [0, 2]])

    for o in openings:
        panel(x, o.start, 0, HEIGHT)
        panel(o.start, o.stop, 0, o.bottom)
        panel(o.start, o.stop, o.top, HEIGHT)
        x = o.stop
    panel(x, length, 0, HEIGHT)


def _strips(b: MeshBuilder, look: Look, length: float, openings: list[Opening]) -> None:
    """Skirting board between the doors, cornice below the ceiling."""
    doors = [o for o in openings if o.bottom == 0.0]
    starts = [0.0, *[o.stop + 0.07 for o in doors]]
    stops = [*[o.start - 0.07 for o in doors], length]
    for x0, x1 in zip(starts, stops):
        if x1 > x0:
            b.box(look.shared.trim, (x0, 0, 0), (x1, 0.016, 0.085), skip=("-y",))
            b.box(look.shared.trim, (x0, 0, 0.085), (x1, 0.009, 0.1), skip=("-y",))
    steps = np.array(
        [(0.0, HEIGHT - 0.075), (0.012, HEIGHT - 0.07), (0.02, HEIGHT - 0.05), (0.05, HEIGHT - 0.02), (0.055, HEIGHT)]
    )
    points = np.stack([np.stack([np.full(len(steps), x), steps[:, 0], steps[:, 1]], -1) for x in (0.0, length)])
    b.grid(look.shared.ceiling, points)


def _passage(b: MeshBuilder, look: Look, o: Opening) -> None:
    """Lining of a doorway through the wall: jambs, head, threshold."""
    depth, trim = 2 * HALF_WALL, look.shared.trim
    x0, x1, top = o.start, o.stop, o.top
    b.quad(look.shared.door, [(x0, -depth, 0), (x1, -depth, 0), (x1, 0, 0), (x0, 0, 0)])
    b.quad(trim, [(x0, -depth, top), (x0, 0, top), (x1, 0, top), (x1, -depth, top)])
    b.quad(trim, [(x0, 0, 0), (x0, -depth, 0), (x0, -depth, top), (x0, 0, top)])
    b.quad(trim, [(x1, -depth, 0), (x1, 0, 0), (x1, 0, top), (x1, -depth, top)])


def _door_frame(b: MeshBuilder, look: Look, o: Opening) -> None:
    """Architrave around a door on one side of the wall."""
    w, d, trim = 0.07, 0.022, look.shared.trim
    b.box(trim, (o.start - w, 0, 0), (o.start, d, o.top + w), skip=("-y",))
    b.box(trim, (o.stop, 0, 0), (o.stop + w, d, o.top + w), skip=("-y",))
    b.box(trim, (o.start, 0, o.top), (o.stop, d, o.top + w), skip=("-y",))


def leaf_angle(rng: np.random.Generator) -> float:
    """How far an open door stands open, rad."""
    return float(rng.uniform(math.radians(86), math.radians(100)))


def _door_leaf(b: MeshBuilder, shared: Shared, o: Opening, rng: np.random.Generator) -> None:
    """An open door leaf with panels and handles, hinged at `o.stop` (leaf = +1) or `o.start` (-1)."""
    hinge = o.stop + 0.01 if o.leaf > 0 else o.start - 0.01
    angle = leaf_angle(rng)
    # Closed, the leaf points from the hinge back across the opening; it turns into the room (+y).
    yaw = math.pi - angle if o.leaf > 0 else angle
    w, h, t = DOOR_WIDTH - 0.02, DOOR_HEIGHT - 0.02, 0.04
    with b.placed(hinge, 0.03, 0.008, yaw=yaw):
        b.box(shared.door, (0, -t / 2, 0), (w, t / 2, h))
        for z0, z1 in ((0.12, 0.78), (0.95, 1.5), (1.58, h - 0.12)):
            for s in (-1, 1):
                low, high = sorted((s * t / 2, s * (t / 2 + 0.008)))
                b.box(shared.door, (0.12, low, z0), (w - 0.12, high, z1))
                b.box(
                    shared.door,
                    (0.17, low - (0.006 if s < 0 else 0), z0 + 0.05),
                    (w - 0.17, high + (0.006 if s > 0 else 0), z1 - 0.05),
                )
        for s in (-1, 1):
            y = s * t / 2
            b.tube(
                shared.metal,
                [
                    (w - 0.06, y, 1.02),
                    (w - 0.06, y + s * 0.05, 1.02),
                    (w - 0.1, y + s * 0.055, 1.02),
                    (w - 0.18, y + s * 0.05, 1.02),
                ],
                0.009,
                segments=6,
            )


def _window(b: MeshBuilder, look: Look, o: Opening, rng: np.random.Generator, *, bath: bool) -> None:
    """Recess, sash with glazing bars, the opaque pane with the view, sill, curtains, radiator below."""
    trim, d = look.shared.trim, WINDOW_DEPTH
    x0, x1, z0, z1 = o.start, o.stop, o.bottom, o.top
    b.quad(trim, [(x0, -d, z0), (x1, -d, z0), (x1, 0, z0), (x0, 0, z0)])
    b.quad(trim, [(x0, 0, z1), (x1, 0, z1), (x1, -d, z1), (x0, -d, z1)])
    b.quad(trim, [(x0, 0, z0), (x0, -d, z0), (x0, -d, z1), (x0, 0, z1)])
    b.quad(trim, [(x1, -d, z0), (x1, 0, z0), (x1, 0, z1), (x1, -d, z1)])
    width, height = x1 - x0, z1 - z0
    # The view is cut to the window's proportions, about 2.6 m for the whole image.
    size = np.minimum(np.array([width, height]) / max(width, height, 2.0), 1.0)
    u0, v0 = float(rng.uniform(0, 1 - size[0] + 1e-9)), 0.5 * (1 - size[1])
    uv = [(u0 + size[0], v0), (u0, v0), (u0, v0 + size[1]), (u0 + size[0], v0 + size[1])]
    b.quad(look.shared.view, [(x1, -d, z0), (x0, -d, z0), (x0, -d, z1), (x1, -d, z1)], uv)
    f = 0.05
    y0, y1 = -d + 0.03, -d + 0.09
    sashes = max(1, round(width / 0.75))
    for k in range(sashes):
        a, c = x0 + k * width / sashes, x0 + (k + 1) * width / sashes
        for low, high in (
            ((a, z0), (c, z0 + f)),
            ((a, z1 - f), (c, z1)),
            ((a, z0 + f), (a + f, z1 - f)),
            ((c - f, z0 + f), (c, z1 - f)),
        ):
            b.box(trim, (low[0], y0, low[1]), (high[0], y1, high[1]))
        bars = max(1, round(height / 0.6))
        for j in range(1, bars):
            z = z0 + j * height / bars
            b.box(trim, (a + f, y0 + 0.015, z - 0.012), (c - f, y1 - 0.015, z + 0.012))
        b.box(look.shared.metal, (c - 0.03, y1, (z0 + z1) / 2 - 0.06), (c - 0.015, y1 + 0.03, (z0 + z1) / 2 + 0.06))
    b.box(look.wood if not bath else look.shared.marble, (x0 - 0.05, -0.08, z0 - 0.03), (x1 + 0.05, 0.06, z0 + 0.004))
    if z0 >= 0.7 and not bath:
        with b.placed((x0 + x1) / 2, 0.0, 0.0):
            decor.radiator(b, look, 0.8 * width, min(z0 - 0.12, 0.68))
    if rng.random() < 0.6:
        with b.placed(x0 + float(rng.uniform(0.25, 0.75)) * width, -0.07, z0 + 0.004):
            (decor.plant if rng.random() < 0.5 else decor.vase)(b, look, rng, 0.24)
    if not bath:
        _curtains(b, look, o, rng)


def _curtains(b: MeshBuilder, look: Look, o: Opening, rng: np.random.Generator) -> None:
    middle, width = (o.start + o.stop) / 2, o.stop - o.start
    cloth = 0.28
    short = o.bottom > 1.0 or rng.random() < 0.3
    bottom = o.bottom - 0.12 if short else 0.0
    top = o.top + 0.12
    with b.placed(middle, 0.06 if not short else 0.05):
        decor.curtain_rod(b, look, width + 0.5, top)
        for s in (-1, 1):
            with b.placed(s * (width / 2 + 0.04), 0.0, bottom):
                decor.curtain(b, look, rng, cloth, top - bottom)


def build_outer_shell(b: MeshBuilder, rooms: list[Room], material: Material) -> None:
    """Outer faces of the outside walls, floor and roof slabs: a second, closed skin around all rooms."""
    low, high = -SLAB, HEIGHT + SLAB
    for room in rooms:
        x0, y0, x1, y1 = (room.rect[0] - OUTER, room.rect[1] - OUTER, room.rect[2] + OUTER, room.rect[3] + OUTER)
        b.quad(material, [(x0, y1, low), (x1, y1, low), (x1, y0, low), (x0, y0, low)])
        b.quad(material, [(x0, y0, high), (x1, y0, high), (x1, y1, high), (x0, y1, high)])
        for side in range(4):
            x, y, yaw, length = room.side(side)
            before, after = room.outside[(side - 1) % 4], room.outside[(side + 1) % 4]
            before_length = room.side((side - 1) % 4)[3]
            for start, stop in room.outside[side]:
                # At a convex corner the face goes on to meet that of the next side.
                convex0 = start < 0 and any(q > before_length for _, q in before)
                convex1 = stop > length and any(p < 0 for p, _ in after)
                a = start - OUTER if convex0 else start
                c = stop + OUTER if convex1 else stop
                with b.placed(x, y, yaw=yaw):
                    d = -(OUTER + HALF_WALL)
                    b.quad(material, [(a, d, low), (c, d, low), (c, d, high), (a, d, high)])
