"""Uncertainty: where is the map poor?"""

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from active3d_pipe.pipeline.stage import NodeId, Stage, StageContext
from stages import shared

if TYPE_CHECKING:
    from active3d_pipe.mapping.hybrid_map import HybridMap
    from active3d_pipe.structures import Frame, UncertaintyVolume
    from active3d_pipe.uncertainty.config import UncertaintySettings
    from active3d_pipe.uncertainty.explicit import ViewResidual


def _inputs(round: int) -> tuple[NodeId, ...]:
    before = () if round == 0 else (NodeId("mapping", round - 1), NodeId("uncertainty", round - 1))
    return (*shared.captures(round), NodeId("mapping", round), *before)


def residuals(
    hybrid: "HybridMap", frames: "Sequence[Frame]", stride: int, timings: dict[str, float], *, of_field: bool = False
) -> "list[ViewResidual]":
    """Errors of the map's renderings at the frames' poses, every `stride`-th pixel; the field's beside, if asked."""
    from active3d_pipe.geometry.thinning import thinned
    from active3d_pipe.uncertainty.explicit import view_residuals

    start = time.perf_counter()
    out, query = [], hybrid.field.query_sdf if of_field else None
    for frame in frames:
        rgb, depth, camera = thinned(frame, stride)
        view = hybrid.render(camera, frame.T_world_camera)
        out.append(view_residuals(view.rgb, view.depth, view.alpha, rgb, depth, camera, frame.T_world_camera, query))
    timings["residuals"] = timings.get("residuals", 0.0) + time.perf_counter() - start
    return out


def examined_frames(
    hybrid: "HybridMap", frames: "Sequence[Frame]", previous: "UncertaintyVolume | None",
    settings: "UncertaintySettings",
) -> "list[Frame]":
    """Frames to render with this round's map: some of the new ones, and C_high of the keyframes before them."""
    from active3d_pipe.uncertainty.explicit import most_uncertain

    chosen = list(frames[::settings.render_every])
    if previous is not None:
        older = [key.frame for key in hybrid.keyframes if key.frame.step < frames[0].step]
        chosen += [older[i] for i in most_uncertain(previous.grid, older, previous["u_exp"], settings)]
    return chosen


def _run(context: StageContext) -> None:
    import numpy as np

    from active3d_pipe.storage.files import read_json
    from active3d_pipe.uncertainty.growth import grown_grid, on_grid
    from active3d_pipe.uncertainty.volume import compute_volume, make_grid

    config, k = context.config, context.round
    low, high = np.array(read_json(context.input("mapping", k) / "mapping.json")["bounds"])
    grid = make_grid(low, high, config.uncertainty)
    frames = shared.load_frames(context.input("capture", k))
    start = time.perf_counter()
    hybrid = shared.load_map(context.input("mapping", k), context.inputs, config, to_train=False)
    context.timings["reading the map"] = time.perf_counter() - start
    previous, predicted, last_field_query = None, [], None
    if k > 0:
        previous = shared.load_volume(context.input("uncertainty", k - 1))
        margin = config.uncertainty.margin_m
        grid = grown_grid(previous.grid, low - margin, high + margin)
        previous = on_grid(previous, grid)
        before = shared.load_map(context.input("mapping", k - 1), context.inputs, config, to_train=False)
        last_field_query = before.field.query_geometry
        ahead = frames[:: config.uncertainty.predict_every]
        predicted = residuals(before, ahead, config.uncertainty.render_stride, context.timings, of_field=True)
    examined = examined_frames(hybrid, frames, previous, config.uncertainty)
    views = residuals(hybrid, examined, config.uncertainty.render_stride, context.timings)
    start = time.perf_counter()
    volume = compute_volume(
        grid=grid, round=k, previous=previous, field_query=hybrid.field.query_geometry,
        gaussians=hybrid.gaussians.to_model(copy=False), new_frames=frames, views=views, predicted=predicted,
        settings=config.uncertainty, last_field_query=last_field_query,
    )
    context.timings["volume"] = time.perf_counter() - start
    shared.save_volume(context.out, volume)
    if shared.leaves_surface(k):
        _write_surface(context, hybrid, volume)
    observed = volume.observed
    context.notes.update(
        coverage=round(float(observed.mean()), 5),
        mean_uncertainty=round(float(volume["u_final"][observed].mean()), 6) if observed.any() else 0.0,
        entropy_bits=round(float(volume["entropy"].sum(dtype=np.float64)), 2),
        alphas=[round(float(a), 5) for a in volume.fusion.get("alphas", [])],
    )


def _write_surface(context: StageContext, hybrid: "HybridMap", volume: "UncertaintyVolume") -> None:
    """The coarse surface of this round, for the curves over steps."""
    from active3d_pipe.export.config import MeshSettings
    from active3d_pipe.export.isosurface import extract_mesh, near_surface
    from active3d_pipe.storage import meshes

    start = time.perf_counter()
    # Finding loose pieces costs a quarter of the time, and the curves over steps do not see them.
    settings = MeshSettings(voxel_size_m=context.config.export.preview_voxel_m, min_component_m2=0)
    observed = near_surface(volume["hit_evidence"], settings.dilate_voxels)
    field = hybrid.field
    mesh = extract_mesh(field.query_sdf, field.low, field.high, settings, grid=volume.grid, observed=observed)
    meshes.write_mesh_ply(context.out / shared.SURFACE_NAME, mesh)
    context.timings["surface"] = time.perf_counter() - start


STAGE = Stage(
    name="uncertainty", version=13, config=("uncertainty", "mapping", "export.preview_voxel_m"),
    inputs=_inputs, run=_run, loop=True,
)
