"""What the depth sensor does to the true depth: noise, range limits, dropped pixels, rounding."""

import numpy as np

from active3d_pipe.sim.config import SensorSettings
from active3d_pipe.structures import Camera


def apply_depth_sensor(
    depth: np.ndarray, camera: Camera, settings: SensorSettings, rng: np.random.Generator
) -> np.ndarray:
    """The reading (H, W) float32 m of a true depth image (H, W) float32 m; no reading: 0, in `depth`
    also infinite.

    Standard deviation of the noise: depth_noise_base_m + depth_noise_per_m2 * depth^2 (structured-light sensors,
    Khoshelham and Elberink 2012). A reading outside the camera's or the sensor's range is lost.
    """
    low, high = max(camera.near, settings.min_range_m), min(camera.far, settings.max_range_m)
    noisy = settings.depth_noise_base_m > 0 or settings.depth_noise_per_m2 > 0
    if not (noisy or settings.depth_quantum_m > 0 or settings.dropout > 0):
        return np.where((depth > 0) & (depth >= low) & (depth <= high), depth, 0)
    out = depth.astype(np.float64)
    valid = np.isfinite(out) & (out > 0)
    out = np.where(valid, out, 0.0)
    if noisy:
        sigma = settings.depth_noise_base_m + settings.depth_noise_per_m2 * out**2
        out = out + sigma * rng.standard_normal(out.shape)
    if settings.depth_quantum_m > 0:
        out = np.rint(out / settings.depth_quantum_m) * settings.depth_quantum_m
    valid &= (out >= low) & (out <= high) & (out > 0)
    if settings.dropout > 0:
        valid &= rng.random(out.shape) >= settings.dropout
    return np.where(valid, out, 0.0).astype(np.float32)


def frame_generator(seed: int, step: int) -> np.random.Generator:
    """The generator of one frame's sensor noise: the same for the same (seed, step)."""
    return np.random.default_rng(np.random.SeedSequence([seed, step, 0x5EED]))
