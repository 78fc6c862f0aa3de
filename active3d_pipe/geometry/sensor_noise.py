"""What the depth readings themselves say of the sensor's noise."""

from collections.abc import Sequence

import numpy as np

from active3d_pipe.geometry.sampling import spread
from active3d_pipe.structures import Frame

MOST_FRAMES = 100  # evenly spread, that are asked
ROW_STRIDE = 16  # rows of an image, every how many are asked
DEPTH_FRAMES, DEPTH_STRIDE = 50, 8  # evenly spread, and every how many pixels: how far readings are, as a rule
FROM_MEDIAN = 1 / (0.6745 * 6**0.5)  # standard deviation of a reading by the median of |a - 2 b + c|


def sensor_noise(frames: Sequence[Frame]) -> np.ndarray:
    """(D,) float32 standard deviation of the depth noise, m, of readings from 0 to 1 m, from 1 to 2 m, and so on.

    By the second difference of the inverse depth along image rows, which is zero on planes, however they are seen: its
    median over all readings leaves edges and what is curved out of account.
    """
    depths, errors = [], []
    for frame in spread(frames, MOST_FRAMES):
        d = frame.depth[ROW_STRIDE // 2 :: ROW_STRIDE]
        d = np.where(d > 0, d, np.nan)
        inverse, middle = 1 / d, d[:, 1:-1]
        error = np.abs(inverse[:, :-2] - 2 * inverse[:, 1:-1] + inverse[:, 2:]) * middle**2
        known = np.isfinite(error)
        depths.append(middle[known].astype(np.int64))
        errors.append(error[known])
    near, error = np.concatenate(depths), np.concatenate(errors)
    out = np.zeros(max(int(near.max(initial=0)), 0) + 1, np.float32)
    for metre in np.unique(near):
        out[metre] = np.median(error[near == metre]) * FROM_MEDIAN
    return out


def typical_noise(noise: np.ndarray, frames: Sequence[Frame]) -> float:
    """Standard deviation, m, of the median reading of `frames`, from what `sensor_noise` found; 0 without readings."""
    some = spread(frames, DEPTH_FRAMES)
    depths = np.concatenate([np.zeros(0), *(f.depth[::DEPTH_STRIDE, ::DEPTH_STRIDE].ravel() for f in some)])
    depths = depths[depths > 0]
    return float(np.median(noise_at(noise, depths))) if len(depths) else 0.0


def noise_at(noise: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Standard deviation, m, of readings at `depth` (any shape, m), from what `sensor_noise` found."""
    return noise[np.clip(depth, 0, len(noise) - 1).astype(np.int64)]
