"""The explicit branch G_k as plain arrays: what crosses a seam or goes to disk."""

from dataclasses import dataclass

import numpy as np

from active3d_pipe.errors import InputError


@dataclass(frozen=True, slots=True, eq=False)
class GaussianModel:
    """N anisotropic 3D Gaussians G_i = (mu_i, Sigma_i, alpha_i, c_i) (paper, hybrid_state).

    Attributes (all float32):
        means: (N, 3) world, m.
        log_scales: (N, 3) natural logarithm of the standard deviation along each local axis, m.
        quats: (N, 4) rotation local -> world, (w, x, y, z), not necessarily normalised.
        opacity_logits: (N,) opacity = sigmoid(logit).
        colors: (N, 3) display colour; 0..1 is the displayable range.
    """

    means: np.ndarray
    log_scales: np.ndarray
    quats: np.ndarray
    opacity_logits: np.ndarray
    colors: np.ndarray

    def __post_init__(self) -> None:
        n = len(self.means)
        tails = {"means": (3,), "log_scales": (3,), "quats": (4,), "opacity_logits": (), "colors": (3,)}
        for name, tail in tails.items():
            a = getattr(self, name)
            if a.shape != (n, *tail) or a.dtype != np.float32:
                raise InputError(f"gaussians: {name} is {a.shape} {a.dtype}, expected {(n, *tail)} float32")

    def __len__(self) -> int:
        return len(self.means)

    @property
    def opacities(self) -> np.ndarray:
        """(N,) in [0, 1]."""
        return 1 / (1 + np.exp(-self.opacity_logits))

    @classmethod
    def empty(cls) -> "GaussianModel":
        """A model without primitives."""
        shapes = ((0, 3), (0, 3), (0, 4), (0,), (0, 3))
        return cls(*(np.zeros(s, np.float32) for s in shapes))
