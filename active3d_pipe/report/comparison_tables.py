"""The tables of a comparison as Markdown, CSV and LaTeX, in the layouts of the paper."""

import csv
import io
from collections.abc import Mapping, Sequence

from active3d_pipe.report.comparison import (
    ABLATION_ORDER,
    KNOWN,
    METRICS,
    Metric,
    Paired,
    Result,
    Summary,
    average,
    best,
    summarise,
)

FAILED, MISSING = "×", "–"


def cell_text(s: Summary, metric: Metric, *, plus_minus: str = " ± ") -> str:
    """`mean ± std`, `×` when every run failed, `–` when there is none; `(1/2)` when only some finished."""
    if s.mean is None:
        if not s.failed:
            return MISSING
        return FAILED if s.failed == s.total else f"{FAILED} ({s.failed}/{s.total})"
    text = f"{s.mean:.{metric.digits}f}"
    if s.std is not None:
        text += f"{plus_minus}{s.std:.{metric.digits}f}"
    return f"{text} ({s.count}/{s.total})" if s.count < s.total else text


class Grid:
    """Summaries of every variant, scene and metric, and their averages over scenes."""

    def __init__(
        self, results: Sequence[Result], labels: Mapping[str, str], metrics: Sequence[Metric] = METRICS
    ) -> None:
        self.results = list(results)
        self.labels = dict(labels)
        self.metrics = list(metrics)
        self.variants = [v for v in labels if any(r.variant == v for r in results)]
        self.scenes = list(dict.fromkeys(r.scene for r in results))

    def row(self, variant: str, metric: Metric) -> list[Summary]:
        """One summary for every scene, and the average when there are several."""
        mine = [r for r in self.results if r.variant == variant]
        out = [summarise([r for r in mine if r.scene == s], metric) for s in self.scenes]
        return [*out, average(mine, metric)] if len(self.scenes) > 1 else out

    def columns(self) -> list[str]:
        """Names of the columns of `row`."""
        return [*self.scenes, "Avg."] if len(self.scenes) > 1 else list(self.scenes)

    def best_of(self, metric: Metric) -> list[set[str]]:
        """For every column the variants that are best in it."""
        rows = [self.row(v, metric) for v in self.variants]
        return [{self.variants[i] for i in best(column, metric)} for column in zip(*rows, strict=True)]


def arrow(metric: Metric) -> str:
    """↑, ↓ or nothing."""
    return "" if not metric.judged else "↑" if metric.higher else "↓"


def per_scene_markdown(grid: Grid) -> str:
    """The layout of the paper's tables: methods x metrics down, scenes across; best in bold."""
    lines = [["Method", "Metric", *grid.columns()], ["---"] * (2 + len(grid.columns()))]
    winners = {m.key: grid.best_of(m) for m in grid.metrics}
    for variant in grid.variants:
        for n, metric in enumerate(grid.metrics):
            cells = []
            for c, s in enumerate(grid.row(variant, metric)):
                text = cell_text(s, metric)
                cells.append(f"**{text}**" if variant in winners[metric.key][c] else text)
            lines.append([grid.labels[variant] if n == 0 else "", f"{metric.name} {arrow(metric)}".strip(), *cells])
    return _markdown(lines)


def overall_markdown(grid: Grid) -> str:
    """The layout of the paper's ablation table: one line for every method, means over scenes."""
    metrics = _ablation(grid.metrics)
    lines = [["Method", *(f"{m.name} {arrow(m)}".strip() for m in metrics)], ["---"] * (1 + len(metrics))]
    winners = {m.key: grid.best_of(m)[-1] for m in metrics}
    for variant in grid.variants:
        texts = [cell_text(grid.row(variant, m)[-1], m) for m in metrics]
        cells = [f"**{t}**" if variant in winners[m.key] else t for t, m in zip(texts, metrics, strict=True)]
        lines.append([grid.labels[variant], *cells])
    return _markdown(lines)


def per_scene_latex(grid: Grid, caption: str) -> str:
    """As `per_scene_markdown`, with booktabs and multirow; best cells are shaded as in the paper."""
    columns, count = grid.columns(), len(grid.metrics)
    lines = [
        r"\begin{table}[t]", r"\centering", r"\resizebox{\linewidth}{!}{",
        rf"\begin{{tabular}}{{ll{'c' * len(columns)}}}", r"\toprule",
        " & ".join(["Method", "Metric", *map(_escape, columns)]) + r" \\",
    ]
    winners = {m.key: grid.best_of(m) for m in grid.metrics}
    for variant in grid.variants:
        lines += [r"\midrule", rf"\multirow{{{count}}}{{*}}{{{_escape(grid.labels[variant])}}}"]
        for metric in grid.metrics:
            cells = [
                _shade(_latex(s, metric), variant in winners[metric.key][c])
                for c, s in enumerate(grid.row(variant, metric))
            ]
            lines.append(f"& {_escape(metric.name)} {_latex_arrow(metric)} & " + " & ".join(cells) + r" \\")
    return _close(lines, caption)


