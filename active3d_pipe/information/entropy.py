"""Shannon entropy of a Bernoulli variable."""

import numpy as np


def bernoulli_entropy(p: np.ndarray | float) -> np.ndarray:
    """H[p] = -p log2 p - (1-p) log2 (1-p) in bits; 0 at p = 0 and 1 (the limit), values outside are clipped.

    Keeps the floating dtype of `p` (float64 for Python numbers). Used by eq. hybrid_entropy.
    """
    p = np.asarray(p)
    if p.dtype.kind != "f":
        p = p.astype(np.float64)
    p = np.clip(p, 0, 1)
    q = 1 - p
    # log2 of a zero never happens: its factor is zero, so any finite logarithm will do.
    return -(p * np.log2(np.where(p > 0, p, 1)) + q * np.log2(np.where(q > 0, q, 1)))
