"""The moves that `update_map` and `refine` are made of: seed, train one branch, couple, add, prune."""

import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from active3d_pipe.errors import ConfigError
from active3d_pipe.field.optimise import field_step
from active3d_pipe.field.rays import sample_rays, surface_points
from active3d_pipe.field.sdf_field import SdfField
from active3d_pipe.field.tsdf import TsdfField
from active3d_pipe.gaussians.config import GaussianSettings
from active3d_pipe.gaussians.optimisation import RowGradient, optimise_step
from active3d_pipe.gaussians.parameters import MEANS
from active3d_pipe.gaussians.pruning import prune_mask
from active3d_pipe.gaussians.sdf_coupling import sdf_gradient
from active3d_pipe.gaussians.seeding import error_driven, seed_frame
from active3d_pipe.geometry.thinning import thinned
from active3d_pipe.mapping.hybrid_map import HybridMap
from active3d_pipe.structures import Camera, Frame

COUPLED = 8192  # primitives of one coupling step


@dataclass(slots=True)
class Clock:
    """Seconds by module, for the journal."""

    seconds: dict[str, float] = field(default_factory=lambda: defaultdict(float))

    @contextmanager
    def of(self, module: str) -> Iterator[None]:
        """Add the time spent inside to `module`."""
        start = time.perf_counter()
        yield
        self.seconds[module] += time.perf_counter() - start


def unit_rgb(frame: Frame) -> np.ndarray:
    """(H, W, 3) float32 colour in 0..1."""
    return frame.rgb.astype(np.float32) * np.float32(1 / 255)


class Target(NamedTuple):
    """An image to train on: rgb (H, W, 3) float32 0..1, depth (H, W) float32 m, and where it was seen from."""

    rgb: np.ndarray
    depth: np.ndarray
    camera: Camera
    T_world_camera: np.ndarray


def target(frame: Frame, stride: int = 1) -> Target:
    """What a frame asks of the Gaussians, every pixel or the means of `stride` x `stride`."""
    if stride == 1:
        return Target(unit_rgb(frame), frame.depth, frame.camera, frame.T_world_camera)
    return Target(*thinned(frame, stride), frame.T_world_camera)


def seed(hybrid: HybridMap, frame: Frame, rng: np.random.Generator, clock: Clock) -> int:
    """Insert primitives where the frame shows surface that the map does not render; returns their number."""
    settings = hybrid.settings.gaussians
    room = int(settings.max_count * hybrid.settings.seeding_share) - hybrid.num_gaussians
    if room <= 0:
        return 0
    with clock.of("seeding"):
        view = hybrid.render(frame.camera, frame.T_world_camera) if len(hybrid.gaussians) else None
        new = seed_frame(
            unit_rgb(frame), frame.depth, frame.camera, frame.T_world_camera, view, settings, max_new=room, rng=rng
        )
        hybrid.gaussians.append(new)
    return len(new)


def train_gaussians(
    hybrid: HybridMap, seen: Target, rate: float, clock: Clock, coupling: RowGradient | None = None,
    settings: GaussianSettings | None = None,
) -> dict[str, float]:
    """One iteration of E_photo and depth on one image; `coupling` is the gradient of E_geo, see `coupling_gradient`.

    `settings`: other loss weights than the map's own.
    """
    with clock.of("gaussians"):
        return optimise_step(
            hybrid.gaussians, seen.camera, seen.T_world_camera, seen.rgb, seen.depth,
            settings or hybrid.settings.gaussians, rate, extra_gradient=coupling,
        )


def train_field(
    hybrid: HybridMap, frames: Sequence[Frame], weights: np.ndarray | None, rng: np.random.Generator, clock: Clock,
    rate: float = 1.0, noise: np.ndarray | None = None,
) -> dict[str, float]:
    """One iteration of the implicit branch on rays and readings of `frames`; `noise` as of `sample_rays`."""
    settings = hybrid.settings.field
    if not isinstance(hybrid.field, SdfField) or hybrid.optimiser is None:
        raise ConfigError("mapping: a TSDF is fused, not trained")
    hybrid.field_changed()
    with clock.of("ray sampling"):
        batch = sample_rays(frames, settings.rays, rng, weights, noise)
        surface = surface_points(frames, settings.surface_points, rng, weights)

    def add(part: str, seconds: float) -> None:
        clock.seconds["ray sampling" if part == "sample" else f"field {part}"] += seconds

    return field_step(hybrid.field, hybrid.optimiser, batch, settings, rng, rate, add, surface)


def fuse(hybrid: HybridMap, frames: Sequence[Frame], clock: Clock) -> None:
    """TSDF fusion of `frames`, for maps whose geometry is one."""
    if not isinstance(hybrid.field, TsdfField):
        raise ConfigError("mapping: a neural field is trained, not fused")
    hybrid.field_changed()
    with clock.of("fusion"):
        hybrid.field.integrate(frames)


def coupling_gradient(hybrid: HybridMap, rng: np.random.Generator, clock: Clock) -> RowGradient:
    """Gradient of E_geo: means onto the SDF's zero level, shortest axes along its gradient.

    A random share of the primitives takes part at a time, since the field is queried five times for each.
    """
    count = len(hybrid.gaussians)
    with clock.of("coupling"):
        chosen = np.sort(rng.choice(count, size=min(count, COUPLED), replace=False)).astype(np.int32)
        values = hybrid.gaussians.rows(chosen)
        means = np.ascontiguousarray(values[:, MEANS])
        sdf, normals = hybrid.field.query_sdf(means), hybrid.field.normals(means)
        return RowGradient(chosen, sdf_gradient(values, sdf, normals, hybrid.settings.gaussians)[1])


def add_where_wrong(
    hybrid: HybridMap, frame: Frame, most: int, limit: int, rng: np.random.Generator, clock: Clock
) -> int:
    """Error-driven adding of at most `most` primitives on one frame, up to `limit` in all; returns their number."""
    settings = hybrid.settings.gaussians
    most = min(most, limit - hybrid.num_gaussians)
    if most <= 0:
        return 0
    with clock.of("adding"):
        view = hybrid.render(frame.camera, frame.T_world_camera)
        new = error_driven(
            unit_rgb(frame), frame.depth, frame.camera, frame.T_world_camera, view, settings, max_new=most, rng=rng
        )
        hybrid.gaussians.append(new)
    return len(new)


def prune(hybrid: HybridMap, clock: Clock) -> int:
    """Drop useless primitives; returns how many."""
    with clock.of("pruning"):
        drop = prune_mask(hybrid.gaussians, hybrid.settings.gaussians)
        hybrid.gaussians.keep(~drop)
    return int(drop.sum())
