"""Expected information gain of looking at voxels, shared by keyframe choice and planning.

The observation model, in one place:

- A voxel is *surface* when depth rays ended in it and it is probably solid; *seen free* when enough rays passed it
  and it is no surface (whatever the field believes: phantom structure draws no attention); everything else is
  *open*: it may still turn out either way.
- A look at an open voxel settles it: each branch's entropy falls to a residual. The fraction of this that is still
  to be had is its novelty, 1 for a voxel that no ray reached and 0 once `settled_rays` did.
- A look at a surface voxel improves it as far as the look is better than the best so far (closer, more frontal),
  up to what is enough; beyond that nothing is gained, so close-ups are not chased.
- Seen free space tells nothing, whatever its U and H say.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from active3d_pipe.information import kernels
from active3d_pipe.information.config import SETTLED_RAYS, InformationSettings

FREE, OPEN, SURFACE = 0, 1, 2
# A voxel whose rays end in it at least this often is no free space: thin structure fills part of a voxel only.
THIN_HIT_SHARE = 0.1
# Uncertainty up to this is none.
LEAST_LEVEL = 1e-9


@dataclass(frozen=True, slots=True)
class GainTerms:
    """What one view is expected to bring.

    Attributes:
        reward: R(c) of eq. nbv_reward over the open voxels, plus the surface term.
        surface: the part of `reward` that comes from poorly seen surface.
        gain_imp, gain_exp: expected entropy reduction of each branch, bits (terms of eq. nbv_eig).
        num_visible: visible voxels. num_open: those of them that are not settled.
    """

    reward: float
    surface: float
    gain_imp: float
    gain_exp: float
    num_visible: int
    num_open: int

    @property
    def gain(self) -> float:
        """Delta I_hybrid = Delta H[F_theta] + Delta H[G_k], bits."""
        return self.gain_imp + self.gain_exp


@dataclass(frozen=True, slots=True, eq=False)
class InformationVolumes:
    """Per-voxel quantities that make up the gain of any view, each [X, Y, Z].

    Attributes:
        kind: uint8, FREE, OPEN or SURFACE.
        value: float32, w(v) (1 - O(v)) times novelty; 0 for surface and seen free space.
        surface_value: float32, what improving the surface from quality 0 to enough is worth.
        quality: float32, best observation so far.
        gain_imp, gain_exp: float32, expected entropy reduction of a look, bits.
    """

    kind: np.ndarray
    value: np.ndarray
    surface_value: np.ndarray
    quality: np.ndarray
    gain_imp: np.ndarray
    gain_exp: np.ndarray


def classify(arrays: Mapping[str, np.ndarray], settings: InformationSettings) -> np.ndarray:
    """uint8 kind of every voxel from occupancy and ray evidence (see the module's first lines)."""
    free, hit, occupancy = arrays["free_evidence"], arrays["hit_evidence"], arrays["occupancy"]
    out = np.empty(free.shape, np.uint8)
    kernels.classify(free, hit, occupancy, np.float32(settings.settled_rays), np.float32(THIN_HIT_SHARE), out)
    return out


def entropy_drop(
    before: Mapping[str, np.ndarray], after: Mapping[str, np.ndarray], settled_rays: float = SETTLED_RAYS
) -> tuple[float, float]:
    """(field's, Gaussians') entropy, bits, lost between two volumes of one run on one grid, where looks showed anew.

    That is where rays went meanwhile, into voxels that fewer than `settled_rays` had reached before or whose surface
    they saw better than any look had: the voxels that a prediction speaks of. Elsewhere the field's entropy drifts by
    thousands of bits with its training: no outcome of the looks.
    """
    rays = before["free_evidence"] + before["hit_evidence"]
    reached = (after["free_evidence"] != before["free_evidence"]) | (after["hit_evidence"] != before["hit_evidence"])
    anew = reached & ((rays < settled_rays) | (after["view_quality"] > before["view_quality"]))
    imp, exp = (
        float((before[name] - after[name])[anew].sum(dtype=np.float64)) for name in ("entropy_imp", "entropy_exp")
    )
    return imp, exp


def uncertainty_level(u_final: np.ndarray, observed: np.ndarray) -> float:
    """The unit of U(v): its typical value where nothing was observed; 0 when it is nothing anywhere.

    The scale of the fused uncertainty follows from the regression that fits it and drifts over a run; weights and
    thresholds of the planner need one that stays. Without the field's term unseen space has no uncertainty of its own:
    then the scale is what one in twenty observed voxels that have any exceeds.
    """
    unseen = np.maximum(u_final[~observed], 0)
    if unseen.size and np.count_nonzero(unseen <= LEAST_LEVEL) <= 0.1 * unseen.size:
        level = float(np.median(unseen))
    else:
        some = u_final[observed & (u_final > LEAST_LEVEL)]
        level = float(np.quantile(some, 0.95)) if some.size else float(u_final.max(initial=0.0))
    return level if level > LEAST_LEVEL else 0.0


def normalised_uncertainty(u_final: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """U(v) in units of `uncertainty_level`, clipped to [0, 2], float32."""
    level = uncertainty_level(u_final, observed)
    if level == 0:
        return np.zeros_like(u_final, dtype=np.float32)
    return np.clip(u_final / np.float32(level), 0, 2).astype(np.float32)


def hybrid_weight(u: np.ndarray, entropy: np.ndarray, settings: InformationSettings) -> np.ndarray:
    """w(v|c) = alpha U(v) + beta H_hybrid(v) (eq. nbv_weight)."""
    return np.float32(settings.alpha) * u + np.float32(settings.beta) * entropy


def view_quality(
    cos_incidence: np.ndarray | float, distance_m: np.ndarray | float, quality_range_m: float
) -> np.ndarray:
    """Quality of one look at a surface: |cos| of the incidence angle times min(1, quality_range / distance).

    The range is `InformationSettings.quality_range_m` of the camera.
    """
    near = np.minimum(1, quality_range_m / np.maximum(distance_m, 1e-6))
    return np.clip(np.abs(cos_incidence), 0, 1) * near


def information_volumes(
    arrays: Mapping[str, np.ndarray],
    settings: InformationSettings,
    enough_quality: float,
    credit: np.ndarray | None = None,
    kind: np.ndarray | None = None,
) -> InformationVolumes:
    """Gain quantities of every voxel, from the arrays of an `UncertaintyVolume`.

    Args:
        arrays: the volumes named in `structures.uncertainty_volume.VOLUMES`, float32 [X, Y, Z].
        enough_quality: `InformationSettings.enough_quality` of the camera.
        credit: [X, Y, Z] factor in [0, 1] on everything that is expected of a voxel, e.g. lowered where earlier
            looks brought nothing; None = 1.
        kind: what `classify` says, where it is known already.
    """
    if kind is None:
        kind = classify(arrays, settings)
    free, hit, u = arrays["free_evidence"], arrays["hit_evidence"], arrays["u_final"]
    trust = np.ones(kind.shape, np.float32) if credit is None else credit.astype(np.float32)
    level = uncertainty_level(u, (free > 0) | (hit > 0))
    filled = tuple(np.zeros(kind.shape, np.float32) for _ in range(4))
    weights = (level, settings.alpha, settings.beta, settings.surface_weight, settings.residual_bits)
    kernels.information(  # type: ignore[call-arg]
        kind, free, hit, arrays["occupancy"], u, arrays["entropy"], arrays["entropy_imp"], arrays["entropy_exp"],
        arrays["view_quality"], trust, *(np.float32(w) for w in weights), np.float32(settings.settled_rays),
        np.float32(enough_quality), *filled,
    )
    value, surface_value, gain_imp, gain_exp = filled
    return InformationVolumes(kind, value, surface_value, arrays["view_quality"], gain_imp, gain_exp)
