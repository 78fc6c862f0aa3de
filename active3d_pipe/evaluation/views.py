"""Scoring rendered views against true ones, view by view, and the poses of the circle protocol."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from active3d_pipe.evaluation import image_metrics
from active3d_pipe.evaluation.lpips import Lpips
from active3d_pipe.geometry import se3
from active3d_pipe.geometry.sampling import spread
from active3d_pipe.structures import Camera, Frame

Render = Callable[[Camera, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]
"""(camera, T_world_camera) -> rgb (H, W, 3) float, z-depth (H, W) m with 0 = nothing, alpha (H, W) in [0, 1]."""

VIEW_METRICS = ("psnr", "ssim", "ms_ssim", "lpips", "depth_l1_cm", "depth_median_cm", "rendered_share")
LOWER_IS_BETTER = frozenset({"lpips", "depth_l1_cm", "depth_median_cm"})


@dataclass(frozen=True, eq=False)
class ViewImages:
    """A true view beside its render: rgb uint8 (H, W, 3), z-depths (H, W) float32 m, 0 = nothing."""

    index: int
    truth_rgb: np.ndarray
    render_rgb: np.ndarray
    truth_depth: np.ndarray
    render_depth: np.ndarray
    psnr: float


@dataclass(frozen=True, eq=False)
class ViewScores:
    """Scores of a view set: one row a view, and the summary {metric: {mean, median, p10, worst}}."""

    rows: list[dict[str, Any]]
    summary: dict[str, dict[str, float | None]]


def circle_poses(centre: np.ndarray, radius_m: float, count: int) -> np.ndarray:
    """(count, 4, 4) T_world_camera on a horizontal circle, looking inward at its centre (protocol of ActiveGAMER)."""
    centre = np.asarray(centre, dtype=np.float64)
    angles = 2 * math.pi * np.arange(count) / max(count, 1)
    ring = centre + radius_m * np.stack([np.cos(angles), np.sin(angles), np.zeros(count)], axis=1)
    return np.array([se3.look_at(p, centre) for p in ring]).reshape(count, 4, 4)


def score_view(
    frame: Frame, render: tuple[np.ndarray, np.ndarray, np.ndarray], lpips: Lpips | None, *, with_ms_ssim: bool = True
) -> dict[str, float | None]:
    """All view metrics of one render; only pixels with a true depth count."""
    rgb, depth, alpha = (np.asarray(x) for x in render)
    truth, mask = frame.rgb.astype(np.float64) / 255, frame.depth > 0
    plain, multi_scale = image_metrics.ssim_pair(rgb, truth, mask, with_ms_ssim=with_ms_ssim)
    return {
        "psnr": image_metrics.psnr(rgb, truth, mask),
        "ssim": plain,
        "ms_ssim": multi_scale,
        "lpips": lpips(rgb, truth, mask) if lpips else None,
        **image_metrics.depth_errors_cm(depth, frame.depth),
        "rendered_share": float((alpha > 0.5)[mask].mean()) if mask.any() else None,
    }


def score_views(
    render: Render, frames: Iterable[Frame], lpips: Lpips | None, *, with_ms_ssim: bool = True,
    progress: Callable[[int], None] | None = None,
) -> ViewScores:
    """Render every frame's pose and score it; `progress` is called with the number of views done."""
    rows = []
    for i, frame in enumerate(frames):
        scores = score_view(frame, render(frame.camera, frame.T_world_camera), lpips, with_ms_ssim=with_ms_ssim)
        rows.append({"view": i, "step": frame.step, **scores})
        if progress:
            progress(i + 1)
    return ViewScores(rows, summarise(rows))


def summarise(rows: list[dict[str, Any]]) -> dict[str, dict[str, float | None]]:
    """Mean, median, 10th percentile from the bad end and worst of every metric over views; None left out."""
    out: dict[str, dict[str, float | None]] = {}
    for name in VIEW_METRICS:
        values = np.array([row[name] for row in rows if row.get(name) is not None], dtype=np.float64)
        if len(values) == 0:
            out[name] = {"mean": None, "median": None, "p10": None, "worst": None}
            continue
        lower = name in LOWER_IS_BETTER
        out[name] = {
            "mean": float(values.mean()),
            "median": float(np.median(values)),
            "p10": float(np.percentile(values, 90 if lower else 10)),
            "worst": float(values.max() if lower else values.min()),
        }
    return out


def pick_examples(rows: list[dict[str, Any]], count: int) -> list[int]:
    """Views to show: spread evenly from the worst PSNR to the best, so that a report does not flatter."""
    ranked = sorted((row["psnr"], row["view"]) for row in rows if row.get("psnr") is not None)
    return [view for _, view in spread(ranked, max(count, 0))]


def view_images(render: Render, frame: Frame, index: int) -> ViewImages:
    """Render one view again and keep the images for the report."""
    rgb, depth, _ = render(frame.camera, frame.T_world_camera)
    value = image_metrics.psnr(rgb, frame.rgb / 255.0, frame.depth > 0)
    picture = (np.clip(rgb, 0, 1) * 255 + 0.5).astype(np.uint8)
    return ViewImages(index, frame.rgb, picture, frame.depth, np.asarray(depth, np.float32), value or 0.0)
