"""Keys: what an artifact depends on, as one digest.

key = sha256(canonical JSON of {stage, version, config, parameters, inputs, seed, threads}), where `config` holds
the declared sections only and `inputs` the content digests of the input artifacts. File times are never looked at.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping
from typing import Any

from active3d_pipe.pipeline.stage import NodeId, Stage


def canonical(value: Any) -> bytes:
    """The one JSON text of a value: sorted keys, no spaces, ASCII, no NaN."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode("ascii")


def digest(value: Any) -> str:
    """Hexadecimal SHA-256 of the canonical JSON of a value."""
    return hashlib.sha256(canonical(value)).hexdigest()


def node_seed(run_seed: int, node: NodeId) -> int:
    """Seed of a node, derived from the run's seed, the stage and the round; 63 bits."""
    words = hashlib.sha256(canonical(["active3d.seed/1", run_seed, node.stage, node.round])).digest()
    return int.from_bytes(words[:8], "little") >> 1


def key_parts(
    stage: Stage,
    seed: int,
    threads: int,
    config: Mapping[str, Any],
    parameters: Mapping[str, Any],
    inputs: Mapping[NodeId, str],
) -> dict[str, Any]:
    """The parts of a node's key as plain JSON values; `inputs` maps a node to its content digest."""
    return {
        "stage": stage.name,
        "version": stage.version,
        "config": dict(config),
        "parameters": json.loads(canonical(dict(parameters))),
        "inputs": {str(node): content for node, content in inputs.items()},
        "seed": seed,
        "threads": threads,
    }


def _leaves(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping) and value:
        for name, below in value.items():
            yield from _leaves(below, f"{path}.{name}" if path else str(name))
    else:
        yield path, value


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Why two keys differ, one short text for each part: `mapping.iterations 8 -> 4`."""
    reasons: list[str] = []
    for part, said in (("version", "stage version "), ("seed", "seed "), ("threads", "threads ")):
        if old.get(part) != new.get(part):
            reasons.append(f"{said}{old.get(part)} -> {new.get(part)}")
    for part in ("config", "parameters"):
        a, b = dict(_leaves(old.get(part, {}))), dict(_leaves(new.get(part, {})))
        for name in sorted({*a, *b} - {""}):
            if a.get(name, _ABSENT) != b.get(name, _ABSENT):
                reasons.append(f"{name} {_short(a.get(name, _ABSENT))} -> {_short(b.get(name, _ABSENT))}")
    a, b = old.get("inputs", {}), new.get("inputs", {})
    for name in sorted({*a, *b}):
        if a.get(name) != b.get(name):
            what = "is a new input" if name not in a else "is no input any more" if name not in b else "changed"
            reasons.append(f"input {name} {what}")
    return reasons


_ABSENT = object()


def _short(value: Any) -> str:
    if value is _ABSENT:
        return "(absent)"
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 24 else f"{text[:21]}..."
