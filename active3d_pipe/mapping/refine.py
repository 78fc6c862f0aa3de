"""Final refinement: a stated budget of annealed iterations over everything that was logged."""

from collections.abc import Callable, Sequence

import numpy as np

from active3d_pipe.errors import NumericalError
from active3d_pipe.geometry.sensor_noise import sensor_noise
from active3d_pipe.mapping import branches
from active3d_pipe.mapping.frame_order import exposure, visiting_order
from active3d_pipe.mapping.hybrid_map import HybridMap
from active3d_pipe.mapping.update import UpdateReport, round_number
from active3d_pipe.structures import Frame

FINAL_RATE = 0.1  # learning rates fall to this share, exponentially
ADD_UNTIL = 0.6  # share of the budget during which primitives are added
ADD_EVERY = 10
PRUNE_EVERY = 200


def annealed(i: int, iterations: int) -> float:
    """Learning-rate factor of iteration `i`: from 1 to FINAL_RATE."""
    return float(FINAL_RATE ** (i / max(iterations - 1, 1)))


def refine(
    hybrid: HybridMap, frames: Sequence[Frame], rng: np.random.Generator, progress: Callable[[str], None]
) -> UpdateReport:
    """Optimise both branches over all captured `frames` (not only keyframes), in place.

    Frames are visited by how much is to be seen of what they show (`frame_order`). Held-out views are never seen here.
    """
    settings, clock = hybrid.settings, branches.Clock()
    steps = settings.refinement_field_iterations if settings.geometry == "neural" else 0
    noise = sensor_noise(frames) if steps else None
    for i in range(steps):
        rate = annealed(i, steps)
        branches.train_field(hybrid, frames, None, rng, clock, rate, noise)
        if i % 20 == 0:
            progress(f"refining field {i}/{steps}")
    total, added, pruned = settings.refinement_iterations if settings.views == "gaussians" else 0, 0, 0
    limit = min(settings.gaussians.max_count, int(len(hybrid.gaussians) * (1 + settings.refinement_growth)))
    growth = limit - len(hybrid.gaussians)
    quota = max(1, int(growth / max(total * ADD_UNTIL / ADD_EVERY, 1))) if growth > 0 else 0
    coupled = settings.representation == "hybrid"
    weights = settings.gaussians.model_copy(update={"sight_weight": settings.refinement_sight_weight})
    scores: list[float] = []
    order = visiting_order(exposure(frames, rng) ** settings.refinement_balance, total, rng) if total else ()
    for i, visited in enumerate(order):
        frame = frames[visited]
        if i % ADD_EVERY == 0 and i < total * ADD_UNTIL:
            added += branches.add_where_wrong(hybrid, frame, quota, limit, rng, clock)
        pull = None
        if coupled and i % settings.coupling_every == settings.coupling_every - 1:
            pull = branches.coupling_gradient(hybrid, rng, clock)
        terms = branches.train_gaussians(hybrid, branches.target(frame), annealed(i, total), clock, pull, weights)
        if not np.isfinite(terms["loss"]):
            raise NumericalError(f"refinement: the loss is not finite in iteration {i}; lower the learning rates")
        scores.append(terms["psnr"])
        if i % PRUNE_EVERY == PRUNE_EVERY - 1:
            pruned += branches.prune(hybrid, clock)
        if i % 20 == 0:
            progress(f"refining Gaussians {i}/{total}")
    last = scores[-min(len(scores), len(frames)) :]
    numbers = {
        "frames": len(frames), "iterations": total, "gaussians": len(hybrid.gaussians), "added": added,
        "pruned": pruned, "psnr_train": round_number(float(np.mean(last))) if last else None,
    }
    return UpdateReport(numbers, dict(clock.seconds))
