"""Mapping: fold the new frames into the hybrid map."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from active3d_pipe.pipeline.stage import NodeId, Stage, StageContext
from stages import shared

if TYPE_CHECKING:
    from active3d_pipe.mapping.hybrid_map import HybridMap
    from active3d_pipe.structures import Frame, UncertaintyVolume


def _inputs(round: int) -> tuple[NodeId, ...]:
    before = () if round == 0 else (NodeId("mapping", round - 1), NodeId("uncertainty", round - 1))
    return (*shared.captures(round), *before)


def _run(context: StageContext) -> None:
    import time

    import numpy as np

    from active3d_pipe.mapping.extent import first_box
    from active3d_pipe.mapping.hybrid_map import HybridMap
    from active3d_pipe.mapping.update import update_map
    from active3d_pipe.storage.files import write_json

    config, k = context.config, context.round
    start = time.perf_counter()
    frames = shared.load_frames(context.input("capture", k))
    known = shared.load_rig(context.inputs)["bounds"]
    if k == 0:
        bounds = first_box(frames, config.mapping.extent) if known is None else np.array(known)
        hybrid = HybridMap.create(bounds[0], bounds[1], config.mapping, context.rng("initial parameters"))
        volume = None
    else:
        hybrid = shared.load_map(context.input("mapping", k - 1), context.inputs, config)
        volume = shared.load_volume(context.input("uncertainty", k - 1))
    context.timings["reading the map"] = time.perf_counter() - start
    if volume is not None and known is None:
        start = time.perf_counter()
        volume = _let_grow(hybrid, volume, frames, context)
        context.timings["extent"] = time.perf_counter() - start
    report = update_map(hybrid, frames, volume, k, config.mapping, context.rng("updates"), context.progress)
    start = time.perf_counter()
    shared.save_map(context.out, hybrid)
    context.timings["writing the map"] = time.perf_counter() - start
    document = {"schema": "active3d.mapping/1", "round": k, "bounds": known or hybrid.bounds.tolist(), **report.numbers}
    write_json(context.out / "mapping.json", document)
    context.timings.update(report.seconds)
    context.notes.update(report.numbers)
    if known is None:
        context.notes["box_m"] = np.ptp(hybrid.bounds, axis=0).round(2).tolist()


def _let_grow(
    hybrid: "HybridMap", volume: "UncertaintyVolume", frames: "Sequence[Frame]", context: StageContext
) -> "UncertaintyVolume":
    """Extend the map's box by what the frames read; the volume on it, where what is new is unseen."""
    import numpy as np

    from active3d_pipe.mapping.extent import grown_box
    from active3d_pipe.uncertainty.growth import grown_grid, on_grid

    box = grown_box(hybrid.bounds, frames, context.config.mapping.extent)
    if not np.array_equal(box, hybrid.bounds):
        hybrid.grow(box, context.rng("growth"))
    return on_grid(volume, grown_grid(volume.grid, box[0], box[1]))


STAGE = Stage(name="mapping", version=9, config=("mapping",), inputs=_inputs, run=_run, loop=True)
