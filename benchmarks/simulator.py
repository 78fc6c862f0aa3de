"""Time and fidelity of the simulator and of its log, scene by scene.

    python benchmarks/simulator.py SCENE.glb [SCENE.glb ...]

Prints a Markdown table: milliseconds per RGB-D frame (minimum and median), PSNR of the colour against 6 x 6 point
samples a pixel (mean and worst of six fixed views), milliseconds per frame to write and to read the log, its size.
"""

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from active3d_pipe.geometry import se3
from active3d_pipe.sim.config import CameraSettings, SceneSettings, SensorSettings
from active3d_pipe.sim.observable import free_positions
from active3d_pipe.sim.raycast import RaycastSimulator
from active3d_pipe.sim.scene import load_scene
from active3d_pipe.storage import capture_log

SUPERSAMPLING = 6
HEAD = [
    "scene", "render min ms", "render median ms", "PSNR mean dB", "PSNR worst dB", "log ms", "read ms",
    "MB / 100 frames",
]


def fixed_views(sim: RaycastSimulator, count: int) -> list[np.ndarray]:
    """Poses T_world_camera in free space, seeded by their number alone, pitch within 30 degrees of the horizon."""
    rng = np.random.default_rng(count)
    positions = free_positions(sim, count, 0.3, rng)
    yaw, pitch = rng.uniform(-np.pi, np.pi, count), np.radians(rng.uniform(-30, 30, count))
    return [se3.pose_from_yaw_pitch(p, float(a), float(b)) for p, a, b in zip(positions, yaw, pitch)]


def supersampled(fine: RaycastSimulator, T: np.ndarray) -> np.ndarray:
    """(H, W, 3) mean of the point samples of `fine`, whose image is SUPERSAMPLING times as wide and high."""
    k = SUPERSAMPLING
    rgb, _ = fine._shade(T, fine._primary(T), 1e-3)
    return rgb.reshape(fine.camera.height // k, k, fine.camera.width // k, k, 3).mean(axis=(1, 3))


def seconds(work: Callable[[], object], repeats: int) -> list[float]:
    """Wall seconds of every repeat, a first one not counted."""
    work()
    out = []
    for _ in range(repeats):
        clock = time.perf_counter()
        work()
        out.append(time.perf_counter() - clock)
    return out


def row(path: Path, width: int, height: int, repeats: int, walk_steps: int, log: Path) -> list[str]:
    """One line of the table."""
    scene = load_scene(SceneSettings(file=str(path)))
    k = SUPERSAMPLING
    camera, large = CameraSettings(width=width, height=height), CameraSettings(width=k * width, height=k * height)
    sim = RaycastSimulator(scene, camera.camera(), SensorSettings())
    fine = RaycastSimulator(scene, large.camera(), SensorSettings(edge_samples=0))
    views = fixed_views(sim, 6)
    errors = [np.mean((sim.render(T).rgb - supersampled(fine, T)) ** 2) for T in views]
    psnr = 10 * np.log10(255**2 / np.array(errors))
    render = np.array([seconds(lambda T=T: sim.render(T), repeats) for T in views]) * 1e3
    steps = [se3.pose_from_yaw_pitch(views[i % 6][:3, 3], 0.17 * i, 0.0) for i in range(walk_steps)]
    frames = [sim.render(T, step=i, stamp_ns=i * capture_log.STEP_NS) for i, T in enumerate(steps)]
    write = seconds(lambda: capture_log.write_frames(log, frames, np.stack(steps)), repeats)
    read = seconds(lambda: capture_log.read_frames(log), repeats)
    return [
        scene.name, f"{render.min(axis=1).mean():.1f}", f"{np.median(render, axis=1).mean():.1f}", f"{psnr.mean():.2f}",
        f"{psnr.min():.2f}", f"{1e3 * min(write) / walk_steps:.1f}", f"{1e3 * min(read) / walk_steps:.1f}",
        f"{log.stat().st_size / walk_steps / 1e4:.1f}",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--width", type=int, default=600)
    parser.add_argument("--height", type=int, default=340)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--frames", type=int, default=12, help="frames of the log that is timed")
    given = parser.parse_args()
    print("| " + " | ".join(HEAD) + " |\n|" + "---|" * len(HEAD))
    with tempfile.TemporaryDirectory() as folder:
        for path in given.scenes:
            cells = row(path, given.width, given.height, given.repeats, given.frames, Path(folder) / "frames.mcap")
            print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
