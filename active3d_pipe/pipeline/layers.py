"""Layers of the configuration as plain values, before they are checked: preset < file < environment < --set.

Only the standard library is imported: the number of threads must be known before NumPy is loaded.
"""

import os
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from importlib.resources import files as package_files
from pathlib import Path
from typing import Any

from active3d_pipe.errors import ConfigError
from active3d_pipe.pipeline.nearest import did_you_mean

ENV_PREFIX = "ACTIVE3D__"


@dataclass(slots=True)
class Layers:
    """Merged raw values, and where each came from.

    Attributes:
        values: nested tables.
        sources: dotted path of a leaf -> the layer that set it, for messages.
        name: name of the preset or file, the default name of a run.
    """

    values: dict[str, Any] = field(default_factory=dict)
    sources: dict[str, str] = field(default_factory=dict)
    name: str = "run"

    def merge(self, table: Mapping[str, Any], source: str, prefix: str = "") -> None:
        """Put the values of `table` on top."""
        for key, value in table.items():
            path = f"{prefix}{key}"
            if isinstance(value, Mapping):
                self._table(path, source)
                self.merge(value, source, f"{path}.")
            else:
                *parents, leaf = path.split(".")
                node = self.values
                for i, name in enumerate(parents):
                    node = self._table(".".join(parents[: i + 1]), source) if name not in node else node[name]
                node[leaf] = value
                self.sources[path] = source

    def folder_of(self, path: str) -> Path | None:
        """Folder of the configuration file that sets `path`, for relative paths; None when no file does."""
        source = Path(self.sources.get(path, ""))
        return source.resolve().parent if source.is_file() else None

    def _table(self, path: str, source: str) -> dict[str, Any]:
        node = self.values
        for name in path.split("."):
            below = node.setdefault(name, {})
            if not isinstance(below, dict):
                below = node[name] = {}
            node = below
        self.sources.setdefault(path, source)
        return node

    def source_of(self, path: str) -> str:
        """Where a leaf or the table around it came from."""
        while path:
            if path in self.sources:
                return self.sources[path]
            path = path.rpartition(".")[0]
        return "defaults"


def preset_names() -> list[str]:
    """Names of the presets that ship with the package."""
    return sorted(
        entry.name.removesuffix(".toml") for entry in package_files("configs").iterdir() if entry.name.endswith(".toml")
    )


def read_layers(
    base: str | None, overrides: Iterable[str] = (), environ: Mapping[str, str] | None = None
) -> Layers:
    """Merge a preset name or TOML file, the environment, and `a.b=value` texts."""
    layers = Layers()
    if base is not None:
        _read_base(layers, base, ())
    _merge_environment(layers, os.environ if environ is None else environ)
    merge_overrides(layers, overrides)
    return layers


def merge_overrides(layers: Layers, overrides: Iterable[str]) -> None:
    """Put `a.b=value` texts on top; the value is TOML, or else a string."""
    for text in overrides:
        path, equals, value = text.partition("=")
        path = path.strip()
        if not equals or not path or not all(path.split(".")):
            raise ConfigError(f"--set {text}: expected a.b=value, for example --set run.steps=400")
        layers.merge(_nest(path, parse_value(value.strip())), "--set")


def parse_value(text: str) -> Any:
    """A TOML value, or the text itself when it is none."""
    try:
        return tomllib.loads(f"x = {text}")["x"]
    except tomllib.TOMLDecodeError:
        return text


def read_toml(path: Path) -> dict[str, Any]:
    """Parse a TOML file; ConfigError in one line."""
    try:
        return tomllib.loads(path.read_bytes().decode("utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}; expected a TOML file") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: is not valid TOML: {' '.join(str(error).split())}") from error


def _read_base(layers: Layers, base: str, seen: tuple[str, ...]) -> None:
    path = Path(base)
    if path.suffix == ".toml" or path.is_file():
        table, source, folder = read_toml(path), str(path), path.resolve().parent
        if any(Path(name).resolve() == path.resolve() for name in seen if name.endswith(".toml")):
            raise ConfigError(f"{source}: `preset` leads back to itself ({' -> '.join((*seen, source))})")
    else:
        table, source, folder = _read_preset(base), f"preset {base}", None
    if source in seen:
        raise ConfigError(f"{source}: `preset` leads back to itself ({' -> '.join((*seen, source))})")
    below = table.pop("preset", None)
    if below is not None:
        if not isinstance(below, str):
            raise ConfigError(f"{source}: preset = {below!r}; expected the name of a preset, as in preset = \"demo\"")
        beside = folder / below if folder is not None and below.endswith(".toml") else None
        _read_base(layers, str(beside) if beside is not None and beside.is_file() else below, (*seen, source))
    layers.merge(table, source)
    layers.name = path.stem


def _read_preset(name: str) -> dict[str, Any]:
    names = preset_names()
    if name not in names:
        hint = did_you_mean(name, names)
        raise ConfigError(f"{name!r} is neither a TOML file nor a preset{hint}; the presets are {', '.join(names)}")
    return tomllib.loads(package_files("configs").joinpath(f"{name}.toml").read_text("utf-8"))


def _merge_environment(layers: Layers, environ: Mapping[str, str]) -> None:
    for name in sorted(environ):
        if name.startswith(ENV_PREFIX):
            path = name.removeprefix(ENV_PREFIX).lower().replace("__", ".")
            if not all(path.split(".")):
                raise ConfigError(f"{name}: expected {ENV_PREFIX}SECTION__KEY")
            layers.merge(_nest(path, parse_value(environ[name])), name)


def _nest(path: str, value: Any) -> dict[str, Any]:
    for name in reversed(path.split(".")):
        value = {name: value}
    return value
