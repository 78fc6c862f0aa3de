"""Finding places for furniture: footprints on a fine grid, doorways kept free, the free floor kept connected."""

import math
from collections.abc import Callable
from contextlib import AbstractContextManager

import numpy as np
from scipy import ndimage

from active3d_pipe.sim.apartment_layout import DOOR_WIDTH, HEIGHT, Room
from active3d_pipe.sim.apartment_mesh import MeshBuilder

CELL = 0.05  # m
AGENT = 0.27  # m, half the width that every passage keeps
ROOMY = 0.5  # m, clearance that some place of every room keeps
CURTAIN = 0.3  # m, that a curtain takes beside a window

Build = Callable[[], None]
Spot = tuple[float, float, float]  # x, y (m), yaw (rad) of a piece's frame in the world


class Floor:
    """The floor of one room while it is being furnished."""

    def __init__(self, room: Room, rng: np.random.Generator) -> None:
        self.room = room
        self.rng = rng
        x0, y0, x1, y1 = room.inner
        self.xs = np.arange(x0 + CELL / 2, x1, CELL)
        self.ys = np.arange(y0 + CELL / 2, y1, CELL)
        self.blocked = np.zeros((len(self.xs), len(self.ys)), dtype=bool)
        self.keep = np.zeros_like(self.blocked)
        self.used: list[list[tuple[float, float, float, float]]] = [[], [], [], []]
        self.approaches: list[tuple[float, float]] = []
        for side in range(4):
            length = room.side(side)[3]
            for o in room.openings[side]:
                if o.kind == "window":
                    self.used[side].append((o.start - CURTAIN, o.stop + CURTAIN, o.bottom, HEIGHT))
                    continue
                self.used[side].append((o.start - 0.1, o.stop + 0.1, 0.0, HEIGHT))
                middle = (o.start + o.stop) / 2
                self.keep |= self.mask(self.on_wall(side, middle), DOOR_WIDTH + 0.3, 0.8)
                self.approaches.append(self.on_wall(side, middle, 0.45)[:2])
                if o.leaf:
                    hinge = o.stop if o.leaf > 0 else o.start
                    self.blocked |= self.mask(self.on_wall(side, hinge + 0.02 * o.leaf), 0.14, 0.95)
                    self.keep |= self.mask(self.on_wall(side, hinge + 0.1 * o.leaf), 0.4, 1.0)
                    if o.leaf > 0 and length - o.stop < 0.6:
                        self.used[(side + 1) % 4].append((0.0, 1.05, 0.0, HEIGHT))
                    if o.leaf < 0 and o.start < 0.6:
                        before = room.side((side - 1) % 4)[3]
                        self.used[(side - 1) % 4].append((before - 1.05, before, 0.0, HEIGHT))

    def on_wall(self, side: int, along: float, away: float = 0.0) -> Spot:
        """The frame at `along` m on side `side`, `away` m from the wall, facing into the room."""
        x, y, yaw, _ = self.room.side(side)
        c, s = math.cos(yaw), math.sin(yaw)
        return x + c * along - s * away, y + s * along + c * away, yaw

    def mask(self, spot: Spot, width: float, depth: float, margin: float = 0.0) -> np.ndarray:
        """Cells under a piece's footprint: local x in +-width / 2, y in 0..depth, grown by `margin` m."""
        c, s = math.cos(spot[2]), math.sin(spot[2])
        dx, dy = self.xs[:, None] - spot[0], self.ys[None, :] - spot[1]
        x, y = c * dx + s * dy, -s * dx + c * dy
        return (np.abs(x) <= width / 2 + margin) & (y >= -margin) & (y <= depth + margin)

    def inside(self, spot: Spot, width: float, depth: float) -> bool:
        """Whether the footprint lies between the walls."""
        c, s = math.cos(spot[2]), math.sin(spot[2])
        x0, y0, x1, y1 = self.room.inner
        for px, py in ((-width / 2, 0), (width / 2, 0), (width / 2, depth), (-width / 2, depth)):
            x, y = spot[0] + c * px - s * py, spot[1] + s * px + c * py
            if not (x0 - 1e-6 <= x <= x1 + 1e-6 and y0 - 1e-6 <= y <= y1 + 1e-6):
                return False
        return True

    def clearance(self, blocked: np.ndarray | None = None) -> np.ndarray:
        """Distance of every cell to furniture or walls, m."""
        return (
            ndimage.distance_transform_edt(
                ~np.pad(self.blocked if blocked is None else blocked, 1, constant_values=True)
            )[1:-1, 1:-1]
            * CELL
        )

    def region(self, blocked: np.ndarray) -> np.ndarray | None:
        """Cells from which an agent gets to every door and to a roomy place; None if there are none."""
        distance = self.clearance(blocked)
        regions, _ = ndimage.label(distance > AGENT)
        roomy = np.unique(regions[distance > ROOMY])
        allowed = set(roomy[roomy > 0].tolist())
        for x, y in self.approaches:
            i = int(np.clip((x - self.xs[0]) / CELL + 0.5, 0, len(self.xs) - 1))
            j = int(np.clip((y - self.ys[0]) / CELL + 0.5, 0, len(self.ys) - 1))
            allowed &= {int(regions[i, j])}
        for k in sorted(allowed, key=lambda k: -np.count_nonzero(regions == k)):
            if np.count_nonzero(regions == k) * CELL**2 > 1.2:
                return regions == k
        return None

    def take(self, spot: Spot, width: float, depth: float, *, margin: float = 0.02) -> bool:
        """Claim a footprint if it is free and leaves the floor connected."""
        if not self.inside(spot, width, depth):
            return False
        mask = self.mask(spot, width, depth, margin)
        if (mask & (self.blocked | self.keep)).any() or self.region(self.blocked | mask) is None:
            return False
        self.blocked |= mask
        return True

    def wall(
        self,
        width: float,
        depth: float,
        height: float,
        *,
        prefer: str = "any",
        near: Spot | None = None,
        gap: float = 0.02,
    ) -> Spot | None:
        """Claim a place against a wall; prefer "corner", "middle" or "any", or near a spot. None if full."""
        candidates = []
        for side in range(4):
            length = self.room.side(side)[3]
            if length < width + 0.04:
                continue
            places = np.arange(width / 2 + 0.03, length - width / 2 - 0.02, 0.1)
            for along in [*places.tolist(), length - width / 2 - 0.03]:
                off = gap
                clash = False
                for a, c, bottom, _ in self.used[side]:
                    if along + width / 2 > a and along - width / 2 < c:
                        clash |= bottom < height
                        off = max(off, 0.2)
                if clash:
                    continue
                edge = min(along, length - along) - width / 2
                cost = {"corner": edge, "middle": abs(along - length / 2), "any": 0.0}[prefer]
                spot = self.on_wall(side, along, off)
                if near is not None:
                    cost += 2 * math.hypot(spot[0] - near[0], spot[1] - near[1])
                candidates.append(
                    (cost + float(self.rng.uniform(0, 0.8)) + (0.3 if off > gap else 0), side, along, spot)
                )
        for _, side, along, spot in sorted(candidates)[:40]:
            if self.take(spot, width, depth):
                self.used[side].append((along - width / 2, along + width / 2, 0.0, height))
                return spot
        return None

    def free(
        self, width: float, depth: float, *, yaws: tuple[float, ...], clear: float = 0.0, tries: int = 60
    ) -> Spot | None:
        """Claim a place away from the walls, roomiest first; `clear` m around it stay free."""
        x0, y0, x1, y1 = self.room.inner
        candidates = []
        distance = self.clearance()
        for _ in range(tries):
            yaw = float(self.rng.choice(yaws))
            x, y = float(self.rng.uniform(x0, x1)), float(self.rng.uniform(y0, y1))
            spot = (x + math.sin(yaw) * depth / 2, y - math.cos(yaw) * depth / 2, yaw)
            i, j = min(int((x - x0) / CELL), len(self.xs) - 1), min(int((y - y0) / CELL), len(self.ys) - 1)
            candidates.append((-float(distance[i, j]), spot))
        for _, spot in sorted(candidates):
            around = (self.shift(spot, 0, -clear), width + 2 * clear, depth + 2 * clear)
            if self.inside(*around) and not (self.mask(*around) & self.blocked).any() and self.take(spot, width, depth):
                return spot
        return None

    @staticmethod
    def shift(spot: Spot, x: float, y: float, turn: float = 0.0) -> Spot:
        """The frame at local (x, y) of `spot`, turned by `turn`."""
        c, s = math.cos(spot[2]), math.sin(spot[2])
        return spot[0] + c * x - s * y, spot[1] + s * x + c * y, spot[2] + turn

    def hang(self, width: float, bottom: float, top: float) -> tuple[int, float] | None:
        """Claim a free piece of wall; (side, along) or None."""
        spans = []
        for side in range(4):
            length = self.room.side(side)[3]
            for along in np.arange(width / 2 + 0.12, length - width / 2 - 0.1, 0.15):
                if all(
                    along + width / 2 + 0.06 <= a or along - width / 2 - 0.06 >= c or z1 <= bottom - 0.06 or z0 >= top
                    for a, c, z0, z1 in self.used[side]
                ):
                    spans.append((float(self.rng.random()), side, float(along)))
        if not spans:
            return None
        _, side, along = min(spans)
        self.used[side].append((along - width / 2, along + width / 2, bottom, top))
        return side, along


def at(b: MeshBuilder, spot: Spot, z: float = 0.0) -> AbstractContextManager[None]:
    """`MeshBuilder.placed` for a spot."""
    return b.placed(spot[0], spot[1], z, yaw=spot[2])
