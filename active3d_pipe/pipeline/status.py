"""What a run folder holds and what it cost, for `status`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from active3d_pipe.pipeline import lock
from active3d_pipe.pipeline.files import list_files
from active3d_pipe.pipeline.journal import spent
from active3d_pipe.pipeline.runner import Runner
from active3d_pipe.pipeline.stage import NodeId
from active3d_pipe.pipeline.survey import NodeState, State

SCHEMA = "active3d.status/1"


@dataclass(frozen=True, slots=True)
class NodeStatus:
    """One node: its state, what its last commit cost in seconds, and the bytes it takes on disk."""

    state: NodeState
    seconds: float | None
    bytes: int


@dataclass(frozen=True, slots=True)
class Status:
    """The status of a run.

    Attributes:
        path: the run folder.
        ended: why the loop ended, or None.
        complete: everything is up to date, the finishing stages included.
        rounds: rounds of which every record is there.
        steps, budget: captured steps, and the most that may be.
        nodes: every node in execution order.
        beyond: nodes on disk that lie beyond the loop's end.
        writer: process id of whoever works on the run now.
        torn_lines: lines of the journal that could not be read.
    """

    path: Path
    ended: str | None
    complete: bool
    rounds: int
    steps: int
    budget: int
    nodes: tuple[NodeStatus, ...]
    beyond: tuple[NodeId, ...]
    writer: int | None
    torn_lines: int

    def totals(self) -> dict[str, dict[str, Any]]:
        """Stage -> number of nodes by state, seconds and bytes."""
        found: dict[str, dict[str, Any]] = {}
        for node in self.nodes:
            row = found.setdefault(node.state.node.stage, {"nodes": 0, "seconds": 0.0, "bytes": 0, "states": {}})
            row["nodes"] += node.state.record is not None
            row["seconds"] = round(row["seconds"] + (node.seconds or 0.0), 4)
            row["bytes"] += node.bytes
            name = node.state.state.value
            row["states"][name] = row["states"].get(name, 0) + 1
        return found

    def notes(self) -> dict[str, Any]:
        """The newest notes of every stage, merged: coverage, PSNR, ... as of now."""
        merged: dict[str, Any] = {}
        for node in self.nodes:
            if node.state.record is not None:
                merged.update(node.state.record.notes)
        return merged

    def to_json(self) -> dict[str, Any]:
        """The document of `status --json`."""
        return {
            "schema": SCHEMA, "run": str(self.path), "complete": self.complete, "ended": self.ended,
            "rounds": self.rounds, "steps": self.steps, "budget": self.budget, "writer": self.writer,
            "torn_journal_lines": self.torn_lines, "stages": self.totals(), "notes": self.notes(),
            "beyond_the_end": [str(node) for node in self.beyond],
            "nodes": [
                {
                    "node": str(n.state.node), "stage": n.state.node.stage, "round": n.state.node.round,
                    "state": n.state.state.value, "reasons": list(n.state.reasons), "seconds": n.seconds,
                    "bytes": n.bytes, "key": n.state.record.key if n.state.record else None,
                    "content": n.state.record.content if n.state.record else None,
                    "notes": n.state.record.notes if n.state.record else {},
                }
                for n in self.nodes
            ],
        }


def status(runner: Runner) -> Status:
    """Survey a run; takes no lock and changes nothing."""
    run_dir = runner.run_dir
    events, torn = run_dir.journal.read()
    cost = spent(events)
    last = runner.last_round()
    nodes = tuple(
        NodeStatus(state, cost[state.node].seconds if state.node in cost else None, _bytes(runner, state))
        for state in runner.surveyor.survey(last).values()
    )
    ended = runner.ended(last)
    return Status(
        path=run_dir.path, ended=ended, complete=ended is not None and all(n.state.state.is_hit for n in nodes),
        rounds=runner.last_whole_round() + 1, steps=runner.steps(last), budget=runner.config.run.steps, nodes=nodes,
        beyond=tuple(beyond(runner)), writer=lock.holder(run_dir.path), torn_lines=torn,
    )


def beyond(runner: Runner) -> list[NodeId]:
    """Nodes on disk after the round where the loop ends: left over from an earlier configuration."""
    last = runner.last_round()
    if runner.ended(last) is None:
        return []
    store = runner.run_dir.store
    return [NodeId(s.name, k) for s in runner.registry.loop for k in store.rounds(s.name) if k > last]


def _bytes(runner: Runner, state: NodeState) -> int:
    folder = runner.run_dir.store.folder(state.node)
    if state.record is None or state.state in (State.PRUNED, State.DAMAGED):
        return sum(path.lstat().st_size for path in list_files(folder)) if folder.is_dir() else 0
    if runner.run_dir.store.is_pruned(state.node):
        return 0
    return state.record.size
