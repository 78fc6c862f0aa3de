"""The uncertainty volume of one round: the algorithm on one page (paper, sec. uncertainty_map)."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from active3d_pipe.errors import InputError, NumericalError
from active3d_pipe.geometry.lattice import LatticePoints, Points
from active3d_pipe.information.gain import entropy_drop
from active3d_pipe.structures import Frame, GaussianModel, UncertaintyVolume, VoxelGrid
from active3d_pipe.uncertainty import explicit, fusion, kernels, occupancy
from active3d_pipe.uncertainty.carving import RayEvidence, integrate_depth, looks_in_vain
from active3d_pipe.uncertainty.config import UncertaintySettings
from active3d_pipe.uncertainty.explicit import ViewResidual
from active3d_pipe.uncertainty.terms import due_to_the_field, open_to_the_field, voxel_terms

FieldQuery = Callable[[Points], tuple[np.ndarray, np.ndarray]]


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
    last_field_query: FieldQuery | None = None,
) -> UncertaintyVolume:
    """Volume of round `round` from the map of this round and everything that was observed so far.

    Unseen space is uncertain; seen free space is not, whatever the field invents there. All u are in 0..1 before
    fusion: u_imp = 1 where unseen, u_exp 1 = residual far above its scale, u_time 1 = full change of the SDF;
    u_final is in units of the normalised residual that it predicts.

    Args:
        grid: of every volume; `previous` must be on the same one.
        previous: volume of the last round, None in the first: it carries the evidence and the fusion statistics.
        field_query: world points (N, 3), m -> (sdf, sigma), (N,) each, m. Asked where it matters
            (`open_to_the_field`) and may have changed (`due_to_the_field`); elsewhere the SDF stays what it was.
        gaussians: the explicit branch of this round's map.
        new_frames: frames captured since `previous`.
        views: renderings of keyframes with this round's map against their images.
        predicted: renderings of the *previous* map at the poses of new frames, against those frames.
        last_field_query: the field of the previous round, for S_{t-1} of the temporal term in voxels that were not
            asked about then and are now. Without it their SDF of some earlier round stands in.

    Raises:
        InputError: `previous` is on another grid, or `field_query` returns the wrong number of values.
        NumericalError: the field returns NaN or infinite values.
    """
    _check_grid(grid, previous)
    before = RayEvidence.none(grid) if previous is None else _evidence_of(previous)
    fresh = integrate_depth(grid, new_frames, settings)
    evidence = before.joined(fresh)

    asked = due = open_to_the_field(evidence, settings)
    if previous is not None:
        late = asked & ~open_to_the_field(before, settings)
        due = due_to_the_field(asked, late, fresh, round, settings)
        if last_field_query is not None:
            sdf = _query(grid, last_field_query, previous, late)[0]
            previous = replace(previous, arrays={**previous.arrays, "sdf": sdf})
    sdf, sigma = _query(grid, field_query, previous, due)
    geometry = sdf, sigma * asked
    vain = looks_in_vain(grid, new_frames, evidence.hit > 0, settings)
    if previous is not None:
        vain = vain + previous["vain_looks"]
    mass = occupancy.opacity_mass(grid, gaussians)
    terms = voxel_terms(evidence, fresh, vain, mass, geometry, previous, settings, grid.voxel_size)

    last_u_exp = None if previous is None else previous["u_exp"]
    # Residuals lie at observed depths, never at phantoms, and their trilinear weights reach the voxels beside a
    # surface, which may prove to hold it; only what lies in the midst of free space is forgotten.
    u_exp = explicit.explicit_uncertainty(grid, views, last_u_exp, settings)
    kernels.near_attention(terms.attention, u_exp)

    rows, targets = revealed_rows(grid, previous, fresh, predicted, settings)
    statistics = _statistics_of(previous).updated(rows, targets, settings.forgetting)
    fused = fusion.fuse(statistics, settings)
    a = fused.alphas.astype(np.float32)

    arrays = {
        "u_imp": terms.u_imp,
        "u_exp": u_exp,
        "u_time": terms.u_time,
        "u_final": a[0] * terms.u_imp + a[1] * u_exp + a[2] * terms.u_time,
        "occupancy": terms.occupancy,
        "entropy_imp": terms.entropy_imp,
        "entropy_exp": terms.entropy_exp,
        "entropy": np.float32(settings.lambda_imp) * terms.entropy_imp
        + np.float32(settings.lambda_exp) * terms.entropy_exp,
        "sdf": geometry[0],
        "sigma": geometry[1],
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


def _query(
    grid: VoxelGrid, field_query: FieldQuery, previous: UncertaintyVolume | None, mask: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """SDF and sigma at the centres of the voxels in `mask`, m, elsewhere those of `previous`; without one, of all."""
    if previous is None:
        mask = np.ones(grid.shape, bool)
    points = LatticePoints((grid.axis(0), grid.axis(1), grid.axis(2)), np.flatnonzero(mask))
    values = field_query(points)
    out = []
    for name, value in zip(("sdf", "sigma"), values, strict=True):
        a = np.asarray(value, dtype=np.float32).ravel()
        if a.size != len(points):
            raise InputError(f"uncertainty: the field returned {a.size} values of {name}, expected {len(points)}")
        if not np.isfinite(a).all():
            raise NumericalError(f"uncertainty: {name} of the field holds NaN or infinite values")
        out.append(a)
    if previous is None:
        return out[0].reshape(grid.shape), out[1].reshape(grid.shape)
    sdf, sigma = previous["sdf"].copy(), previous["sigma"].copy()
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
