"""What stands in which room of a generated apartment, and where."""

import math

import numpy as np

from active3d_pipe.sim import apartment_decor as decor
from active3d_pipe.sim import apartment_fittings as fit
from active3d_pipe.sim import apartment_furniture as fur
from active3d_pipe.sim import apartment_storage as sto
from active3d_pipe.sim.apartment_layout import HEIGHT, Room
from active3d_pipe.sim.apartment_look import Look
from active3d_pipe.sim.apartment_mesh import MeshBuilder
from active3d_pipe.sim.apartment_placement import Floor, Spot, at

QUARTERS = (0.0, math.pi / 2, math.pi, -math.pi / 2)


class Furnisher:
    """Furnishes one room; the order of the calls is the order of importance."""

    def __init__(self, b: MeshBuilder, room: Room, look: Look, rng: np.random.Generator, first_picture: int) -> None:
        self.b, self.room, self.look, self.rng = b, room, look, rng
        self.floor = Floor(room, rng)
        self.picture = first_picture
        x0, y0, x1, y1 = room.inner
        self.light: tuple[float, float, float] = ((x0 + x1) / 2, (y0 + y1) / 2, 2.08)

    def furnish(self) -> None:
        """Everything: furniture by type of room, then pictures and the ceiling lamp."""
        {
            "living": self.living,
            "kitchen": self.kitchen,
            "bedroom": self.bedroom,
            "study": self.study,
            "bath": self.bath,
        }[self.room.kind]()
        self.pictures(1 if self.room.kind == "bath" else int(self.rng.integers(3, 6)))
        x, y, bottom = self.light
        with self.b.placed(x, y):
            decor.pendant(self.b, self.look, self.rng, HEIGHT, bottom)

    def living(self) -> None:
        """Sofa with low table and rug, television, shelves, armchair, lamp, plants, a dining table if there is room."""
        b, look, rng = self.b, self.look, self.rng
        width = 2.1 if self.room.area > 13 else 1.6
        sofa = self.floor.wall(width, 0.9, 0.9, prefer="middle")
        if sofa:
            with at(b, sofa):
                fur.sofa(b, look, rng, width, 0.9, 3 if width > 2 else 2)
            self.rug(Floor.shift(sofa, 0, 0.75), 2.3, 1.6)
            low = Floor.shift(sofa, 0, 1.28)
            if self.floor.take(low, 1.05, 0.55):
                with at(b, low):
                    fur.table(b, look, rng, 1.05, 0.55, 0.42, shelf=True)
            opposite = Floor.shift(sofa, 0, 3.2)
            self.tv(opposite)
            for s in (-1, 1):
                chair = Floor.shift(sofa, s * (width / 2 + 0.15), 1.5, s * math.pi / 2 * 0.9)
                if self.floor.take(chair, 0.85, 0.8):
                    with at(b, chair):
                        fur.sofa(b, look, rng, 0.85, 0.8, 1)
                    break
            for s in (1, -1):
                if self.small(Floor.shift(sofa, s * (width / 2 + 0.26), 0.06), 0.36, "lamp"):
                    break
        self.shelves(2, prefer="corner")
        if self.room.area > 14:
            self.dining(4 if self.room.area > 17 else 2)
        self.sideboard()
        self.corners(("plant", "plant", "basket"))

    def kitchen(self) -> None:
        """A counter with sink and oven, wall cupboards, fridge, table with chairs."""
        b, look, rng = self.b, self.look, self.rng
        counter = None
        for width in (3.3, 2.75, 2.2, 1.65):
            counter = self.floor.wall(width, 0.62, 2.3, prefer="corner")
            if counter:
                with at(b, counter):
                    fit.kitchen_counter(b, look, rng, width)
                    fit.wall_cupboards(b, look, rng, width)
                break
        spot = self.floor.wall(0.62, 0.66, 1.8, prefer="corner", near=counter)
        if spot:
            with at(b, spot):
                fit.fridge(b, look, rng)
        self.dining(4)
        self.shelves(1, width=0.7, height=1.6)
        self.sideboard()
        self.corners(("basket", "plant"))

    def bedroom(self) -> None:
        """Bed between nightstands, wardrobe, chest of drawers, chair, rug."""
        b, look, rng = self.b, self.look, self.rng
        for width in (1.6, 1.4, 0.95):
            bed = self.floor.wall(width + 0.06, 2.08, 1.06, prefer="middle")
            if bed:
                with at(b, bed):
                    fur.bed(b, look, rng, width, 2.03)
                self.rug(Floor.shift(bed, 0, 1.25), 2.4, 1.5)
                for s in (-1, 1):
                    stand = Floor.shift(bed, s * (width / 2 + 0.3), 0)
                    if self.floor.take(stand, 0.44, 0.4, margin=0.0):
                        with at(b, stand):
                            sto.drawers(b, look, look.wood, 0.44, 0.4, 0.5, 2)
                            with b.placed(0, 0.18, 0.5):
                                decor.lamp(b, look, rng, 0.48)
                break
        for width in (2.0, 1.5, 1.0):
            spot = self.floor.wall(width + 0.06, 0.62, 2.15, prefer="corner")
            if spot:
                with at(b, spot):
                    sto.wardrobe(b, look, width, 0.6, 2.12)
                break
        self.sideboard()
        self.shelves(1, width=0.8, height=1.8)
        spot = self.floor.free(0.46, 0.48, yaws=(0.5, 2.2, 3.9, 5.4))
        if spot:
            with at(b, spot):
                fur.chair(b, look, rng, 1)
        self.corners(("basket", "plant"))

    def study(self) -> None:
        """Desk with swivel chair, book shelves, reading corner."""
        b, look, rng = self.b, self.look, self.rng
        desk = self.floor.wall(1.5, 0.72, 1.28, prefer="middle")
        if desk:
            with at(b, desk):
                fur.desk(b, look, rng, 1.5, 0.7)
            seat = Floor.shift(desk, -0.12, 0.85)
            if self.floor.take(Floor.shift(seat, 0, -0.05), 0.56, 0.6):
                with at(b, Floor.shift(seat, 0, 0.28, math.pi + float(rng.normal(0, 0.4)))):
                    fur.office_chair(b, look)
            self.small(Floor.shift(desk, 0.98, 0.05), 0.34, "basket")
        self.shelves(3)
        spot = self.floor.wall(0.9, 0.85, 0.85, prefer="corner")
        if spot:
            with at(b, spot):
                fur.sofa(b, look, rng, 0.86, 0.8, 1)
            for s in (1, -1):
                if self.small(Floor.shift(spot, s * 0.7, 0.05), 0.36, "lamp"):
                    break
        x, y, _ = self.light
        self.rug((x, y - 0.8, 0.0), 2.2, 1.6)
        self.sideboard()
        self.corners(("plant", "basket"))

    def bath(self) -> None:
        """Tub, washstand, toilet, towel rail."""
        b, look, rng = self.b, self.look, self.rng
        tub = self.floor.wall(1.72, 0.8, 0.62, prefer="corner", gap=0.02)
        if tub:
            with at(b, tub):
                fit.bathtub(b, look, rng, 1.68, 0.76)
            self.rug(Floor.shift(tub, 0, 0.9), 0.9, 0.6)
        for width in (1.1, 0.8):
            spot = self.floor.wall(width, 0.5, 2.0, prefer="middle")
            if spot:
                with at(b, spot):
                    fit.washstand(b, look, rng, width - 0.04)
                break
        spot = self.floor.wall(0.44, 0.72, 0.82, prefer="any")
        if spot:
            with at(b, spot):
                fit.toilet(b, look)
        spot = self.floor.wall(0.62, 0.16, 1.75)
        if spot:
            with at(b, spot):
                fit.towel_rail(b, look, 0.5)
        self.shelves(1, width=0.6, height=1.5, books=False)
        self.corners(("basket", "plant"))

    def rug(self, spot: Spot, width: float, depth: float) -> None:
        """A thin rug, moved and cut so that it stays inside the room."""
        x0, y0, x1, y1 = self.room.inner
        c, s = abs(math.cos(spot[2])), abs(math.sin(spot[2]))
        middle = Floor.shift(spot, 0, depth / 2)
        wx, wy = (width * c + depth * s) / 2, (width * s + depth * c) / 2
        x = float(np.clip(middle[0], x0 + wx + 0.03, max(x1 - wx - 0.03, x0 + wx + 0.03)))
        y = float(np.clip(middle[1], y0 + wy + 0.03, max(y1 - wy - 0.03, y0 + wy + 0.03)))
        if x + wx > x1 or y + wy > y1:
            return
        with self.b.placed(x, y, 0, yaw=spot[2]):
            w, d, t = width / 2, depth / 2, 0.009
            self.b.box(self.look.fabric3, (-w, -d, 0.001), (w, d, t - 0.001))
            self.b.quad(
                self.look.rug, [(-w, -d, t), (w, -d, t), (w, d, t), (-w, d, t)], [(0, 0), (1, 0), (1, 1), (0, 1)]
            )

    def tv(self, near: Spot) -> None:
        """Television on a low board."""
        spot = self.floor.wall(1.5, 0.42, 1.2, near=near)
        if spot:
            with at(self.b, spot):
                fur.tv_unit(self.b, self.look, self.rng, 1.46, 0.4)

    def shelves(
        self, count: int, *, width: float = 0.9, height: float = 2.0, prefer: str = "any", books: bool = True
    ) -> None:
        """Shelves along the walls, with books or only with other things."""
        near = None
        for _ in range(count):
            tall = height * float(self.rng.uniform(0.75, 1.05))
            spot = self.floor.wall(width, 0.32, tall + 0.3, prefer=prefer, near=near)
            if spot is None:
                return
            near = spot if self.rng.random() < 0.5 else None
            with at(self.b, spot):
                sto.bookshelf(self.b, self.look, self.rng, width - 0.03, 0.3, tall, max(3, round(tall / 0.36)), books)

    def sideboard(self) -> None:
        """A chest of drawers with a lamp and things on it."""
        width = float(self.rng.choice([0.8, 1.0, 1.2]))
        spot = self.floor.wall(width + 0.04, 0.45, 0.86)
        if spot is None:
            return
        with at(self.b, spot):
            body = self.look.paint if self.rng.random() < 0.6 else self.look.wood
            sto.drawers(self.b, self.look, body, width, 0.43, 0.85, 3, 2 if width > 0.9 else 1)
            with self.b.placed(-0.3 * width, 0.2, 0.85):
                decor.lamp(self.b, self.look, self.rng, 0.5)
            with self.b.placed(0.1 * width, 0.22, 0.85):
                decor.ornament(self.b, self.look, self.rng)
            with self.b.placed(0.34 * width, 0.2, 0.85):
                decor.vase(self.b, self.look, self.rng, 0.3)

    def dining(self, chairs: int) -> None:
        """A table with chairs around it and the lamp above."""
        b, look, rng = self.b, self.look, self.rng
        for width, depth, places in ((1.5, 0.85, 4), (1.1, 0.75, 4), (0.8, 0.75, 2)):
            if places > chairs and width > 1.2:
                continue
            side = 0.42  # the chairs stand pushed in by half
            spot = self.floor.free(
                width + (0.1 if places == 4 else 2 * side), depth + (2 * side if places == 4 else 0.05), yaws=QUARTERS
            )
            if spot is None:
                continue
            inset = side if places == 4 else 0.025
            corner = Floor.shift(spot, 0, inset)
            style = int(rng.integers(3))
            with at(b, corner):
                fur.table(b, look, rng, width, depth, 0.75)
            seats = [
                (-width / 4, -0.36, 0.0),
                (width / 4, -0.36, 0.0),
                (-width / 4, depth + 0.36, math.pi),
                (width / 4, depth + 0.36, math.pi),
            ]
            if places == 2:
                seats = [(-width / 2 - 0.38, depth / 2, -math.pi / 2), (width / 2 + 0.38, depth / 2, math.pi / 2)]
            for x, y, turn in seats:
                with at(b, Floor.shift(corner, x, y, turn + float(rng.normal(0, 0.06)))):
                    fur.chair(b, look, rng, style)
            x, y, _ = Floor.shift(corner, 0, depth / 2)
            self.light = (x, y, 1.62)
            return

    def small(self, spot: Spot, size: float, kind: str) -> bool:
        """A lamp, plant or basket on a square of `size` m whose back edge is at `spot`; False if there is no room."""
        if not self.floor.take(spot, size, size):
            return False
        b, look, rng = self.b, self.look, self.rng
        with at(b, Floor.shift(spot, 0, size / 2)):
            if kind == "lamp":
                decor.lamp(b, look, rng, float(rng.uniform(1.45, 1.7)))
            elif kind == "plant":
                decor.plant(b, look, rng, float(rng.uniform(0.8, 1.35)))
            else:
                decor.basket(b, look, rng, 0.45 * size, float(rng.uniform(0.3, 0.45)))
        return True

    def corners(self, kinds: tuple[str, ...]) -> None:
        """Plants and baskets against the walls, corners first."""
        for kind in kinds:
            size = 0.6 if kind == "plant" else 0.36
            height = 1.3 if kind == "plant" else 0.4
            spot = self.floor.wall(size, size, height, prefer="corner", gap=0.12 if kind == "plant" else 0.02)
            if spot is None:
                continue
            with at(self.b, Floor.shift(spot, 0, size / 2)):
                if kind == "plant":
                    decor.plant(self.b, self.look, self.rng, float(self.rng.uniform(0.8, 1.35)))
                else:
                    decor.basket(self.b, self.look, self.rng, 0.45 * size, float(self.rng.uniform(0.3, 0.45)))

    def pictures(self, count: int) -> None:
        """Framed paintings on free pieces of wall, in several sizes."""
        sizes = ((1.1, 0.75), (0.7, 0.9), (0.6, 0.45), (0.4, 0.5), (0.35, 0.35))
        for k in range(count):
            width, height = sizes[min(k, 4)]
            middle = 1.62 + float(self.rng.uniform(-0.05, 0.1))
            found = self.floor.hang(width, middle - height / 2, middle + height / 2)
            if found:
                x, y, yaw = self.floor.on_wall(*found)
                with self.b.placed(x, y, middle, yaw=yaw):
                    decor.picture(self.b, self.look, self.rng, self.picture, width, height)
                self.picture += 1
