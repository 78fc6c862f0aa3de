"""HTML tables: the metrics laid out by form, decisions, timings, key-value lists."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from active3d_pipe.report.data import DecisionRow, Metric, Timing
from active3d_pipe.report.style import nice_number

# (heading, rows: base name -> label, columns: suffix -> heading). A name is base + suffix.
Layout = tuple[str, dict[str, str], dict[str, str]]
LAYOUTS: tuple[Layout, ...] = (
    (
        "Geometry",
        {
            "accuracy_cm": "Accuracy: reconstruction to truth, mean", "accuracy_median_cm": "Accuracy, median",
            "completion_cm": "Completion: truth to reconstruction, mean", "completion_median_cm": "Completion, median",
            "completion_ratio": "Completion ratio within the threshold", "precision": "Precision within the threshold",
            "fscore": "F-score",
        },
        {
            "_surface": "surface", "_surface_observable": "surface, observable",
            "_surface_unculled": "surface, unculled",
            "_p2p": "point to point", "_p2p_floor": "its floor",
            "_density": "fixed density", "_density_floor": "its floor ",
        },
    ),
    (
        "Views",
        {
            "psnr": "PSNR, mean", "psnr_median": "PSNR, median", "psnr_p10": "PSNR, worst tenth",
            "ssim": "SSIM, plain", "ms_ssim": "MS-SSIM", "lpips": "LPIPS, AlexNet", "depth_l1_cm": "Depth error, mean",
            "depth_median_cm": "Depth error, median", "rendered_share": "Pixels rendered",
            "num_views": "Number of views",
        },
        {"": "held-out", "_circle": "circle", "_train": "captured frames"},
    ),
)
STATISTICS = ("_median", "_p10")  # of the psnr rows: their suffix comes after the view set's
DECIMALS = {"cm": 2, "dB": 2, "m": 2, "m²": 1, "s": 2, "MB": 0}
COUNTS = ("num_views", "steps", "rounds", "collisions", "keyframes", "gaussians")


def value_text(metric: Metric, name: str = "") -> str:
    """A metric for people, with its unit; an en dash when it was not measured."""
    if metric.value is None:
        return "–"
    if metric.unit == "%":
        return f"{100 * metric.value:.1f} %"
    if any(name.startswith(c) for c in COUNTS):
        return nice_number(round(metric.value))
    decimals = DECIMALS.get(metric.unit)
    text = nice_number(metric.value) if decimals is None else f"{metric.value:.{decimals}f}"
    return f"{text} {metric.unit}".strip()


def metrics_tables(metrics: Mapping[str, Metric]) -> str:
    """The evaluation's metrics as one table for geometry and one for views; the rest as a list."""
    used: set[str] = set()
    parts = [_layout_table(layout, metrics, used) for layout in LAYOUTS]
    rest = {name: m for name, m in metrics.items() if name not in used}
    if rest:
        rows = [
            f"<tr><th scope=row><code>{escape(name)}</code></th><td class=num>{escape(value_text(m, name))}</td>"
            f"<td>{escape(m.explanation)}{_arrow(m)}{_note(m)}</td></tr>"
            for name, m in rest.items()
        ]
        parts.append(
            "<h3>Run</h3><table><thead><tr><th>metric<th class=num>value<th>meaning</tr></thead>"
            f"<tbody>{''.join(rows)}</tbody></table>"
        )
    reasons: dict[str, list[str]] = {}
    for name, m in metrics.items():
        if m.value is None and m.note and name in used:
            reasons.setdefault(m.note, []).append(name)
    parts += [f"<p class=note>–  {escape(', '.join(n))}: {escape(why)}</p>" for why, n in reasons.items()]
    return "\n".join(p for p in parts if p)


