"""What the engine tells whoever watches it; it prints nothing itself."""

from dataclasses import dataclass
from typing import Any, Protocol

from active3d_pipe.pipeline.stage import NodeId


@dataclass(frozen=True, slots=True)
class Done:
    """A node that was committed, or found up to date (`seconds` is then None)."""

    node: NodeId
    notes: dict[str, Any]
    bytes: int
    seconds: float | None
    same_bytes: bool | None = None  # for a node that was made again: whether its content is what it was


class Watcher(Protocol):
    """Receives the engine's events, in order, on the engine's thread."""

    def began(self, node: NodeId, why: str) -> None:
        """`node` starts to run, because of `why`."""

    def working(self, node: NodeId, text: str) -> None:
        """A short text of a stage at work."""

    def done(self, done: Done) -> None:
        """A node is committed or was up to date."""

    def say(self, text: str) -> None:
        """One line for the user: damage found, a rebuild, a warning."""


class Silent:
    """A watcher that ignores everything."""

    def began(self, node: NodeId, why: str) -> None:
        """Ignored."""

    def working(self, node: NodeId, text: str) -> None:
        """Ignored."""

    def done(self, done: Done) -> None:
        """Ignored."""

    def say(self, text: str) -> None:
        """Ignored."""
