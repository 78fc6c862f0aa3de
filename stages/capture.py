"""Capture: execute the decided path step by step and log what the camera sees."""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from active3d_pipe.pipeline.stage import NodeId, Stage, StageContext
from stages import shared


def _inputs(round: int) -> tuple[NodeId, ...]:
    if round == 0:
        return ()
    return (NodeId("planning", round - 1), NodeId("capture", round - 1))


def _parameters(config: Any, inputs: Mapping[NodeId, Path]) -> dict[str, Any]:
    """The scene's name and digest, and how many steps this round may take (the budget counts only where it binds)."""
    from active3d_pipe.sim.digest import scene_name, source_digest
    from active3d_pipe.storage.files import read_json

    values: dict[str, Any] = {
        "scene": source_digest(config.scene.file), "scene_name": scene_name(Path(config.scene.file)),
    }
    done = planned = 0
    for node, folder in inputs.items():
        if node.stage == "capture":
            done = read_json(folder / shared.CAPTURE_NAME)["steps_total"]
        else:
            planned = len(read_json(folder / shared.DECISION_NAME)["path"])
    left = config.run.steps - done
    values["limit"] = left if not inputs else min(left, planned)
    if not inputs:
        values["limit"] = min(left, 1000)  # round 0: the look-around is shorter than this in any configuration
    return values


def _run(context: StageContext) -> None:
    from active3d_pipe.planning.decide import bootstrap_decision
    from active3d_pipe.sim.execute import execute_path
    from active3d_pipe.storage import capture_log
    from active3d_pipe.storage.files import read_json, write_json
    from active3d_pipe.structures import Decision

    config = context.config
    simulator = shared.make_simulator(config, config.run.seed)
    rig: dict[str, Any] | None = None
    if context.round == 0:
        start = simulator.scene.start_pose
        path = bootstrap_decision(start, config.motion, config.planning).path
        current, first_step = start, 0
        corners = (simulator.scene.bounds_low, simulator.scene.bounds_high)
        bounds = None if config.scene.bounds == "auto" else [[float(v) for v in corner] for corner in corners]
        rig = {"scene": simulator.scene.name, "bounds": bounds, "camera": asdict(simulator.camera)}
    else:
        decision = Decision.from_json(read_json(context.input("planning", context.round - 1) / shared.DECISION_NAME))
        before = context.input("capture", context.round - 1)
        previous = read_json(before / shared.CAPTURE_NAME)
        path, first_step = decision.path, previous["steps_total"]
        current = np.array(previous["poses"][-1])
    path = path[: context.parameters["limit"]]
    with shared.log_frames(context.out, path) as log:
        walk = execute_path(
            simulator, current, path, config.motion, first_step=first_step, step_ns=capture_log.STEP_NS,
            log=log, progress=context.progress,
        )
        if not walk.frames:  # a blocked first step: the camera still looks from where it stands
            walk.frames.append(simulator.render(current, step=first_step, stamp_ns=first_step * capture_log.STEP_NS))
            log(walk.frames[0])
    document = {
        "schema": "active3d.capture/1", "round": context.round, "first_step": first_step, "steps": len(walk.frames),
        "steps_total": first_step + len(walk.frames), "planned": len(path), "collisions": walk.collisions,
        "min_clearance_m": round(walk.min_clearance_m, 4), "path_length_m": round(walk.length_m, 4),
        "poses": [f.T_world_camera.tolist() for f in walk.frames],
    }
    if rig is not None:
        document["rig"] = rig
    write_json(context.out / shared.CAPTURE_NAME, document)
    context.timings.update(walk.seconds)
    context.notes.update({k: document[k] for k in ("steps", "steps_total", "collisions", "min_clearance_m")})


STAGE = Stage(
    name="capture", version=3,
    config=("scene", "camera", "sensor", "motion", "planning.bootstrap_turn_deg", "planning.bootstrap_pitch_deg",
        "run.seed",),
    inputs=_inputs, run=_run, loop=True, parameters=_parameters, unkeyed=("scene.file",),
)
