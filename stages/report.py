"""Report: gather what the run left on disk and lay it out as one HTML page."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from active3d_pipe.geometry.sampling import spread
from active3d_pipe.pipeline.stage import NodeId, Stage, StageContext
from stages import shared

if TYPE_CHECKING:
    import numpy as np

    from active3d_pipe.report import data as rd
    from active3d_pipe.structures import Decision, UncertaintyVolume

SLICED_ROUNDS = 6
SLICES = ("u_imp", "u_exp", "u_time", "u_final", "entropy")
SECTIONS = (  # everything: the page shows it
    "run", "scene", "camera", "sensor", "motion", "mapping", "uncertainty", "planning", "export", "evaluation",
    "report",
)  # fmt: skip
HEADLINE = ("completion_ratio_surface_observable", "accuracy_cm_surface", "psnr", "ssim", "lpips", "collisions")
SHARES = ("completion_ratio", "precision", "fscore")


def _inputs(last_round: int) -> tuple[NodeId, ...]:
    rounds = range(last_round + 1)
    loop = (NodeId(stage, k) for k in rounds for stage in ("capture", "uncertainty", "planning"))
    return (*loop, NodeId("mapping", last_round), NodeId("export"), NodeId("evaluation"))


def _run(context: StageContext) -> None:
    from active3d_pipe.report.data import ReportData
    from active3d_pipe.report.mesh_pictures import default_views, render_mesh
    from active3d_pipe.report.page import build_report
    from active3d_pipe.storage import meshes, volumes
    from active3d_pipe.storage.files import read_json
    from active3d_pipe.structures import Decision

    config, rounds = context.config, range(context.last_round + 1)
    logs = [read_json(context.input("capture", k) / shared.CAPTURE_NAME) for k in rounds]
    poses = shared.walked_poses(context.inputs, context.last_round)
    height = config.report.slice_height_m
    height = float(poses[0, 2, 3]) if height is None else height
    decisions = [
        Decision.from_json(read_json(context.input("planning", k) / shared.DECISION_NAME)) for k in rounds
    ]
    sliced = {
        k: volumes.read_volume(context.input("uncertainty", k) / shared.VOLUME_NAME)
        for k in spread(rounds, SLICED_ROUNDS)
    }
    last = sliced[context.last_round]
    fusion = [_fusion_document(context.input("uncertainty", k)) for k in rounds]
    context.progress("mesh pictures")
    mesh = meshes.read_mesh(context.input("export") / "mesh.ply")
    metrics = read_json(context.input("evaluation") / "metrics.json")
    rig = shared.load_rig(context.inputs)
    page = build_report(
        ReportData(
            title=config.run.name or context.out.parent.name,
            subtitle=f"{rig['scene']}, {len(poses)} steps in {len(logs)} rounds, "
            f"{config.camera.width}x{config.camera.height} px, seed {config.run.seed}",
            config_text=_config_text(config),
            metrics=_metrics(metrics),
            headline=HEADLINE,
            floor_plan=_floor_plan(last, height),
            trajectory=poses,
            keyframes=_keyframes(context, logs),
            goals=_goals(decisions),
            curves=_curves(context, logs),
            views=_views(context.input("evaluation") / "examples"),
            mesh_pictures=render_mesh(mesh, default_views(mesh, poses, config.report.mesh_width_px)),
            slices=_slices(sliced, height),
            fusion=_fusion(fusion),
            decisions=_decision_rows(context, decisions),
            timings=_timings(context),
            reproducibility={"seed": config.run.seed, "threads": config.run.threads, **_versions()},
        ),
        config.report,
    )
    (context.out / "index.html").write_text(page, encoding="utf-8")
    context.notes.update(bytes=len(page.encode()))


def _config_text(config: Any) -> str:
    import tomli_w

    return tomli_w.dumps({s: getattr(config, s).model_dump(mode="json", exclude_none=True) for s in SECTIONS})


def _metrics(document: dict[str, Any]) -> "dict[str, rd.Metric]":
    from active3d_pipe.evaluation.names import describe
    from active3d_pipe.report.data import Metric

    out = {}
    for name, value in document["metrics"].items():
        about = describe(name)
        if about:
            note = document["lpips"] if value is None and name.startswith("lpips") else ""
            out[name] = Metric(value, about["unit"], about["explanation"], about["better"], note)
    return out


def _level(volume: "UncertaintyVolume", height: float) -> int:
    import numpy as np

    k = int(np.floor((height - volume.grid.origin[2]) / volume.grid.voxel_size))
    return int(np.clip(k, 0, volume.grid.shape[2] - 1))


def _floor_plan(volume: "UncertaintyVolume", height: float) -> "rd.FloorPlan":
    from active3d_pipe.report.data import FloorPlan

    grid, k = volume.grid, _level(volume, height)
    return FloorPlan(volume["occupancy"][:, :, k], grid.origin[:2], grid.voxel_size, float(grid.axis(2)[k]))


def _slices(volumes: "dict[int, UncertaintyVolume]", height: float) -> "list[rd.SliceSeries]":
    from active3d_pipe.report.data import SliceSeries
    from active3d_pipe.structures import VOLUMES
    from active3d_pipe.uncertainty.growth import on_grid

    last = volumes[max(volumes)].grid  # the largest, if they grew
    volumes = {k: on_grid(v, last) for k, v in volumes.items()}
    return [
        SliceSeries(name, *VOLUMES[name], [(k, v[name][:, :, _level(v, height)]) for k, v in volumes.items()])
        for name in SLICES
    ]


def _keyframes(context: StageContext, logs: list[dict]) -> "np.ndarray":
    import numpy as np

    from active3d_pipe.storage.files import read_json

    documents = read_json(context.input("mapping", context.last_round) / "keyframes.json")
    poses = [logs[d["round"]]["poses"][d["step"] - logs[d["round"]]["first_step"]] for d in documents]
    return np.array(poses)[:, :3, 3]


def _goals(decisions: "list[Decision]") -> "np.ndarray":
    import numpy as np

    goals = [d.ranking[d.chosen].T_world_camera[:3, 3] for d in decisions if d.chosen >= 0]
    return np.array(goals).reshape(-1, 3)


def _records(context: StageContext, stage: str) -> list[dict[str, Any]]:
    """The notes of a stage's records, round by round."""
    from active3d_pipe.storage.files import read_json

    rounds = range(context.last_round + 1)
    return [read_json(context.input(stage, k) / "record.json")["notes"] for k in rounds]


