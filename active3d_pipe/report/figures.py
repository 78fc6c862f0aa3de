"""The charts: floor plan, curves, fusion, predicted and realised gain, time."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from active3d_pipe.report.data import Curve, DecisionRow, FloorPlan, FusionHistory, ReportData, Timing
from active3d_pipe.report.style import FREE, GREEN, INK, MARKERS, MUTED, SERIES, SKY, UNKNOWN, VERMILION, draw

PLAN_COLORS = ListedColormap([FREE, UNKNOWN, "#52606d"])
MAX_MARKS = 40  # goals that are numbered, headings that are drawn


def floor_plan(data: ReportData, scale: float) -> str:
    """Trajectory over the occupancy slice, with keyframes, goals, start and end."""
    poses = data.trajectory
    positions = np.zeros((0, 3)) if poses is None else np.asarray(poses)[:, :3, 3]
    low, high = _plan_bounds(data, positions)
    aspect = (high[1] - low[1]) / max(high[0] - low[0], 1e-6)
    width = 9.2
    height = float(np.clip(0.86 * width * aspect + 1.1, 3.4, 9.5))

    def paint(figure: Figure) -> None:
        axes = figure.add_subplot()
        if data.floor_plan is not None:
            _paint_plan(axes, data.floor_plan)
        if len(positions):
            _paint_track(figure, axes, np.asarray(poses), positions)
        if data.keyframes is not None and len(data.keyframes):
            k = np.asarray(data.keyframes)
            axes.scatter(k[:, 0], k[:, 1], s=16, facecolor="white", edgecolor=INK, linewidth=0.8, zorder=4,
                         label=f"keyframes ({len(k)})")
        if data.goals is not None and len(data.goals):
            _paint_goals(axes, np.asarray(data.goals))
        if len(positions):
            ends = ((-1, "s", 150, VERMILION, "end"), (0, "^", 70, GREEN, "start"))
            for i, marker, size, color, label in ends:
                x, y = positions[i, :2]
                axes.scatter(x, y, marker=marker, s=size, color=color, edgecolor="white", zorder=6, label=label)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x [m]", ylabel="y [m]")
        axes.set_aspect("equal")
        axes.grid(False)
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=5)

    return draw(width, height, paint, scale, "Trajectory over the floor plan")


def _plan_bounds(data: ReportData, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    corners = [positions[:, :2]] if len(positions) else []
    if data.floor_plan is not None:
        plan = data.floor_plan
        known = np.argwhere(np.abs(plan.occupancy - 0.5) > 0.1)
        if len(known):  # the grid's unknown margin only wastes space
            corners.append(np.asarray(plan.origin)[:2] + plan.voxel_size * (known + 0.5))
        elif not len(positions):
            x0, x1, y0, y1 = plan.extent
            corners.append(np.array([[x0, y0], [x1, y1]]))
    points = np.concatenate(corners) if corners else np.array([[0.0, 0.0], [1.0, 1.0]])
    return points.min(axis=0) - 0.3, points.max(axis=0) + 0.3


def _paint_plan(axes: Axes, plan: FloorPlan) -> None:
    states = np.digitize(np.nan_to_num(plan.occupancy, nan=0.5), [0.4, 0.6])
    axes.set_facecolor(UNKNOWN)
    axes.imshow(states.T, origin="lower", extent=plan.extent, cmap=PLAN_COLORS, vmin=0, vmax=2, interpolation="nearest")
    for color, label in ((FREE, "free"), (UNKNOWN, "unknown"), ("#52606d", "occupied")):
        axes.scatter([], [], marker="s", s=60, facecolor=color, edgecolor=MUTED, linewidth=0.5, label=label)


def _paint_track(figure: Figure, axes: Axes, poses: np.ndarray, positions: np.ndarray) -> None:
    segments = np.stack([positions[:-1, :2], positions[1:, :2]], axis=1)
    track = LineCollection(list(segments), cmap="viridis", linewidth=2.2, zorder=3, capstyle="round")
    track.set_array(np.arange(len(segments)))
    axes.add_collection(track)
    every = max(1, len(poses) // MAX_MARKS)
    heading = poses[::every, :2, 2]
    axes.quiver(
        positions[::every, 0], positions[::every, 1], heading[:, 0], heading[:, 1], color=MUTED, width=0.0022,
        scale=45, headwidth=4, zorder=3.5, alpha=0.7,
    )
    if len(segments):
        figure.colorbar(track, ax=axes, shrink=0.75, pad=0.02, label="exploration step")


def _paint_goals(axes: Axes, goals: np.ndarray) -> None:
    axes.scatter(goals[:, 0], goals[:, 1], marker="x", s=42, color=VERMILION, linewidth=1.6, zorder=5,
                 label=f"chosen views ({len(goals)})")
    every = max(1, len(goals) // MAX_MARKS)
    for i in range(0, len(goals), every):
        place = (goals[i, 0], goals[i, 1])
        axes.annotate(str(i), place, xytext=(4, 4), textcoords="offset points", fontsize=7, color=INK, zorder=7)


def curves(series: Sequence[Curve], scale: float) -> str:
    """Small multiples over exploration steps, one panel for every `panel` name, in order of appearance."""
    panels = list(dict.fromkeys(c.panel for c in series))
    columns = min(3, len(panels))
    rows = -(-len(panels) // columns)

    def paint(figure: Figure) -> None:
        all_axes = figure.subplots(rows, columns, squeeze=False, sharex=True).ravel()
        for axes, panel in zip(all_axes, panels):
            _paint_curves(axes, panel, [c for c in series if c.panel == panel])
        for axes in all_axes[len(panels):]:
            axes.set_axis_off()
        for i in range(len(panels)):
            if i + columns >= len(panels):
                all_axes[i].set_xlabel("exploration step")
                all_axes[i].tick_params(labelbottom=True)

    return draw(3.8 * columns if columns > 1 else 6.0, 2.5 * rows, paint, scale, "Curves over exploration steps")


def _paint_curves(axes: Axes, panel: str, series: Sequence[Curve]) -> None:
    percent = series[0].unit == "%"
    for i, curve in enumerate(series):
        y = np.array([np.nan if v is None else v for v in curve.values], dtype=np.float64) * (100 if percent else 1)
        few = MARKERS[i % len(MARKERS)] if len(y) <= 40 else None
        axes.plot(curve.steps, y, color=SERIES[i % len(SERIES)], marker=few, markersize=3.5, label=curve.label)
    unit = "" if series[0].unit in ("", "1") else f" [{series[0].unit}]"
    axes.set_title(panel + unit)
    axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.margins(y=0.12)
    if percent:
        axes.set_ylim(0, 104)
    else:
        axes.yaxis.set_major_formatter(lambda v, _: f"{v:,.0f}".replace(",", "\u202f") if abs(v) >= 1000 else f"{v:g}")
    if len(series) > 1:
        axes.legend(fontsize=8)


def fusion(history: FusionHistory, scale: float) -> str:
    """Weights alpha of the three terms over rounds, and the evidence and noise of every fit."""
    extra = [(n, v) for n, v in (("Log evidence", history.evidence), ("Noise of the fit", history.noise)) if len(v)]

    def paint(figure: Figure) -> None:
        ratios = [2.0] + [1.0] * len(extra)
        axes = np.atleast_1d(figure.subplots(1, 1 + len(extra), width_ratios=ratios))
        labels = ("implicit  α₁", "explicit  α₂", "temporal  α₃")
        for i, label in enumerate(labels):
            axes[0].plot(history.rounds, np.asarray(history.alphas)[:, i], color=SERIES[i], marker=MARKERS[i],
                         markersize=4, label=label)
        axes[0].set_title("Fusion weights")
        axes[0].legend(ncols=3, fontsize=8)
        axes[0].margins(y=0.2)
        for panel, (name, values) in zip(axes[1:], extra):
            y = np.array([np.nan if v is None else v for v in values], dtype=np.float64)
            panel.plot(history.rounds, y, color=INK, marker=".")
            panel.set_title(name)
        for panel in axes:
            panel.set_xlabel("round")
            panel.xaxis.set_major_locator(MaxNLocator(6, integer=True))

    return draw(11.4 if extra else 7.0, 2.8, paint, scale, "Fusion weights over rounds")


def gains(rows: Sequence[DecisionRow], scale: float) -> str:
    """Predicted gain of both branches, stacked, beside the realised one, for every decision; both against each other
    where the outcome is known by branch."""
    rounds = np.array([r.round for r in rows])
    imp, exp, real = (
        np.array([np.nan if v is None else v for v in column], dtype=np.float64)
        for column in zip(*((r.gain_imp_bits, r.gain_exp_bits, r.realised_bits) for r in rows))
    )

    outcomes = [
        (r.gain_imp_bits, r.realised_imp_bits, r.gain_exp_bits, r.realised_exp_bits)
        for r in rows
        if None not in (r.gain_imp_bits, r.realised_imp_bits, r.gain_exp_bits, r.realised_exp_bits)
    ]

    def paint(figure: Figure) -> None:
        axes = figure.add_subplot(1, 1, 1)
        if len(outcomes) > 2:
            figure.clear()
            axes, compared = figure.subplots(1, 2, width_ratios=[3, 1])
            _paint_outcomes(compared, np.array(outcomes, dtype=np.float64))
        base = np.nan_to_num(imp)
        axes.bar(rounds, base, width=0.75, color=SERIES[0], label="predicted, implicit branch")
        axes.bar(rounds, np.nan_to_num(exp), width=0.75, bottom=base, color=SKY, label="predicted, explicit branch")
        if np.isfinite(real).any():
            axes.plot(rounds, real, color=VERMILION, marker="D", markersize=4, linewidth=1.2, label="realised")
        axes.set_title("Information gain of every decision [bit]")
        axes.set_xlabel("round")
        axes.xaxis.set_major_locator(MaxNLocator(12, integer=True))
        axes.legend(fontsize=8, ncols=3)
        axes.margins(y=0.2)

    return draw(11.4, 2.9, paint, scale, "Predicted and realised information gain")


def _paint_outcomes(axes: Axes, outcomes: np.ndarray) -> None:
    """Realised over predicted bits of every decision (N, 4), one mark for each branch; on the diagonal it came true."""
    for i, (label, color, marker) in enumerate((("implicit", SERIES[0], "o"), ("explicit", SKY, "^"))):
        predicted, realised = outcomes[:, 2 * i], outcomes[:, 2 * i + 1]
        ranks = [np.argsort(np.argsort(a)) for a in (predicted, realised)]
        rank = float(np.atleast_2d(np.corrcoef(np.stack(ranks)))[0, 1])
        axes.scatter(predicted, realised, s=14, color=color, marker=marker, label=f"{label}, rank corr. {rank:.2f}")
    top = float(outcomes.max())
    axes.plot([0, top], [0, top], color=MUTED, linewidth=0.8)
    axes.set(title="Came true?", xlabel="predicted [bit]", ylabel="realised [bit]")
    axes.legend(fontsize=7)


def timings(rows: Sequence[Timing], scale: float) -> str:
    """One bar for every stage, stacked by module."""
    stages = list(dict.fromkeys(r.stage for r in rows))
    total = sum(r.seconds for r in rows) or 1.0
    longest = max(sum(r.seconds for r in rows if r.stage == stage) for stage in stages)

    def paint(figure: Figure) -> None:
        axes = figure.add_subplot()
        for y, stage in enumerate(stages):
            left = 0.0
            mine = [r for r in rows if r.stage == stage]
            for i, r in enumerate(mine):
                axes.barh(y, r.seconds, left=left, height=0.62, color=SERIES[i % len(SERIES)], edgecolor="white")
                if r.seconds > 0.009 * longest * (len(r.module) + 2):  # the name fits into its bar
                    axes.text(left + r.seconds / 2, y, r.module, ha="center", va="center", color="white", fontsize=8)
                left += r.seconds
            axes.text(left, y, f"  {left:.1f} s, {100 * left / total:.0f} %", va="center", fontsize=8.5)
        axes.set_yticks(range(len(stages)), stages)
        axes.tick_params(axis="y", labelcolor=INK)
        axes.invert_yaxis()
        axes.grid(axis="y", visible=False)
        axes.set_xlabel("wall time of the whole run [s]")
        axes.margins(x=0.14)

    return draw(11.4, 0.42 * len(stages) + 0.9, paint, scale, "Wall time by stage and module")
