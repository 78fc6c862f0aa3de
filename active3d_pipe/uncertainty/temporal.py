"""Temporal variation uncertainty: where the surface changed since the last round (eq. temporal_uncertainty)."""

import numpy as np

from active3d_pipe.uncertainty.config import UncertaintySettings


def focus_masks(
    sdf: np.ndarray, previous_sdf: np.ndarray, settings: UncertaintySettings
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """M_new, M_change and M_free, bool, from S_t and S_{t-1} in m (clipped to +-sdf_range_m by the caller)."""
    change = sdf - previous_sdf
    new = (sdf >= 0) & (sdf <= settings.tau_s_m) & (change > settings.tau_n_m)
    changed = np.abs(change) > settings.tau_c_m
    freed = (sdf > settings.tau_f_m) & (previous_sdf < -settings.tau_f_m)
    return new, changed, freed


def temporal_uncertainty(
    sdf: np.ndarray, previous_sdf: np.ndarray, previous_u: np.ndarray, relevant: np.ndarray,
    settings: UncertaintySettings,
) -> np.ndarray:
    """u_time in 0..1: beta_1 |S_t - S_{t-1}| / sdf_range_m (at most 1) + beta_2 [v in M_focus].

    SDF is compared within +-sdf_range_m, since the field saturates beyond its truncation distance and any change
    there is noise. The value of the last round fades by `temporal_decay` where nothing changes.

    Args:
        sdf, previous_sdf: S_t and S_{t-1}, m. previous_u: u_time of the last round.
        relevant: 0..1, how much a change matters: 0 outside observed space, and in space that was known to be free
            both before and after this round's frames, where only the field's phantoms move.
    """
    bound = np.float32(settings.sdf_range_m)
    now, before = np.clip(sdf, -bound, bound), np.clip(previous_sdf, -bound, bound)
    new, changed, freed = focus_masks(now, before, settings)
    size = np.minimum(np.abs(now - before) / bound, 1)
    u = np.float32(settings.beta_1) * size + np.float32(settings.beta_2) * (new | changed | freed)
    return np.maximum(relevant * u, np.float32(settings.temporal_decay) * previous_u).astype(np.float32)
