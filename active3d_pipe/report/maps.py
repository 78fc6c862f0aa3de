"""Pictures that carry a colour scale: held-out views with their errors, and slices of the volumes."""

from collections.abc import Sequence
from html import escape

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from active3d_pipe.geometry.sampling import spread
from active3d_pipe.report.config import ReportSettings
from active3d_pipe.report.data import FloorPlan, HeldOutView, SliceSeries
from active3d_pipe.report.style import UNKNOWN, colorize, draw, photo

ERROR_MAP, DEPTH_MAP = "magma", "viridis"


def views_section(views: Sequence[HeldOutView], settings: ReportSettings) -> str:
    """Truth, render and error of every view in one row; depths in a row that unfolds; shared scales below."""
    views = spread(views, settings.max_views)
    deepest = max((_deepest(v) for v in views), default=0.0)
    parts = [_colour_scales(settings, deepest)]
    for i, view in enumerate(views):
        parts.append(_view(view, settings, deepest, unfold=i == 0))
    return "\n".join(parts)


def _deepest(view: HeldOutView) -> float:
    depth = view.truth_depth
    return 0.0 if depth is None or not (depth > 0).any() else float(np.percentile(depth[depth > 0], 99))


def _view(view: HeldOutView, settings: ReportSettings, deepest: float, *, unfold: bool) -> str:
    invalid = None if view.truth_depth is None else ~(view.truth_depth > 0)
    error = np.abs(view.truth_rgb.astype(np.float32) - view.render_rgb).mean(axis=2) / 255
    error_map = colorize(error, ERROR_MAP, 0, settings.color_error_scale, invalid)
    label = escape(view.label)
    row = [
        _cell(view.truth_rgb, "truth", label, settings),
        _cell(view.render_rgb, "render", label, settings),
        _cell(error_map, "colour error", label, settings),
    ]
    html = f'<h3>{label}</h3>\n<div class="triple">{"".join(row)}</div>'
    if view.truth_depth is None or view.render_depth is None or invalid is None:
        return html
    difference = np.abs(view.render_depth - view.truth_depth)
    pictures = {
        "true depth": colorize(view.truth_depth, DEPTH_MAP, 0, deepest, invalid),
        "rendered depth": colorize(view.render_depth, DEPTH_MAP, 0, deepest, view.render_depth <= 0),
        "depth error": colorize(difference, ERROR_MAP, 0, settings.depth_error_scale_m, invalid),
    }
    row = [_cell(image, what, label, settings) for what, image in pictures.items()]
    state = " open" if unfold else ""
    return html + f'\n<details{state}><summary>Depth</summary><div class="triple">{"".join(row)}</div></details>'


def _cell(image: np.ndarray, what: str, label: str, settings: ReportSettings) -> str:
    tag = photo(image, settings.image_width_px, settings.jpeg_quality, f"{what}, {label}")
    return f"<figure>{tag}<figcaption>{what}</figcaption></figure>"


def _colour_scales(settings: ReportSettings, deepest: float) -> str:
    bars = [("colour error, mean of channels (0..1)", ERROR_MAP, settings.color_error_scale)]
    if deepest > 0:
        bars.append(("depth [m]", DEPTH_MAP, deepest))
        bars.append(("depth error [m]", ERROR_MAP, settings.depth_error_scale_m))

    def paint(figure: Figure) -> None:
        for axes, (label, cmap, top) in zip(np.atleast_1d(figure.subplots(1, 3)), bars):
            figure.colorbar(
                ScalarMappable(Normalize(0, top), cmap), cax=axes, orientation="horizontal", label=label,
                extend="max",
            )
        for axes in figure.axes[len(bars):3]:
            axes.set_axis_off()

    scales = draw(11.4, 0.62, paint, settings.figure_scale, "Colour scales of the maps below")
    return f'<div class="scales">{scales}</div>'


