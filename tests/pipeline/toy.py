"""A small real pipeline for the engine's tests: every stage reads its inputs and writes files with NumPy.

It has the shape of the true one (a loop of four stages with feedback, three that finish), reads true sections of
the configuration, and takes milliseconds. `crash_after_write` and `sleep` let tests stop it half-way.
"""

import json
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from active3d_pipe.errors import ArtifactError
from active3d_pipe.pipeline.graph import Registry
from active3d_pipe.pipeline.stage import NodeId, Stage, StageContext

STEPS_A_ROUND = 4
SLEEP = "ACTIVE3D_TEST_TOY_SLEEP"


def _pause() -> None:
    time.sleep(float(os.environ.get(SLEEP, "0")))


def _load(path: Path) -> np.ndarray:
    try:
        return np.load(path, allow_pickle=False)
    except (OSError, ValueError) as error:
        raise ArtifactError(f"{path}: cannot be read") from error


def _capture_parameters(config: Any, inputs: Mapping[NodeId, Path]) -> dict[str, Any]:
    done = 0
    for node, folder in inputs.items():
        if node.stage == "capture":
            done = json.loads((folder / "capture.json").read_text())["total"]
    return {"limit": min(STEPS_A_ROUND, config.run.steps - done), "done": done}


def _capture(c: StageContext) -> None:
    n = c.parameters["limit"]
    direction = 0.0
    if c.round > 0:
        direction = json.loads((c.input("planning", c.round - 1) / "decision.json").read_text())["direction"]
    c.progress("capturing")
    frames = c.rng("noise").normal(direction, 1 + c.config.sensor.dropout, (n, c.config.camera.height, 8))
    np.save(c.out / "frames.npy", frames.astype(np.float32))
    (c.out / "capture.json").write_text(json.dumps({"total": c.parameters["done"] + n}))
    c.notes.update(steps=n)
    c.timings["render"] = 0.001
    _pause()


def _mapping(c: StageContext) -> None:
    frames = _load(c.input("capture", c.round) / "frames.npy")
    state = np.zeros(8, np.float32) if c.round == 0 else _load(c.input("mapping", c.round - 1) / "state.npy")
    w = np.float32(1.0 / c.config.mapping.window.size)
    np.save(c.out / "state.npy", (1 - w) * state + w * frames.mean((0, 1)))
    _pause()
    (c.out / "optimiser").mkdir()
    np.save(c.out / "optimiser" / "moments.npy", np.repeat(frames.std((0, 1)), 500))
    c.notes.update(psnr=round(20 + float(np.abs(state).sum()), 3))


def _uncertainty(c: StageContext) -> None:
    state = _load(c.input("mapping", c.round) / "state.npy")
    np.save(c.out / "volume.npy", np.outer(state, state) + c.config.mapping.keyframes.tau_high)
    c.notes.update(coverage=round(1 - 0.5 ** (c.round + 1), 4))
    _pause()


def _planning(c: StageContext) -> None:
    volume = _load(c.input("uncertainty", c.round) / "volume.npy")
    direction = float(volume.mean()) * c.config.motion.max_step_m + float(c.rng("jitter").normal())
    (c.out / "decision.json").write_text(json.dumps({"direction": direction}))
    c.notes.update(stop=False, reason="best_gain")
    _pause()


def _export(c: StageContext) -> None:
    np.save(c.out / "mesh.npy", _load(c.input("mapping", c.last_round) / "state.npy") * c.config.mapping.window.size)


def _evaluation(c: StageContext) -> None:
    frames = [_load(c.input("capture", k) / "frames.npy") for k in range(c.last_round + 1)]
    score = float(np.concatenate(frames).mean() * c.config.camera.width + _load(c.input("export") / "mesh.npy").sum())
    (c.out / "metrics.json").write_text(json.dumps({"score": score}))
    c.notes.update(score=round(score, 6))


def _report(c: StageContext) -> None:
    seconds = {str(node): s["total"] for node, s in c.runs_seconds.items()}
    score = json.loads((c.input("evaluation") / "metrics.json").read_text())["score"]
    (c.out / "index.html").write_text(f"<p>{c.config.run.name} {score}</p><!-- {seconds} -->")


def _loop(name: str, sections: tuple[str, ...], inputs: Any, run: Any, parameters: Any = None) -> Stage:
    return Stage(name, 1, sections, inputs, run, loop=True, parameters=parameters)


def _back(name: str, k: int) -> tuple[NodeId, ...]:
    return () if k == 0 else (NodeId(name, k - 1),)


REGISTRY = Registry(
    loop=(
        _loop(
            "capture", ("camera.height", "sensor"), lambda k: (*_back("planning", k), *_back("capture", k)), _capture,
            _capture_parameters,
        ),
        _loop("mapping", ("mapping.window",), lambda k: (NodeId("capture", k), *_back("mapping", k)), _mapping),
        _loop("uncertainty", ("mapping.keyframes.tau_high",), lambda k: (NodeId("mapping", k),), _uncertainty),
        _loop("planning", ("motion",), lambda k: (NodeId("uncertainty", k),), _planning),
    ),
    finish=(
        Stage("export", 1, ("mapping.window.size",), lambda k: (NodeId("mapping", k),), _export, loop=False),
        Stage(
            "evaluation", 1, ("camera.width",),
            lambda k: (NodeId("export"), *(NodeId("capture", i) for i in range(k + 1))), _evaluation, loop=False,
        ),
        Stage("report", 1, ("run",), lambda k: (NodeId("evaluation"),), _report, loop=False, volatile=True),
    ),
)
LOOP, FINISH = REGISTRY.loop, REGISTRY.finish
