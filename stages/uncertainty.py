"""Uncertainty: where is the map poor?"""

from active3d_pipe.pipeline.stage import NodeId, Stage, StageContext
from stages import shared


def _inputs(round: int) -> tuple[NodeId, ...]:
    before = () if round == 0 else (NodeId("mapping", round - 1), NodeId("uncertainty", round - 1))
    return (*shared.captures(round), NodeId("mapping", round), *before)


def _run(context: StageContext) -> None:
    from active3d_pipe.mapping.views import predict_views, uncertain_views
    from active3d_pipe.uncertainty.volume import compute_volume

    from active3d_pipe.storage import volumes

    config, k = context.config, context.round
    grid = shared.volume_grid(shared.load_rig(context.inputs), config.uncertainty.voxel_size_m)
    frames = shared.load_frames(context.input("capture", k))
    hybrid = shared.load_map(context.input("mapping", k), context.inputs, config)
    previous, predicted = None, []
    if k > 0:
        previous = volumes.read_volume(context.input("uncertainty", k - 1) / shared.VOLUME_NAME)
        before = shared.load_map(context.input("mapping", k - 1), context.inputs, config)
        predicted = predict_views(before, frames, config.uncertainty.predicted_views)
    views = uncertain_views(hybrid, config.uncertainty.examined_views, context.rng("examined views"))
    volume = compute_volume(
        grid=grid, round=k, previous=previous, field_query=hybrid.query_sdf_sigma, gaussians=hybrid.gaussians.to_model(),
        new_frames=frames, views=views, predicted=predicted, settings=config.uncertainty,
    )
    volumes.write_volume(context.out / shared.VOLUME_NAME, volume)
    observed = volume.observed
    context.notes.update(
        coverage=round(float(observed.mean()), 5),
        mean_uncertainty=round(float(volume["u_final"][observed].mean()), 6) if observed.any() else 0.0,
        entropy_bits=round(float(volume["entropy"].sum()), 2),
        alphas=[round(float(a), 5) for a in volume.fusion.get("alphas", [])],
    )


STAGE = Stage(name="uncertainty", version=1, config=("uncertainty", "mapping"), inputs=_inputs, run=_run, loop=True)
