"""`journal.jsonl`: what happened when, one JSON line each, appended and fsynced.

It holds all that must not be in an artifact because it differs between equal runs: times and seconds. A line
that a crash tore is skipped on reading and closed before the next one is written.
"""

import json
import os
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from active3d_pipe.pipeline.files import failpoint, writing
from active3d_pipe.pipeline.stage import NodeId

JOURNAL = "journal.jsonl"


def parse_node(text: str) -> NodeId:
    """Inverse of `str(NodeId)`."""
    stage, _, tail = text.partition("/round_")
    return NodeId(stage, int(tail) if tail else None)


@dataclass(frozen=True, slots=True)
class Spent:
    """What the newest commit of a node cost: seconds in all, and by module."""

    seconds: float
    timings: dict[str, float]
    content: str


class Journal:
    """The journal of one run folder."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / JOURNAL

    def append(self, event: str, **fields: Any) -> None:
        """Add one line and make it durable."""
        line = json.dumps({"event": event, "time": datetime.now(UTC).isoformat(timespec="milliseconds"), **fields})
        failpoint()
        with writing(self.path), open(self.path, "ab+") as f:
            if f.tell() > 0:
                f.seek(-1, os.SEEK_END)
                if f.read(1) != b"\n":
                    f.write(b"\n")
            f.write(line.encode("ascii") + b"\n")
            f.flush()
            os.fsync(f.fileno())

    def read(self) -> tuple[list[dict[str, Any]], int]:
        """All events in order, and the number of lines that could not be read."""
        try:
            data = self.path.read_bytes()
        except FileNotFoundError:
            return [], 0
        events: list[dict[str, Any]] = []
        torn = 0
        for line in data.split(b"\n"):
            if not line.strip():
                continue
            try:
                doc = json.loads(line)
                events.append({"event": str(doc["event"]), **doc})
            except (ValueError, KeyError, TypeError):
                torn += 1
        return events, torn

    def spent(self) -> dict[NodeId, Spent]:
        """Newest commit of every node."""
        return spent(self.read()[0])


def spent(events: Iterable[dict[str, Any]]) -> dict[NodeId, Spent]:
    """Newest commit of every node among `events`; lines of another form are passed over."""
    found: dict[NodeId, Spent] = {}
    for event in events:
        if event["event"] != "commit":
            continue
        try:
            node = parse_node(event["node"])
            found[node] = Spent(float(event["seconds"] or 0), dict(event.get("timings") or {}), str(event["content"]))
        except (AttributeError, KeyError, TypeError, ValueError):
            continue
    return found
