"""The loop: no-op, force, stop, budget, interruption, one stage at a time."""

import json
import os
import signal
from dataclasses import replace
from pathlib import Path

import pytest

from active3d_pipe.errors import ArtifactError, ConfigError, InputError
from active3d_pipe.pipeline.events import Done
from active3d_pipe.pipeline.graph import Registry
from active3d_pipe.pipeline.interrupt import Interrupted
from active3d_pipe.pipeline.stage import NodeId, Stage, StageContext
from active3d_pipe.pipeline.status import status
from active3d_pipe.pipeline.survey import State
from active3d_pipe.pipeline.view import UndeclaredConfigError
from tests.pipeline.conftest import open_runner, snapshot
from tests.pipeline.toy import REGISTRY


def _with(name: str, **changes: object) -> Registry:
    """The toy registry with one stage changed."""
    def change(stage: Stage) -> Stage:
        return replace(stage, **changes) if stage.name == name else stage  # type: ignore[arg-type]

    return Registry(tuple(map(change, REGISTRY.loop)), tuple(map(change, REGISTRY.finish)))


def test_two_runs_are_byte_identical(finished: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    open_runner(other).run()
    assert snapshot(other) == snapshot(finished)


def test_running_again_does_nothing(run_path: Path) -> None:
    before = snapshot(run_path)
    journal = (run_path / "journal.jsonl").read_bytes()
    runner = open_runner(run_path)
    outcome = runner.run()
    assert outcome.executed == ()
    assert len(runner.watcher.hits) == 15
    assert snapshot(run_path) == before
    assert (run_path / "journal.jsonl").read_bytes() == journal


@pytest.mark.parametrize("stage", [s.name for s in REGISTRY.stages if not s.volatile])
@pytest.mark.parametrize("round", [0, 1, 2])
def test_force_gives_the_same_bytes(run_path: Path, stage: str, round: int) -> None:
    if not REGISTRY.stage(stage).loop and round:
        return
    before = snapshot(run_path)
    runner = open_runner(run_path)
    at = round if REGISTRY.stage(stage).loop else None
    assert runner.run_stage(stage, at).executed == ()
    assert runner.run_stage(stage, at, force=True).executed == (NodeId(stage, at),)
    assert runner.watcher.dones[-1].same_bytes is True
    assert snapshot(run_path) == before


def test_run_stage_until_runs_the_stages_between(run_path: Path) -> None:
    outcome = open_runner(run_path).run_stage("mapping", 2, force=True, until="export")
    assert [str(n) for n in outcome.executed] == [
        "mapping/round_0002", "uncertainty/round_0002", "planning/round_0002", "export",
    ]
    with pytest.raises(ConfigError, match="--until capture: comes before mapping; the order is capture, mapping"):
        open_runner(run_path).run_stage("mapping", 2, until="capture")
    with pytest.raises(ConfigError, match="--until export: is made of all rounds, not of those up to --round 0"):
        open_runner(run_path).run_stage("planning", 0, until="export")


def test_run_stage_makes_again_what_was_damaged_without_changing_its_size(run_path: Path) -> None:
    runner = open_runner(run_path)
    folder = runner.run_dir.store.folder(NodeId("export"))
    file = next(p for p in sorted(folder.iterdir()) if p.name != "record.json" and p.stat().st_size)
    intact = file.read_bytes()
    file.write_bytes(bytes([intact[0] ^ 1]) + intact[1:])
    assert runner.run_stage("export").executed == (NodeId("export"),)
    assert file.read_bytes() == intact


def test_run_stage_in_a_new_run_goes_step_by_step(finished: Path, tmp_path: Path) -> None:
    path = tmp_path / "by_hand"
    for k in range(3):
        for stage in REGISTRY.loop:
            outcome = open_runner(path).run_stage(stage.name)  # the default round is the one that can run next
            assert outcome.executed == (NodeId(stage.name, k),)
    for stage in REGISTRY.finish:
        open_runner(path).run_stage(stage.name)
    assert snapshot(path) == snapshot(finished)


def test_run_stage_names_a_missing_input(tmp_path: Path) -> None:
    runner = open_runner(tmp_path / "new")
    with pytest.raises(ArtifactError, match=r"mapping/round_0000 needs capture/round_0000, which is not made"):
        runner.run_stage("mapping", 0)
    with pytest.raises(ArtifactError, match="no round is complete yet"):
        runner.run_stage("export")
    with pytest.raises(ConfigError, match="'maping' is no stage; did you mean 'mapping'"):
        runner.run_stage("maping")
    with pytest.raises(ConfigError, match="--round 7: the run has rounds"):
        runner.run_stage("mapping", 7)
    with pytest.raises(ConfigError, match="--round 1: export runs once"):
        runner.run_stage("export", 1)


def test_a_changed_stage_makes_what_follows_stale(run_path: Path) -> None:
    runner = open_runner(run_path, "mapping.window.size=3")
    runner.run_stage("mapping", 1)
    states = runner.survey()
    assert states[NodeId("mapping", 0)].state is State.STALE
    assert states[NodeId("uncertainty", 1)].state is State.STALE
    assert states[NodeId("capture", 0)].state is State.FRESH
    assert any("mapping/round_0000 is stale" in line for line in runner.watcher.lines)


def test_the_loop_stops_when_planning_says_so(tmp_path: Path) -> None:
    def stop_in_round_one(c: StageContext) -> None:
        (c.out / "decision.json").write_text(json.dumps({"direction": 0.0}))
        c.notes.update(stop=c.round == 1, reason="stop_gain")

    outcome = open_runner(tmp_path / "run", registry=_with("planning", run=stop_in_round_one)).run()
    assert (outcome.ended, outcome.last_round) == ("planning decided to stop (stop_gain)", 1)
    assert (tmp_path / "run/report/index.html").is_file()


def test_the_loop_stops_at_the_round_limit(tmp_path: Path) -> None:
    outcome = open_runner(tmp_path / "run", "run.max_rounds=2").run()
    assert (outcome.ended, outcome.last_round) == ("the limit of 2 rounds is reached", 1)


def test_a_larger_budget_goes_on(run_path: Path, tmp_path: Path) -> None:
    outcome = open_runner(run_path, "run.steps=14").run()
    fresh = tmp_path / "fresh"
    open_runner(fresh, "run.steps=14").run()
    assert [str(n) for n in outcome.executed[:2]] == ["capture/round_0002", "mapping/round_0002"]
    assert snapshot(run_path) == snapshot(fresh)


@pytest.mark.parametrize(("signum", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_stops_at_the_next_commit_point(finished: Path, tmp_path: Path, signum: int, code: int) -> None:
    path = tmp_path / "run"
    runner = open_runner(path)

    def began(node: NodeId, why: str) -> None:
        if node == NodeId("mapping", 1):
            os.kill(os.getpid(), signum)

    runner.watcher.began = began
    with pytest.raises(Interrupted, match=r"stopped after mapping/round_0001; .*: active3d resume") as caught:
        runner.run()
    assert caught.value.exit_code == code
    assert (path / "mapping/round_0001/record.json").is_file()
    assert not (path / "uncertainty/round_0001").exists()
    open_runner(path).run()
    assert snapshot(path) == snapshot(finished)


def test_a_second_ctrl_c_ends_at_once(tmp_path: Path) -> None:
    runner = open_runner(tmp_path / "run")

    def began(node: NodeId, why: str) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)

    runner.watcher.began = began
    handler = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        runner.run()
    assert signal.getsignal(signal.SIGINT) is handler


def test_a_stage_that_fails_leaves_nothing(tmp_path: Path) -> None:
    def fail(c: StageContext) -> None:
        (c.out / "half.bin").write_bytes(b"half")
        raise InputError("scene.glb: no faces")

    path = tmp_path / "run"
    with pytest.raises(InputError, match="no faces"):
        open_runner(path, registry=_with("mapping", run=fail)).run()
    assert sorted(p.name for p in (path / "mapping").iterdir()) == []
    assert (path / "capture/round_0000/record.json").is_file()


def test_reading_undeclared_configuration_is_refused(tmp_path: Path) -> None:
    def greedy(c: StageContext) -> None:
        assert c.config.mapping.window.size == 10
        _ = c.config.mapping.learning_rate_scale

    said = "stage 'mapping' reads the configuration's 'mapping.learning_rate_scale' but declares only mapping.window"
    with pytest.raises(UndeclaredConfigError, match=said):
        open_runner(tmp_path / "run", registry=_with("mapping", run=greedy)).run()


def test_notes_must_be_plain(tmp_path: Path) -> None:
    def odd(c: StageContext) -> None:
        c.notes["psnr"] = float("nan")

    with pytest.raises(RuntimeError, match="stage 'mapping' leaves notes that are no plain JSON values"):
        open_runner(tmp_path / "run", registry=_with("mapping", run=odd)).run()


def test_an_artifact_holds_plain_files_only(tmp_path: Path) -> None:
    def link(c: StageContext) -> None:
        (c.out / "outside").symlink_to("/etc/passwd")

    with pytest.raises(ArtifactError, match="outside: an artifact may hold plain files only"):
        open_runner(tmp_path / "run", registry=_with("mapping", run=link)).run()


def test_finishing_stages_see_what_the_run_cost(run_path: Path) -> None:
    page = (run_path / "report/index.html").read_text()
    assert "mapping/round_0002" in page
    assert "evaluation" in page


def test_status_counts(run_path: Path) -> None:
    found = status(open_runner(run_path))
    document = json.loads(json.dumps(found.to_json()))
    assert (document["complete"], document["rounds"], document["steps"], document["writer"]) == (True, 3, 10, None)
    assert document["stages"]["mapping"]["nodes"] == 3
    assert document["stages"]["capture"]["bytes"] == sum(
        p.stat().st_size for p in (run_path / "capture").rglob("*") if p.is_file() and p.name != "record.json"
    )
    assert document["notes"]["coverage"] == 0.875
    assert all(node["seconds"] >= 0 for node in document["nodes"])


def test_status_shows_stale_and_missing(run_path: Path) -> None:
    import shutil

    shutil.rmtree(run_path / "evaluation")
    found = status(open_runner(run_path, "motion.max_step_m=0.05", write=False))
    states = {str(n.state.node): n.state.state for n in found.nodes}
    assert not found.complete
    assert states["uncertainty/round_0000"] is State.FRESH
    assert states["planning/round_0000"] is State.STALE
    assert states["capture/round_0001"] is State.STALE
    assert states["evaluation"] is State.MISSING


def test_progress_text_reaches_the_watcher(tmp_path: Path) -> None:
    runner = open_runner(tmp_path / "run")
    texts: list[str] = []
    runner.watcher.working = lambda node, text: texts.append(text)
    runner.run()
    assert texts == ["capturing"] * 3
    assert all(isinstance(done, Done) for done in runner.watcher.dones)
