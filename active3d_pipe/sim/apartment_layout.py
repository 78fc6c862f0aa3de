"""Floor plans: recursive subdivision into rooms, doors between them, windows to the outside.

Room rectangles are centre lines of walls; the inner face of a wall lies HALF_WALL inside its line. Sides are counted
0 south, 1 east, 2 north, 3 west; a side's own frame has x along the wall (counter-clockwise), y into the room.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np

HEIGHT = 2.6  # m, floor to ceiling
HALF_WALL = 0.07  # m, half the thickness of an inner wall
OUTER = 0.23  # m, from the centre line to the outer face of an outside wall
DOOR_WIDTH, DOOR_HEIGHT = 0.9, 2.05  # m, clear opening

TYPES = ("living", "kitchen", "bedroom", "study", "bath")


@dataclass(frozen=True)
class Opening:
    """A hole in one side of a room: [start, stop] along the side's inner face (m from its corner), z range.

    `leaf` is +1 / -1 for a door leaf that opens into this room, hinged at `stop` / `start`, else 0.
    `passage` names the reveal: the room that owns the opening builds it.
    """

    kind: str
    start: float
    stop: float
    bottom: float
    top: float
    other: int = -1
    leaf: int = 0


@dataclass
class Room:
    """One room: centre-line rectangle (x0, y0, x1, y1) in m, its type, openings by side, outside wall intervals."""

    rect: tuple[float, float, float, float]
    kind: str = ""
    openings: list[list[Opening]] = field(default_factory=lambda: [[], [], [], []])
    outside: list[list[tuple[float, float]]] = field(default_factory=lambda: [[], [], [], []])

    @property
    def inner(self) -> tuple[float, float, float, float]:
        """Rectangle of the inner wall faces."""
        x0, y0, x1, y1 = self.rect
        return x0 + HALF_WALL, y0 + HALF_WALL, x1 - HALF_WALL, y1 - HALF_WALL

    @property
    def area(self) -> float:
        """Floor area between the inner faces, m2."""
        x0, y0, x1, y1 = self.inner
        return (x1 - x0) * (y1 - y0)

    def side(self, k: int) -> tuple[float, float, float, float]:
        """(x, y, yaw, length) of side k's frame: its first corner on the inner face, direction, length in m."""
        x0, y0, x1, y1 = self.inner
        corner = ((x0, y0), (x1, y0), (x1, y1), (x0, y1))[k]
        return (*corner, k * math.pi / 2, (x1 - x0, y1 - y0)[k % 2])


def _split(rect: tuple[float, float, float, float], count: int, rng: np.random.Generator) -> list[tuple]:
    if count == 1:
        return [rect]
    x0, y0, x1, y1 = rect
    first = count // 2 if count % 2 == 0 or rng.random() < 0.5 else count - count // 2
    share = first / count + rng.uniform(-0.05, 0.05)
    if x1 - x0 > y1 - y0:
        cut = x0 + share * (x1 - x0)
        halves = (x0, y0, cut, y1), (cut, y0, x1, y1)
    else:
        cut = y0 + share * (y1 - y0)
        halves = (x0, y0, x1, cut), (x0, cut, x1, y1)
    return _split(halves[0], first, rng) + _split(halves[1], count - first, rng)


def _shared(a: tuple, b: tuple) -> tuple[int, float, float] | None:
    """(side of a, start, stop) of the common line of two rectangles in world coordinates, or None."""
    tiny = 1e-9
    for side, (i, j) in enumerate(((1, 3), (2, 0), (3, 1), (0, 2))):
        if abs(a[i] - b[j]) < tiny:
            k = side % 2  # sides 0 and 2 run along x, 1 and 3 along y
            low, high = max(a[k], b[k]), min(a[k + 2], b[k + 2])
            if high - low > 1e-6:
                return side, low, high
    return None


def _plausible(rects: list[tuple]) -> bool:
    sizes = np.array([(x1 - x0, y1 - y0) for x0, y0, x1, y1 in rects])
    return bool((sizes.min() >= 2.9) and (sizes.max() <= 5.6) and (sizes.max(1) / sizes.min(1)).max() <= 1.7)


def _connections(rects: list[tuple], rng: np.random.Generator) -> list[tuple[int, int]] | None:
    """Pairs of rooms that get a door: a random spanning tree and a few more, or None if some room is cut off."""
    need = DOOR_WIDTH + 0.7
    pairs = []
    for i in range(len(rects)):
        for j in range(i + 1, len(rects)):
            s = _shared(rects[i], rects[j])
            if s and s[2] - s[1] >= need:
                pairs.append((i, j))
    group = list(range(len(rects)))
    doors = []
    for index in rng.permutation(len(pairs)) if pairs else []:
        i, j = pairs[index]
        if group[i] != group[j]:
            old, new = group[j], group[i]
            group = [new if g == old else g for g in group]
            doors.append((i, j))
        elif rng.random() < 0.3:
            doors.append((i, j))
    return doors if len(set(group)) == 1 else None


