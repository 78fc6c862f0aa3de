"""What a stage may see of the configuration: the sections that it declared, and nothing else."""

from typing import Any

from pydantic import BaseModel

from active3d_pipe.pipeline.stage import Stage


class UndeclaredConfigError(RuntimeError):
    """A stage read a section that is not part of its key: a mistake in the stage, not of the user."""


class ConfigView:
    """Attribute access to declared sections of a configuration.

    A declared section (`"mapping"`) is the pydantic model itself; the way to a declared part of one
    (`"mapping.field"`) is another view.
    """

    def __init__(self, config: Any, stage: Stage, prefix: str = "") -> None:
        self.__dict__.update(_config=config, _stage=stage, _prefix=prefix)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        path = f"{self._prefix}{name}"
        value = getattr(self._config, name)
        if path in self._stage.config:
            return value
        if any(section.startswith(f"{path}.") for section in self._stage.config):
            return ConfigView(value, self._stage, f"{path}.")
        raise UndeclaredConfigError(
            f"stage {self._stage.name!r} reads the configuration's {path!r} but declares only "
            f"{', '.join(self._stage.config) or 'nothing'}; add it to the stage's `config`"
        )

    def __setattr__(self, name: str, value: Any) -> None:
        raise UndeclaredConfigError(f"stage {self._stage.name!r} tries to change the configuration's {name!r}")


def subset(config: BaseModel, sections: tuple[str, ...], unkeyed: tuple[str, ...] = ()) -> dict[str, Any]:
    """Dotted section -> its values as plain JSON, without the settings `unkeyed` (dotted).

    A section or setting that does not exist is a mistake in the stage.
    """
    found: dict[str, Any] = {}
    for section in sorted(sections):
        value: Any = config
        for name in section.split("."):
            if not isinstance(value, BaseModel) or name not in type(value).model_fields:
                raise UndeclaredConfigError(f"the configuration has no section {section!r}")
            value = getattr(value, name)
        found[section] = value.model_dump(mode="json") if isinstance(value, BaseModel) else _plain(value)
    for path in unkeyed:
        section, _, name = path.rpartition(".")
        if name not in found.get(section, {}):
            raise UndeclaredConfigError(f"the configuration's {path!r} is in none of the stage's sections")
        del found[section][name]
    return found


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return value if isinstance(value, str | int | float | None) else str(value)
