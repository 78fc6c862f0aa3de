"""The hierarchical uncertainty volume: evidence, three terms, fusion, entropies (sec. uncertainty_map)."""

from active3d_pipe.uncertainty.carving import RayEvidence, integrate_depth
from active3d_pipe.uncertainty.config import UncertaintySettings
from active3d_pipe.uncertainty.explicit import ViewResidual, backproject, view_residuals
from active3d_pipe.uncertainty.volume import compute_volume, make_grid

__all__ = [
    "RayEvidence", "UncertaintySettings", "ViewResidual", "backproject", "compute_volume", "integrate_depth",
    "make_grid", "view_residuals",
]