def _layout_table(layout: Layout, metrics: Mapping[str, Metric], used: set[str]) -> str:
    title, bases, suffixes = layout
    columns = {s: h for s, h in suffixes.items() if any(_full(b, s) in metrics for b in bases)}
    if not columns:
        return ""
    rows = []
    for base, label in bases.items():
        cells, meaning = [], ""
        for suffix in columns:
            name = _full(base, suffix)
            metric = metrics.get(name)
            cells.append("<td class=num></td>" if metric is None else _cell(name, metric))
            if metric is not None:
                used.add(name)
                meaning = meaning or _arrow(metric)
        if meaning or any(_full(base, s) in metrics for s in columns):
            rows.append(f"<tr><th scope=row>{escape(label)}{meaning}</th>{''.join(cells)}</tr>")
    head = "".join(f"<th class=num>{escape(h)}" for h in columns.values())
    return (
        f"<h3>{title}</h3><div class=wide><table><thead><tr><th>{head}</tr></thead>"
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _cell(name: str, metric: Metric) -> str:
    hint = escape(f"{name}: {metric.explanation}" if metric.explanation else name, quote=True)
    floor = " floor" if name.endswith("_floor") else ""
    return f'<td class="num{floor}" title="{hint}">{escape(value_text(metric, name))}</td>'


def _full(base: str, suffix: str) -> str:
    for statistic in STATISTICS:
        if base == f"psnr{statistic}":
            return f"psnr{suffix}{statistic}"
    return base + suffix


def _arrow(metric: Metric) -> str:
    text = {"higher": "↑", "lower": "↓"}.get(metric.better, "")
    return f' <span class=arrow title="{metric.better} is better">{text}</span>' if text else ""


def _note(metric: Metric) -> str:
    return f" <span class=note>{escape(metric.note)}</span>" if metric.note else ""


def cards(metrics: Mapping[str, Metric], names: Sequence[str]) -> str:
    """The few numbers at the top of the page."""
    found = [(name, metrics[name]) for name in names if name in metrics]
    inner = "".join(
        f"<div class=card><div class=value>{escape(value_text(m, name))}</div>"
        f"<div class=name>{escape(_readable(name))}</div><div class=meaning>{escape(m.explanation)}</div></div>"
        for name, m in found
    )
    return f"<div class=cards>{inner}</div>" if inner else ""


def _readable(name: str) -> str:
    for _, bases, suffixes in LAYOUTS:
        for base in sorted(bases, key=len, reverse=True):
            for suffix, heading in suffixes.items():
                if name == _full(base, suffix):
                    return f"{bases[base].split(',')[0].split(':')[0].split(' within')[0]} · {heading.strip()}"
    words = name.removesuffix("_m").removesuffix("_mb").removesuffix("_cm").replace("_", " ")
    return words[:1].upper() + words[1:]


def decisions_table(rows: Sequence[DecisionRow]) -> str:
    """One line for every decision."""
    names = (
        "steps", "path [m]", "predicted, implicit [bit]", "predicted, explicit [bit]", "realised [bit]", "risk",
        "candidates",
    )
    columns = "".join(f"<th class=num>{name}" for name in names)
    head = f"<tr><th class=num>round<th>reason{columns}</tr>"
    body = "".join(
        f"<tr><td class=num>{r.round}</td><td><span class=tag>{escape(r.reason.replace('_', ' '))}</span></td>"
        + "".join(
            f"<td class=num>{nice_number(v)}</td>"
            for v in (r.steps, r.path_m, r.gain_imp_bits, r.gain_exp_bits, r.realised_bits, r.risk, r.candidates)
        )
        + "</tr>"
        for r in rows
    )
    return f"<div class='wide tall'><table><thead>{head}</thead><tbody>{body}</tbody></table></div>"


def timings_table(rows: Sequence[Timing], steps: int | None) -> str:
    """Seconds of every stage and module, their share, and seconds per step."""
    total = sum(r.seconds for r in rows) or 1.0
    per_step = f"<th class=num>per step ({steps})" if steps else ""
    lines = []
    for stage in dict.fromkeys(r.stage for r in rows):
        mine = [r for r in rows if r.stage == stage]
        whole = sum(r.seconds for r in mine)
        lines.append(_time_row(f"<b>{escape(stage)}</b>", whole, total, steps, None, "stage"))
        if len(mine) > 1 or mine[0].module != stage:
            lines += [
                _time_row(f"<span class=indent>{escape(r.module)}</span>", r.seconds, total, steps, r.calls, "")
                for r in mine
            ]
    lines.append(_time_row("<b>total</b>", total, total, steps, None, "stage"))
    return (
        f"<table><thead><tr><th>stage, module<th class=num>seconds<th class=num>share{per_step}<th class=num>calls"
        f"</tr></thead><tbody>{''.join(lines)}</tbody></table>"
    )


def _time_row(label: str, seconds: float, total: float, steps: int | None, calls: int | None, css: str) -> str:
    per_step = f"<td class=num>{1000 * seconds / steps:.0f} ms</td>" if steps else ""
    count = "" if calls is None else nice_number(calls)
    return (
        f'<tr class="{css}"><th scope=row>{label}</th><td class=num>{seconds:.2f}</td>'
        f"<td class=num>{100 * seconds / total:.1f} %</td>{per_step}<td class=num>{count}</td></tr>"
    )


def key_values(items: Mapping[str, Any]) -> str:
    """A two-column list of names and values."""
    rows = "".join(
        f"<tr><th scope=row>{escape(str(k))}</th><td><code>{escape(str(v))}</code></td></tr>" for k, v in items.items()
    )
    return f"<table class=keys><tbody>{rows}</tbody></table>"
