"""Uncertainty-driven keyframe selection (paper, sec. keyframe; eq. kf_selection)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from active3d_pipe.geometry import projection, se3
from active3d_pipe.mapping.config import KeyframeSettings
from active3d_pipe.mapping.kernels_overlap import seen_share
from active3d_pipe.structures import Camera, Frame, UncertaintyVolume

OVERLAP_STRIDE = 24  # px between the depth samples that measure frustum overlap
OCCLUSION_TOLERANCE = 0.1  # relative depth difference at which a sample counts as hidden from the keyframe
NEAR_FIRST = 0.2  # 1/m, how much the distance of its centre delays a keyframe in the search for the nearest view
BITS_PER_VOXEL_FLOOR = 0.02  # entropy below which a voxel has nothing left to tell


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A promoted frame and why: divergence delta_c, gain in bits, coverage ratio rho_c."""

    frame: Frame
    round: int
    reason: str
    delta: float
    gain: float
    rho: float

    def to_json(self) -> dict:
        """Everything but the images, which stay in the capture log."""
        return {
            "step": self.frame.step, "round": self.round, "reason": self.reason,
            "delta": round(self.delta, 6), "gain": round(self.gain, 3), "rho": round(self.rho, 6),
        }


def depth_samples(frame: Frame, stride: int = OVERLAP_STRIDE) -> np.ndarray:
    """(N, 3) float64 world points of a sparse grid of valid depth pixels."""
    depth = frame.depth[stride // 2 :: stride, stride // 2 :: stride]
    rays = _sparse_rays(frame.camera, stride)
    valid = depth > 0
    return se3.transform_points(frame.T_world_camera, (rays * depth[..., None])[valid].astype(np.float64))


@lru_cache(maxsize=4)
def _sparse_rays(camera: Camera, stride: int) -> np.ndarray:
    """Every `stride`-th pixel's ray, the same for all frames of a camera."""
    return projection.pixel_rays(camera)[stride // 2 :: stride, stride // 2 :: stride].copy()


def overlap(points_world: np.ndarray, other: Frame) -> float:
    """Share of points that `other` sees: inside its image and not behind its depth."""
    if len(points_world) == 0:
        return 0.0
    c = other.camera
    T_camera_world = se3.inverse(other.T_world_camera)
    return seen_share(points_world, T_camera_world, c.fx, c.fy, c.cx, c.cy, c.near, other.depth, OCCLUSION_TOLERANCE)


def horizontal_fov(camera: Camera) -> float:
    """Horizontal field of view, rad."""
    return 2 * math.atan(camera.width / (2 * camera.fx))


def view_distance(frame: Frame, points_world: np.ndarray, other: Frame) -> float:
    """d_view in [0, 1]: mean of the viewing-angle difference (in fields of view) and the lack of overlap.

    A frame without a reading has no overlap to compare: then the angle alone.
    """
    angle = se3.rotation_angle(frame.T_world_camera[:3, :3], other.T_world_camera[:3, :3])
    angular = min(angle / horizontal_fov(frame.camera), 1.0)
    if len(points_world) == 0:
        return angular
    return 0.5 * angular + 0.5 * (1 - overlap(points_world, other))


def divergence(frame: Frame, keyframes: Sequence[Keyframe], enough: float = 0.0) -> float:
    """delta_c: least view distance to any keyframe; 1 when there is none.

    The search ends early once a distance of at most `enough` is found. Keyframes are visited in the order of their
    angle to the frame: half the angular term bounds the distance from below, so most are never compared.
    """
    if not keyframes:
        return 1.0
    points = depth_samples(frame)
    rotations = np.stack([k.frame.T_world_camera[:3, :3] for k in keyframes])
    centres = np.stack([k.frame.T_world_camera[:3, 3] for k in keyframes])
    cosine = (np.einsum("ij,kij->k", frame.T_world_camera[:3, :3], rotations) - 1) / 2
    least = 0.5 * np.minimum(np.arccos(np.clip(cosine, -1, 1)) / horizontal_fov(frame.camera), 1.0)
    apart = np.linalg.norm(centres - frame.T_world_camera[:3, 3], axis=1)
    found = 1.0
    for i in np.argsort(least + NEAR_FIRST * apart, kind="stable"):
        # The slack keeps rounding of the bound from cutting off the nearest one.
        if least[i] - 1e-6 < found:
            found = min(found, view_distance(frame, points, keyframes[i].frame))
            if found <= enough:
                break
    return found


class Information:
    """What the frames of a round can tell, by the volume of the round before.

    A working copy is kept, so that the second of two frames that see the same voxels gains nothing.
    """

    def __init__(self, volume: UncertaintyVolume, settings: KeyframeSettings) -> None:
        self.grid = volume.grid
        self.entropy = volume["entropy"].astype(np.float64).copy()
        self.high = np.all([volume[f"u_{b}"] > settings.tau_high for b in settings.high_branches], axis=0)

    def visible(self, frame: Frame) -> np.ndarray:
        """Flat indices of the voxels whose surface the frame observed."""
        ijk = self.grid.index_of(depth_samples(frame, 6))
        ijk = ijk[self.grid.contains_index(ijk)]
        return np.unique(np.ravel_multi_index(tuple(ijk.T), self.grid.shape)) if len(ijk) else np.zeros(0, np.int64)

    def gain(self, visible: np.ndarray) -> float:
        """Delta I_hybrid: bits that the visible voxels still hold."""
        h = self.entropy.ravel()[visible]
        return float(h[h > BITS_PER_VOXEL_FLOOR].sum())

    def rho(self, visible: np.ndarray) -> float:
        """Coverage ratio: share of the visible voxels that lie in V_high."""
        return float(self.high.ravel()[visible].mean()) if len(visible) else 0.0

    def consume(self, visible: np.ndarray) -> None:
        """Count the voxels as told."""
        self.entropy.ravel()[visible] = 0.0
        self.high.ravel()[visible] = False


def select_keyframes(
    frames: Sequence[Frame], keyframes: Sequence[Keyframe], volume: UncertaintyVolume | None, round: int,
    settings: KeyframeSettings,
) -> list[Keyframe]:
    """The frames of a round that become keyframes, in order of capture (eq. kf_selection).

    Without a volume (first round) the viewpoint criterion decides alone.
    """
    known = list(keyframes)
    information = None if volume is None else Information(volume, settings)
    for frame in frames:
        if settings.policy == "every_n":
            if not known or frame.step - known[-1].frame.step >= settings.every_n:
                known.append(Keyframe(frame, round, "every_n", 1.0, 0.0, 0.0))
            continue
        delta = divergence(frame, known, settings.tau_view)
        if delta <= settings.tau_view:
            continue
        if information is None:
            known.append(Keyframe(frame, round, "viewpoint", delta, 0.0, 0.0))
            continue
        visible = information.visible(frame)
        gain, rho = information.gain(visible), information.rho(visible)
        waited = frame.step - known[-1].frame.step if known else settings.max_gap
        if gain > settings.tau_info and rho > settings.tau_rho:
            reason = "information"
        elif waited >= settings.max_gap:
            reason = "gap"
        else:
            continue
        information.consume(visible)
        known.append(Keyframe(frame, round, reason, delta, gain, rho))
    return known[len(keyframes) :]
