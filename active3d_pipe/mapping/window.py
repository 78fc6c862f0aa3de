"""The viewpoint-space sliding window W_k (paper, sec. keyframe; eq. sw_energy)."""

from collections.abc import Sequence

import numpy as np

from active3d_pipe.mapping.config import WindowSettings
from active3d_pipe.mapping.keyframes import Keyframe, depth_samples, view_distance


def choose_window(keyframes: Sequence[Keyframe], newest: Sequence[Keyframe], settings: WindowSettings) -> list[int]:
    """Indices into `keyframes` of the frames to optimise together.

    The newest keyframes belong to it; the rest are the nearest ones in viewpoint space (covisible and close in
    angle), or with policy `temporal` the last ones.
    """
    n = len(keyframes)
    if settings.policy == "temporal" or not newest:
        return list(range(max(0, n - settings.size), n))
    first_new = n - len(newest)
    chosen = list(range(max(first_new, n - settings.size), n))
    room = settings.size - len(chosen)
    if room > 0 and first_new > 0:
        anchors = [(k.frame, depth_samples(k.frame)) for k in (newest[0], newest[len(newest) // 2], newest[-1])]
        distance = [min(view_distance(f, p, keyframes[i].frame) for f, p in anchors) for i in range(first_new)]
        nearest = np.argsort(np.asarray(distance), kind="stable")[:room]
        chosen = sorted(int(i) for i in nearest) + chosen
    return chosen


def draw_keyframe(rng: np.random.Generator, window: Sequence[int], count: int, replay: float) -> int:
    """Index of the keyframe of the next iteration: from the window, or with probability `replay` any older one."""
    if len(window) < count and rng.random() < replay:
        return int(rng.integers(count))
    return int(window[int(rng.integers(len(window)))])