def slices_figure(series: Sequence[SliceSeries], plan: FloorPlan | None, settings: ReportSettings) -> str:
    """One row for every volume, rounds as columns, one colour scale a row, x to the right and y up."""
    shown = [(s, spread(list(s.rounds), settings.max_rounds)) for s in series if len(s.rounds)]
    columns = max(len(rounds) for _, rounds in shown)
    window = _known_window([a for _, rounds in shown for _, a in rounds])
    width, height = (w.stop - w.start for w in window)
    gap = max(1, round(0.05 * width))
    total = columns * width + (columns - 1) * gap
    left, right, top, bottom = 0.95, 0.85, 0.3, 0.42  # margins, inches
    cell_h = float(np.clip((11.4 - left - right) * height / total, 0.5, 2.6))
    row_w = cell_h * total / height
    figure_w, figure_h = left + row_w + right, top + bottom + len(shown) * (cell_h + 0.14)

    def paint(figure: Figure) -> None:
        figure.set_layout_engine("none")
        for n, (s, rounds) in enumerate(shown):
            low, high = _range([a[window] for _, a in rounds])
            y = figure_h - top - (n + 1) * cell_h - n * 0.14
            axes = figure.add_axes((left / figure_w, y / figure_h, row_w / figure_w, cell_h / figure_h))
            mosaic = np.full((total, height, 4), 1.0)
            colours = matplotlib.colormaps["gray_r" if s.name == "occupancy" else "viridis"].with_extremes(bad=UNKNOWN)
            scale = ScalarMappable(Normalize(low, high), colours)
            for k, (number, array) in enumerate(rounds):
                start = k * (width + gap)
                mosaic[start : start + width] = scale.to_rgba(np.ma.masked_invalid(array[window]))
                if n == 0:
                    place = start + width / 2, height * (1 + 0.12 / cell_h)
                    axes.text(*place, f"round {number}", ha="center", fontsize=8.5)
            axes.imshow(mosaic.swapaxes(0, 1), origin="lower", extent=(0, total, 0, height), interpolation="nearest")
            axes.set_axis_off()
            place = (left - 0.1) / figure_w, (y + cell_h / 2) / figure_h
            figure.text(*place, s.name, ha="right", va="center", fontsize=9)
            bar = figure.add_axes(((left + row_w + 0.12) / figure_w, y / figure_h, 0.1 / figure_w, cell_h / figure_h))
            figure.colorbar(scale, cax=bar)
            bar.tick_params(labelsize=7)
            if s.unit not in ("", "1"):
                bar.set_ylabel(f"[{s.unit}]", fontsize=7.5)
            if n == len(shown) - 1:
                _scale_bar(figure, axes, width, plan)

    return draw(figure_w, figure_h, paint, settings.figure_scale, "Slices of the volumes over rounds")


def _scale_bar(figure: Figure, axes: Axes, width: int, plan: FloorPlan | None) -> None:
    """A bar of a round number of metres (voxels where the grid is not known) under the first slice."""
    size = plan.voxel_size if plan is not None else 1.0
    length = max((v for v in (0.5, 1, 2, 5, 10, 20, 50, 100) if v <= 0.5 * width * size), default=0.5 * width * size)
    unit = "m" if plan is not None else "voxels"
    inch = axes.get_position().height * figure.get_figheight()
    y = -0.1 * axes.get_ylim()[1] / inch
    axes.plot([0, length / size], [y, y], color="#1f2933", linewidth=2, clip_on=False, solid_capstyle="butt")
    axes.text(length / size, y, f"  {length:g} {unit}", va="center", fontsize=8, clip_on=False)
    axes.set_ylim(0, axes.get_ylim()[1])


def _known_window(arrays: Sequence[np.ndarray]) -> tuple[slice, slice]:
    """Rows and columns outside which every map is constant or unknown, with a margin of one voxel."""
    stack = np.stack([np.nan_to_num(a, nan=-1.0) for a in arrays])
    differs = (stack != stack[:, :1, :1]).any(axis=0)
    if not differs.any():
        return slice(0, stack.shape[1]), slice(0, stack.shape[2])
    i, j = np.nonzero(differs)
    return (slice(max(int(i.min()) - 1, 0), min(int(i.max()) + 2, stack.shape[1])),
            slice(max(int(j.min()) - 1, 0), min(int(j.max()) + 2, stack.shape[2])))


def _range(arrays: Sequence[np.ndarray]) -> tuple[float, float]:
    """Shared colour range of a row: from 0 (or the least value) to the 99th percentile of all rounds."""
    values = np.concatenate([a[np.isfinite(a)].ravel() for a in arrays])
    if len(values) == 0:
        return 0.0, 1.0
    low, high = min(0.0, float(values.min())), float(np.percentile(values, 99))
    return low, high if high > low else low + 1.0
