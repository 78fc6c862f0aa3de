"""Distances between a reconstruction and the true surface, in both directions and in three forms.

Accuracy goes from the reconstruction to the truth, completion from the truth to the reconstruction. Each form has
its suffix: `_surface` measures from sampled points to the other mesh's surface (exact, the headline), `_p2p` to the
nearest of `num_points` samples of it (what the field's earlier evaluations do), `_density` likewise with a fixed
number of points per square metre. The last two have a floor from sampling alone, `_floor`: what a perfect
reconstruction would score.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from active3d_pipe.errors import InputError, NumericalError
from active3d_pipe.evaluation.config import EvaluationSettings
from active3d_pipe.geometry.raycasting import SurfaceIndex
from active3d_pipe.structures import TriangleMesh

Metrics = dict[str, float | None]
Observable = Callable[[np.ndarray], np.ndarray]
"""Points (N, 3) on the true surface, world m -> (N,) bool, whether some reachable pose can see them."""

TRUTH, TRUTH_AGAIN, RECONSTRUCTION = 1, 2, 3  # streams of random numbers, one for every sampled set
MAX_DENSITY_POINTS = 5_000_000  # memory guard of the fixed-density form, some 2000 m2 at 2500 per m2


def sample_surface(mesh: TriangleMesh, n: int, rng: np.random.Generator) -> np.ndarray:
    """(n, 3) float32 points uniform by area on a mesh, world m.

    Raises InputError when the mesh has no area or vertices that are not finite.
    """
    if not np.isfinite(mesh.vertices).all():
        raise InputError("mesh: vertices contain NaN or infinity; expected finite coordinates in metres")
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(np.float64) for i in range(3))
    cumulative = np.cumsum(np.linalg.norm(np.cross(b - a, c - a), axis=1))
    if len(cumulative) == 0 or cumulative[-1] <= 0:
        raise InputError(f"mesh with {len(mesh.faces)} faces has no area; expected a surface to sample points on")
    face = np.searchsorted(cumulative, rng.random(n) * cumulative[-1], side="right")
    face = np.minimum(face, len(cumulative) - 1)
    # The square root makes the points uniform over the triangle and not only over its two edges.
    s, t = np.sqrt(rng.random((n, 1))), rng.random((n, 1))
    return ((1 - s) * a[face] + s * (1 - t) * b[face] + s * t * c[face]).astype(np.float32)


@dataclass(frozen=True, eq=False)
class TruthSurface:
    """The true surface, prepared once and used for every reconstruction of a run; see `prepare_truth`.

    Attributes:
        mesh: the whole ground truth.
        index: nearest-surface queries on it.
        points: (num_points, 3) float32 samples, world m.
        observable: (num_points,) bool, samples that a reachable pose can see, or None when not known.
        samples: nearest-sample queries on `points` ("p2p") and on points at the fixed density ("density").
        density_points: (num_points or fewer, 3) float32, those of the fixed density that distances start from.
        floors: the `_p2p_floor` and `_density_floor` metrics.
    """

    mesh: TriangleMesh
    index: SurfaceIndex
    points: np.ndarray
    observable: np.ndarray | None
    samples: dict[str, cKDTree]
    density_points: np.ndarray
    floors: Metrics = field(default_factory=dict)


def prepare_truth(
    mesh: TriangleMesh, settings: EvaluationSettings, observable: Observable | None = None, *, floors: bool = True
) -> TruthSurface:
    """Sample the ground truth and measure the sampling floors (pass floors=False where only curves are needed).

    Raises InputError when the mesh has no area, or when `observable` gives anything but one bool for every point.
    """
    points = sample_surface(mesh, settings.num_points, np.random.default_rng([settings.seed, TRUTH, 0]))
    mask = None
    if observable is not None:
        mask = np.asarray(observable(points), dtype=bool)
        if mask.shape != (len(points),):
            raise InputError(f"observable mask is {mask.shape}, expected ({len(points)},), one bool for every point")
    density = np.zeros((0, 3), np.float32)
    samples: dict[str, cKDTree] = {}
    found: Metrics = {}
    if floors:
        samples["p2p"] = _tree(points)
        if settings.density_per_m2 > 0:
            density = _sample_density(mesh, settings, TRUTH)
            samples["density"] = _tree(density)
        # A second, independent sampling of the truth stands for a perfect reconstruction. Both directions have the
        # same distribution, so one is measured.
        again = sample_surface(mesh, settings.num_points, np.random.default_rng([settings.seed, TRUTH_AGAIN, 0]))
        for form, tree in samples.items():
            distances = _nearest(again, tree)
            found |= _rename(distance_metrics(distances, distances, settings), f"_{form}_floor")
    index = SurfaceIndex(mesh.vertices, mesh.faces)
    return TruthSurface(mesh, index, points, mask, samples, density[: settings.num_points], found)


def thinned_truth(truth: TruthSurface, count: int) -> TruthSurface:
    """The same truth with its first `count` samples and no point-to-point forms: what a curve needs.

    Samples are independent draws, so that any of them are a uniform sampling too.
    """
    observable = None if truth.observable is None else truth.observable[:count]
    return TruthSurface(truth.mesh, truth.index, truth.points[:count], observable, {}, np.zeros((0, 3), np.float32))


def density_count(mesh: TriangleMesh, settings: EvaluationSettings) -> int:
    """Number of points that the fixed density asks for on `mesh`."""
    return int(min(np.ceil(settings.density_per_m2 * mesh.area_m2), MAX_DENSITY_POINTS))


def _sample_density(mesh: TriangleMesh, settings: EvaluationSettings, stream: int) -> np.ndarray:
    return sample_surface(mesh, density_count(mesh, settings), np.random.default_rng([settings.seed, stream, 1]))


def _tree(points: np.ndarray) -> cKDTree:
    # Splitting at midpoints builds several times faster than at medians and answers the same.
    return cKDTree(points, balanced_tree=False, compact_nodes=False)


def _nearest(points: np.ndarray, tree: cKDTree) -> np.ndarray:
    return tree.query(points, workers=2)[0]


def distance_metrics(to_truth: np.ndarray, to_reconstruction: np.ndarray, settings: EvaluationSettings) -> Metrics:
    """Metrics of two sets of distances, m: reconstruction -> truth (A,) and truth -> reconstruction (C,).

    An empty set of distances gives None for what cannot be said, and a ratio of 0 for what was missed.
    """
    near = settings.threshold_m
    precision = float(np.mean(to_truth <= near)) if len(to_truth) else None
    ratio = float(np.mean(to_reconstruction <= near)) if len(to_reconstruction) else None
    total = (precision or 0.0) + (ratio or 0.0)
    finite = to_reconstruction[np.isfinite(to_reconstruction)]
    complete = len(finite) == len(to_reconstruction) and len(finite) > 0
    return {
        "accuracy_cm": 100 * float(np.mean(to_truth)) if len(to_truth) else None,
        "accuracy_median_cm": 100 * float(np.median(to_truth)) if len(to_truth) else None,
        "completion_cm": 100 * float(np.mean(finite)) if complete else None,
        "completion_median_cm": 100 * float(np.median(finite)) if complete else None,
        "completion_ratio": ratio,
        "precision": precision,
        "fscore": 2 * (precision or 0.0) * (ratio or 0.0) / total if total > 0 else 0.0,
    }


COMPLETION_SIDE = ("completion_cm", "completion_median_cm", "completion_ratio", "fscore")


def _rename(metrics: Metrics, suffix: str, only: tuple[str, ...] = ()) -> Metrics:
    return {name + suffix: value for name, value in metrics.items() if not only or name in only}


def surface_metrics(
    reconstruction: TriangleMesh, truth: TruthSurface, settings: EvaluationSettings, *, forms: tuple[str, ...] = ()
) -> Metrics:
    """All distance metrics of a reconstruction, flat; `names.py` says what each one means.

    Args:
        reconstruction: world m; an empty mesh scores a completion ratio of 0 and None for distances.
        truth: from `prepare_truth`.
        settings: number of points, threshold, seed.
        forms: which of "surface", "p2p", "density"; all that `truth` was prepared for by default.

    Returns:
        For every form `accuracy_cm_*`, `accuracy_median_cm_*`, `completion_cm_*`, `completion_median_cm_*`,
        `completion_ratio_*`, `precision_*`, `fscore_*` (ratios as shares of 1), their floors, and where the truth
        has an observable mask the completion side again as `*_observable`.
    """
    forms = forms or ("surface", *truth.samples)
    empty = len(reconstruction.faces) == 0 or not reconstruction.area_m2 > 0
    none = np.zeros((0, 3), np.float32)
    rng = np.random.default_rng([settings.seed, RECONSTRUCTION, 0])
    points = none if empty else sample_surface(reconstruction, settings.num_points, rng)
    out: Metrics = {}
    for form in forms:
        goal = truth.density_points if form == "density" else truth.points
        if empty:
            forth, back = np.zeros(0), np.full(len(goal), np.inf)
        elif form == "surface":
            forth = truth.index.distance(points)
            back = SurfaceIndex(reconstruction.vertices, reconstruction.faces).distance(goal)
        else:
            # Distances start from at most `num_points` points; what they end at has the form's full density.
            samples = points if form == "p2p" else _sample_density(reconstruction, settings, RECONSTRUCTION)
            forth = _nearest(samples[: settings.num_points], truth.samples[form])
            back = _nearest(goal, _tree(samples))
        out |= _rename(distance_metrics(forth, back, settings), f"_{form}")
        out |= {name: value for name, value in truth.floors.items() if name.endswith(f"_{form}_floor")}
        if truth.observable is not None and form != "density":
            seen = distance_metrics(forth, back[truth.observable], settings)
            out |= _rename(seen, f"_{form}_observable", COMPLETION_SIDE)
    return out


def mad_cm(
    query_sdf: Callable[[np.ndarray], np.ndarray], points: np.ndarray, *, batch: int = 65_536
) -> float:
    """Mean absolute SDF, cm, that a field predicts at true surface points (N, 3), unseen ones included.

    `query_sdf` maps (B, 3) float32 world m to (B,) signed distances in m. Raises NumericalError on NaN.
    """
    total = 0.0
    for start in range(0, len(points), batch):
        part = np.asarray(query_sdf(points[start : start + batch]), dtype=np.float64)
        if not np.isfinite(part).all():
            raise NumericalError("the field's SDF is NaN or infinite at ground-truth points; MAD cannot be computed")
        total += float(np.abs(part).sum())
    return 100 * total / len(points)
