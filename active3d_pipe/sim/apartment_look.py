"""The materials of a generated apartment: what is shared by all rooms and what each room has for itself."""

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from active3d_pipe.sim import apartment_artwork as art
from active3d_pipe.sim import apartment_cloth as cloth_tex
from active3d_pipe.sim import apartment_textures as tex
from active3d_pipe.sim.apartment_mesh import Material
from active3d_pipe.sim.apartment_noise import pick_hue

WOODS = (
    ((0.33, 0.19, 0.10), (0.68, 0.46, 0.28)),
    ((0.52, 0.36, 0.20), (0.86, 0.70, 0.48)),
    ((0.20, 0.12, 0.08), (0.44, 0.29, 0.19)),
    ((0.45, 0.24, 0.13), (0.74, 0.45, 0.26)),
    ((0.48, 0.43, 0.36), (0.78, 0.73, 0.64)),
)


def hsv(h: float, s: float, v: float) -> tuple[float, float, float]:
    """Display colour of hue, saturation, value in 0..1."""
    return colorsys.hsv_to_rgb(h % 1.0, s, v)


@dataclass(frozen=True, eq=False)
class Shared:
    """Materials that all rooms share."""

    ceiling: Material
    trim: Material
    door: Material
    metal: Material
    iron: Material
    ceramic: Material
    marble: Material
    soil: Material
    leaf: Material
    leaf2: Material
    wicker: Material
    paper: Material
    spines: Material
    paintings: Material
    labels: Material
    view: Material
    screen: Material
    television: Material
    shell: Material
    vases: tuple[Material, ...]
    black: Material


@dataclass(frozen=True, eq=False)
class Look:
    """Materials of one room."""

    shared: Shared
    floor: Material
    wall: Material
    accent_wall: Material
    wood: Material
    wood2: Material
    paint: Material
    fabric: Material
    fabric2: Material
    fabric3: Material
    curtain: Material
    rug: Material
    shade: Material


def make_shared(rng: np.random.Generator) -> Shared:
    """Draw the shared materials."""
    dark, light = WOODS[int(rng.integers(len(WOODS)))]
    hue = pick_hue(rng)
    door = (
        Material("door", partial(tex.wood, dark=dark, light=light), 1.28, grain=True)
        if rng.random() < 0.5
        else Material("door", partial(tex.lacquer, colour=hsv(hue, 0.12, 0.86)), 1.28, grain=True)
    )
    vases = tuple(
        Material(
            f"vase_{k}",
            partial(
                tex.glaze,
                colour=hsv(pick_hue(rng), rng.uniform(0.05, 0.5), rng.uniform(0.6, 0.92)),
                second=hsv(pick_hue(rng), rng.uniform(0.3, 0.7), rng.uniform(0.35, 0.75)),
                bands=int(rng.integers(2, 14)),
            ),
            0.64,
            256,
        )
        for k in range(5)
    )
    return Shared(
        ceiling=Material("ceiling", partial(tex.plaster, colour=(0.90, 0.89, 0.86), strength=1.2), 2.56, 1024),
        trim=Material("trim", partial(tex.lacquer, colour=(0.90, 0.88, 0.83)), 1.28, grain=True),
        door=door,
        metal=Material("metal", partial(tex.brushed, colour=(0.68, 0.69, 0.71)), 0.64, 256, grain=True),
        iron=Material("iron", partial(tex.brushed, colour=(0.20, 0.19, 0.20)), 0.64, 256, grain=True),
        ceramic=Material("ceramic", partial(tex.plaster, colour=(0.90, 0.90, 0.88), strength=0.8), 1.28),
        marble=Material(
            "marble",
            partial(tex.marble, base=hsv(hue + 0.3, 0.06, rng.uniform(0.45, 0.9)), vein=hsv(hue, 0.25, 0.35)),
            1.28,
        ),
        soil=Material("soil", cloth_tex.earth, 0.32, 128),
        leaf=Material("leaf", partial(cloth_tex.leaf, dark=(0.07, 0.22, 0.07), light=(0.42, 0.60, 0.24)), 1.0, 256),
        leaf2=Material("leaf_2", partial(cloth_tex.leaf, dark=(0.16, 0.30, 0.20), light=(0.66, 0.74, 0.48)), 1.0, 256),
        wicker=Material("wicker", partial(cloth_tex.wicker, dark=(0.48, 0.32, 0.17), light=(0.84, 0.69, 0.47)), 0.64),
        paper=Material("paper", partial(tex.brushed, colour=(0.88, 0.84, 0.74)), 0.16, 128, grain=True),
        spines=Material("book_spines", art.spines, 1.0, 1024),
        paintings=Material("paintings", art.paintings, 1.0, 1024),
        labels=Material("labels", art.labels, 1.0, 1024),
        view=Material("window_view", art.view, 1.0, 1024),
        screen=Material("screen", art.screen, 1.0, 512),
        television=Material("television", art.broadcast, 1.0, 512),
        shell=Material("shell", partial(tex.plaster, colour=(0.7, 0.66, 0.6)), 2.56, 256),
        vases=vases,
        black=Material("plastic", partial(cloth_tex.leather, colour=(0.16, 0.16, 0.17)), 0.64, 256),
    )


