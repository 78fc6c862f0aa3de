"""What is wrong with a configuration, one line for each problem: where, which layer said so, what was expected."""

import json
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from active3d_pipe.pipeline.layers import Layers
from active3d_pipe.pipeline.nearest import did_you_mean


def explain(error: ValidationError, layers: Layers, model: type[BaseModel]) -> str:
    """The lines for a failed validation, joined by newlines."""
    lines: dict[str, None] = {}
    best: dict[str, list[str]] = {}
    for problem in error.errors(include_url=False):
        path, wanted = _path(problem["loc"], model), problem
        if problem["type"] == "extra_forbidden":
            where = ".".join(str(part) for part in problem["loc"])
            lines[f"{where}: unknown key ({layers.source_of(where)}){_nearest(where, model)}"] = None
        else:
            best.setdefault(path, []).append(_expected(wanted))
            lines[path] = None
    said = []
    for line in lines:
        if line in best:
            value = _lookup(layers.values, line)
            expected = " or ".join(dict.fromkeys(best[line])).replace(" or expected ", " or ")
            said.append(f"{line} = {_show(value)} ({layers.source_of(line)}): {expected}")
        else:
            said.append(line)
    return "\n".join(said)


def leaves(model: type[BaseModel], prefix: str = "") -> list[str]:
    """Dotted paths of every field of a model, sections included."""
    found: list[str] = []
    for name, info in model.model_fields.items():
        found.append(f"{prefix}{name}")
        below = section_of(info.annotation)
        if below is not None:
            found += leaves(below, f"{prefix}{name}.")
    return found


def take_unknown(values: dict[str, Any], model: type[BaseModel], prefix: str = "") -> list[str]:
    """Take out the values that a model has no field for; their dotted paths."""
    taken: list[str] = []
    for name, value in list(values.items()):
        if name not in model.model_fields:
            del values[name]
            taken.append(f"{prefix}{name}")
        elif isinstance(value, dict) and (below := section_of(model.model_fields[name].annotation)) is not None:
            taken += take_unknown(value, below, f"{prefix}{name}.")
    return taken


def section_of(annotation: Any) -> type[BaseModel] | None:
    """The model that a field holds, if it holds one."""
    for candidate in (annotation, *get_args(annotation)):
        if isinstance(candidate, type) and issubclass(candidate, BaseModel):
            return candidate
    return None


def _path(loc: tuple[int | str, ...], model: type[BaseModel]) -> str:
    """The dotted path of a field: pydantic adds names of union members and list indices, which users never wrote."""
    parts: list[str] = []
    below: type[BaseModel] | None = model
    for part in loc:
        if below is None or not isinstance(part, str) or part not in below.model_fields:
            break
        parts.append(part)
        below = section_of(below.model_fields[part].annotation)
    return ".".join(parts) or ".".join(str(part) for part in loc)


def _expected(problem: Any) -> str:
    if problem["type"] in ("model_type", "model_attributes_type", "dict_type"):
        return "expected a table of settings"
    text = problem["msg"].removeprefix("Value error, ")
    for start in ("Input should be ", "Value should have ", "Tuple should have ", "List should have "):
        if text.startswith(start):
            return f"expected {text.removeprefix(start).partition(', unable')[0].partition(', got')[0]}"
    return " ".join(text.split())


def _nearest(where: str, model: type[BaseModel]) -> str:
    known = leaves(model)
    parent, _, name = where.rpartition(".")
    siblings = [path for path in known if path.rpartition(".")[0] == parent]
    near = did_you_mean(where, siblings) or did_you_mean(where, known)
    if near:
        return near
    # The right name in the wrong place: `iterations` for `mapping.iterations`.
    same = [path for path in known if path.rpartition(".")[2] == name]
    if same:
        return f"; did you mean {same[0]!r}?"
    return f"; known here: {', '.join(path.rpartition('.')[2] for path in siblings)}" if siblings else ""


def _lookup(values: Any, path: str) -> Any:
    for name in path.split("."):
        if not isinstance(values, dict) or name not in values:
            return None
        values = values[name]
    return values


def _show(value: Any) -> str:
    text = json.dumps(value, default=str)
    return text if len(text) <= 60 else f"{text[:57]}..."
