"""Planning: decide the next best view and the path to it, from the artifacts alone."""

from active3d_pipe.pipeline.stage import NodeId, Stage, StageContext
from stages import shared


def _inputs(round: int) -> tuple[NodeId, ...]:
    before = () if round == 0 else (NodeId("planning", round - 1),)
    return (*shared.captures(round), NodeId("uncertainty", round), *before)


def _run(context: StageContext) -> None:
    from active3d_pipe.planning.decide import decide
    from active3d_pipe.storage import volumes
    from active3d_pipe.storage.files import read_json, write_json
    from active3d_pipe.structures import Camera, Decision

    config, k = context.config, context.round
    volume = volumes.read_volume(context.input("uncertainty", k) / shared.VOLUME_NAME)
    poses = shared.walked_poses(context.inputs, k)
    camera = Camera(**shared.load_rig(context.inputs)["camera"])
    previous = None
    if k > 0:
        previous = Decision.from_json(read_json(context.input("planning", k - 1) / shared.DECISION_NAME))
    decision = decide(
        volume, poses[-1], poses, camera, config.motion, config.planning, context.rng("decide"), previous=previous
    )
    write_json(context.out / shared.DECISION_NAME, decision.to_json())
    context.notes.update(stop=decision.stop, reason=decision.reason.value, path_steps=len(decision.path))
    if decision.chosen >= 0:
        best = decision.ranking[decision.chosen]
        context.notes.update(gain_bits=round(best.gain_imp + best.gain_exp, 3), reward=round(best.reward, 3))


STAGE = Stage(name="planning", version=1, config=("planning", "motion"), inputs=_inputs, run=_run, loop=True)
