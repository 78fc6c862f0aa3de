"""Pictures that carry a colour scale: held-out views with their errors, and slices of the volumes."""

from collections.abc import Sequence
from html import escape

import matplotlib
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

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


def spread(items: Sequence, count: int) -> list:
    """At most `count` items, evenly chosen, first and last included."""
    if len(items) <= count:
        return list(items)
    places = np.unique(np.linspace(0, len(items) - 1, count).round().astype(int)) if count > 0 else ()
    return [items[p] for p in places]


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
    """One row for every volume, rounds as columns, one colour scale a row."""
    shown = [(s, spread(list(s.rounds), settings.max_rounds)) for s in series if len(s.rounds)]
    columns = max(len(rounds) for _, rounds in shown)
    rows, cols = _known_window([a for _, rounds in shown for _, a in rounds])
    first = shown[0][1][0][1]
    extent = (0.0, float(first.shape[0]), 0.0, float(first.shape[1]))
    if plan is not None and plan.occupancy.shape == first.shape:
        extent = plan.extent
    unit = "m" if plan is not None and plan.occupancy.shape == first.shape else "voxel"
    step = (extent[1] - extent[0]) / first.shape[0]
    limits = (extent[0] + rows.start * step, extent[0] + rows.stop * step,
              extent[2] + cols.start * step, extent[2] + cols.stop * step)
    cell_w = 10.2 / columns
    cell_h = float(np.clip(cell_w * (limits[3] - limits[2]) / (limits[1] - limits[0]), 0.6, 2.6))

    def paint(figure: Figure) -> None:
        grid = figure.subplots(len(shown), columns, squeeze=False, sharex=True, sharey=True)
        for line, (s, rounds) in zip(grid, shown):
            low, high = _range([a[rows, cols] for _, a in rounds])
            colours = matplotlib.colormaps["gray_r" if s.name == "occupancy" else "viridis"].with_extremes(bad=UNKNOWN)
            picture = None
            for axes, (number, array) in zip(line, rounds):
                picture = axes.imshow(array.T, origin="lower", extent=extent, cmap=colours, vmin=low, vmax=high,
                                      interpolation="nearest")
                axes.set(xlim=limits[:2], ylim=limits[2:])
                axes.grid(False)
                axes.tick_params(labelsize=6.5)
                if line is grid[0]:
                    axes.set_title(f"round {number}", fontsize=8.5)
            for axes in line[len(rounds):]:
                axes.set_axis_off()
            line[0].set_ylabel(f"{s.name}\ny [{unit}]", color="#1f2933", fontsize=8.5)
            if picture is not None:
                bar = figure.colorbar(picture, ax=list(line), fraction=0.03, pad=0.01, aspect=14)
                bar.set_label(f"[{s.unit}]" if s.unit not in ("", "1") else "", fontsize=7.5)
                bar.ax.tick_params(labelsize=6.5)
        for axes in grid[-1]:
            axes.set_xlabel(f"x [{unit}]", fontsize=7.5)

    height = (cell_h + 0.16) * len(shown) + 0.55
    return draw(11.4, height, paint, settings.figure_scale, "Slices of the volumes over rounds")


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
