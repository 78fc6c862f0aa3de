"""Seamless noise, colour ramps and blending: what procedural textures are made of; images are float32 in 0..1."""

from collections.abc import Sequence

import numpy as np
from scipy import fft

Colour = Sequence[float] | np.ndarray

# Hues that go together in a home: brick, terracotta, sand, ochre, olive, sage, teal, petrol, slate, navy, dusty rose.
HUES = (0.01, 0.045, 0.085, 0.12, 0.19, 0.33, 0.47, 0.53, 0.58, 0.62, 0.965)


def pick_hue(rng: np.random.Generator) -> float:
    """One of HUES, a little moved."""
    return float(HUES[int(rng.integers(len(HUES)))] + rng.normal(0, 0.012)) % 1.0


def noise(
    rng: np.random.Generator, n: int, beta: float = 1.3, *, stretch: tuple[float, float] = (1.0, 1.0), low: float = 1.0
) -> np.ndarray:
    """Seamless fractal noise (n, n), zero mean, unit deviation: amplitude spectrum f^-beta from `low` cycles on.

    `stretch` = (along u, along v) elongates the features.
    """
    fv = np.fft.fftfreq(n, 1 / n).astype(np.float32)[:, None] * np.float32(stretch[1])
    fu = np.fft.rfftfreq(n, 1 / n).astype(np.float32)[None, :] * np.float32(stretch[0])
    f = np.hypot(fu, fv)
    amplitude = np.where(f < low * 0.999, 0, np.maximum(f, 1e-3) ** np.float32(-beta)).astype(np.float32)
    amplitude[0, 0] = 0
    draw = rng.standard_normal((2, *amplitude.shape), dtype=np.float32)
    field = fft.irfft2((draw[0] + 1j * draw[1]) * amplitude, s=(n, n))
    return (field / max(float(field.std()), 1e-9)).astype(np.float32)


def coordinates(n: int) -> tuple[np.ndarray, np.ndarray]:
    """u (columns) and v (rows) of pixel centres in 0..1, each (n, n) float32."""
    t = (np.arange(n, dtype=np.float32) + 0.5) / n
    return np.broadcast_to(t[None], (n, n)), np.broadcast_to(t[:, None], (n, n))


def ramp(t: np.ndarray, *colours: Colour) -> np.ndarray:
    """Interpolate between colours at t in 0..1; (..., 3) float32."""
    stops = np.linspace(0, 1, len(colours))
    c = np.asarray(colours, dtype=np.float32)
    return np.stack([np.interp(t, stops, c[:, i]) for i in range(3)], axis=-1).astype(np.float32)


def shade(image: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """Multiply an image (..., 3) by a gain (...)."""
    return image * gain[..., None].astype(np.float32)


def blend(a: np.ndarray, b: Colour, weight: np.ndarray) -> np.ndarray:
    """a where weight = 0, b where weight = 1."""
    out = np.asarray(b, dtype=np.float32) - a
    out *= weight[..., None].astype(np.float32)
    out += a
    return out


def smooth(edge0: float, edge1: float, t: np.ndarray) -> np.ndarray:
    """Cubic step from 0 at edge0 to 1 at edge1."""
    x = np.clip((t - edge0) / (edge1 - edge0), 0, 1)
    return x * x * (3 - 2 * x)


def warp(image: np.ndarray, du: np.ndarray, dv: np.ndarray) -> np.ndarray:
    """Look up `image` (n, n) displaced by (du, dv) pixels, wrapping around; nearest pixel."""
    n = image.shape[0]
    i = (np.arange(n)[:, None] + np.rint(dv).astype(np.int64)) % n
    j = (np.arange(n)[None, :] + np.rint(du).astype(np.int64)) % n
    return image[i, j]
