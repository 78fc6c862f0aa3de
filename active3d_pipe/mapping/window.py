"""The viewpoint-space sliding window W_k (paper, sec. keyframe; eq. sw_energy)."""

from collections.abc import Sequence

import numpy as np

from active3d_pipe.mapping.config import WindowSettings
from active3d_pipe.mapping.keyframes import Keyframe, depth_samples, view_distance
from active3d_pipe.structures import Frame


def choose_window(
    keyframes: Sequence[Keyframe], newest: Sequence[Keyframe], frames: Sequence[Frame], settings: WindowSettings
) -> list[int]:
    """Indices into `keyframes` of the frames to optimise together.

    The newest keyframes belong to it; the rest are the nearest ones in viewpoint space (covisible and close in
    angle) to them, or to the `frames` of the round where none became a keyframe; with policy `temporal` the last ones.
    """
    n = len(keyframes)
    around = [k.frame for k in newest] or list(frames)
    if settings.policy == "temporal" or not around:
        return list(range(max(0, n - settings.size), n))
    first_new = n - len(newest)
    chosen = list(range(max(first_new, n - settings.size), n))
    room = settings.size - len(chosen)
    if room > 0 and first_new > 0:
        anchors = [(f, depth_samples(f)) for f in (around[0], around[len(around) // 2], around[-1])]
        distance = [min(view_distance(f, p, keyframes[i].frame) for f, p in anchors) for i in range(first_new)]
        nearest = np.argsort(np.asarray(distance), kind="stable")[:room]
        chosen = sorted(int(i) for i in nearest) + chosen
    return chosen


def draw_older(rng: np.random.Generator, window: Sequence[int], count: int, settings: WindowSettings) -> list[int]:
    """Indices of the keyframes outside the window that are replayed in this round (E_reg): against forgetting."""
    outside = np.setdiff1d(np.arange(count), window)
    most = min(len(outside), int(np.ceil(settings.replay * settings.size)))
    return sorted(int(i) for i in rng.choice(outside, size=most, replace=False)) if most else []


def draw_keyframe(rng: np.random.Generator, window: Sequence[int], older: Sequence[int], replay: float) -> int:
    """Index of the keyframe of the next iteration: from the window, or with probability `replay` an older one."""
    if older and rng.random() < replay:
        return int(older[int(rng.integers(len(older)))])
    return int(window[int(rng.integers(len(window)))])