def _floor(kind: str, tag: str, hue: float, rng: np.random.Generator) -> Material:
    dark, light = WOODS[int(rng.integers(len(WOODS)))]
    pick = rng.random()
    if kind in ("bath", "kitchen"):
        layout = "checker" if pick < 0.4 else "square"
        face, other = hsv(hue, rng.uniform(0.03, 0.15), 0.86), hsv(hue, rng.uniform(0.2, 0.45), rng.uniform(0.3, 0.6))
        if pick > 0.8:
            chips = [hsv(hue + 0.05, 0.5, 0.5), (0.25, 0.25, 0.27), (0.72, 0.6, 0.42), (0.95, 0.94, 0.92)]
            return Material(f"floor_{tag}", partial(tex.terrazzo, base=face, chips=chips), 1.92, 1024)
        return Material(
            f"floor_{tag}",
            partial(tex.tiles, face=face, other=other, grout=(0.5, 0.48, 0.45), count=8, layout=layout, veins=0.7),
            2.56,
            1024,
        )
    if pick < 0.35:
        return Material(f"floor_{tag}", partial(tex.parquet, dark=dark, light=light), 2.56, 1024)
    if pick > 0.85 and kind == "bedroom":
        return Material(
            f"floor_{tag}",
            partial(cloth_tex.carpet, colour=hsv(hue, 0.2, 0.6), second=hsv(hue + 0.1, 0.3, 0.42)),
            2.56,
            1024,
        )
    return Material(
        f"floor_{tag}", partial(tex.planks, dark=dark, light=light, contrast=rng.uniform(0.6, 1.2)), 2.56, 1024
    )


def _walls(kind: str, tag: str, hue: float, rng: np.random.Generator) -> tuple[Material, Material]:
    ground = hsv(hue, rng.uniform(0.06, 0.2), rng.uniform(0.8, 0.92))
    figure = hsv(hue + rng.uniform(-0.04, 0.04), rng.uniform(0.2, 0.38), rng.uniform(0.6, 0.78))
    accent = hsv(pick_hue(rng), rng.uniform(0.3, 0.5), rng.uniform(0.55, 0.75))
    if kind == "bath":
        layout = str(rng.choice(["brick", "mosaic", "square"]))
        wall = partial(
            tex.tiles,
            face=ground,
            other=figure,
            grout=(0.86, 0.86, 0.84),
            count=16 if layout != "mosaic" else 14,
            layout=layout,
        )
        other = partial(tex.tiles, face=figure, other=accent, grout=(0.86, 0.86, 0.84), count=14, layout="mosaic")
        return Material(f"wall_{tag}", wall, 2.56, 1024), Material(f"accent_{tag}", other, 1.28, 512)
    pattern = str(rng.choice(["damask", "stripes", "floral", "lattice", "leaves"]))
    paper = partial(
        cloth_tex.wallpaper,
        ground=ground,
        figure=figure,
        accent=accent,
        pattern=pattern,
        repeat=int(rng.integers(5, 9)),
    )
    if kind == "kitchen":
        paper = partial(
            tex.tiles, face=hsv(hue, 0.08, 0.9), other=figure, grout=(0.6, 0.58, 0.55), count=18, layout="brick"
        )
    plain = partial(tex.plaster, colour=ground, strength=1.2)
    papered = Material(f"accent_{tag}", paper, 2.56, 1024)
    if kind != "kitchen" and rng.random() < 0.45:
        return papered, Material(
            f"wall_{tag}", partial(tex.plaster, colour=hsv(hue, 0.28, 0.74), strength=1.2), 2.56, 1024
        )
    return Material(f"wall_{tag}", plain, 2.56, 1024), papered


