"""The evaluation on one page: geometry, views, curves, and their tables."""

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from active3d_pipe.evaluation.config import EvaluationSettings
from active3d_pipe.evaluation.culling import SeenBy, cull_unseen
from active3d_pipe.evaluation.geometry_metrics import Metrics, TruthSurface, mad_cm, surface_metrics
from active3d_pipe.evaluation.lpips import load_lpips
from active3d_pipe.evaluation.names import describe
from active3d_pipe.evaluation.views import VIEW_METRICS, Render, ViewScores, score_views
from active3d_pipe.structures import Frame, TriangleMesh


def evaluate_geometry(
    reconstruction: TriangleMesh,
    truth: TruthSurface,
    settings: EvaluationSettings,
    *,
    seen_by: SeenBy | None = None,
    query_sdf: Callable[[np.ndarray], np.ndarray] | None = None,
) -> Metrics:
    """Every geometry metric of a run, flat.

    With `seen_by` the plain names are of the reconstruction culled to what the cameras saw, and `*_unculled` of the
    whole one; without it nothing is culled. `query_sdf` (world m -> m) adds `mad_cm`.
    """
    headline = cull_unseen(reconstruction, seen_by, settings) if seen_by else reconstruction
    out = surface_metrics(headline, truth, settings)
    out["reconstruction_area_m2"] = headline.area_m2
    out["truth_area_m2"] = truth.mesh.area_m2
    if truth.observable is not None:
        out["observable_share"] = float(truth.observable.mean())
    if seen_by:
        forms = ("surface", *(form for form in truth.samples if form == "p2p"))
        whole = surface_metrics(reconstruction, truth, settings, forms=forms)
        out |= {f"{k}_unculled": v for k, v in whole.items() if not k.endswith("_floor")}
    if query_sdf:
        out["mad_cm"] = mad_cm(query_sdf, truth.points)
    return out


def evaluate_views(
    render: Render, view_sets: Mapping[str, Sequence[Frame]], settings: EvaluationSettings,
    progress: Callable[[str, int, int], None] | None = None,
) -> tuple[dict[str, ViewScores], str]:
    """Score every view set ("heldout", "circle", "train"); also says where LPIPS came from, or why it is null.

    `progress(set, done, total)` is called after every view.
    """
    lpips, source = load_lpips(settings.lpips)

    def scored(name: str, frames: Sequence[Frame]) -> ViewScores:
        report = (lambda done: progress(name, done, len(frames))) if progress else None
        return score_views(render, frames, lpips, with_ms_ssim=settings.ms_ssim, progress=report)

    return {name: scored(name, frames) for name, frames in view_sets.items() if len(frames)}, source


def view_metrics(scores: Mapping[str, ViewScores]) -> Metrics:
    """Flat summary: `psnr` and so on of the held-out set, `psnr_circle`, `psnr_train`, `psnr_gap`, and `psnr_p10`."""
    out: Metrics = {}
    for name, scored in scores.items():
        suffix = "" if name == "heldout" else f"_{name}"
        for metric in VIEW_METRICS:
            out[metric + suffix] = scored.summary[metric]["mean"]
        for statistic in ("median", "p10"):
            out[f"psnr{suffix}_{statistic}"] = scored.summary["psnr"][statistic]
        out[f"num_views{suffix}"] = float(len(scored.rows))
    if "heldout" in scores and "train" in scores:
        held, train = out["psnr"], out["psnr_train"]
        out["psnr_gap"] = train - held if held is not None and train is not None else None
    return out


def curve_point(
    step: int, reconstruction: TriangleMesh, truth: TruthSurface, settings: EvaluationSettings
) -> dict[str, Any]:
    """One point of the curves over steps: the surface form alone, on `curve_points` samples.

    `truth` is `thinned_truth` to `curve_points`, or prepared with the settings of `curve_settings` (no floors).
    """
    metrics = surface_metrics(reconstruction, truth, curve_settings(settings), forms=("surface",))
    return {"step": step, **metrics}


def curve_settings(settings: EvaluationSettings) -> EvaluationSettings:
    """The same settings with as many points as a curve needs."""
    return settings.model_copy(update={"num_points": max(settings.curve_points, 100), "density_per_m2": 0.0})


def summary_rows(metrics: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Rows {name, value, unit, better, explanation} of all metrics that have a description, in their order.

    Shares are shares of 1, and their unit says so.
    """
    rows = []
    for name, value in metrics.items():
        about = describe(name)
        if about:
            unit = "of 1" if about["unit"] == "%" else about["unit"]
            rows.append({"name": name, "value": value, **about, "unit": unit})
    return rows


def rows_to_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """CSV text with one column for every key that occurs, in order of appearance; None is an empty cell."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows([{k: "" if v is None else v for k, v in row.items()} for row in rows])
    return text.getvalue()
