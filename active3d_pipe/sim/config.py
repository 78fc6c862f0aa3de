"""Knobs of the simulated world: which scene, which camera, how good its depth sensor is."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from active3d_pipe.structures import Camera, Settings

Triple = Annotated[tuple[float, float, float], Field(description="x, y, z")]


class SceneSettings(Settings):
    """Which scene is explored and how its file is brought into the world frame (metres, Z up)."""

    file: str = Field("", description="scene file: .glb, .gltf, .obj or .ply; must be given")
    up_axis: Literal["auto", "X", "Y", "Z", "-X", "-Y", "-Z"] = Field(
        "auto", description="axis of the file that points up; auto: scene.json beside the file, else the geometry tells"
    )
    unit_scale: Literal["auto"] | Annotated[float, Field(gt=0)] = Field(
        "auto", description="metres per unit of the file; auto: scene.json, else the extent tells"
    )
    bounds: Literal["scene", "auto"] | tuple[Triple, Triple] = Field(
        "scene",
        description="box to explore: scene: that of the scene's mesh; auto: unknown, found in the depth readings and "
        "grown with them; or its lowest and highest corner, world, m",
    )
    start_position: Triple | None = Field(None, description="camera position at step 0, world, m; default: found")
    start_look_at: Triple | None = Field(None, description="point that the camera looks at at step 0, world, m")


class CameraSettings(Settings):
    """The pinhole camera that the agent carries."""

    width: int = Field(600, ge=8, le=8192, description="image width, px")
    height: int = Field(340, ge=8, le=8192, description="image height, px")
    hfov_deg: float = Field(90.0, gt=1, lt=170, description="horizontal field of view, degrees")
    near: float = Field(0.05, ge=0, description="shortest depth that counts as a reading, m")
    far: float = Field(10.0, gt=0, description="longest depth that counts as a reading, m")

    @model_validator(mode="after")
    def _check_range(self) -> Self:
        if self.near >= self.far:
            raise ValueError(f"near = {self.near:g} and far = {self.far:g}: expected near < far")
        return self

    def camera(self) -> Camera:
        """The intrinsics: square pixels, principal point in the middle of the image."""
        return Camera.from_fov(self.width, self.height, self.hfov_deg, near=self.near, far=self.far)


class SensorSettings(Settings):
    """How the scene is rendered and what the depth sensor does to the true depth."""

    backend: Literal["raster", "raycast", "pyrender"] = Field(
        "raster", description="renderer: raster (scan conversion, fastest), raycast (Open3D) or pyrender (EGL)"
    )
    edge_samples: int = Field(
        14, ge=0, le=64, description="colour samples of a pixel that holds an edge; 0 = no supersampling"
    )
    depth_noise_base_m: float = Field(0.0, ge=0, description="constant part of the depth noise's standard deviation, m")
    depth_noise_per_m2: float = Field(
        0.0, ge=0, description="standard deviation grows by this times depth squared, 1/m (0.002 is a consumer sensor)"
    )
    dropout: float = Field(0.0, ge=0, le=1, description="share of pixels whose depth is lost at random")
    min_range_m: float = Field(0.0, ge=0, description="readings nearer than this are lost, m")
    max_range_m: float = Field(100.0, gt=0, description="readings farther than this are lost, m")
    depth_quantum_m: float = Field(
        1 / 8192, ge=0, description="depth is rounded to multiples of this, m, so that logs compress; 0 = not rounded"
    )
