"""Progress on stderr: a bar on a terminal, one line for every artifact elsewhere."""

import sys
import time
from typing import Any

from active3d_pipe.cli.console import say, seconds
from active3d_pipe.pipeline.events import Done, Silent, Watcher
from active3d_pipe.pipeline.stage import NodeId


def make_watcher(budget: int, quiet: bool) -> Watcher:
    """A watcher for this terminal; `budget` is the number of steps of the whole run."""
    if quiet:
        return Warnings()
    return Bar(budget) if sys.stderr.isatty() and budget else Lines(budget)


class Warnings(Silent):
    """Only what must be said."""

    def say(self, text: str) -> None:
        """Print the line."""
        say(f"active3d: {text}")


class Tally:
    """What is known so far: steps, round, quality, seconds of every stage, time to go."""

    def __init__(self, budget: int) -> None:
        self.budget = budget
        self.steps = self.round = self.hits = 0
        self.seconds: dict[str, float] = {}
        self.quality: dict[str, float] = {}
        self._started: float | None = None
        self._steps_before = 0

    def add(self, done: Done) -> None:
        """Take in a node that is done."""
        if done.seconds is None:
            self.hits += 1
        else:
            self.seconds[done.node.stage] = self.seconds.get(done.node.stage, 0.0) + done.seconds
        if done.node.round is not None:
            self.round = done.node.round
            self.steps += int(done.notes.get("steps", 0))
        if self._started is None or done.seconds is None:
            self._started, self._steps_before = time.monotonic() - (done.seconds or 0), self.steps
            if done.seconds is not None:
                self._steps_before -= int(done.notes.get("steps", 0))
        for name, value in done.notes.items():
            if isinstance(value, int | float) and not isinstance(value, bool):
                for wanted in ("coverage", "psnr"):
                    if name.startswith(wanted):
                        self.quality[wanted] = float(value)

    def remaining(self) -> float | None:
        """Seconds to the end of the loop at the pace so far, or None before there is one."""
        made = self.steps - self._steps_before
        if self._started is None or made <= 0:
            return None
        return (time.monotonic() - self._started) / made * max(self.budget - self.steps, 0)

    def text(self) -> str:
        """`round 3 · coverage 41 % · PSNR 23.1 dB · mapping 12.0 s ...`."""
        parts = [f"round {self.round}"]
        if "coverage" in self.quality:
            parts.append(f"coverage {100 * self.quality['coverage']:.0f} %")
        if "psnr" in self.quality:
            parts.append(f"PSNR {self.quality['psnr']:.1f} dB")
        parts += [f"{name} {seconds(value)}" for name, value in self.seconds.items() if value >= 0.05]
        return " · ".join(parts)


class Lines:
    """For logs: one line an artifact, with the time to go after every round."""

    def __init__(self, budget: int) -> None:
        self.tally = Tally(budget)

    def began(self, node: NodeId, why: str) -> None:
        """Say what runs again and why; the first time goes without saying."""
        self._flush()
        if why != "not made yet":
            say(f"{node}: {why}")

    def working(self, node: NodeId, text: str) -> None:
        """Too much for a log."""

    def done(self, done: Done) -> None:
        """One line."""
        self.tally.add(done)
        if done.seconds is None:
            return
        same = {None: "", True: ", same bytes as before", False: ", other bytes than before"}[done.same_bytes]
        notes = ", ".join(f"{name} {_short(value)}" for name, value in list(done.notes.items())[:4])
        left = self.tally.remaining() if done.node.stage == "planning" else None
        eta = f" [step {self.tally.steps}/{self.tally.budget}, about {seconds(left)} to go]" if left is not None else ""
        say(f"{done.node}: {seconds(done.seconds)}{same}{f' ({notes})' if notes else ''}{eta}")

    def say(self, text: str) -> None:
        """One line."""
        self._flush()
        say(f"active3d: {text}")

    def _flush(self) -> None:
        if self.tally.hits:
            say(f"{self.tally.hits} artifacts are up to date")
            self.tally.hits = 0


class Bar:
    """For a terminal: one bar that follows the steps of the run."""

    def __init__(self, budget: int) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

        self.tally = Tally(budget)
        self._progress = Progress(
            TextColumn("step"), MofNCompleteColumn(), BarColumn(24), TextColumn("{task.fields[text]}"),
            TextColumn("[cyan]{task.fields[now]}"), TextColumn("{task.fields[eta]}"),
            console=Console(stderr=True), transient=True, refresh_per_second=4,
        )
        self._task: Any = self._progress.add_task("", total=budget, text="", now="", eta="")
        self._running = False

    def began(self, node: NodeId, why: str) -> None:
        """Show the stage at work."""
        self._show(now=node.stage)

    def working(self, node: NodeId, text: str) -> None:
        """Show what the stage says."""
        self._show(now=f"{node.stage}: {text}")

    def done(self, done: Done) -> None:
        """Move the bar."""
        self.tally.add(done)
        left = self.tally.remaining()
        self._progress.update(
            self._task, completed=min(self.tally.steps, self.tally.budget), text=self.tally.text(),
            eta="" if left is None or self.tally.steps >= self.tally.budget else f"ETA {seconds(left)}",
        )

    def say(self, text: str) -> None:
        """One line above the bar."""
        self._progress.console.print(f"active3d: {text}", highlight=False, markup=False)

    def close(self) -> None:
        """Take the bar away."""
        if self._running:
            self._progress.stop()
            self._running = False

    def _show(self, now: str) -> None:
        if not self._running:
            self._progress.start()
            self._running = True
        self._progress.update(self._task, now=now)


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)[:24]
