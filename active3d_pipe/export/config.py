"""Knobs of the final models."""

from pydantic import Field

from active3d_pipe.structures import Settings


class MeshSettings(Settings):
    """Extraction of the triangle mesh from the field."""

    voxel_size_m: float = Field(0.02, gt=0, description="edge of a marching-cubes cell, m")
    block_cells: int = Field(64, ge=8, multiple_of=2, description="edge of the blocks that bound the memory, cells")
    refine_margin: float = Field(
        1.25, ge=1, description="factor on the distance within which a coarse cell is refined; 1 trusts the SDF fully"
    )
    dilate_voxels: int = Field(1, ge=0, description="how far beyond observed surface voxels the surface may run")
    min_component_m2: float = Field(
        0.004, ge=0, description="connected pieces of less area are dropped as spurious, m2"
    )
    cull_tolerance_m: float = Field(
        0.05, gt=0, description="a face this far behind an observed depth still counts as seen, m"
    )
    cull_facing_cosine: float = Field(
        0.0, ge=-1, le=1, description="a face is seen only by cameras towards which its normal has at least this cosine"
    )


class ExportSettings(Settings):
    """What is handed over at the end of a run."""

    mesh: MeshSettings = Field(default_factory=MeshSettings, description="the coloured mesh")
    glb: bool = Field(True, description="write the mesh as GLB beside PLY")
    preview_voxel_m: float = Field(
        0.08, gt=0, description="cell edge of the coarse surface written every round (curves, looking at progress), m"
    )
