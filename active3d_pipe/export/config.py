"""Knobs of the final models."""

from typing import Literal

from pydantic import Field

from active3d_pipe.structures import Settings


class MeshSettings(Settings):
    """Extraction of the triangle mesh from the field."""

    voxel_size_m: float = Field(0.02, gt=0, description="edge of a marching-cubes cell, m")
    block_cells: int = Field(64, ge=8, multiple_of=2, description="edge of the blocks that bound the memory, cells")
    refine_margin: float = Field(
        0.5, ge=0, description="a coarse cell is refined when a corner is within this many fine cells of the surface"
    )
    dilate_voxels: int = Field(
        1, ge=0, description="how far beyond the volume's surface voxels the preview may run, voxels"
    )
    dilate_cells: int = Field(
        2, ge=0, description="how far from a depth reading the surface may run, coarse cells (two marching-cubes cells)"
    )
    min_component_m2: float = Field(
        0.004, ge=0, description="connected pieces of less area are dropped as spurious, m2"
    )
    cull_tolerance_m: float = Field(
        0.03, gt=0, description="a face counts as seen where an observed depth is this near to it along the axis, m"
    )
    cull_facing_cosine: float = Field(
        0.0, ge=-1, le=1, description="a face is seen only by cameras towards which its normal has at least this cosine"
    )
    cull_margin_m: float = Field(
        0.08, ge=0, description="faces this near to seen ones are kept although no frame saw them, m"
    )
    dispute_m: float = Field(
        0.004, ge=0,
        description="mean SDF at depth readings from which fused readings replace the field there, m; 0: never",
    )
    fuse_noise_m: float = Field(
        0.004, ge=0, description="standard deviation of the depth noise, found in the readings, from which TSDF fusion "
        "of all of them replaces the field wherever there are many, m; 0: never"
    )
    fusion_truncation_cells: float = Field(
        2.0, gt=0, description="truncation of that fusion, marching-cubes cells"
    )
    sheet_frames: int = Field(
        2, ge=0, description="frames with readings off the surface from which faces are laid through them; 0: never"
    )
    sheet_agreement: float = Field(
        0.25, ge=0, le=1, description="least share of the frames it is not hidden from that must read surface there"
    )
    colour: Literal["views", "field"] = Field(
        "views", description="views: from the logged frames that see a vertex; field: the field's own, softer"
    )
    colour_tolerance_m: float = Field(
        0.015, gt=0, description="a vertex this far from an observed depth takes colour from that frame, m"
    )


class ExportSettings(Settings):
    """What is handed over at the end of a run."""

    mesh: MeshSettings = Field(default_factory=MeshSettings, description="the coloured mesh")
    glb: bool = Field(True, description="write the mesh as GLB beside PLY")
    viewer_iterations: int = Field(
        600, ge=0, description="iterations that fit a copy of the Gaussians (gaussians.ply) to the filters of other "
        "programs; 0 = a plain copy of the map's"
    )
    viewer_learning_rate_scale: float = Field(
        0.3, gt=0, description="scale on the Gaussians' learning rates in that fit"
    )
    preview_voxel_m: float = Field(
        0.08, gt=0, description="cell edge of the coarse surface behind the curves over steps, m"
    )
