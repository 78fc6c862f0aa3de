"""Comparing runs: means and deviations over seeds, which one is best, and whether that can be chance."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.stats import wilcoxon


@dataclass(frozen=True, slots=True)
class Metric:
    """A row of the tables: key in `metrics.json`, name as the paper prints it, factor, digits, which way is better.

    `judged` is False for what is neither good nor bad by itself: nothing is marked as best.
    """

    key: str
    name: str
    factor: float
    digits: int
    higher: bool
    judged: bool = True


# The rows of the paper's tables. Completion is judged against surface that some reachable pose can see.
METRICS = (
    Metric("accuracy_cm_surface", "Acc (cm)", 1, 2, False),
    Metric("completion_cm_surface_observable", "Com. (cm)", 1, 2, False),
    Metric("completion_ratio_surface_observable", "C.R. (%)", 100, 2, True),
    Metric("psnr", "PSNR", 1, 2, True),
    Metric("ssim", "SSIM", 1, 3, True),
    Metric("lpips", "LPIPS", 1, 3, False),
    Metric("mad_cm", "MAD (cm)", 1, 2, False),
)
EXTRA = (
    Metric("completion_ratio_surface", "C.R. whole (%)", 100, 2, True),
    Metric("steps", "steps", 1, 0, False, judged=False),
    Metric("path_m", "path (m)", 1, 1, False, judged=False),
    Metric("collisions", "collisions", 1, 0, False),
    Metric("seconds_per_step", "s/step", 1, 2, False),
)
KNOWN = {m.key: m for m in (*METRICS, *EXTRA)}
ABLATION_ORDER = ("psnr", "ssim", "lpips", "mad_cm", "accuracy_cm_surface", "completion_cm_surface_observable",
                  "completion_ratio_surface_observable")


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """One run: its metrics (empty when it failed or is not made yet), and its curve.

    Attributes:
        state: done, failed or missing. error: one line when failed.
        curve: (P, 3) step, walked metres, completion ratio 0..1.
    """

    scene: str
    variant: str
    seed: int
    state: str
    metrics: Mapping[str, float]
    curve: np.ndarray
    error: str = ""


@dataclass(frozen=True, slots=True)
class Summary:
    """One cell of a table: mean and standard deviation over the seeds that finished, and how many of how many did.

    `failed` counts the runs that ended in an error; what is merely not made yet is in neither number.
    """

    mean: float | None
    std: float | None
    count: int
    failed: int
    total: int


def summarise(results: Sequence[Result], metric: Metric) -> Summary:
    """Over the seeds of one scene and variant; the deviation (n - 1) needs two seeds."""
    values = [metric.factor * r.metrics[metric.key] for r in results if metric.key in r.metrics]
    failed = sum(r.state == "failed" for r in results)
    if not values:
        return Summary(None, None, 0, failed, len(results))
    std = float(np.std(values, ddof=1)) if len(values) > 1 else None
    return Summary(float(np.mean(values)), std, len(values), failed, len(results))


def average(results: Sequence[Result], metric: Metric) -> Summary:
    """Over scenes: the mean of the scenes' means; the deviation is that of the seeds' means over all scenes.

    None when a scene has no result: an average over other scenes than the neighbours' would mislead.
    """
    scenes = list(dict.fromkeys(r.scene for r in results))
    per_scene = [summarise([r for r in results if r.scene == s], metric) for s in scenes]
    failed, total = sum(p.failed for p in per_scene), len(results)
    means = [p.mean for p in per_scene if p.mean is not None]
    if not means or len(means) < len(scenes):
        return Summary(None, None, 0, failed, total)
    by_seed = []
    for seed in dict.fromkeys(r.seed for r in results):
        mine = [metric.factor * r.metrics[metric.key] for r in results if r.seed == seed and metric.key in r.metrics]
        if len(mine) == len(scenes):
            by_seed.append(float(np.mean(mine)))
    std = float(np.std(by_seed, ddof=1)) if len(by_seed) > 1 else None
    return Summary(float(np.mean(means)), std, sum(p.count for p in per_scene), failed, total)


def best(summaries: Sequence[Summary], metric: Metric) -> set[int]:
    """Indices of the best cells as they are printed (ties share); none when fewer than two have a value."""
    shown = {i: round(s.mean, metric.digits) for i, s in enumerate(summaries) if s.mean is not None}
    if len(shown) < 2 or not metric.judged:
        return set()
    top = max(shown.values()) if metric.higher else min(shown.values())
    return {i for i, value in shown.items() if value == top}


@dataclass(frozen=True, slots=True)
class Paired:
    """A paired comparison of a variant with the reference over scene x seed.

    Attributes:
        count: pairs in which both finished. mean: mean of variant - reference, in the table's unit.
        p_permutation: two-sided sign-flip test of the mean; p_wilcoxon: signed-rank test; None without enough pairs.
        p_holm: the permutation p-value, adjusted for the number of variants (Holm 1979).
    """

    variant: str
    metric: Metric
    count: int
    mean: float | None
    p_permutation: float | None
    p_wilcoxon: float | None
    p_holm: float | None = None


EXACT_PAIRS = 14


def permutation_p(differences: np.ndarray) -> float | None:
    """Two-sided p of mean 0 under flips of the signs; exact up to 14 pairs, else 20 000 flips from a fixed seed."""
    d = np.asarray(differences, dtype=np.float64)
    if len(d) < 2:
        return None
    if len(d) <= EXACT_PAIRS:
        signs = np.array(list(product((1.0, -1.0), repeat=len(d))))
    else:
        drawn = np.random.default_rng(0).integers(0, 2, (20000, len(d)))
        signs = np.concatenate([np.ones((1, len(d))), 2.0 * drawn - 1])
    means = np.abs(signs @ d)
    return float((means >= np.abs(d.sum()) - 1e-12 * max(1.0, np.abs(d).sum())).mean())


def paired_tests(results: Sequence[Result], variants: Sequence[str], metrics: Sequence[Metric]) -> list[Paired]:
    """Every variant against the first one, metric by metric."""
    table = {(r.scene, r.seed, r.variant): r.metrics for r in results}
    places = list(dict.fromkeys((r.scene, r.seed) for r in results))
    out: list[Paired] = []
    for metric in metrics:
        group = []
        for variant in variants[1:]:
            pairs = [(table.get((*p, variant), {}), table.get((*p, variants[0]), {})) for p in places]
            d = np.array([
                metric.factor * (a[metric.key] - b[metric.key]) for a, b in pairs if metric.key in a and metric.key in b
            ])
            rank = float(wilcoxon(d).pvalue) if len(d) >= 5 and np.any(d != 0) else None
            mean = float(d.mean()) if len(d) else None
            group.append(Paired(variant, metric, len(d), mean, permutation_p(d), rank))
        out += _holm(group)
    return out


def _holm(group: list[Paired]) -> list[Paired]:
    known = sorted((p.p_permutation, i) for i, p in enumerate(group) if p.p_permutation is not None)
    adjusted: dict[int, float] = {}
    running = 0.0
    for rank, (p, i) in enumerate(known):
        running = max(running, min(1.0, (len(known) - rank) * p))
        adjusted[i] = running
    return [
        Paired(p.variant, p.metric, p.count, p.mean, p.p_permutation, p.p_wilcoxon, adjusted.get(i))
        for i, p in enumerate(group)
    ]
