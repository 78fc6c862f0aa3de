"""The hierarchical uncertainty volume V_u (paper, sec. uncertainty_map) and what belongs to it."""

from dataclasses import dataclass, field

import numpy as np

from active3d_pipe.errors import InputError
from active3d_pipe.structures.voxel_grid import VoxelGrid

# name -> (unit, meaning). The order is the order on disk and in reports.
VOLUMES: dict[str, tuple[str, str]] = {
    "u_imp": ("1", "global structure uncertainty of the field (eq. global_uncertainty)"),
    "u_exp": ("1", "view-dependent local uncertainty of the Gaussians (eq. view_uncertainty)"),
    "u_time": ("1", "temporal variation uncertainty (eq. temporal_uncertainty)"),
    "u_final": ("1", "fused hierarchical uncertainty (eq. final_uncertainty)"),
    "occupancy": ("1", "O(v), probability that the voxel is solid"),
    "entropy_imp": ("bit", "Shannon entropy of the field's occupancy"),
    "entropy_exp": ("bit", "Shannon entropy of the observed / Gaussian occupancy"),
    "entropy": ("bit", "H_hybrid (eq. hybrid_entropy)"),
    "sdf": ("m", "signed distance predicted by the field, positive in free space"),
    "sigma": ("m", "standard deviation of that distance, 0 where the field is not asked"),
    "free_evidence": ("1", "number of depth rays that passed through the voxel"),
    "hit_evidence": ("1", "number of depth rays that ended in the voxel"),
    "view_quality": ("1", "best observation of the voxel's surface so far, 0 = unseen, 1 = close and frontal"),
    "vain_looks": ("1", "rounds in which rays through the voxel came back without a reading, and no other rays went"),
    "cells_passed": ("1", "bits of the eight half-size cells of the voxel that depth rays passed, 0 to 255"),
    "cells_hit": ("1", "bits of the eight half-size cells of the voxel that depth rays ended in, 0 to 255"),
}
# Layers that a producer may leave out: nothing happened there, or nothing is known about parts of voxels.
ZERO_BY_DEFAULT = ("sigma", "vain_looks", "cells_passed", "cells_hit")


@dataclass(frozen=True, slots=True, eq=False)
class UncertaintyVolume:
    """All volumes of one round, float32 [X, Y, Z] on one grid.

    Attributes:
        grid: the voxel grid.
        round: the round after whose mapping the volume was computed.
        arrays: one array for every name in `VOLUMES`.
        fusion: what evidence maximisation found: `alphas` (3,), `evidence`, `noise`, and the running
            statistics it needs next round, as plain JSON values.
        drop_bits: (field's, Gaussians') entropy lost since the volume before, bits, over the voxels of which rays of
            this round showed something new (`information.gain.entropy_drop`); None when there is none before.
    """

    grid: VoxelGrid
    round: int
    arrays: dict[str, np.ndarray]
    fusion: dict = field(default_factory=dict)
    drop_bits: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        for name in ZERO_BY_DEFAULT:
            if name not in self.arrays:
                object.__setattr__(self, "arrays", {**self.arrays, name: np.zeros(self.grid.shape, np.float32)})
        for name in VOLUMES:
            a = self.arrays.get(name)
            if a is None or a.shape != self.grid.shape or a.dtype != np.float32:
                got = "missing" if a is None else f"{a.shape} {a.dtype}"
                raise InputError(f"uncertainty volume: {name} is {got}, expected {self.grid.shape} float32")

    def __getitem__(self, name: str) -> np.ndarray:
        return self.arrays[name]

    @property
    def observed(self) -> np.ndarray:
        """(X, Y, Z) bool, voxels that at least one ray passed or hit."""
        return (self.arrays["free_evidence"] + self.arrays["hit_evidence"]) > 0
