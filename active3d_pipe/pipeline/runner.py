"""The loop: run, resume, run one stage. Everything that is up to date is left alone.

    for k = 0, 1, ...:  the loop stages of round k;  stop when the budget is spent or the last stage says so
    the finishing stages
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from active3d_pipe.errors import ArtifactError, ConfigError
from active3d_pipe.pipeline.events import Done, Silent, Watcher
from active3d_pipe.pipeline.execute import Executor
from active3d_pipe.pipeline.graph import Registry
from active3d_pipe.pipeline.interrupt import Interrupted, StopRequest
from active3d_pipe.pipeline.journal import spent
from active3d_pipe.pipeline.lock import RunLock
from active3d_pipe.pipeline.record import Record
from active3d_pipe.pipeline.run_dir import Manifest, RunDir
from active3d_pipe.pipeline.stage import NodeId
from active3d_pipe.pipeline.survey import NodeState, State, Surveyor


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a command did.

    Attributes:
        ended: why the loop ended, or None when it has not.
        last_round: the last round of the loop.
        executed: the nodes that ran, in order.
        plan: with `dry_run`, what would run or not, and why.
    """

    ended: str | None
    last_round: int
    executed: tuple[NodeId, ...] = ()
    plan: tuple[NodeState, ...] = ()


class Runner:
    """Runs the stages of `registry` in one run folder.

    `config` needs a `run` section (`seed`, `steps`, `max_rounds`, `threads`, `keep`); the rest is the stages' own.
    """

    def __init__(
        self, run_dir: RunDir, registry: Registry, config: Any, watcher: Watcher | None = None,
        manifest: Manifest | None = None,
    ) -> None:
        self.run_dir = run_dir
        self.registry = registry
        self.config = config
        self.watcher = watcher or Silent()
        lineage = (manifest or run_dir.manifest()).lineage
        try:
            past = [(old.until_round, type(config).model_validate(old.config)) for old in lineage]
        except ValidationError as error:
            wrong = ".".join(map(str, error.errors()[0]["loc"]))
            raise ArtifactError(
                f"{run_dir.path}/manifest.json: {wrong} of the run that this one was forked from is not known to this "
                "version; go on with the version that made it"
            ) from error
        self.surveyor = Surveyor(run_dir.store, registry, config, past)
        self.executor = Executor(self.surveyor, run_dir.journal, self.watcher)
        self._executed: list[NodeId] = []

    def run(self) -> Outcome:
        """Explore to the end and finish; goes on where an earlier call stopped."""
        with RunLock(self.run_dir.path), StopRequest() as stop:
            self._recover()
            k = 0
            while True:
                before = len(self._executed)
                for node in self.registry.round_nodes(k):
                    self._ensure(node, k, stop)
                if len(self._executed) > before:
                    self._prune(k)
                ended = self.ended(k)
                if ended:
                    break
                k += 1
            for node in self.registry.finish_nodes():
                self._ensure(node, k, stop)
            self._prune(k)
            return Outcome(ended, k, tuple(self._executed))

    def run_stage(
        self, name: str, round: int | None = None, *, force: bool = False, until: str | None = None
    ) -> Outcome:
        """Run one stage of one round if its key changed (or always, with `force`); `until` goes on to a later stage."""
        nodes, last = self.selection(name, round, until)
        with RunLock(self.run_dir.path), StopRequest() as stop:
            self._recover()
            self._warn_of_stale_inputs(nodes, last)
            for node in nodes:
                state = self.surveyor.assess(node, last, deep=True)
                if state.state is State.UNKNOWN:
                    self.surveyor.parts(node, last)  # raises what made it unknown
                if not force and state.state.is_hit and state.record is not None:
                    self.watcher.done(Done(node, state.record.notes, state.record.size, None))
                    continue
                self._execute(node, last, "forced" if state.state.is_hit else "; ".join(state.reasons), stop)
            if self._executed:
                self._prune(self.last_round())
            return Outcome(self.ended(last), last, tuple(self._executed))

    def dry_run(
        self, name: str | None = None, round: int | None = None, *, force: bool = False, until: str | None = None
    ) -> Outcome:
        """What `run` (no name) or `run_stage` would do, and why; touches nothing."""
        if name is None:
            last = self.last_round()
            return Outcome(self.ended(last), last, plan=tuple(self.surveyor.survey(last).values()))
        nodes, last = self.selection(name, round, until)
        plan: list[NodeState] = []
        for node in nodes:
            waiting = [s.node for s in plan if not s.state.is_hit and s.node in self.surveyor.inputs(node, last)]
            state = self.surveyor.assess(node, last)
            if waiting:
                state = NodeState(node, State.STALE, (f"follows {waiting[0]}",), state.record)
            elif force and state.state.is_hit:
                state = NodeState(node, State.STALE, ("forced",), state.record)
            plan.append(state)
        return Outcome(self.ended(last), last, plan=tuple(plan))

    def survey(self) -> dict[NodeId, NodeState]:
        """The state of every node, up to the end of the loop or the first round that is not whole."""
        return self.surveyor.survey(max(self.last_round(), 0))

    def last_round(self) -> int:
        """The round where the loop ends as far as the disk tells, else the first that is not whole."""
        k, on_disk = 0, self.surveyor.last_round_on_disk()
        while k <= on_disk:
            if any(self._record(node) is None for node in self.registry.round_nodes(k)):
                return k
            if self.ended(k):
                return k
            k += 1
        return k

    def last_whole_round(self) -> int:
        """The last round, not beyond the loop's end, of which every record is there; -1 when there is none."""
        last = self.last_round()
        whole = all(self._record(node) is not None for node in self.registry.round_nodes(last))
        return last if whole else last - 1

    def ended(self, k: int) -> str | None:
        """Why the loop ends after round `k`, or None when it goes on; reads records only."""
        if k < self.surveyor.inherited_rounds - 1:
            return None
        last = self._record(self.registry.round_nodes(k)[-1])
        if last is None:
            return None
        if last.notes.get("stop"):
            return f"{last.node.stage} decided to stop ({last.notes.get('reason', 'no reason noted')})"
        if self.steps(k) >= self.config.run.steps:
            return f"the budget of {self.config.run.steps} steps is spent"
        if k + 1 >= self.config.run.max_rounds:
            return f"the limit of {self.config.run.max_rounds} rounds is reached"
        return None

    def steps(self, k: int) -> int:
        """Steps captured in rounds 0..k: the sum of the first stage's note `steps`."""
        first = self.registry.loop[0].name
        records = (self._record(NodeId(first, i)) for i in range(k + 1))
        return sum(int(record.notes.get("steps", 0)) for record in records if record is not None)

    def prunable(self, last_round: int) -> list[Record]:
        """Records of the whole artifacts that the policy `run.keep` does not keep."""
        keep = self.config.run.keep
        for name in keep.stages:
            self.registry.stage(name)
        found: list[Record] = []
        for stage in self.registry.loop:
            for k in self.run_dir.store.rounds(stage.name) if stage.name in keep.stages else ():
                node = NodeId(stage.name, k)
                kept = k > last_round - keep.last or (keep.every and k % keep.every == 0)
                record = None if kept or self.run_dir.store.is_pruned(node) else self._record(node)
                if record is not None:
                    found.append(record)
        return found

    def prune(self, record: Record) -> None:
        """Drop the payload of an artifact, keep its record. The caller holds the lock."""
        self.run_dir.store.prune(record)
        self.executor.distrust(record.node)
        self.run_dir.journal.append("prune", node=str(record.node), bytes=record.size)

    def _prune(self, last_round: int) -> None:
        for record in self.prunable(last_round):
            self.prune(record)

    def _ensure(self, node: NodeId, last_round: int, stop: StopRequest) -> None:
        state = self.surveyor.assess(node, last_round, deep=True)
        if state.state is State.UNKNOWN:
            self.surveyor.parts(node, last_round)  # raises what made it unknown
        if state.state.is_hit and state.record is not None:
            self.watcher.done(Done(node, state.record.notes, state.record.size, None))
            return
        if state.state is State.DAMAGED:
            self.watcher.say(f"{node} is damaged: {state.reasons[0]}; it is made again from its inputs")
        self._execute(node, last_round, "; ".join(state.reasons), stop)

    def _execute(self, node: NodeId, last_round: int, why: str, stop: StopRequest) -> None:
        self._check(stop)
        self.executor.execute(node, last_round, why)
        self._executed.append(node)
        self._check(stop)

    def _check(self, stop: StopRequest) -> None:
        if stop.signum is not None:
            after = f" after {self._executed[-1]}" if self._executed else ""
            raise Interrupted(
                f"stopped{after}; everything committed is kept, go on with: active3d resume {self.run_dir.path}",
                stop.signum,
            )

    def _record(self, node: NodeId) -> Record | None:
        try:
            return self.surveyor.record(node)
        except ArtifactError:
            return None

    def selection(self, name: str, round: int | None, until: str | None) -> tuple[list[NodeId], int]:
        """The nodes that `run_stage` is about, and the last round; ConfigError or ArtifactError where it is refused."""
        stage = self.registry.stage(name)
        names = [s.name for s in self.registry.stages]
        end = names.index(self.registry.stage(until).name) if until else names.index(name)
        if end < names.index(name):
            raise ConfigError(f"--until {until}: comes before {name}; the order is {', '.join(names)}")
        chosen = names[names.index(name) : end + 1]
        if not stage.loop:
            if round is not None:
                raise ConfigError(f"--round {round}: {name} runs once, after the last round; leave --round out")
            last = self.last_whole_round()
            if last < 0:
                raise ArtifactError(
                    f"{self.run_dir.path}: no round is complete yet; `active3d resume {self.run_dir.path}` makes it"
                )
        else:
            last = self._default_round(name) if round is None else round
            if last < 0 or last > self.surveyor.last_round_on_disk() + 1:
                raise ConfigError(
                    f"--round {last}: the run has rounds 0 to {self.surveyor.last_round_on_disk()}"
                )
            if not self.registry.stage(names[end]).loop and last < self.last_whole_round():
                raise ConfigError(
                    f"--until {names[end]}: is made of all rounds, not of those up to --round {last}; go on with "
                    f"`active3d run-stage {names[end]}`, or `active3d fork` for another end"
                )
        nodes = [NodeId(n, last if self.registry.stage(n).loop else None) for n in chosen]
        for wanted in self.surveyor.inputs(nodes[0], last):
            if not self.run_dir.store.folder(wanted).exists():
                raise ArtifactError(
                    f"{nodes[0]} needs {wanted}, which is not made yet; `active3d resume {self.run_dir.path}` makes it"
                )
        return nodes, last

    def _default_round(self, name: str) -> int:
        """The newest round whose inputs are all there, not beyond the loop's end."""
        last = self.last_round()
        has: Callable[[NodeId], bool] = lambda node: self._record(node) is not None  # noqa: E731
        for k in range(last, -1, -1):
            if all(has(node) for node in self.surveyor.inputs(NodeId(name, k), k)):
                return k
        return 0

    def _warn_of_stale_inputs(self, nodes: list[NodeId], last: int) -> None:
        states = self.surveyor.survey(last)
        inputs = self.surveyor.inputs(nodes[0], last)
        stale = [states[name] for name in inputs if name in states and states[name].state is State.STALE]
        # The one with a reason of its own tells more than those that merely follow.
        stale.sort(key=lambda state: state.reasons[0].startswith("follows "))
        if stale:
            said = f"{stale[0].node} is stale ({stale[0].reasons[0]}) and is used as it is"
            self.watcher.say(f"{said}; `active3d resume` renews it")

    def _recover(self) -> None:
        """Tidy up after a crash: unfinished folders go, artifacts whose journal line was lost get one."""
        for text in self.run_dir.store.clean():
            self.watcher.say(text)
        journal = self.run_dir.journal
        known = spent(journal.read()[0])
        for stage in self.registry.stages:
            rounds: list[int | None] = [*self.run_dir.store.rounds(stage.name)] if stage.loop else [None]
            for k in rounds:
                record = self._record(NodeId(stage.name, k))
                if record is not None and (record.node not in known or known[record.node].content != record.content):
                    journal.append(
                        "commit", node=str(record.node), key=record.key, content=record.content, bytes=record.size,
                        seconds=None, timings={}, recovered=True,
                    )
