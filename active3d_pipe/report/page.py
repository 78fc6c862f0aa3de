"""The report: one HTML page that stands alone, without scripts, fonts or files from elsewhere."""

from collections.abc import Callable
from html import escape

import numpy as np

from active3d_pipe.geometry.sampling import spread
from active3d_pipe.report import figures, maps, tables
from active3d_pipe.report.config import ReportSettings
from active3d_pipe.report.css import CSS
from active3d_pipe.report.data import SECTIONS, ReportData
from active3d_pipe.report.style import photo

LEADS = {
    "metrics": "Accuracy goes from the reconstruction to the truth, completion from the truth to the reconstruction. "
    "“Surface” measures to the other mesh's surface and is the figure to quote; point-to-point figures have a floor "
    "from sampling alone and do not compare between scenes.",
    "floor_plan": "A horizontal slice of what the map holds for free, occupied and unknown, and the path over it; "
    "arrows show where the camera looked, numbers the order of the chosen views.",
    "curves": "What the run knew after so many exploration steps. Completion and distances are those of a coarse "
    "surface of the round; the final mesh is finer. The mean uncertainty is that of all voxels observed so far, "
    "weighted as in each round's fusion: it rises with the weights and with voxels that were hardly seen yet.",
    "views": "Poses that the run never visited, from the worst render shown to the best. Grey: nothing is known there "
    "in the truth (errors) or nothing was rendered (depth).",
    "mesh": "The exported mesh. In views from outside, faces are seen from the side of the room only.",
    "slices": "The same horizontal slice after several rounds; one colour scale a row. Values above the 99th "
    "percentile are clipped.",
    "fusion": "Weights by which the three terms enter the fused uncertainty, found by evidence maximisation.",
    "decisions": "Why the next view was chosen, what it was expected to bring, and what it brought.",
    "timings": "Wall time of the committed work, summed over the rounds.",
    "reproducibility": "The same versions, seed and thread count give the same artifacts.",
    "config": "Every setting of the run, defaults included.",
}


def build_report(data: ReportData, settings: ReportSettings | None = None) -> str:
    """The page as HTML text; equal data give equal text.

    Sections without data say so in one line, with the reason in `data.missing` where there is one.
    """
    settings = settings or ReportSettings.model_validate({})
    builders: dict[str, Callable[[ReportData, ReportSettings], str]] = {
        "metrics": _metrics, "floor_plan": _floor_plan, "curves": _curves, "views": _views, "mesh": _mesh,
        "slices": _slices, "fusion": _fusion, "decisions": _decisions, "timings": _timings,
        "reproducibility": _reproducibility, "config": _config,
    }
    sections = []
    for key, heading in SECTIONS.items():
        body = builders[key](data, settings)
        if body:
            body = f"<p class=lead>{LEADS[key]}</p>\n{body}"
        else:
            reason = data.missing.get(key, "this run recorded no data for it")
            body = f"<p class=missing>Not shown: {escape(reason)}.</p>"
        sections.append(f'<section id="{key}">\n<h2>{heading}</h2>\n{body}\n</section>')
    links = "".join(f'<a href="#{key}">{heading}</a>' for key, heading in SECTIONS.items())
    subtitle = f"<p>{escape(data.subtitle)}</p>" if data.subtitle else ""
    content = "\n".join(sections)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(data.title)}</title>\n<style>{CSS}</style>\n</head>\n<body>\n"
        f"<header><div><h1>{escape(data.title)}</h1>{subtitle}<nav>{links}</nav></div></header>\n"
        f"<main>\n{tables.cards(data.metrics, data.headline)}\n{content}\n"
        "<footer>Made by active3d. The page stands alone and can be sent as one file.</footer>\n"
        "</main>\n</body>\n</html>\n"
    )


def _metrics(data: ReportData, settings: ReportSettings) -> str:
    return tables.metrics_tables(data.metrics) if data.metrics else ""


def _floor_plan(data: ReportData, settings: ReportSettings) -> str:
    if data.floor_plan is None and (data.trajectory is None or not len(data.trajectory)):
        return ""
    note = ""
    if data.floor_plan is not None:
        plan = data.floor_plan
        note = f"<p class=note>Slice at z = {plan.height_m:.2f} m, voxels of {plan.voxel_size:g} m"
        if data.trajectory is not None and len(data.trajectory) > 1:
            path = np.asarray(data.trajectory)[:, :3, 3]
            length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
            note += f"; {len(path)} poses, {length:.1f} m walked"
        note += ".</p>"
    return figures.floor_plan(data, settings.figure_scale) + note


def _curves(data: ReportData, settings: ReportSettings) -> str:
    series = [c for c in data.curves if any(v is not None for v in c.values)]
    return figures.curves(series, settings.figure_scale) if series else ""


def _views(data: ReportData, settings: ReportSettings) -> str:
    return maps.views_section(data.views, settings) if data.views and settings.max_views else ""


def _mesh(data: ReportData, settings: ReportSettings) -> str:
    cells = [
        f"<figure>{photo(p.image, settings.mesh_width_px, settings.jpeg_quality, p.caption)}"
        f"<figcaption>{escape(p.caption)}</figcaption></figure>"
        for p in data.mesh_pictures
    ]
    return f"<div class=pictures>{''.join(cells)}</div>" if cells else ""


def _slices(data: ReportData, settings: ReportSettings) -> str:
    series = [s for s in data.slices if len(s.rounds)]
    if not series:
        return ""
    terms = "".join(f"<dt>{escape(s.name)}</dt><dd>{escape(s.explanation)}</dd>" for s in series)
    return f"<dl class=terms>{terms}</dl>" + maps.slices_figure(series, data.floor_plan, settings)


def _fusion(data: ReportData, settings: ReportSettings) -> str:
    if data.fusion is None or len(data.fusion.rounds) == 0:
        return ""
    return figures.fusion(data.fusion, settings.figure_scale)


def _decisions(data: ReportData, settings: ReportSettings) -> str:
    if not data.decisions:
        return ""
    rows = spread(data.decisions, settings.max_decisions)
    chart = figures.gains(data.decisions, settings.figure_scale) if _has_gains(data) else ""
    return chart + (tables.decisions_table(rows) if rows else "")


def _has_gains(data: ReportData) -> bool:
    return any(r.gain_imp_bits is not None or r.gain_exp_bits is not None for r in data.decisions)


def _timings(data: ReportData, settings: ReportSettings) -> str:
    if not data.timings:
        return ""
    steps = data.metrics.get("steps")
    count = int(steps.value) if steps is not None and steps.value else None
    return figures.timings(data.timings, settings.figure_scale) + tables.timings_table(data.timings, count)


def _reproducibility(data: ReportData, settings: ReportSettings) -> str:
    return tables.key_values(data.reproducibility) if data.reproducibility else ""


def _config(data: ReportData, settings: ReportSettings) -> str:
    if not data.config_text.strip():
        return ""
    return f"<details open><summary>run.toml</summary><pre>{escape(data.config_text)}</pre></details>"
