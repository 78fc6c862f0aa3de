"""The uncertainty volume of one round: the algorithm on one page (paper, sec. uncertainty_map)."""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.special import expit

from active3d_pipe.errors import InputError, NumericalError
from active3d_pipe.information.entropy import bernoulli_entropy
from active3d_pipe.information.gain import entropy_drop
from active3d_pipe.structures import Frame, GaussianModel, UncertaintyVolume, VoxelGrid
from active3d_pipe.uncertainty import explicit, fusion, implicit, occupancy, temporal
from active3d_pipe.uncertainty.carving import RayEvidence, integrate_depth, looks_in_vain
from active3d_pipe.uncertainty.config import UncertaintySettings
from active3d_pipe.uncertainty.explicit import ViewResidual

# Attention below which what the field says of a voxel counts for nothing.
MASKED = 0.02
FieldQuery = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


def make_grid(low: np.ndarray, high: np.ndarray, settings: UncertaintySettings) -> VoxelGrid:
    """The grid of every volume: the bounds [low, high] (world, m) widened by `margin_m`."""
    margin = settings.margin_m
    return VoxelGrid.from_bounds(np.asarray(low) - margin, np.asarray(high) + margin, settings.voxel_size_m)


def compute_volume(  # noqa: PLR0913  (the inputs of the stage, by name)
    *,
    grid: VoxelGrid,
    round: int,
    previous: UncertaintyVolume | None,
    field_query: FieldQuery,
    gaussians: GaussianModel,
    new_frames: Sequence[Frame],
    views: Sequence[ViewResidual],
    predicted: Sequence[ViewResidual],
    settings: UncertaintySettings,
) -> UncertaintyVolume:
    """Volume of round `round` from the map of this round and everything that was observed so far.

    Unseen space is uncertain; seen free space is not, whatever the field invents there. All u are in 0..1 before
    fusion: u_imp = 1 where unseen, u_exp 1 = residual far above its scale, u_time 1 = full change of the SDF;
    u_final is in units of the normalised residual that it predicts.

    Args:
        grid: of every volume; `previous` must be on the same one.
        previous: volume of the last round, None in the first: it carries the evidence and the fusion statistics.
        field_query: world points (N, 3) float32, m -> (sdf, sigma), (N,) each, m. Asked where it matters
            (`open_to_the_field`); elsewhere the SDF stays what it was.
        gaussians: the explicit branch of this round's map.
        new_frames: frames captured since `previous`.
        views: renderings of keyframes with this round's map against their images.
        predicted: renderings of the *previous* map at the poses of new frames, against those frames.

    Raises:
        InputError: `previous` is on another grid, or `field_query` returns the wrong number of values.
        NumericalError: the field returns NaN or infinite values.
    """
    _check_grid(grid, previous)
    before = RayEvidence.none(grid) if previous is None else _evidence_of(previous)
    fresh = integrate_depth(grid, new_frames, settings)
    evidence = before.joined(fresh)

    not_free = occupancy.attention(evidence, settings)
    sdf, sigma = _query(grid, field_query, previous, open_to_the_field(evidence, not_free))
    observed = occupancy.observation(evidence, settings)
    vain = looks_in_vain(grid, new_frames, evidence.hit > 0, settings)
    if previous is not None:
        vain = vain + previous["vain_looks"]
    open_share = occupancy.resolvable(vain, observed, settings)
    attention = open_share * not_free
    support = implicit.cube_support(sdf, grid.voxel_size)
    p_imp = implicit.implicit_occupancy(sdf, sigma, observed, support, settings)
    log_odds = occupancy.explicit_log_odds(evidence, occupancy.opacity_mass(grid, gaussians), settings)
    entropy_imp = attention * implicit.implicit_entropy(sdf, sigma, observed, support, settings)
    entropy_exp = open_share * bernoulli_entropy(expit(log_odds))

    known = implicit.knowledge(observed, evidence.hit, settings)
    u_imp = attention * implicit.implicit_uncertainty(sigma, known, settings)
    last_u_exp = None if previous is None else previous["u_exp"]
    # Residuals lie at observed depths, never at phantoms, and their trilinear weights reach the voxels beside a
    # surface, which may prove to hold it; only what lies in the midst of free space is forgotten.
    near = maximum_filter(attention, size=3, mode="nearest")
    u_exp = near * explicit.explicit_uncertainty(grid, views, last_u_exp, settings)
    u_time = np.zeros(grid.shape, np.float32)
    if previous is not None:
        # What the field does in space known to be free is a phantom, unless this round's rays found it otherwise;
        # space that was not known to be free before the round, and is now, is news.
        found = np.where(fresh.free + fresh.hit > 0, occupancy.attention(fresh, settings), 0)
        relevant = observed * np.maximum(found, occupancy.attention(before, settings))
        u_time = temporal.temporal_uncertainty(sdf, previous["sdf"], previous["u_time"], relevant, settings)

    rows, targets = revealed_rows(grid, previous, fresh, predicted, settings)
    statistics = _statistics_of(previous).updated(rows, targets, settings.forgetting)
    fused = fusion.fuse(statistics, settings)
    a = fused.alphas.astype(np.float32)

    arrays = {
        "u_imp": u_imp,
        "u_exp": u_exp,
        "u_time": u_time,
        "u_final": a[0] * u_imp + a[1] * u_exp + a[2] * u_time,
        "occupancy": occupancy.hybrid_occupancy(log_odds, p_imp, evidence, settings),
        "entropy_imp": entropy_imp,
        "entropy_exp": entropy_exp,
        "entropy": np.float32(settings.lambda_imp) * entropy_imp + np.float32(settings.lambda_exp) * entropy_exp,
        "sdf": sdf,
        "free_evidence": evidence.free,
        "hit_evidence": evidence.hit,
        "view_quality": evidence.quality,
        "vain_looks": vain,
        "cells_passed": evidence.passed,
        "cells_hit": evidence.ended,
    }
    arrays = {name: np.ascontiguousarray(array, dtype=np.float32) for name, array in arrays.items()}
    drop = None if previous is None else entropy_drop(previous.arrays, arrays)
    return UncertaintyVolume(grid, round, arrays, fused.to_json(statistics, len(targets)), drop)


