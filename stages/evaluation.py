"""Evaluation: the only stage beside capture that knows the ground truth."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from active3d_pipe.geometry.sampling import spread
from active3d_pipe.pipeline.stage import NodeId, Stage, StageContext
from stages import shared

if TYPE_CHECKING:
    from active3d_pipe.evaluation.geometry_metrics import TruthSurface
    from active3d_pipe.evaluation.views import ViewScores

MAX_FRAMES = 1000  # logged frames that say what was seen: bounds the memory of long runs
CURVE_ROUNDS = 16  # rounds whose surfaces are measured for the curves over steps


def _inputs(last_round: int) -> tuple[NodeId, ...]:
    rounds = [k for k in range(last_round + 1) if shared.leaves_surface(k)]
    surfaces = tuple(NodeId("uncertainty", k) for k in spread(rounds, CURVE_ROUNDS))
    return (*shared.captures(last_round), *surfaces, NodeId("export"))


def _parameters(config: Any, inputs: Mapping[NodeId, Path]) -> dict[str, Any]:
    from active3d_pipe.sim.digest import scene_name, source_digest

    # The name seeds the held-out views.
    return {"scene": source_digest(config.scene.file), "scene_name": scene_name(Path(config.scene.file))}


def _run(context: StageContext) -> None:
    import numpy as np

    from active3d_pipe.evaluation import evaluate as ev
    from active3d_pipe.evaluation.culling import SeenBy
    from active3d_pipe.evaluation.geometry_metrics import prepare_truth, thinned_truth
    from active3d_pipe.sim.observable import observable_points
    from active3d_pipe.storage import meshes
    from active3d_pipe.storage.files import write_json

    config = context.config
    settings = config.evaluation
    simulator = shared.make_simulator(config, config.run.seed)
    frames = shared.load_covering(context.inputs, context.last_round, MAX_FRAMES)
    hybrid = shared.load_map(context.input("export"), context.inputs, config, to_train=False)
    mesh = meshes.read_mesh(context.input("export") / "mesh.ply")

    context.progress("ground truth")
    scene = simulator.scene

    def observable(points: np.ndarray) -> np.ndarray:
        # Seeded by the evaluation, not by the run: every run of such an agent is judged on the same points.
        rng, motion = np.random.default_rng(settings.seed), config.motion
        return observable_points(simulator, points, rng, radius_m=motion.agent_radius_m, planar=motion.planar)

    truth = prepare_truth(scene.surface, settings, observable)
    context.progress("geometry")
    seen_by = SeenBy(frames[0].camera, np.stack([f.T_world_camera for f in frames]), [f.depth for f in frames])
    metrics = ev.evaluate_geometry(mesh, truth, settings, seen_by=seen_by, query_sdf=hybrid.field.query_sdf)

    def render(camera: Any, T: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        view = hybrid.render(camera, T)
        return view.rgb, view.depth, view.alpha

    sets = _view_sets(simulator, _viewer(config, simulator), frames, settings)
    scores, lpips_source = ev.evaluate_views(
        render, sets, settings, lambda name, done, total: context.progress(f"{name} views {done}/{total}")
    )
    metrics |= ev.view_metrics(scores)
    logs = [shared.read_capture(context.input("capture", k)) for k in range(context.last_round + 1)]
    metrics |= _run_metrics(logs)
    _write_examples(context.out / "examples", render, sets, scores, settings.example_views)

    curves = _curves(context, logs, thinned_truth(truth, settings.curve_points)) if settings.curve_points else []
    write_json(context.out / "curves.json", curves)
    (context.out / "curves.csv").write_text(ev.rows_to_csv(curves), encoding="utf-8")
    rows = ev.summary_rows(metrics)
    document = {"schema": "active3d.metrics/1", "lpips": lpips_source, "metrics": metrics}
    write_json(context.out / "metrics.json", document)
    write_json(context.out / "views.json", {name: s.rows for name, s in scores.items()})
    (context.out / "metrics.csv").write_text(ev.rows_to_csv(rows), encoding="utf-8")
    (context.out / "views.csv").write_text(
        ev.rows_to_csv([{"set": name, **row} for name, s in scores.items() for row in s.rows]), encoding="utf-8"
    )
    headline = (
        "completion_ratio_surface", "completion_ratio_surface_observable", "accuracy_cm_surface",
        "completion_cm_surface", "precision_surface", "psnr", "ssim", "lpips", "psnr_gap", "mad_cm", "collisions",
    )
    context.notes.update({k: metrics[k] for k in headline if metrics.get(k) is not None})


def _curves(context: StageContext, logs: list[dict], truth: "TruthSurface") -> list[dict[str, Any]]:
    """Completion and accuracy of the surface of every sampled round, by steps and walked metres."""
    from itertools import accumulate

    from active3d_pipe.evaluation import evaluate as ev
    from active3d_pipe.storage import meshes

    settings = context.config.evaluation
    walked = list(accumulate(d["path_length_m"] for d in logs))
    points = []
    for node, folder in context.inputs.items():
        if node.stage == "uncertainty" and node.round is not None:
            surface = meshes.read_mesh(folder / shared.SURFACE_NAME)
            values = ev.curve_point(logs[node.round]["steps_total"], surface, truth, settings)
            points.append({"round": node.round, "path_m": round(walked[node.round], 3), **values})
            context.progress(f"curve at round {node.round}")
    return points


def _viewer(config: Any, simulator: Any) -> Any:
    """The simulator that takes the scored views, at their resolution; of the scene that is open."""
    from active3d_pipe.sim.simulator import open_simulator

    scale, camera = config.evaluation.view_scale, config.camera
    if scale == 1:
        return simulator
    size = {name: max(8, round(scale * getattr(camera, name))) for name in ("width", "height")}
    return open_simulator(simulator.scene, camera.model_copy(update=size), config.sensor, config.run.seed)


def _view_sets(simulator: Any, viewer: Any, frames: list, settings: Any) -> dict[str, list]:
    """Held-out views at random free poses, the circle protocol, and a sample of the captured frames.

    `simulator` has the agent's camera; `viewer` takes the views, and the captured ones again where it has another.
    """
    from active3d_pipe.evaluation.views import circle_poses
    from active3d_pipe.sim.observable import held_out_poses

    scene = simulator.scene
    held_out = held_out_poses(simulator, settings.num_views, scene.name, min_clearance_m=settings.view_clearance_m)
    circle = circle_poses(scene.start_pose[:3, 3], settings.circle_radius_m, settings.circle_views)
    circle = circle[simulator.clearance(circle[:, :3, 3]) >= settings.view_clearance_m]
    train = spread(frames, settings.train_views) if settings.train_views else []
    return {
        "heldout": [_true_view(viewer, T, i) for i, T in enumerate(held_out)],
        "circle": [_true_view(viewer, T, i) for i, T in enumerate(circle)],
        "train": train if viewer is simulator else [_true_view(viewer, f.T_world_camera, f.step) for f in train],
    }


def _true_view(simulator: Any, T: Any, step: int) -> Any:
    """What is to be seen at a pose: depth without the sensor's noise and gaps."""
    from dataclasses import replace

    return replace(simulator.render(T, step=step), depth=simulator.depth(T))


