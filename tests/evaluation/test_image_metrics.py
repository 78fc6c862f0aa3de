"""Image metrics against closed forms and scikit-image."""

import numpy as np
import pytest
from skimage.metrics import structural_similarity

from active3d_pipe.errors import InputError
from active3d_pipe.evaluation import image_metrics as im


def picture(height=96, width=128, seed=0):
    """Smooth structure with an edge and texture, in [0, 1]."""
    y, x = np.mgrid[0:height, 0:width] / 32
    rng = np.random.default_rng(seed)
    base = 0.5 + 0.2 * np.sin(3 * x) * np.cos(2 * y) + 0.2 * (x > 2) + 0.05 * rng.standard_normal((height, width))
    return np.clip(np.stack([base, 0.8 * base, base**2], axis=-1), 0, 1)


def noisy(image, sigma, seed=1):
    return np.clip(image + np.random.default_rng(seed).normal(0, sigma, image.shape), 0, 1)


def test_constant_offset_has_the_psnr_of_the_formula():
    a = np.full((20, 30, 3), 0.5)
    assert im.psnr(a, a + 0.1) == pytest.approx(20.0)
    assert im.psnr(a, a + 0.01) == pytest.approx(40.0)
    assert im.psnr(a, a) == im.PSNR_CAP


def test_masked_pixels_are_neither_errors_nor_perfect():
    truth = np.full((20, 30, 3), 0.5)
    render = truth + 0.1
    mask = np.ones((20, 30), bool)
    mask[:, 15:] = False
    assert im.psnr(render, truth, mask) == pytest.approx(20.0)  # multiplying by the mask would give 23 dB
    render[:, 15:] = 1.0  # nonsense where nothing is known
    assert im.psnr(render, truth, mask) == pytest.approx(20.0)
    assert im.psnr(render, truth, np.zeros_like(mask)) is None


def test_ssim_is_scikit_images_with_the_gaussian_window():
    a = picture()
    b = noisy(a, 0.08)
    expected = structural_similarity(
        a, b, channel_axis=2, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1.0
    )
    assert im.ssim(a, b) == pytest.approx(expected, abs=1e-9)


def test_ssim_of_constant_images_is_the_luminance_term():
    a, b = np.full((32, 32, 3), 0.4), np.full((32, 32, 3), 0.6)
    c1 = 0.01**2
    assert im.ssim(a, b) == pytest.approx((2 * 0.24 + c1) / (0.16 + 0.36 + c1), abs=1e-9)


def test_masked_ssim_ignores_what_is_outside_and_equals_the_plain_one_when_all_is_valid():
    a = picture()
    b = noisy(a, 0.05)
    full = np.ones(a.shape[:2], bool)
    assert im.ssim(a, b, full) == im.ssim(a, b)
    mask = full.copy()
    mask[30:60, 40:90] = False
    spoiled = b.copy()
    spoiled[~mask] = 1 - spoiled[~mask]
    assert im.ssim(a, spoiled, mask) == pytest.approx(im.ssim(a, b, mask), abs=1e-12)
    assert im.ms_ssim(picture(192, 192), picture(192, 192), np.zeros((192, 192), bool)) is None


def test_identity_is_perfect_and_noise_makes_everything_worse():
    a = picture(176, 192)
    assert im.ssim(a, a) == pytest.approx(1) and im.ms_ssim(a, a) == pytest.approx(1)
    for metric in (im.psnr, im.ssim, im.ms_ssim):
        values = [metric(noisy(a, sigma), a) for sigma in (0.01, 0.03, 0.1, 0.3)]
        assert values == sorted(values, reverse=True)
        assert values[0] > values[-1]


def test_a_shift_costs_more_than_the_same_image():
    ramp = 0.5 + 0.4 * np.sin(np.arange(128) * 2 * np.pi / 32)
    a = np.tile(ramp[None, :, None], (48, 1, 3))
    shifts = [im.ssim(np.roll(a, s, axis=1), a) for s in (0, 1, 2, 4, 8)]
    assert shifts == sorted(shifts, reverse=True) and shifts[0] == pytest.approx(1)
    assert len(set(shifts)) == 5


def test_ms_ssim_pinned_to_the_fields_implementation():
    """0.838563 is what pytorch-msssim 1.0.0 gives for these two images (float64, data range 1)."""
    rng = np.random.default_rng(7)
    a = np.cumsum(rng.normal(0, 0.05, (176, 192, 3)), axis=1) % 1
    b = np.clip(a + rng.normal(0, 0.3, a.shape), 0, 1)
    assert im.ms_ssim(a, b) == pytest.approx(0.8385629, abs=1e-6)
    assert im.ms_ssim(a[:160], b[:160]) is None  # no window left at the coarsest octave


def test_depth_error_counts_missing_depth_in_full():
    truth = np.full((10, 10), 2.0, np.float32)
    truth[:, :2] = 0  # unknown: out of every average
    render = truth + np.float32(0.03)
    assert im.depth_errors_cm(render, truth)["depth_l1_cm"] == pytest.approx(3.0, abs=1e-4)
    render[:, 2:6] = 0  # half of the valid pixels are not rendered
    errors = im.depth_errors_cm(render, truth)
    assert errors["depth_l1_cm"] == pytest.approx((3.0 + 200.0) / 2, abs=1e-3)
    assert im.depth_errors_cm(render, np.zeros_like(truth)) == {"depth_l1_cm": None, "depth_median_cm": None}


def test_shapes_must_agree():
    with pytest.raises(InputError, match="same shape"):
        im.psnr(np.zeros((4, 4, 3)), np.zeros((4, 5, 3)))
    with pytest.raises(InputError, match="mask"):
        im.psnr(np.zeros((4, 4, 3)), np.zeros((4, 4, 3)), np.ones((3, 3), bool))
    with pytest.raises(InputError, match="depth"):
        im.depth_errors_cm(np.zeros((4, 4)), np.zeros((4, 5)))


def test_the_pair_of_both_measures_is_the_two_of_them():
    rng = np.random.default_rng(5)
    a = rng.random((180, 170, 3))
    b, mask = np.clip(a + rng.normal(0, 0.1, a.shape), 0, 1), rng.random((180, 170)) < 0.8
    assert im.ssim_pair(a, b, mask) == (im.ssim(a, b, mask), im.ms_ssim(a, b, mask))
    assert im.ssim_pair(a, b, mask, with_ms_ssim=False) == (im.ssim(a, b, mask), None)
    assert im.ssim_pair(a, b, np.zeros_like(mask)) == (None, None)
