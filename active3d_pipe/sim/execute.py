"""Walk a planned path in the simulator, one step at a time."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from active3d_pipe.errors import InputError
from active3d_pipe.geometry import se3
from active3d_pipe.sim.simulator import Simulator
from active3d_pipe.structures import Frame
from active3d_pipe.structures.motion import MotionSettings

TOLERANCE = 1e-6


@dataclass(slots=True)
class Walk:
    """What happened: frames, collisions (0 or 1: a collision ends the leg), least true clearance, length."""

    frames: list[Frame] = field(default_factory=list)
    collisions: int = 0
    min_clearance_m: float = math.inf
    length_m: float = 0.0
    seconds: dict[str, float] = field(default_factory=lambda: {"render": 0.0, "collision check": 0.0})


def check_step(before: np.ndarray, after: np.ndarray, motion: MotionSettings, what: str) -> float:
    """Length in metres of one step; InputError when it breaks the motion limits."""
    length = float(np.linalg.norm(after[:3, 3] - before[:3, 3]))
    turn = math.degrees(se3.rotation_angle(before[:3, :3], after[:3, :3]))
    if length > motion.max_step_m + TOLERANCE or turn > motion.max_turn_deg + 1e-3:
        raise InputError(
            f"{what}: a step of {length:.3f} m and {turn:.2f} degrees; the motion limits are "
            f"{motion.max_step_m} m and {motion.max_turn_deg} degrees"
        )
    return length


def execute_path(
    simulator: Simulator, current: np.ndarray, path: np.ndarray, motion: MotionSettings, *, first_step: int,
    step_ns: int, log: Callable[[Frame], None], progress: Callable[[str], None],
) -> Walk:
    """Execute `path` (M, 4, 4) from pose `current`, capturing a frame after every step and handing it to `log`.

    A step whose segment comes nearer to the true mesh than the agent's radius is a collision: it is not
    taken, it is counted, and the leg ends there.
    """
    walk = Walk()
    for i, T in enumerate(path):
        step = first_step + i
        length = check_step(current, T, motion, f"step {step}")
        clock = time.perf_counter()
        clearance = simulator.segment_clearance(current[:3, 3], T[:3, 3])
        walk.seconds["collision check"] += time.perf_counter() - clock
        if clearance < motion.agent_radius_m and length > TOLERANCE:
            walk.collisions += 1
            walk.min_clearance_m = min(walk.min_clearance_m, clearance)
            break
        walk.min_clearance_m = min(walk.min_clearance_m, clearance)
        clock = time.perf_counter()
        walk.frames.append(simulator.render(T, step=step, stamp_ns=step * step_ns))
        walk.seconds["render"] += time.perf_counter() - clock
        log(walk.frames[-1])
        walk.length_m += length
        current = T
        progress(f"step {step}")
    if not math.isfinite(walk.min_clearance_m):
        walk.min_clearance_m = float(simulator.clearance(current[None, :3, 3])[0])
    return walk
