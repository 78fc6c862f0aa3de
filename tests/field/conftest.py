import numpy as np
import pytest
import torch
from room_with_ball import HIGH, LOW, RADIUS, SPHERE, render

from active3d_pipe.field.config import FieldSettings
from active3d_pipe.field.sdf_field import SdfField
from active3d_pipe.geometry import se3
from active3d_pipe.structures import Camera


@pytest.fixture(scope="session")
def frames():
    camera = Camera.from_fov(80, 60, 90)
    rng = np.random.default_rng(5)
    out = []
    while len(out) < 24:
        p = rng.uniform(LOW + 0.15, HIGH - 0.15)
        if np.linalg.norm(p - SPHERE) < RADIUS + 0.2:
            continue
        T = se3.pose_from_yaw_pitch(p, rng.uniform(0, 6.28), rng.uniform(-0.9, 0.9))
        out.append(render(camera, T, len(out)))
    return out


@pytest.fixture
def small():
    return FieldSettings(rays=64, prior_points=32, grid_voxel_m=0.2, plane_resolutions_m=(0.4, 0.2))


@pytest.fixture
def make_field():
    def make(settings, seed=0):
        return SdfField(LOW - 0.1, HIGH + 0.1, settings, torch.Generator().manual_seed(seed))

    return make
