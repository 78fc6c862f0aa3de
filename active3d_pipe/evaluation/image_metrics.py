"""Image quality of a render against the true view: PSNR, SSIM, MS-SSIM, depth error.

Images are (H, W, 3) float in [0, 1]; masks are (H, W) bool. A pixel outside the mask has no part in any average:
it is neither an error nor counted as perfect.
"""

from collections.abc import Sequence

import numpy as np

from active3d_pipe.errors import InputError
from active3d_pipe.evaluation.kernels_ssim import ssim_rows

WINDOW, SIGMA = 11, 1.5  # Wang et al. 2004
K1, K2 = 0.01, 0.03
MS_SSIM_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)  # Wang et al. 2003, table of the exponents
PSNR_CAP = 100.0  # of identical images, where the formula is infinite and JSON has no number


def check_pair(a: np.ndarray, b: np.ndarray, mask: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Both images as float64 in [0, 1] and the mask (all True when None); InputError when shapes differ."""
    if a.shape != b.shape or a.ndim != 3:
        raise InputError(f"images are {a.shape} and {b.shape}; expected two of the same shape (H, W, channels)")
    if mask is None:
        mask = np.ones(a.shape[:2], dtype=bool)
    if mask.shape != a.shape[:2]:
        raise InputError(f"mask is {mask.shape}, expected {a.shape[:2]} as the images")
    return np.clip(a, 0, 1).astype(np.float64), np.clip(b, 0, 1).astype(np.float64), mask.astype(bool)


def psnr(image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float | None:
    """Peak signal-to-noise ratio, dB, over masked pixels; 100 at most, None when the mask is empty."""
    image, truth, mask = check_pair(image, truth, mask)
    if not mask.any():
        return None
    mse = float(np.mean((image[mask] - truth[mask]) ** 2))
    return min(PSNR_CAP, -10 * float(np.log10(max(mse, 1e-30))))


def _gaussian_window() -> np.ndarray:
    x = np.arange(WINDOW) - WINDOW // 2
    g = np.exp(-(x**2) / (2 * SIGMA**2))
    return g / g.sum()


def _ssim_terms(a: np.ndarray, b: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Masked means of SSIM and of its contrast-structure factor, each (channels,).

    Window statistics are taken over the valid pixels of the window alone, so that an invalid pixel does not spoil
    its neighbours; with a full mask this is plain SSIM.
    """
    channels = a.shape[2]
    sums = np.zeros((len(mask), 2 * channels + 1))
    a, b = (np.ascontiguousarray(np.moveaxis(x, -1, 0)) for x in (a, b))
    ssim_rows(a, b, mask.astype(np.float64), _gaussian_window(), K1**2, K2**2, sums)
    means = sums.sum(axis=0)
    return means[:channels] / means[-1], means[channels:-1] / means[-1]


def _has_window(mask: np.ndarray) -> bool:
    r = WINDOW // 2
    return min(mask.shape) >= WINDOW and bool(mask[r:-r, r:-r].any())


def ssim(image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float | None:
    """Plain structural similarity, 11x11 Gaussian window of sigma 1.5, mean over valid pixels and channels.

    None when no valid pixel has its window inside the image. Source: Wang et al., Image quality assessment, 2004.
    """
    return ssim_pair(image, truth, mask, with_ms_ssim=False)[0]


def ms_ssim(image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float | None:
    """Multi-scale SSIM over five octaves (what the SplaTAM family reports as SSIM).

    None for images under 161 px on a side, whose coarsest octave has no window. Negative factors count as zero.
    Source: Wang et al., Multiscale structural similarity, 2003.
    """
    return ssim_pair(image, truth, mask)[1]


def ssim_pair(
    image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None, *, with_ms_ssim: bool = True
) -> tuple[float | None, float | None]:
    """`ssim` and `ms_ssim` of one pair; they share the finest octave, which is most of the work."""
    a, b, mask = check_pair(image, truth, mask)
    if not _has_window(mask):
        return None, None
    whole, cs = _ssim_terms(a, b, mask)
    plain = float(whole.mean())
    if not with_ms_ssim or min(mask.shape) <= (WINDOW - 1) * 2 ** (len(MS_SSIM_WEIGHTS) - 1):
        return plain, None
    product = np.maximum(cs, 0) ** MS_SSIM_WEIGHTS[0]
    for level, exponent in enumerate(MS_SSIM_WEIGHTS[1:], start=1):
        a, b, mask = _halve([a, b], mask)
        if not _has_window(mask):
            return plain, None
        whole, cs = _ssim_terms(a, b, mask)
        product *= np.maximum(whole if level == len(MS_SSIM_WEIGHTS) - 1 else cs, 0) ** exponent
    return plain, float(product.mean())


def _halve(images: Sequence[np.ndarray], mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Both images and their mask at half resolution: means over the valid pixels of each 2x2 block."""
    h, w = (n - n % 2 for n in mask.shape)

    def blocks(x: np.ndarray) -> np.ndarray:
        return x[0:h:2, 0:w:2] + x[1:h:2, 0:w:2] + x[0:h:2, 1:w:2] + x[1:h:2, 1:w:2]

    count = blocks(mask.astype(np.float64))[..., None]
    a, b = (blocks(x * mask[..., None]) / np.maximum(count, 1) for x in images)
    return a, b, count[..., 0] > 0


def depth_errors_cm(depth: np.ndarray, truth: np.ndarray) -> dict[str, float | None]:
    """Mean and median |depth difference|, cm, over pixels with true depth, (H, W) m along the optical axis.

    Where the model renders nothing its depth is 0 and the whole true depth counts as error.
    """
    if depth.shape != truth.shape:
        raise InputError(f"depth images are {depth.shape} and {truth.shape}; expected the same shape")
    valid = truth > 0
    if not valid.any():
        return {"depth_l1_cm": None, "depth_median_cm": None}
    error = np.abs(depth[valid].astype(np.float64) - truth[valid])
    return {"depth_l1_cm": 100 * float(error.mean()), "depth_median_cm": 100 * float(np.median(error))}