def _run_metrics(logs: list[dict]) -> dict[str, Any]:
    return {
        "steps": sum(len(d["poses"]) for d in logs), "rounds": len(logs),
        "collisions": sum(d["collisions"] for d in logs),
        "path_m": round(sum(d["path_length_m"] for d in logs), 3),
        "min_clearance_m": min(d["min_clearance_m"] for d in logs),
    }


def _write_examples(folder: Path, render: Any, sets: dict, scores: "dict[str, ViewScores]", count: int) -> None:
    """A few held-out views as images (worst to best), for the report."""
    import numpy as np

    from active3d_pipe.evaluation.views import pick_examples, view_images
    from active3d_pipe.storage.files import write_tensors

    if "heldout" not in scores:
        return
    folder.mkdir()
    for index in pick_examples(scores["heldout"].rows, count):
        images = view_images(render, sets["heldout"][index], index)
        tensors = {
            "truth_rgb": images.truth_rgb, "render_rgb": images.render_rgb,
            "truth_depth": images.truth_depth.astype(np.float32), "render_depth": images.render_depth,
        }
        write_tensors(folder / f"view_{index:04d}.safetensors", tensors, {"index": index, "psnr": images.psnr})


STAGE = Stage(
    name="evaluation", version=5, config=("evaluation", "scene", "camera", "sensor", "motion", "mapping", "run.seed"),
    inputs=_inputs, run=_run, loop=False, parameters=_parameters,
    unkeyed=("scene.file",),
)
