"""Frozen dataclasses that flow between rooms; NumPy only, validated where they are born."""

from active3d_pipe.structures.camera import Camera
from active3d_pipe.structures.decision import Decision, Reason, ScoredCandidate
from active3d_pipe.structures.frame import Frame, check_pose
from active3d_pipe.structures.gaussian_model import GaussianModel
from active3d_pipe.structures.settings import Settings
from active3d_pipe.structures.triangle_mesh import TriangleMesh
from active3d_pipe.structures.uncertainty_volume import VOLUMES, UncertaintyVolume
from active3d_pipe.structures.voxel_grid import VoxelGrid

__all__ = [
    "VOLUMES", "Camera", "Decision", "Frame", "GaussianModel", "Reason", "ScoredCandidate", "Settings", "TriangleMesh",
    "UncertaintyVolume", "VoxelGrid", "check_pose",
]
