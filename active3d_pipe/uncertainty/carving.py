"""Running free and hit evidence from depth frames, and how well each surface voxel was seen."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from active3d_pipe.geometry.voxel_traversal import fan_stride
from active3d_pipe.structures import Camera, Frame, VoxelGrid
from active3d_pipe.uncertainty import kernels_carving as kernels
from active3d_pipe.uncertainty.config import UncertaintySettings

# Distance at which neighbouring rays lie a voxel apart where the stride is not given, m.
RAY_RANGE_M = 5.0
# Rows and columns of rays that an image of a narrow camera has at least.
LEAST_ROWS = 8


@dataclass(frozen=True, slots=True, eq=False)
class RayEvidence:
    """What depth rays said about every voxel; [X, Y, Z] on one grid, counts and quality float32.

    Attributes:
        free: number of rays that passed through the voxel.
        hit: number of rays that ended in it.
        quality: best observation of its surface, 0 = never hit, 1 = frontal, with pixels no wider than the reference.
        passed, ended: uint8, one bit for each of the eight half-size cells of the voxel: some ray passed it, some ray
            ended in it. Bit 4 a + 2 b + c, where a, b, c say whether the cell is the upper one in x, y, z.
    """

    free: np.ndarray
    hit: np.ndarray
    quality: np.ndarray
    passed: np.ndarray
    ended: np.ndarray

    @classmethod
    def none(cls, grid: VoxelGrid) -> "RayEvidence":
        """No ray so far."""
        counts, cells = (np.zeros((n, *grid.shape), t) for n, t in ((3, np.float32), (2, np.uint8)))
        return cls(*counts, *cells)

    def joined(self, newer: "RayEvidence") -> "RayEvidence":
        """Both together: counts add up, the better view stays, cells are joined."""
        out = RayEvidence(*(a.copy() for a in self._arrays()))
        kernels.join(*newer._arrays(), *out._arrays())
        return out

    def _arrays(self) -> tuple[np.ndarray, ...]:
        return self.free, self.hit, self.quality, self.passed, self.ended


def integrate_depth(grid: VoxelGrid, frames: Sequence[Frame], settings: UncertaintySettings) -> RayEvidence:
    """Evidence of `frames` alone, by traversal of the grid along the rays of a lattice of pixels (`ray_stride`).

    A ray counts at most once per voxel. A voxel in which some ray of a frame ends is not counted free by other rays
    of the same frame (they graze it). Depth 0 or below `near` says nothing; depth beyond `far` carves up to `far`
    and hits nothing. The sampled pixels shift with the step, so that successive frames fill each other's gaps.

    View quality is (cosine of incidence) x min(1, reference footprint / pixel width on the surface), with normals
    from the depth image itself.
    """
    shape = (kernels.CHUNKS, *grid.shape)
    free, hit = np.zeros(shape, np.int32), np.zeros(shape, np.int32)
    quality = np.zeros(shape, np.float32)
    passed, ended = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
    for group in by_image_size(frames):
        kernels.carve_frames(
            *_stacked(group, _stride(grid, group, settings)), grid.origin, 1 / grid.voxel_size,
            settings.reference_footprint_m, free, hit, quality, passed, ended,
        )
    out = RayEvidence.none(grid)
    kernels.gather(free, hit, quality, passed, ended, *out._arrays())
    return out


def looks_in_vain(
    grid: VoxelGrid, frames: Sequence[Frame], solid: np.ndarray, settings: UncertaintySettings
) -> np.ndarray:
    """1 where rays without a reading went in some frame and no ray with one did; float32 [X, Y, Z].

    Windows, mirrors, black or far-away surfaces give no depth however often one looks. A lost ray counts up to
    `vain_range_m` and up to the first voxel of `solid` (bool); sensor dropout beside readings does not count, since
    its neighbours cross the same voxels.
    """
    vain = np.zeros((kernels.CHUNKS, *grid.shape), np.uint8)
    blocked = np.ascontiguousarray(solid, np.uint8)
    for group in by_image_size(frames):
        s = _stride(grid, group, settings)
        starts = [_start(f, s) for f in group]
        lossy = [f for f, (i, j) in zip(group, starts, strict=True) if not (f.depth[i::s, j::s] >= f.camera.near).all()]
        if lossy:
            kernels.mark_vain(
                *_stacked(lossy, s), grid.origin, 1 / grid.voxel_size, settings.vain_range_m, blocked, vain
            )
    return np.bitwise_or.reduce(vain).astype(np.float32)


def _stride(grid: VoxelGrid, frames: Sequence[Frame], settings: UncertaintySettings) -> int:
    """Pixels between two rays of frames of one image size."""
    if settings.ray_stride:
        return settings.ray_stride
    smallest = min(frames[0].depth.shape)
    return max(1, min(*(fan_stride(f.camera, grid.voxel_size, RAY_RANGE_M) for f in frames), smallest // LEAST_ROWS))


def _start(frame: Frame, stride: int) -> tuple[int, int]:
    """First row and column that cast rays; they shift with the step, so that frames fill each other's gaps."""
    return frame.step // stride % stride, frame.step % stride


def _stacked(
    frames: Sequence[Frame], stride: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, int]:
    """Frames of one image size as the kernels take them: depths, cameras, poses, reaches, first pixels, stride."""
    return (
        np.stack([f.depth for f in frames]), intrinsics([f.camera for f in frames]),
        np.stack([f.T_world_camera for f in frames])[:, :3].astype(np.float64),
        np.array([(f.camera.near, f.camera.far) for f in frames], np.float64),
        np.array([_start(f, stride) for f in frames], np.int64), stride,
    )


def by_image_size(items: Sequence) -> Iterator[list]:
    """Groups of frames or views whose images share one size, in order of first appearance."""
    groups: dict[tuple[int, int], list] = {}
    for item in items:
        groups.setdefault(item.depth.shape, []).append(item)
    yield from groups.values()


def intrinsics(cameras: Sequence[Camera]) -> np.ndarray:
    """(N, 4) float64 fx, fy, cx, cy."""
    return np.array([(c.fx, c.fy, c.cx, c.cy) for c in cameras], np.float64)
