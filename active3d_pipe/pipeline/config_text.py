"""A configuration as commented TOML: the form of `run.toml` and of `config show`."""

import json
from typing import Any, Literal, get_args, get_origin

import tomli_w
from pydantic import BaseModel
from pydantic.fields import FieldInfo


def resolved_toml(config: BaseModel) -> str:
    """Every setting with its value, the descriptions as comments. Fields that are None are left out."""
    lines: list[str] = []
    _section(config, "", lines)
    return "\n".join(lines).lstrip("\n") + "\n"


def _section(section: BaseModel, path: str, lines: list[str]) -> None:
    below: list[tuple[str, BaseModel]] = []
    values = section.model_dump(mode="json")
    if path:
        lines += ["", f"[{path}]"]
    for name, info in type(section).model_fields.items():
        value = getattr(section, name)
        if isinstance(value, BaseModel):
            below.append((name, value))
        elif value is not None:
            lines.append(f"{name} = {inline(values[name])}{_comment(info)}")
        else:
            lines.append(f"# {name} is not set{_comment(info)}")
    for name, value in below:
        _section(value, f"{path}.{name}" if path else name, lines)


def inline(value: Any) -> str:
    """A plain value as TOML on one line."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(inline(item) for item in value)}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{json.dumps(key)} = {inline(item)}' for key, item in value.items())}}}"
    return tomli_w.dumps({"x": value}).removeprefix("x = ").rstrip("\n")


def _comment(info: FieldInfo) -> str:
    parts = [info.description or "", " | ".join(_words(info.annotation))]
    text = "; words: ".join(part for part in parts if part)
    return f"  # {text}" if text else ""


def _words(annotation: Any) -> list[str]:
    """The words that a setting, or an item of its list, may be."""
    if get_origin(annotation) is Literal:
        return [inline(word) for word in get_args(annotation)]
    return [word for inner in get_args(annotation) for word in _words(inner)]
