"""What the report shows, and how large."""

from pydantic import Field

from active3d_pipe.structures import Settings


class ReportSettings(Settings):
    """Knobs of the page; none of them changes a number in it."""

    max_views: int = Field(6, ge=0, description="held-out views shown, spread from the worst to the best")
    max_rounds: int = Field(6, ge=1, description="rounds shown in the uncertainty slices, evenly spread over the run")
    max_decisions: int = Field(200, ge=0, description="rows of the decision table; beyond it, evenly chosen ones")
    slice_height_m: float | None = Field(
        None, description="height of the horizontal slices, m; null = the height of the start pose"
    )
    image_width_px: int = Field(480, ge=64, description="width of embedded photographs and maps, px")
    mesh_width_px: int = Field(640, ge=64, description="width of the mesh pictures, px")
    jpeg_quality: int = Field(86, ge=30, le=100, description="quality of embedded photographs")
    figure_scale: float = Field(2.0, ge=0.5, le=4, description="pixels per CSS pixel of the charts")
    color_error_scale: float = Field(0.25, gt=0, le=1, description="colour error at the top of the error maps' scale")
    depth_error_scale_m: float = Field(0.10, gt=0, description="depth error at the top of the depth error maps, m")
