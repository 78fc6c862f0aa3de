"""The pinhole camera.

OpenCV optical frame: +x right, +y down, +z forward. Pixel (row i, column j) has its centre at
(u, v) = (j + 0.5, i + 0.5), measured from the top-left *corner* of the image.
"""

import math
from dataclasses import dataclass, replace

from active3d_pipe.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Camera:
    """Intrinsics of a pinhole camera without distortion.

    Attributes:
        width, height: image size, px.
        fx, fy, cx, cy: focal lengths and principal point, px; cx counts from the left edge.
        near, far: range in which a depth reading is valid, m along the optical axis.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    near: float = 0.05
    far: float = 10.0

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1 or self.fx <= 0 or self.fy <= 0:
            raise ConfigError(
                f"camera {self.width}x{self.height} fx={self.fx} fy={self.fy}: expected a positive "
                "image size and focal length"
            )
        if not 0 <= self.near < self.far:
            raise ConfigError(f"camera range near={self.near} far={self.far}: expected 0 <= near < far")

    @classmethod
    def from_fov(
        cls, width: int, height: int, hfov_deg: float, *, near: float = 0.05, far: float = 10.0
    ) -> "Camera":
        """Square pixels, principal point in the middle, horizontal field of view in degrees."""
        focal = 0.5 * width / math.tan(math.radians(hfov_deg) / 2)
        return cls(width, height, focal, focal, width / 2, height / 2, near, far)

    def scaled(self, factor: float) -> "Camera":
        """The same camera with `factor` times the resolution (rounded to whole pixels)."""
        width, height = max(1, round(self.width * factor)), max(1, round(self.height * factor))
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )
