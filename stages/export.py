"""Export: refine the final map over everything that was logged, and hand over mesh and Gaussians."""

from active3d_pipe.pipeline.stage import NodeId, Stage, StageContext
from stages import shared

MAX_FRAMES = 700  # logged frames that refinement and mesh use: bounds the memory of long runs


def _inputs(last_round: int) -> tuple[NodeId, ...]:
    return (*shared.captures(last_round), NodeId("mapping", last_round))


def _run(context: StageContext) -> None:
    import time

    from active3d_pipe.export.final_mesh import final_mesh
    from active3d_pipe.export.viewer_model import fit_to_viewers
    from active3d_pipe.mapping.refine import refine
    from active3d_pipe.storage import meshes, splats
    from active3d_pipe.storage.files import write_json

    config, last = context.config, context.last_round
    hybrid = shared.load_map(context.input("mapping", last), context.inputs, config)
    frames = shared.load_covering(context.inputs, last, MAX_FRAMES)
    report = refine(hybrid, frames, context.rng("refinement"), context.progress)
    context.timings.update(report.seconds)

    start = time.perf_counter()
    context.progress("extracting the mesh")
    mesh = final_mesh(hybrid.field, frames, config.export.mesh)
    context.timings["mesh"] = time.perf_counter() - start

    start = time.perf_counter()
    exact, order = hybrid.gaussians.to_model(), context.rng("viewers")
    viewers = fit_to_viewers(exact, frames, config.mapping.gaussians, config.export, order, context.progress)
    context.timings["Gaussians for viewers"] = time.perf_counter() - start

    shared.save_map(context.out, hybrid, to_train=False)
    meshes.write_mesh_ply(context.out / "mesh.ply", mesh)
    if config.export.glb:
        meshes.write_mesh_glb(context.out / "mesh.glb", mesh)
    splats.write_splats(context.out / "gaussians.ply", viewers, "fitted to viewers; the map is gaussians.safetensors")
    numbers = {**report.numbers, "vertices": len(mesh.vertices), "faces": len(mesh.faces)}
    numbers["mesh_area_m2"] = round(mesh.area_m2, 3)
    write_json(context.out / "export.json", {"schema": "active3d.export/1", **numbers})
    context.notes.update(numbers)


STAGE = Stage(name="export", version=19, config=("mapping", "export"), inputs=_inputs, run=_run, loop=False)
