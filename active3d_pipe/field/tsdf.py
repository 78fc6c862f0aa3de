"""TSDF fusion (Curless & Levoy 1996) behind the interface of the neural field: nothing is learned, nothing guessed."""

from collections.abc import Sequence

import numpy as np

from active3d_pipe.errors import ArtifactError, ConfigError
from active3d_pipe.field import kernels_tsdf as kernels
from active3d_pipe.field.config import TsdfSettings
from active3d_pipe.field.encoding import check_memory
from active3d_pipe.field.normals import unit_gradients
from active3d_pipe.geometry import se3
from active3d_pipe.geometry.lattice import Points
from active3d_pipe.structures import Frame

MARK_STRIDE = 2  # px between the readings that allocate blocks; a block is many pixels wide
WIDTH = 6  # values of a voxel


class TsdfField:
    """Truncated signed distance and colour, means over all frames, in sparse blocks around the observed surface.

    What no frame reached counts as free at the truncation distance, as in a field that was not trained there. A
    TSDF predicts no uncertainty: sigma is the prior where nothing was fused, and falls with the square root of the
    number of observations elsewhere.

    Args:
        low, high: (3,) corners of the box in the world, m.
        settings: see `TsdfSettings`.
        anchor: (2, 3) the box with which the field was created, when it has grown since: blocks keep their places.
    """

    def __init__(
        self, low: np.ndarray, high: np.ndarray, settings: TsdfSettings, anchor: np.ndarray | None = None
    ) -> None:
        self.box = np.stack([low, high]).astype(np.float64)
        self.anchor = self.box if anchor is None else np.asarray(anchor, dtype=np.float64)
        self.low, self.high = self.box.astype(np.float32)
        self.settings = settings
        if self.low.shape != (3,) or not (self.high > self.low).all():
            raise ConfigError(f"field bounds {self.low.tolist()} .. {self.high.tolist()}: expected low < high")
        start = self.anchor[0].astype(np.float32)
        self._below = np.ceil(np.maximum(start - self.low, 0) / self._block_m - 1e-6).astype(np.int32)
        self._origin = (start - self._below * self._block_m).astype(np.float32)
        shape = np.ceil((self.high - self._origin) / self._block_m - 1e-6).astype(int)
        check_memory(int(shape.prod()), settings.max_megabytes)
        self._index = np.full(tuple(shape), -1, np.int32)
        self._blocks = np.zeros((0, 3), np.int32)
        self._values = np.zeros((0, kernels.BLOCK**3, WIDTH), np.float32)

    @property
    def _block_m(self) -> np.float32:
        return np.float32(kernels.BLOCK * self.settings.voxel_m)

    @property
    def truncation_m(self) -> float:
        """Distance at which the SDF is truncated, m."""
        return self.settings.truncation_m

    def grown(self, low: np.ndarray, high: np.ndarray) -> "TsdfField":
        """The same field over a larger box (world, m)."""
        box = np.stack([np.minimum(low, self.box[0]), np.maximum(high, self.box[1])])
        new = TsdfField(box[0], box[1], self.settings, self.anchor)
        arrays = new.state() | {"blocks": self._blocks + (new._below - self._below), "voxels": self._values}
        new.load_state(arrays)
        return new

    def integrate(self, frames: Sequence[Frame]) -> None:
        """Fuse posed RGB-D frames, each with weight one."""
        touched = [self._touched(frame) for frame in frames]
        if touched:
            self._allocate(np.any(touched, axis=0) & (self._index < 0))
        for frame, marks in zip(frames, touched, strict=True):
            blocks = np.argwhere(marks).astype(np.int32)
            T = se3.inverse(frame.T_world_camera)
            kernels.integrate(
                frame.depth, frame.rgb, *_pose(T), _intrinsics(frame), self._origin, np.float32(self.settings.voxel_m),
                np.float32(self.settings.truncation_m), blocks, self._index[marks], self._values,
            )

    def _touched(self, frame: Frame) -> np.ndarray:
        """(X, Y, Z) bool, blocks near the frame's readings."""
        marks = np.zeros(self._index.shape, bool)
        kernels.mark_blocks(
            frame.depth, *_pose(frame.T_world_camera), _intrinsics(frame), self._origin, self._block_m,
            np.float32(self.settings.truncation_m), MARK_STRIDE, marks,
        )
        return marks

    def _allocate(self, wanted: np.ndarray) -> None:
        new = np.argwhere(wanted).astype(np.int32)
        first = len(self._blocks)
        check_memory((first + len(new)) * kernels.BLOCK**3 * WIDTH, self.settings.max_megabytes)
        self._index[wanted] = np.arange(first, first + len(new), dtype=np.int32)
        self._blocks = np.concatenate([self._blocks, new])
        fresh = np.zeros((len(new), kernels.BLOCK**3, WIDTH), np.float32)
        self._values = np.concatenate([self._values, fresh])

    def _interpolate(self, points: Points) -> np.ndarray:
        """(N, 5) tsdf in truncations, weight, r, g, b at world points (N, 3)."""
        points = np.ascontiguousarray(points, np.float32).reshape(-1, 3)
        out = np.empty((len(points), 5), np.float32)
        kernels.interpolate(points, self._origin, np.float32(self.settings.voxel_m), self._index, self._values, out)
        return out

    def query_sdf(self, points: Points) -> np.ndarray:
        """(N,) float32 SDF in m at world points (N, 3), cut at +-truncation."""
        return self._interpolate(points)[:, 0] * np.float32(self.truncation_m)

    def query_fused(self, points: Points) -> tuple[np.ndarray, np.ndarray]:
        """(sdf, m, and how many readings it is the mean of), both (N,) float32, at world points (N, 3)."""
        found = self._interpolate(points)
        return found[:, 0] * np.float32(self.truncation_m), found[:, 1]

    def query_geometry(self, points: Points) -> tuple[np.ndarray, np.ndarray]:
        """(sdf, sigma), both (N,) float32 m, at world points (N, 3)."""
        found = self._interpolate(points)
        weight = found[:, 1]
        sigma = np.float32(self.settings.voxel_m / 2) / np.sqrt(np.maximum(weight, 1))
        sigma = np.where(weight > 0, sigma, np.float32(self.settings.sigma_prior_m))
        return found[:, 0] * np.float32(self.truncation_m), sigma.astype(np.float32)

    def query_color(self, points: np.ndarray, batch: int = 0) -> np.ndarray:
        """(N, 3) float32 colour in 0..1 at world points (N, 3); black where nothing was fused."""
        return np.ascontiguousarray(self._interpolate(points)[:, 2:])

    def normals(self, points: np.ndarray, step_m: float = 0.01) -> np.ndarray:
        """(N, 3) float32 unit SDF gradients at world points (N, 3), see `SdfField.normals`."""
        points = np.ascontiguousarray(points, np.float32).reshape(-1, 3)
        return unit_gradients(self.query_sdf, points, step_m)

    def state(self) -> dict[str, np.ndarray]:
        """Blocks, voxels and `boxes`, those at creation and now (copies); `load_state` restores them exactly."""
        boxes = np.stack([self.anchor, self.box])
        return {"blocks": self._blocks.copy(), "voxels": self._values.copy(), "boxes": boxes}

    def load_state(self, arrays: dict[str, np.ndarray]) -> None:
        """Inverse of `state`; ArtifactError when an array is missing or belongs to another box."""
        blocks, values = arrays.get("blocks"), arrays.get("voxels")
        shape = np.array(self._index.shape)
        if (
            blocks is None or values is None or blocks.dtype != np.int32 or values.dtype != np.float32
            or values.shape != (len(blocks), kernels.BLOCK**3, WIDTH) or (blocks < 0).any() or (blocks >= shape).any()
        ):
            raise ArtifactError(
                "TSDF state: blocks (B, 3) int32 and voxels (B, 512, 6) float32 of this box expected; "
                "it belongs to other bounds or settings"
            )
        self._index.fill(-1)
        self._index[tuple(blocks.T)] = np.arange(len(blocks), dtype=np.int32)
        self._blocks, self._values = blocks.copy(), values.copy()


def _pose(T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    T = np.asarray(T, np.float32)
    return np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3])


def _intrinsics(frame: Frame) -> np.ndarray:
    c = frame.camera
    return np.array([c.fx, c.fy, c.cx, c.cy], np.float32)
