"""Implicit branch: encodings, decoders, ray rendering, losses."""

from active3d_pipe.field.config import FieldSettings
from active3d_pipe.field.optimise import FieldOptimiser, field_step
from active3d_pipe.field.rays import RayBatch, sample_rays
from active3d_pipe.field.sdf_field import FieldSamples, SdfField

__all__ = ["FieldOptimiser", "FieldSamples", "FieldSettings", "RayBatch", "SdfField", "field_step", "sample_rays"]