def _curves(context: StageContext, logs: list[dict]) -> "list[rd.Curve]":
    from active3d_pipe.report.data import Curve
    from active3d_pipe.storage.files import read_json

    steps = [d["steps_total"] for d in logs]
    points = read_json(context.input("evaluation") / "curves.json")
    at = [p["step"] for p in points]
    notes = _records(context, "uncertainty")

    def measured(panel: str, label: str, unit: str, name: str) -> Curve:
        return Curve(panel, label, unit, at, [p.get(name) for p in points])

    return [
        measured("Completion ratio", "whole scene", "%", "completion_ratio_surface"),
        measured("Completion ratio", "observable", "%", "completion_ratio_surface_observable"),
        measured("Distances", "accuracy", "cm", "accuracy_cm_surface"),
        measured("Distances", "completion", "cm", "completion_cm_surface"),
        Curve("Entropy", "hybrid entropy", "bit", steps, [n["entropy_bits"] for n in notes]),
        Curve("Mean uncertainty", "observed voxels", "1", steps, [n["mean_uncertainty"] for n in notes]),
        Curve("Observed share of the box", "voxels", "%", steps, [n["coverage"] for n in notes]),
    ]


def _views(folder: Path) -> "list[rd.HeldOutView]":
    from active3d_pipe.report.data import HeldOutView
    from active3d_pipe.storage.files import read_tensors

    views = []
    for path in sorted(folder.glob("view_*.safetensors")) if folder.is_dir() else []:
        tensors, about = read_tensors(path)
        views.append((about["psnr"], HeldOutView(f"view {about['index']}, {about['psnr']:.1f} dB", **tensors)))
    return [view for _, view in sorted(views, key=lambda pair: pair[0])]


def _fusion_document(folder: Path) -> dict[str, Any]:
    from active3d_pipe.storage.volumes import read_fusion

    return read_fusion(folder / shared.VOLUME_NAME)


def _fusion(documents: list[dict[str, Any]]) -> "rd.FusionHistory":
    import numpy as np

    from active3d_pipe.report.data import FusionHistory

    return FusionHistory(
        list(range(len(documents))), np.array([d["alphas"] for d in documents]),
        [d.get("evidence") for d in documents], [d.get("noise") for d in documents],
    )


def _decision_rows(context: StageContext, decisions: "list[Decision]") -> "list[rd.DecisionRow]":
    """What each decision expected of its path, beside the entropy drop that the next round brought."""
    from active3d_pipe.report.data import DecisionRow

    entropy = [n["entropy_bits"] for n in _records(context, "uncertainty")]
    rows = []
    for k, decision in enumerate(decisions):
        best, terms = decision.ranking[decision.chosen] if decision.chosen >= 0 else None, decision.terms
        outcome = decisions[k + 1].terms.get("previous", {}) if k + 1 < len(decisions) else {}
        realised = entropy[k] - entropy[k + 1] if k + 1 < len(entropy) else None
        if outcome:
            realised = outcome["realised_imp"] + outcome["realised_exp"]
        rows.append(
            DecisionRow(
                k, decision.reason.value, terms.get("predicted_imp", best.gain_imp if best else None),
                terms.get("predicted_exp", best.gain_exp if best else None), realised,
                terms.get("path_length_m"), terms.get("max_risk"), len(decision.path), terms.get("num_candidates"),
                outcome.get("realised_imp"), outcome.get("realised_exp"),
            )
        )
    return rows


def _timings(context: StageContext) -> "list[rd.Timing]":
    from active3d_pipe.report.data import Timing

    modules: dict[tuple[str, str], list[float]] = {}
    for node, seconds in context.runs_seconds.items():
        named = {name: s for name, s in seconds.items() if name != "total"}
        rest = seconds.get("total", 0.0) - sum(named.values())
        for name, s in [*named.items(), ("other", max(rest, 0.0))]:
            modules.setdefault((node.stage, name), []).append(s)
    return [Timing(stage, name, sum(s), len(s)) for (stage, name), s in sorted(modules.items())]


def _versions() -> dict[str, str]:
    from importlib.metadata import version

    names = ("active3d", "torch", "numpy", "numba", "open3d-cpu", "zarr", "mcap")
    found = {}
    for name in names:
        try:
            found[name] = version(name)
        except ImportError:
            found[name] = "not installed"
    return found


STAGE = Stage(name="report", version=1, config=SECTIONS, inputs=_inputs, run=_run, loop=False, volatile=True)
