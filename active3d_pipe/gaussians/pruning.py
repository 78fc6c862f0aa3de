"""Which Gaussians to drop."""

import numpy as np

from active3d_pipe.gaussians.config import GaussianSettings
from active3d_pipe.gaussians.parameters import GaussianParameters


def prune_mask(params: GaussianParameters, settings: GaussianSettings) -> np.ndarray:
    """(N,) bool, True = drop; apply with `params.keep(~mask)`.

    Dropped are primitives that are nearly transparent, of absurd size or not finite, and then, while more than
    `settings.max_count` remain, the least opaque ones; of equal ones the newest go first.

    Args:
        params: the model.
        settings: `prune_opacity`, `prune_scale_m`, `max_count`.
    """
    values = params.values.detach().numpy()
    opacity = params.opacity_logits.detach().sigmoid().numpy()
    drop = ~np.isfinite(values).all(axis=1)
    drop |= opacity < settings.prune_opacity
    drop |= params.log_scales.detach().numpy().max(axis=1, initial=-np.inf) > np.log(settings.prune_scale_m)
    excess = int(np.count_nonzero(~drop)) - settings.max_count
    if excess > 0:
        kept = np.flatnonzero(~drop)
        # Stable sort of the reversed list: among equals the newest comes first.
        ranked = kept[::-1][np.argsort(opacity[kept[::-1]], kind="stable")]
        drop[ranked[:excess]] = True
    return drop
