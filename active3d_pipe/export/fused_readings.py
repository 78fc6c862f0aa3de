"""Under a noisy sensor: the mean of all readings wherever there are many, the field where there are few."""

from collections.abc import Callable, Sequence

import numpy as np

from active3d_pipe.errors import ConfigError
from active3d_pipe.export.config import MeshSettings
from active3d_pipe.field.config import TsdfSettings
from active3d_pipe.field.tsdf import TsdfField
from active3d_pipe.geometry.sampling import spread
from active3d_pipe.geometry.sensor_noise import noise_at, sensor_noise
from active3d_pipe.structures import Frame

TRUNCATION_CELLS = 4.0  # of the fusion, marching-cubes cells
MOST_MEGABYTES = 2048.0  # of the fused volume
MANY = 10  # readings from which their mean is believed
DEPTH_FRAMES, DEPTH_STRIDE = 50, 8  # evenly spread, and every how many pixels: how far readings are, as a rule


def fused_if_noisy(
    query_sdf: Callable[[np.ndarray], np.ndarray], low: np.ndarray, high: np.ndarray, frames: Sequence[Frame],
    settings: MeshSettings,
) -> Callable[[np.ndarray], np.ndarray]:
    """`query_sdf`; under a sensor noisier than `fuse_noise_m`, TSDF fusion of all `frames` where that saw enough.

    A field is trained on a few readings of each place, fusion takes the mean of all of them: of exact ones it makes
    nothing better than the field is, of noisy ones it does. A scene whose fused volume would need more than
    `MOST_MEGABYTES` keeps the field. Arguments as of `correction.corrected_sdf`.
    """
    if settings.fuse_noise_m <= 0 or not frames or typical_noise(frames) < settings.fuse_noise_m:
        return query_sdf
    size = settings.voxel_size_m
    fusion = TsdfSettings(voxel_m=size, truncation_m=TRUNCATION_CELLS * size, max_megabytes=MOST_MEGABYTES)
    try:
        fused = TsdfField(low, high, fusion)
        fused.integrate(frames)
    except ConfigError:  # more surface than fits: a run must not fail at its end for what the field has all the same
        return query_sdf

    def query(points: np.ndarray) -> np.ndarray:
        sdf, readings = fused.query_fused(points)
        few = np.flatnonzero(readings < MANY)
        if len(few):
            sdf[few] = query_sdf(np.ascontiguousarray(points[few]))
        return sdf

    return query


def typical_noise(frames: Sequence[Frame]) -> float:
    """Standard deviation, m, of the median reading's noise; 0 without readings."""
    depths = np.concatenate([f.depth[::DEPTH_STRIDE, ::DEPTH_STRIDE].ravel() for f in spread(frames, DEPTH_FRAMES)])
    depths = depths[depths > 0]
    return float(np.median(noise_at(sensor_noise(frames), depths))) if len(depths) else 0.0
