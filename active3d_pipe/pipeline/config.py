"""The whole configuration: every room's section, composed; how it is loaded and checked.

Layers, weakest first: defaults < preset < TOML file (which may name a preset) < environment `ACTIVE3D__A__B` <
`--set a.b=value`.
"""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import Field, ValidationError

from active3d_pipe.errors import ArtifactError, ConfigError
from active3d_pipe.evaluation.config import EvaluationSettings
from active3d_pipe.export.config import ExportSettings
from active3d_pipe.mapping.config import MappingSettings
from active3d_pipe.pipeline.config_errors import explain, take_unknown
from active3d_pipe.pipeline.config_text import resolved_toml
from active3d_pipe.pipeline.layers import Layers, merge_overrides, read_layers, read_toml
from active3d_pipe.pipeline.settings import RunSettings
from active3d_pipe.planning.config import PlanningSettings
from active3d_pipe.report.config import ReportSettings
from active3d_pipe.sim.config import CameraSettings, SceneSettings, SensorSettings
from active3d_pipe.structures.motion import MotionSettings
from active3d_pipe.structures.settings import Settings
from active3d_pipe.uncertainty.config import UncertaintySettings

AnySettings = TypeVar("AnySettings", bound=Settings)


class Config(Settings):
    """Everything that can be configured."""

    run: RunSettings = Field(RunSettings(), description="one exploration")
    scene: SceneSettings = Field(SceneSettings(), description="which scene is explored")
    camera: CameraSettings = Field(CameraSettings(), description="the camera")
    sensor: SensorSettings = Field(SensorSettings(), description="renderer and depth sensor")
    motion: MotionSettings = Field(MotionSettings(), description="how the agent may move")
    mapping: MappingSettings = Field(MappingSettings(), description="the hybrid map")
    uncertainty: UncertaintySettings = Field(UncertaintySettings(), description="where the map is poor")
    planning: PlanningSettings = Field(PlanningSettings(), description="next best view and path")
    export: ExportSettings = Field(ExportSettings(), description="final mesh and Gaussians")
    evaluation: EvaluationSettings = Field(EvaluationSettings(), description="metrics")
    report: ReportSettings = Field(ReportSettings(), description="the HTML page")


def validate(layers: Layers, model: type[AnySettings]) -> AnySettings:
    """Check merged layers against a model; ConfigError holds one line for every problem."""
    try:
        return model.model_validate(layers.values)
    except ValidationError as error:
        raise ConfigError(explain(error, layers, model)) from None


def load_config(base: str | None, overrides: Iterable[str] = (), environ: Mapping[str, str] | None = None) -> Config:
    """The configuration from a preset name or TOML file, the environment and `a.b=value` texts."""
    return validate(read_layers(base, overrides, environ), Config)


def load_run_config(
    run_toml: Path, model: type[AnySettings], overrides: Iterable[str] = (), warn: Callable[[str], None] | None = None
) -> AnySettings:
    """The configuration of a run folder, with `a.b=value` texts on top. The environment is not looked at.

    Settings that another version wrote and this one does not know are left out when there is `warn` to tell it to.

    Raises:
        ArtifactError: there is no such file, or it holds such settings and there is no `warn`.
        ConfigError: a value is wrong.
    """
    if not run_toml.is_file():
        raise ArtifactError(f"{run_toml}: is missing; expected the configuration of a run")
    values = read_toml(run_toml)
    unknown = take_unknown(values, model)
    if unknown and warn is None:
        raise ArtifactError(
            f"{run_toml}: {', '.join(unknown)} not known to this version; go on with the version that made the run, or "
            "remove this from the file (what was made with it is made again)"
        )
    if unknown and warn is not None:
        warn(f"{run_toml}: {', '.join(unknown)} not known to this version, ignored")
    layers = Layers()
    layers.merge(values, str(run_toml))
    merge_overrides(layers, overrides)
    return validate(layers, model)


def resolve_toml(config: Settings) -> str:
    """The text of `run.toml`."""
    return resolved_toml(config)


def with_values(config: AnySettings, **sections: Mapping[str, Any]) -> AnySettings:
    """A copy with some fields of some sections replaced; checked again."""
    values = config.model_dump()
    for name, fields in sections.items():
        values[name].update(fields)
    return type(config).model_validate(values)