def make_layout(count: int, rng: np.random.Generator) -> list[Room]:
    """Rooms with types, doors and windows; the plan is centred on the origin."""
    while True:
        corner = count >= 3 and rng.random() < 0.6  # an L-shape: one corner room more, then left out
        cells = count + int(corner)
        area = cells * rng.uniform(13.5, 17.5)
        aspect = rng.uniform(1.0, 1.7)
        width, depth = math.sqrt(area * aspect), math.sqrt(area / aspect)
        rects = _split((0.0, 0.0, width, depth), cells, rng)
        if corner:
            at_corner = [k for k, r in enumerate(rects) if r[0] in (0.0, width) or r[2] == width]
            at_corner = [k for k in at_corner if rects[k][1] == 0.0 or rects[k][3] == depth]
            rects.pop(int(rng.choice(at_corner)))
        if not _plausible(rects):
            continue
        doors = _connections(rects, rng)
        if doors is not None:
            break
    centre = (np.min(rects, axis=0)[:2] + np.max(rects, axis=0)[2:]) / 2
    rooms = [Room((r[0] - centre[0], r[1] - centre[1], r[2] - centre[0], r[3] - centre[1])) for r in rects]
    _name(rooms, rng)
    _outside(rooms)
    for i, j in doors:
        _door(rooms, i, j, rng)
    for room in rooms:
        _windows(room, rng)
    for room in rooms:
        _drop_obstructed_leaves(room)
    return rooms


def _name(rooms: list[Room], rng: np.random.Generator) -> None:
    """The largest room is the living room, from four rooms on the smallest the bathroom; the rest at random."""
    order = sorted(range(len(rooms)), key=lambda k: -rooms[k].area)
    rooms[order[0]].kind = "living"
    rest = order[1:]
    if len(rooms) >= 4:
        rooms[rest.pop()].kind = "bath"
    kinds = [str(k) for k in rng.permutation(["kitchen", "bedroom", "study"])] + ["bedroom", "study", "bedroom"]
    for k, kind in zip([rest[i] for i in rng.permutation(len(rest))], kinds):
        rooms[k].kind = kind


def _to_side(room: Room, side: int, low: float, high: float) -> tuple[float, float]:
    """World interval along a side's line to the side's own x."""
    x0, y0, x1, y1 = room.inner
    if side == 0:
        return low - x0, high - x0
    if side == 1:
        return low - y0, high - y0
    if side == 2:
        return x1 - high, x1 - low
    return y1 - high, y1 - low


def _outside(rooms: list[Room]) -> None:
    """Intervals of every side that no other room touches."""
    for room in rooms:
        for side in range(4):
            k = side % 2
            free = [(room.rect[k], room.rect[k + 2])]
            for other in rooms:
                s = _shared(room.rect, other.rect) if other is not room else None
                if s and s[0] == side:
                    free = [p for a, b in free for p in ((a, min(b, s[1])), (max(a, s[2]), b)) if p[1] - p[0] > 1e-6]
            room.outside[side] = [_to_side(room, side, a, b) for a, b in free]


def _door(rooms: list[Room], i: int, j: int, rng: np.random.Generator) -> None:
    shared = _shared(rooms[i].rect, rooms[j].rect)
    assert shared is not None
    side, low, high = shared
    low, high = low + HALF_WALL + 0.2, high - HALF_WALL - 0.2 - DOOR_WIDTH
    # Doors near a corner leave whole walls for furniture.
    t = float(np.clip(rng.beta(0.4, 0.4), 0, 1))
    start = low + t * (high - low)
    swing = int(rng.integers(0, 4))  # 0, 1: no leaf; 2: into i; 3: into j
    for room, own_side, leaf in ((i, side, swing == 2), (j, (side + 2) % 4, swing == 3)):
        a, b = _to_side(rooms[room], own_side, start, start + DOOR_WIDTH)
        length = rooms[room].side(own_side)[3]
        hinge = (1 if length - b < a else -1) if leaf else 0
        other = j if room == i else i
        rooms[room].openings[own_side].append(Opening("door", a, b, 0.0, DOOR_HEIGHT, other, hinge))


def _drop_obstructed_leaves(room: Room) -> None:
    """Remove open door leaves that would stand in front of another opening near the same corner."""
    swept = DOOR_WIDTH + 0.25
    for side, openings in enumerate(room.openings):
        length = room.side(side)[3]
        for k, o in enumerate(openings):
            if not o.leaf:
                continue
            if o.leaf > 0:
                beyond, reach = room.openings[(side + 1) % 4], length - o.stop
                obstructed = reach < swept and any(p.start < swept for p in beyond)
                obstructed |= any(0 <= p.start - o.stop < 0.5 for p in openings)
            else:
                end = room.side((side - 1) % 4)[3]
                beyond, reach = room.openings[(side - 1) % 4], o.start
                obstructed = reach < swept and any(p.stop > end - swept for p in beyond)
                obstructed |= any(0 <= o.start - p.stop < 0.5 for p in openings)
            if obstructed:
                openings[k] = replace(o, leaf=0)


def _windows(room: Room, rng: np.random.Generator) -> None:
    """One window in every long enough outside wall, at most two; low and wide in living rooms, small in bathrooms."""
    left = 2
    for side in rng.permutation(4):
        length = room.side(int(side))[3]
        spans = [(max(a, 0.0), min(b, length)) for a, b in room.outside[side]]
        spans = [s for s in spans if s[1] - s[0] >= 1.7]
        if not spans or left == 0:
            continue
        a, b = spans[0]
        width = {"living": rng.uniform(1.5, 2.1), "bath": rng.uniform(0.6, 0.8)}.get(room.kind, rng.uniform(1.0, 1.6))
        width = min(width, b - a - 0.7)
        sill = {"living": rng.uniform(0.5, 0.9), "bath": 1.35, "kitchen": 1.15}.get(room.kind, rng.uniform(0.8, 0.95))
        start = a + 0.35 + rng.uniform(0.25, 0.75) * (b - a - 0.7 - width)
        room.openings[side].append(Opening("window", start, start + width, sill, 2.2))
        left -= 1
