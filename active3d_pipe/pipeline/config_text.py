"""A configuration as commented TOML: the form of `run.toml` and of `config show`."""

import json
from typing import Any

import tomli_w
from pydantic import BaseModel


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
            lines.append(f"{name} = {inline(values[name])}{_comment(info.description)}")
        else:
            lines.append(f"# {name} is not set{_comment(info.description)}")
    for name, value in below:
        _section(value, f"{path}.{name}" if path else name, lines)


def inline(value: Any) -> str:
    """A plain value as TOML on one line."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(inline(item) for item in value)}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{json.dumps(key)} = {inline(item)}' for key, item in value.items())}}}"
    return tomli_w.dumps({"x": value}).removeprefix("x = ").rstrip("\n")


def _comment(description: str | None) -> str:
    return f"  # {description}" if description else ""
