"""Colours, chart style and the encoding of pictures into the page."""

import base64
import io
from collections.abc import Callable
from html import escape
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from PIL import Image

# Okabe and Ito's palette, distinguishable with every common colour vision deficiency.
BLUE, ORANGE, GREEN, VERMILION, PURPLE, SKY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9"
SERIES = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY)
MARKERS = ("o", "s", "^", "D", "v", "P")
INK, MUTED, RULE, FREE, UNKNOWN = "#1f2933", "#616e7c", "#d9dee5", "#ffffff", "#e4e7eb"

RC: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.titlepad": 8,
    "axes.labelcolor": MUTED,
    "axes.edgecolor": RULE,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": RULE,
    "grid.linewidth": 0.6,
    "text.color": INK,
    "axes.titlecolor": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.major.size": 0,
    "ytick.major.size": 0,
    "lines.linewidth": 1.8,
    "legend.frameon": False,
    "figure.facecolor": "white",
}

CSS_DPI = 96


def draw(width: float, height: float, paint: Callable[[Figure], None], scale: float, alt: str) -> str:
    """An <img> of a chart `width` x `height` inches, painted by `paint(figure)` in the page's style.

    The drawing depends on nothing outside this call: no pyplot, no user style, no date in the file.
    """
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(RC)
        figure = Figure(figsize=(width, height), layout="constrained")
        paint(figure)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=CSS_DPI * scale, metadata={"Software": None})
    with Image.open(io.BytesIO(buffer.getvalue())) as image:
        # Flat charts lose nothing visible in 256 colours and shrink to a third.
        packed = image.convert("RGB").quantize(256, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
        out = io.BytesIO()
        packed.save(out, format="PNG", optimize=True)
    return img_tag("png", out.getvalue(), alt, width=round(width * CSS_DPI))


def photo(image: np.ndarray, max_width: int, quality: int, alt: str) -> str:
    """An <img> of a picture (H, W, 3) uint8, shrunk to `max_width` px where it is wider."""
    picture = Image.fromarray(np.ascontiguousarray(image[..., :3], dtype=np.uint8))
    if picture.width > max_width:
        height = max(1, round(picture.height * max_width / picture.width))
        picture = picture.resize((max_width, height), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    picture.save(buffer, format="JPEG", quality=quality, optimize=True, subsampling=0)
    return img_tag("jpeg", buffer.getvalue(), alt)


def img_tag(kind: str, data: bytes, alt: str, width: int | None = None) -> str:
    """An <img> whose data stand in the page itself."""
    size = f' width="{width}"' if width else ""
    text = base64.b64encode(data).decode()
    return f'<img alt="{escape(alt, quote=True)}"{size} src="data:image/{kind};base64,{text}">'


def colorize(values: np.ndarray, cmap: str, low: float, high: float, invalid: np.ndarray | None = None) -> np.ndarray:
    """(H, W, 3) uint8 picture of a map, clipped to [low, high]; `invalid` pixels are light grey."""
    scaled = np.clip((np.nan_to_num(values) - low) / max(high - low, 1e-12), 0, 1)
    rgb = (matplotlib.colormaps[cmap](scaled)[..., :3] * 255 + 0.5).astype(np.uint8)
    bad = ~np.isfinite(values) if invalid is None else invalid | ~np.isfinite(values)
    rgb[bad] = tuple(int(UNKNOWN[i : i + 2], 16) for i in (1, 3, 5))
    return rgb


def nice_number(value: float | None, digits: int = 3) -> str:
    """A short number for people: 3 significant digits, integers in full, thousands grouped, an en dash for None."""
    if value is None or not np.isfinite(value):
        return "–"
    if isinstance(value, int | np.integer):
        return f"{value:,}".replace(",", "\u202f")
    if value == 0:
        return "0"
    if abs(value) >= 1000:
        return f"{value:,.0f}".replace(",", "\u202f")  # narrow no-break space
    if abs(value) < 1e-3:
        return f"{value:.1e}"
    decimals = max(0, digits - 1 - int(np.floor(np.log10(abs(value)))))
    return f"{value:.{min(decimals, 4)}f}"
