"""Planning: decide the next best view and the path to it, from the artifacts alone."""

from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from active3d_pipe.pipeline.stage import NodeId, Stage, StageContext
from stages import shared

if TYPE_CHECKING:
    from active3d_pipe.planning.policies.context import MapView
    from active3d_pipe.structures import UncertaintyVolume


def _inputs(round: int) -> tuple[NodeId, ...]:
    before = () if round == 0 else (NodeId("planning", round - 1),)
    return (*shared.captures(round), NodeId("uncertainty", round), *before)


def _extra_inputs(config: Any, round: int) -> tuple[NodeId, ...]:
    """The map, for policies that look at it."""
    from active3d_pipe.planning.policies.registry import needs_map

    return (NodeId("mapping", round),) if needs_map(config.planning.policy) else ()


def _parameters(config: Any, inputs: Mapping[NodeId, Path]) -> dict[str, Any]:
    """What else a decision depends on: how the map is read, a recorded trajectory, the code of a foreign policy."""
    from active3d_pipe.planning.policies.registry import source_digest
    from active3d_pipe.storage.poses import poses_digest

    values: dict[str, Any] = {}
    if any(node.stage == "mapping" for node in inputs):
        values["mapping"] = config.mapping.model_dump(mode="json")
    if config.planning.trajectory:
        values["trajectory"] = poses_digest(Path(config.planning.trajectory))
    source = source_digest(config.planning.policy)
    if source is not None:
        values["policy_source"] = source
    return values


def _run(context: StageContext) -> None:
    from active3d_pipe.planning.policies.context import PolicyContext
    from active3d_pipe.planning.policies.registry import make_policy
    from active3d_pipe.storage.files import read_json, write_json
    from active3d_pipe.storage.poses import read_poses
    from active3d_pipe.structures import Camera, Decision

    settings, k = context.config.planning, context.round
    previous = None
    if k > 0:
        previous = Decision.from_json(read_json(context.input("planning", k - 1) / shared.DECISION_NAME))
    decision = make_policy(settings.policy).decide(
        PolicyContext(
            volume=_volume(context),
            walked_poses=shared.walked_poses(context.inputs, k),
            camera=Camera(**shared.load_rig(context.inputs)["camera"]),
            motion=context.config.motion,
            settings=settings,
            rng=context.rng("decide"),
            previous=previous,
            map=_map(context),
            recorded=read_poses(Path(settings.trajectory)) if settings.trajectory else None,
        )
    )
    write_json(context.out / shared.DECISION_NAME, decision.to_json())
    context.notes.update(stop=decision.stop, reason=decision.reason.value, path_steps=len(decision.path))
    if decision.chosen >= 0:
        best = decision.ranking[decision.chosen]
        context.notes.update(gain_bits=round(best.gain_imp + best.gain_exp, 3), reward=round(best.reward, 3))


def _volume(context: StageContext) -> "UncertaintyVolume":
    """The volume of this round; a copy of their own for policies from outside, which may write into it."""
    from active3d_pipe.storage.volumes import read_volume

    folder = context.input("uncertainty", context.round)
    if "policy_source" in context.parameters:
        return read_volume(folder / shared.VOLUME_NAME)
    return shared.load_volume(folder)


def _map(context: StageContext) -> "MapView | None":
    """The map of this round, read when the policy first looks at it; None when it is no input."""
    from active3d_pipe.mapping.config import MappingSettings
    from active3d_pipe.planning.policies.context import MapView

    if "mapping" not in context.parameters:
        return None
    config = SimpleNamespace(mapping=MappingSettings.model_validate(context.parameters["mapping"]))
    folder = context.input("mapping", context.round)
    return MapView(lambda: shared.load_map(folder, context.inputs, config, to_train=False))


STAGE = Stage(
    name="planning", version=14, config=("planning", "motion"), inputs=_inputs, run=_run, loop=True,
    parameters=_parameters, extra_inputs=_extra_inputs,
)