def overall_latex(grid: Grid, caption: str) -> str:
    """As `overall_markdown`."""
    metrics = _ablation(grid.metrics)
    heads = [f"{_escape(m.name)}{_latex_arrow(m)}" for m in metrics]
    lines = [
        r"\begin{table}[t]", r"\centering", r"\resizebox{\linewidth}{!}{",
        rf"\begin{{tabular}}{{l{'c' * len(metrics)}}}", r"\toprule",
        " & ".join(["Method", *heads]) + r" \\", r"\midrule",
    ]
    winners = {m.key: grid.best_of(m)[-1] for m in metrics}
    for variant in grid.variants:
        cells = [_shade(_latex(grid.row(variant, m)[-1], m), variant in winners[m.key]) for m in metrics]
        lines.append(" & ".join([_escape(grid.labels[variant]), *cells]) + r" \\")
    return _close(lines, caption)


def summary_csv(grid: Grid) -> str:
    """Long form: variant, scene (or Avg.), metric, mean, std, finished, failed, total, best."""
    rows: list[list[object]] = []
    for metric in grid.metrics:
        winners = grid.best_of(metric)
        for variant in grid.variants:
            for c, (name, s) in enumerate(zip(grid.columns(), grid.row(variant, metric), strict=True)):
                std = "" if s.std is None else repr(s.std)
                mean = "" if s.mean is None else repr(s.mean)
                rows.append([
                    variant, name, metric.key, metric.factor, mean, std, s.count, s.failed, s.total,
                    int(variant in winners[c]),
                ])
    head = ["variant", "scene", "metric", "factor", "mean", "std", "finished", "failed", "total", "best"]
    return _csv(head, rows)


def runs_csv(results: Sequence[Result]) -> str:
    """One line for every run with every metric that any run has."""
    keys = sorted({key for r in results for key in r.metrics})
    rows = [[r.scene, r.variant, r.seed, r.state, r.error, *(r.metrics.get(k, "") for k in keys)] for r in results]
    return _csv(["scene", "variant", "seed", "state", "error", *keys], rows)


def tests_markdown(tests: Sequence[Paired], labels: Mapping[str, str], reference: str) -> str:
    """Paired differences to the reference; p after Holm below 0.05 in bold."""
    lines = [["Metric", "Method", "pairs", f"mean difference to {reference}", "p permutation", "p Holm", "p Wilcoxon"]]
    lines.append(["---"] * len(lines[0]))
    for t in tests:
        shown = [MISSING if p is None else f"{p:.3f}" for p in (t.p_permutation, t.p_holm, t.p_wilcoxon)]
        if t.p_holm is not None and t.p_holm < 0.05:
            shown[1] = f"**{shown[1]}**"
        mean = MISSING if t.mean is None else f"{t.mean:+.{t.metric.digits}f}"
        lines.append([t.metric.name, labels.get(t.variant, t.variant), str(t.count), mean, *shown])
    return _markdown(lines)


def chosen_metrics(names: Sequence[str]) -> list[Metric]:
    """The metrics of a spec by their keys; the paper's when none are given. KeyError for an unknown one."""
    return [KNOWN[name] for name in names] if names else list(METRICS)


def _ablation(metrics: Sequence[Metric]) -> list[Metric]:
    order = {key: i for i, key in enumerate(ABLATION_ORDER)}
    return sorted(metrics, key=lambda m: order.get(m.key, len(order)))


def _markdown(lines: Sequence[Sequence[str]]) -> str:
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def _csv(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(head)
    writer.writerows(rows)
    return out.getvalue()


def _latex(s: Summary, metric: Metric) -> str:
    text = cell_text(s, metric, plus_minus=r" $\pm$ ")
    return text.replace(FAILED, r"$\times$").replace(MISSING, "--")


def _shade(text: str, is_best: bool) -> str:
    return rf"\cellcolor{{blue!25}}{text}" if is_best else text


def _latex_arrow(metric: Metric) -> str:
    if not metric.judged:
        return ""
    return r"$\uparrow$" if metric.higher else r"$\downarrow$"


def _escape(text: str) -> str:
    for mark in ("\\", "&", "%", "#", "_", "$", "{", "}"):
        text = text.replace(mark, r"\textbackslash " if mark == "\\" else f"\\{mark}")
    return text


def _close(lines: list[str], caption: str) -> str:
    lines += [r"\bottomrule", r"\end{tabular}}", rf"\caption{{{_escape(caption)}}}", r"\end{table}"]
    return "\n".join(lines) + "\n"
