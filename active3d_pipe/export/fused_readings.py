"""Under a noisy sensor: the mean of all readings wherever there are many, the field where there are few."""

from collections.abc import Sequence

import numpy as np

from active3d_pipe.errors import ConfigError
from active3d_pipe.export.config import MeshSettings
from active3d_pipe.field.config import TsdfSettings
from active3d_pipe.field.tsdf import TsdfField
from active3d_pipe.geometry.lattice import Points, SdfQuery
from active3d_pipe.geometry.sensor_noise import sensor_noise, typical_noise
from active3d_pipe.structures import Frame

TRUNCATION_CELLS = 4.0  # of the fusion, marching-cubes cells
MOST_MEGABYTES = 2048.0  # of the fused volume
MANY = 10  # readings from which their mean is believed


def fused_if_noisy(
    query_sdf: SdfQuery, low: np.ndarray, high: np.ndarray, frames: Sequence[Frame], settings: MeshSettings
) -> SdfQuery:
    """`query_sdf`; under a sensor noisier than `fuse_noise_m`, TSDF fusion of all `frames` where that saw enough.

    A field is trained on a few readings of each place, fusion takes the mean of all of them: of exact ones it makes
    nothing better than the field is, of noisy ones it does. A scene whose fused volume would need more than
    `MOST_MEGABYTES` keeps the field. Arguments as of `correction.corrected_sdf`.
    """
    if settings.fuse_noise_m <= 0 or not frames or typical_noise(sensor_noise(frames), frames) < settings.fuse_noise_m:
        return query_sdf
    size = settings.voxel_size_m
    fusion = TsdfSettings(voxel_m=size, truncation_m=TRUNCATION_CELLS * size, max_megabytes=MOST_MEGABYTES)
    try:
        fused = TsdfField(low, high, fusion)
        fused.integrate(frames)
    except ConfigError:  # more surface than fits: a run must not fail at its end for what the field has all the same
        return query_sdf

    def query(points: Points) -> np.ndarray:
        sdf, readings = fused.query_fused(points)
        few = np.flatnonzero(readings < MANY)
        if len(few):
            sdf[few] = query_sdf(points[few])
        return sdf

    return query
