"""Curves of completion over steps and over walked metres: one line a variant, a band for the spread over seeds."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from active3d_pipe.report.comparison import Result
from active3d_pipe.report.style import RC, SERIES

SAMPLES = 200
STYLES = ("-", "--", ":")
AXES = ((0, "exploration step"), (1, "path length [m]"))


def band(curves: Sequence[np.ndarray], column: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Mean, lowest and highest completion ratio (percent) of several runs on common abscissae.

    `curves` (P, 3) each: step, metres, completion. A run that has stopped keeps its last value; the common range
    begins where every run has one and ends where the longest does.
    """
    start, end = max(c[0, column] for c in curves), max(c[-1, column] for c in curves)
    x = np.linspace(start, max(end, start), SAMPLES)
    y = np.stack([100 * np.interp(x, c[:, column], c[:, 2]) for c in curves])
    return x, y.mean(axis=0), y.min(axis=0), y.max(axis=0)


def completion_figure(results: Sequence[Result], labels: Mapping[str, str]) -> Figure | None:
    """One row for every scene, two columns: over steps and over metres. None when there is no curve."""
    drawn = [r for r in results if len(r.curve)]
    scenes = list(dict.fromkeys(r.scene for r in drawn))
    if not scenes:
        return None
    figure = Figure(figsize=(11.4, 3.3 * len(scenes) + 0.5), layout="constrained")
    axes = figure.subplots(len(scenes), 2, squeeze=False, sharey="row")
    for row, scene in enumerate(scenes):
        for (column, label), panel in zip(AXES, axes[row], strict=True):
            _panel(panel, [r for r in drawn if r.scene == scene], labels, column)
            panel.set_xlabel(label)
        axes[row][0].set_title(scene)
        axes[row][0].set_ylabel("completion ratio, observable [%]")
    figure.legend(*axes[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)
    return figure


def _panel(axes: Axes, results: Sequence[Result], labels: Mapping[str, str], column: int) -> None:
    for i, (variant, label) in enumerate(labels.items()):
        curves = [r.curve for r in results if r.variant == variant and np.isfinite(r.curve[:, column]).all()]
        color, style = SERIES[i % len(SERIES)], STYLES[i // len(SERIES) % len(STYLES)]
        if not curves:
            axes.plot([], [], color=color, linestyle=style, label=f"{label} (none)")
            continue
        x, mean, low, high = band(curves, column)
        axes.plot(x, mean, color=color, linestyle=style, label=label)
        if len(curves) > 1:
            axes.fill_between(x, low, high, color=color, alpha=0.15, linewidth=0)
    axes.set_ylim(top=min(axes.get_ylim()[1], 100.5))


def write_figure(results: Sequence[Result], labels: Mapping[str, str], folder: Path) -> list[Path]:
    """Write `completion.png` and `completion.svg`; the files that were written. Same input, same bytes."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update({**RC, "svg.hashsalt": "active3d"})
        figure = completion_figure(results, labels)
        if figure is None:
            return []
        figure.savefig(folder / "completion.png", dpi=150, metadata={"Software": None})
        figure.savefig(folder / "completion.svg", metadata={"Date": None})
    return [folder / "completion.png", folder / "completion.svg"]