def make_look(kind: str, tag: str, hue: float, shared: Shared, rng: np.random.Generator) -> Look:
    """Draw the materials of one room; `tag` makes their names unique, `hue` sets its colour."""
    first, second = rng.choice(len(WOODS), 2, replace=False)
    wall, accent = _walls(kind, tag, hue, rng)
    patterns: Sequence[str] = [str(p) for p in rng.permutation(["stripes", "plaid", "dots", "zigzag"])]

    def cloth(name: str, pattern: str, h: float, s: float, v: float) -> Material:
        light = hsv(h if rng.random() < 0.5 else pick_hue(rng), rng.uniform(0.08, 0.3), rng.uniform(0.75, 0.92))
        return Material(
            f"{name}_{tag}", partial(cloth_tex.weave, colour=hsv(h, s, v), second=light, pattern=pattern), 0.768
        )

    warm = max((pick_hue(rng) for _ in range(3)), key=lambda h: min(abs(h - hue) % 1, 1 - abs(h - hue) % 1))
    sofa = (
        Material(
            f"fabric_{tag}",
            partial(cloth_tex.leather, colour=hsv(rng.uniform(0.02, 0.08), 0.6, rng.uniform(0.3, 0.6))),
            1.28,
        )
        if kind in ("living", "study") and rng.random() < 0.3
        else cloth("fabric", "plain", warm, rng.uniform(0.25, 0.5), rng.uniform(0.4, 0.75))
    )
    rug = partial(
        art.rug,
        ground=hsv(warm, rng.uniform(0.4, 0.65), rng.uniform(0.35, 0.6)),
        figure=hsv(pick_hue(rng), rng.uniform(0.3, 0.5), rng.uniform(0.3, 0.5)),
        accent=hsv(0.11, 0.35, 0.84),
    )
    return Look(
        shared=shared,
        floor=_floor(kind, tag, hue, rng),
        wall=wall,
        accent_wall=accent,
        wood=Material(f"wood_{tag}", partial(tex.wood, dark=WOODS[first][0], light=WOODS[first][1]), 1.28, grain=True),
        wood2=Material(
            f"wood2_{tag}", partial(tex.wood, dark=WOODS[second][0], light=WOODS[second][1]), 1.28, grain=True
        ),
        paint=Material(
            f"paint_{tag}",
            partial(
                tex.lacquer,
                colour=hsv(hue if rng.random() < 0.5 else warm, rng.uniform(0.08, 0.4), rng.uniform(0.55, 0.88)),
            ),
            1.28,
            grain=True,
        ),
        fabric=sofa,
        fabric2=cloth("fabric2", patterns[0], hue + 0.03, rng.uniform(0.35, 0.6), rng.uniform(0.4, 0.7)),
        fabric3=cloth("fabric3", patterns[1], pick_hue(rng), rng.uniform(0.35, 0.65), rng.uniform(0.45, 0.75)),
        curtain=cloth(
            "curtain", patterns[2], hue if rng.random() < 0.4 else warm, rng.uniform(0.2, 0.45), rng.uniform(0.5, 0.75)
        ),
        rug=Material(f"rug_{tag}", rug, 1.0, 768),
        shade=cloth("shade", "plain", 0.11, 0.18, 0.92),
    )
