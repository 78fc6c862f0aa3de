"""The independent readers, found or asked for: a missing one fails with a line that says what to install."""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from active3d_pipe.structures import Camera

NODE = Path(__file__).parent / "node"
CHROMIUM = os.environ.get("ACTIVE3D_CHROMIUM", "chromium")
ICD = Path(os.environ.get("ACTIVE3D_SWIFTSHADER", "/usr/lib/chromium/vk_swiftshader_icd.json"))


def need(found: object, what: str, install: str) -> None:
    """Fail, with one line, unless the tool was found. Nothing here is ever skipped."""
    if not found:
        pytest.fail(f"interop needs {what}: {install}", pytrace=False)


def need_module(name: str) -> None:
    """A Python package of the extra `interop`."""
    need(importlib.util.find_spec(name), f"the Python package {name}", "pip install -c constraints.txt -e '.[interop]'")


def run_program(command: list[object], env: dict[str, str] | None = None) -> str:
    """What the program prints; an exit code other than 0 fails the test with what it said."""
    done = subprocess.run(
        list(map(str, command)), capture_output=True, text=True, check=False, env={**os.environ, **(env or {})}
    )
    assert done.returncode == 0, f"{command}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
    return done.stdout


def node_package(name: str) -> Path:
    need(shutil.which("node"), "Node.js 20 or newer", "apt install nodejs npm")
    folder = NODE / "node_modules" / name
    need(folder.is_dir(), f"the npm package {name}", "npm ci --prefix tests/interop/node")
    return folder


@pytest.fixture(scope="session")
def node_script() -> Callable[..., Any]:
    """Run one of node/*.mjs, which reads with the named npm packages; its JSON answer."""

    def run(script: str, packages: list[str], *arguments: object) -> Any:
        for name in packages:
            node_package(name)
        return json.loads(run_program(["node", NODE / script, *arguments]))

    return run


@pytest.fixture(scope="session")
def rerun(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., str]:
    """The Rerun command line, in a home folder of its own, with its usage reports off."""
    need_module("rerun")
    program = shutil.which("rerun", path=os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]))
    need(program, "the program rerun", "pip install -c constraints.txt -e '.[interop]'")
    home = str(tmp_path_factory.mktemp("rerun_home"))
    env = {"HOME": home, "XDG_CONFIG_HOME": home, "XDG_DATA_HOME": home}
    run_program([program, "analytics", "disable"], env)
    return lambda *arguments: run_program([program, *arguments], env)


@pytest.fixture(scope="session")
def splat_transform(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Path, Camera, np.ndarray], np.ndarray]:
    """Render a Gaussian .ply with splat-transform on SwiftShader: (H, W, 3) float32 in 0..1.

    It turns every .ply by 180 degrees about Z, so the camera is given in that frame. Version 2.7.1 draws next to
    nothing in images of fewer than 257 tiles of 16 x 16 pixels (all of 320 x 180, for instance), hence the check.
    """
    program = node_package("@playcanvas/splat-transform") / "bin" / "cli.mjs"
    need(ICD.is_file(), f"SwiftShader, a Vulkan driver for CPUs ({ICD})", "apt install chromium (it ships one)")
    folder = tmp_path_factory.mktemp("splat_transform")
    # Debian's chromium ships the Vulkan loader beside the driver.
    libraries = os.pathsep.join([str(ICD.parent), *filter(None, [os.environ.get("LD_LIBRARY_PATH")])])
    env = {"VK_ICD_FILENAMES": str(ICD), "XDG_RUNTIME_DIR": str(folder), "LD_LIBRARY_PATH": libraries}

    def render(ply: Path, camera: Camera, T_world_camera: np.ndarray) -> np.ndarray:
        assert -(-camera.width // 16) * -(-camera.height // 16) > 256, "splat-transform fails on images this small"
        R, position = T_world_camera[:3, :3], T_world_camera[:3, 3]

        def vector(v: np.ndarray) -> str:
            return ",".join(f"{x:.9f}" for x in v * [-1, -1, 1])

        out = folder / "view.webp"
        fov = np.degrees(2 * np.arctan(0.5 * camera.height / camera.fy))
        run_program(
            ["node", program, "-w", "-q", ply, f"--camera={vector(position)}",
             f"--look-at={vector(position + R[:, 2])}", f"--up={vector(-R[:, 1])}", "--fov", f"{fov:.9f}",
             "--near", camera.near, "--resolution", f"{camera.width}x{camera.height}", out],
            env,
        )
        return np.asarray(Image.open(out).convert("RGB"), np.float32) / np.float32(255)

    return render


@pytest.fixture(scope="session")
def spark(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Path, Camera, list[np.ndarray]], list[np.ndarray]]:
    """Render views of a Gaussian .ply with Spark on three.js at its defaults, in a headless Chromium (SwiftShader).

    Every view is (H, W, 3) float32 in 0..1. One page load draws all poses, since loading takes longer than drawing.
    """
    for name in ("@sparkjsdev/spark", "three"):
        node_package(name)
    program = shutil.which(CHROMIUM)
    need(program, f"Chromium ({CHROMIUM}; ACTIVE3D_CHROMIUM names another)", "apt install chromium")
    folder = tmp_path_factory.mktemp("spark")

    def render(ply: Path, camera: Camera, poses: list[np.ndarray]) -> list[np.ndarray]:
        job = {
            "ply": str(ply.resolve()), "out": str(folder), "chromium": program, "width": camera.width,
            "height": camera.height, "fov_deg": float(np.degrees(2 * np.arctan(0.5 * camera.height / camera.fy))),
            "near": camera.near, "poses": [T.tolist() for T in poses],
        }
        (folder / "job.json").write_text(json.dumps(job), encoding="utf-8")
        answer = json.loads(run_program(["node", NODE / "render_spark.mjs", folder / "job.json"]))
        # What this test means depends on these defaults: a dilation of 0.3 px2 with opacity compensation.
        assert (answer["blurAmount"], answer["preBlurAmount"]) == (0.3, 0)
        shape = (camera.height, camera.width, 4)
        views = [np.frombuffer((folder / f"view_{i}.rgba").read_bytes(), np.uint8) for i in range(len(poses))]
        return [v.reshape(shape)[..., :3].astype(np.float32) / np.float32(255) for v in views]

    return render
