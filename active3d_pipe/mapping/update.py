"""One round of mapping: fold new frames into the hybrid map. The paper's mapping algorithm on one page."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from active3d_pipe.errors import NumericalError
from active3d_pipe.geometry.sampling import spread
from active3d_pipe.geometry.sensor_noise import sensor_noise
from active3d_pipe.mapping import branches
from active3d_pipe.mapping.config import MappingSettings
from active3d_pipe.mapping.hybrid_map import HybridMap
from active3d_pipe.mapping.keyframes import select_keyframes
from active3d_pipe.mapping.window import choose_window, draw_keyframe, draw_older
from active3d_pipe.structures import Frame, UncertaintyVolume

PRUNE_EVERY = 100  # iterations
NOISE_FRAMES = 10  # keyframes that say how noisy the sensor is
OTHERS_LOOKED_AT = 1  # keyframes of the window, beside the new ones, that error-driven adding looks at in a round


@dataclass(frozen=True, slots=True)
class UpdateReport:
    """`numbers`: deterministic facts for the record; `seconds`: wall time by module."""

    numbers: dict[str, Any]
    seconds: dict[str, float]


def update_map(
    hybrid: HybridMap, frames: Sequence[Frame], volume: UncertaintyVolume | None, round: int,
    settings: MappingSettings, rng: np.random.Generator, progress: Callable[[str], None],
) -> UpdateReport:
    """Fold the frames of a round into `hybrid`, in place.

    Args:
        hybrid: the map M_{k-1}; becomes M_k.
        frames: the round's frames in order of capture.
        volume: uncertainty volume of the round before, None in the first: it decides on keyframes.
        round: k.
        settings: the mapping section.
        rng: every random choice.
        progress: called with a short text now and then.

    Raises:
        NumericalError: a loss became NaN or infinite.
    """
    clock = branches.Clock()
    with clock.of("keyframes"):
        new = select_keyframes(frames, hybrid.keyframes, volume, round, settings.keyframes)
        hybrid.keyframes += new
        window = choose_window(hybrid.keyframes, new, frames, settings.window)

    factor = settings.first_round_factor if round == 0 else 1.0
    iterations = round_up(
        factor * (settings.field_iterations_per_step * len(frames) + settings.field_iterations_per_keyframe * len(new))
    )
    field_loss = 0.0
    if settings.geometry == "tsdf":
        branches.fuse(hybrid, frames, clock)
    else:
        field_loss = _field(hybrid, len(new), iterations, rng, clock)
    progress("field trained")

    seeded, psnr, added, pruned = 0, 0.0, 0, 0
    iterations = round_up(factor * (
        settings.gaussian_iterations_per_step * len(frames) + settings.gaussian_iterations_per_keyframe * len(new)
    ))
    if settings.window.submap_keyframes and settings.views == "gaussians":
        window = open_submap(hybrid, len(new))
        with hybrid.newest_submap():
            seeded = sum(branches.seed(hybrid, k.frame, rng, clock) for k in new)
            psnr, added, pruned = _gaussians(hybrid, window, [], len(new), iterations, rng, clock, progress)
    elif settings.views == "gaussians":
        seeded = sum(branches.seed(hybrid, k.frame, rng, clock) for k in new)
        older = draw_older(rng, window, len(hybrid.keyframes), settings.window)
        with hybrid.working_set([hybrid.keyframes[i].frame for i in [*window, *older]]):
            psnr, added, pruned = _gaussians(hybrid, window, older, len(new), iterations, rng, clock, progress)

    numbers = {
        "keyframes": len(hybrid.keyframes), "new_keyframes": len(new), "window": len(window),
        "gaussians": hybrid.num_gaussians, "seeded": seeded, "added": added, "pruned": pruned,
        "psnr_window": round_number(psnr), "field_loss": round_number(field_loss),
    }
    return UpdateReport(numbers, dict(clock.seconds))


def open_submap(hybrid: HybridMap, num_new: int) -> list[int]:
    """Keyframes of the submap that the new ones belong to; when the last one is full, its primitives come to rest."""
    first_new = len(hybrid.keyframes) - num_new
    if num_new and first_new - hybrid.submap[0] >= hybrid.settings.window.submap_keyframes:
        hybrid.submap = (first_new, len(hybrid.gaussians))
    return list(range(hybrid.submap[0], len(hybrid.keyframes)))


def round_up(x: float) -> int:
    """Number of iterations for a real-valued budget."""
    return int(np.ceil(x))


def round_number(x: float) -> float:
    """Six significant decimals: what a record keeps."""
    return float(np.round(x, 6))


def _field(hybrid: HybridMap, num_new: int, iterations: int, rng: np.random.Generator, clock: branches.Clock) -> float:
    """Train the implicit branch: half of the rays from the new keyframes, half from all."""
    frames = [k.frame for k in hybrid.keyframes]
    weights = np.full(len(frames), 1.0 / len(frames))
    if 0 < num_new < len(frames):
        weights *= 0.5
        weights[-num_new:] += 0.5 / num_new
    with clock.of("ray sampling"):
        noise = sensor_noise(spread(frames, NOISE_FRAMES))
    loss = 0.0
    for _ in range(iterations):
        loss = branches.train_field(hybrid, frames, weights, rng, clock, noise=noise)["total"]
    return loss


def _gaussians(
    hybrid: HybridMap, window: Sequence[int], older: Sequence[int], num_new: int, iterations: int,
    rng: np.random.Generator, clock: branches.Clock, progress: Callable[[str], None],
) -> tuple[float, int, int]:
    """Train the explicit branch over the window; returns (mean PSNR of the last pass, added, pruned)."""
    settings = hybrid.settings
    coupled = settings.representation == "hybrid"
    limit = int(settings.gaussians.max_count * settings.adding_share)
    scores: list[float] = []
    targets: dict[int, branches.Target] = {}
    added = pruned = 0
    # Adding looks once at every new keyframe and at some of the others, in the first two thirds of the iterations, so
    # that what is new still settles.
    looked_at = window[-(num_new + OTHERS_LOOKED_AT) :]
    adding = {int(i * iterations * 0.66 / max(len(looked_at), 1)): index for i, index in enumerate(looked_at)}
    quota = settings.add_per_round // max(len(looked_at), 1)
    for i in range(iterations):
        if i in adding:
            frame = hybrid.keyframes[adding[i]].frame
            added += branches.add_where_wrong(hybrid, frame, quota, limit, rng, clock)
        index = draw_keyframe(rng, window, older, settings.window.replay)
        pull = None
        if coupled and i % settings.coupling_every == settings.coupling_every - 1:
            pull = branches.coupling_gradient(hybrid, rng, clock)
        if index not in targets:
            targets[index] = branches.target(hybrid.keyframes[index].frame, settings.round_stride)
        terms = branches.train_gaussians(hybrid, targets[index], settings.learning_rate_scale, clock, pull)
        if not np.isfinite(terms["loss"]):
            raise NumericalError(f"gaussians: the loss is not finite in iteration {i}; lower the learning rates")
        scores.append(terms["psnr"])
        if i % PRUNE_EVERY == PRUNE_EVERY - 1:
            pruned += branches.prune(hybrid, clock)
        if i % 20 == 0:
            progress(f"gaussians {i}/{iterations}")
    pruned += branches.prune(hybrid, clock)
    last = scores[-min(len(scores), 2 * len(window)) :]
    return (float(np.mean(last)) if last else 0.0), added, pruned