def revealed_rows(
    grid: VoxelGrid, previous: UncertaintyVolume | None, fresh: RayEvidence, predicted: Sequence[ViewResidual],
    settings: UncertaintySettings,
) -> tuple[np.ndarray, np.ndarray]:
    """Rows (N, 3) of the last round's u_imp, u_exp, u_time and targets (N,): the realised residual.

    One row for every voxel in which rays of the new frames ended and that a prediction covers, whether it was seen
    before or not.
    """
    if previous is None or not predicted:
        return np.zeros((0, 3)), np.zeros(0)
    residual, coverage = explicit.backproject(grid, predicted, settings)
    revealed = (fresh.hit > 0) & (coverage > 0)
    rows = np.stack([previous[f"u_{name}"][revealed] for name in fusion.TERMS], axis=-1)
    return rows, residual[revealed]


def open_to_the_field(evidence: RayEvidence, not_free: np.ndarray) -> np.ndarray:
    """(X, Y, Z) bool, voxels of which the field's opinion matters: some two thirds of a volume may go without.

    Where no ray went, nothing that is computed depends on it; in space that rays surely found free it is masked. The
    voxels next to all others are asked too, for the gradient of the SDF. `not_free` is `occupancy.attention`.
    """
    unseen = (evidence.free + evidence.hit == 0).view(np.uint8)
    surely_free = (not_free < MASKED).view(np.uint8)
    settled = [minimum_filter(a, size=3, mode="nearest") for a in (unseen, surely_free)]
    return (settled[0] | settled[1]) == 0


def _query(
    grid: VoxelGrid, field_query: FieldQuery, previous: UncertaintyVolume | None, mask: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """SDF and sigma at the centres of the voxels in `mask`, m, elsewhere the SDF of `previous`; without one, of all."""
    if previous is None:
        mask = np.ones(grid.shape, bool)
    points = np.stack([grid.axis(i).astype(np.float32)[at] for i, at in enumerate(np.nonzero(mask))], axis=-1)
    values = field_query(points)
    out = []
    for name, value in zip(("sdf", "sigma"), values, strict=True):
        a = np.asarray(value, dtype=np.float32).ravel()
        if a.size != len(points):
            raise InputError(f"uncertainty: the field returned {a.size} values of {name}, expected {len(points)}")
        if not np.isfinite(a).all():
            raise NumericalError(f"uncertainty: {name} of the field holds NaN or infinite values")
        out.append(a)
    sdf = np.zeros(grid.shape, np.float32) if previous is None else previous["sdf"].copy()
    sigma = np.zeros(grid.shape, np.float32)
    sdf[mask], sigma[mask] = out
    return sdf, sigma


def _check_grid(grid: VoxelGrid, previous: UncertaintyVolume | None) -> None:
    if previous is None:
        return
    p = previous.grid
    if p.shape != grid.shape or p.voxel_size != grid.voxel_size or not np.array_equal(p.origin, grid.origin):
        raise InputError(
            f"uncertainty: the volume of round {previous.round} is on grid {p.shape} at {p.origin.tolist()}, "
            f"expected {grid.shape} at {grid.origin.tolist()}; use one grid for the whole run"
        )


def _evidence_of(volume: UncertaintyVolume) -> RayEvidence:
    cells = (volume[name].astype(np.uint8) for name in ("cells_passed", "cells_hit"))
    return RayEvidence(volume["free_evidence"], volume["hit_evidence"], volume["view_quality"], *cells)


def _statistics_of(previous: UncertaintyVolume | None) -> fusion.FusionStatistics:
    if previous is None or "statistics" not in previous.fusion:
        return fusion.FusionStatistics.empty()
    return fusion.FusionStatistics.from_json(previous.fusion["statistics"])
