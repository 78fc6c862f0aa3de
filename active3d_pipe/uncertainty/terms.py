"""What is known voxel by voxel: attention, u_imp, u_time, occupancy, entropies of both branches."""

from dataclasses import dataclass

import numpy as np

from active3d_pipe.structures import UncertaintyVolume
from active3d_pipe.uncertainty import implicit, kernels_terms
from active3d_pipe.uncertainty.carving import RayEvidence
from active3d_pipe.uncertainty.config import UncertaintySettings
from active3d_pipe.uncertainty.kernels_terms import TermConstants

# Attention below which what the field says of a voxel counts for nothing.
MASKED = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class VoxelTerms:
    """Volumes of one round, float32 [X, Y, Z].

    Attributes:
        attention: 1 where unseen or occupied, towards 0 the surer a voxel is free; less after looks in vain.
        u_imp, u_time: two of the three terms, in 0..1. occupancy: O(v). entropy_imp, entropy_exp: bits in 0..1.
    """

    attention: np.ndarray
    u_imp: np.ndarray
    u_time: np.ndarray
    occupancy: np.ndarray
    entropy_imp: np.ndarray
    entropy_exp: np.ndarray


def voxel_terms(
    evidence: RayEvidence, fresh: RayEvidence, vain: np.ndarray, mass: np.ndarray,
    geometry: tuple[np.ndarray, np.ndarray], previous: UncertaintyVolume | None, settings: UncertaintySettings,
    voxel_size: float,
) -> VoxelTerms:
    """All of them in one pass (`kernels_terms`); `reference_terms` says the same in formulas over whole volumes.

    Args:
        evidence: all rays so far. fresh: those of this round.
        vain: rounds of looks in vain. mass: `occupancy.opacity_mass`. geometry: sdf and sigma of the field, m.
        previous: volume of the last round, None in the first.
    """
    sdf, sigma = geometry
    constants = _constants(settings)._replace(voxel_size_m=float(voxel_size))
    out = VoxelTerms(*(np.zeros(sdf.shape, np.float32) for _ in range(6)))
    nothing = np.zeros((1, 1, 1), np.float32)
    last_sdf, last_u_time = (nothing, nothing) if previous is None else (previous["sdf"], previous["u_time"])
    kernels_terms.voxel_terms(
        evidence.free, evidence.hit, fresh.free, fresh.hit, vain, mass, sdf, sigma, last_sdf, last_u_time,
        previous is not None, constants, implicit.ENTROPY_INTEGRAL, implicit.ENTROPY_REACH,
        out.attention, out.u_imp, out.u_time, out.occupancy, out.entropy_imp, out.entropy_exp,
    )
    return out


def open_to_the_field(evidence: RayEvidence, settings: UncertaintySettings) -> np.ndarray:
    """(X, Y, Z) bool, voxels of which the field's opinion matters: some two thirds of a volume may go without.

    Where no ray went, nothing that is computed depends on it; in space that rays surely found free it is masked. The
    voxels next to all others are asked too, for the gradient of the SDF.
    """
    out = np.zeros(evidence.free.shape, np.uint8)
    least = np.log(MASKED / (2 - MASKED))  # of the log-odds, where `occupancy.attention` is MASKED
    kernels_terms.near_open_space(evidence.free, evidence.hit, _constants(settings), least, out)
    return out.view(bool)


def due_to_the_field(
    asked: np.ndarray, late: np.ndarray, fresh: RayEvidence, round: int, settings: UncertaintySettings
) -> np.ndarray:
    """(X, Y, Z) bool, voxels of `asked` of which the field is asked in this round.

    All that rays of this round came near to, all of `late`, which were not asked about before, and by turns a part of
    the rest, where the field hardly changes from round to round.
    """
    out = np.zeros(asked.shape, np.uint8)
    kernels_terms.due(asked, late, fresh.free, fresh.hit, round, settings.field_turns, out)
    return out.view(bool)


def _constants(settings: UncertaintySettings) -> TermConstants:
    return TermConstants(*(float(getattr(settings, name)) for name in TermConstants._fields))
