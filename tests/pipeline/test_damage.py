"""Damage: found by verify, healed by run; pruning, rebuilding, forking."""

import json
import random
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from active3d_pipe.errors import ArtifactError, ConfigError, OutputError
from active3d_pipe.pipeline.config import load_config, resolve_toml
from active3d_pipe.pipeline.fork import fork
from active3d_pipe.pipeline.gc import gc
from active3d_pipe.pipeline.graph import Registry
from active3d_pipe.pipeline.run_dir import RunDir
from active3d_pipe.pipeline.runner import Runner
from active3d_pipe.pipeline.stage import NodeId, StageContext
from active3d_pipe.pipeline.survey import State
from active3d_pipe.pipeline.verify import verify
from tests.pipeline.conftest import SMALL, Recorder, open_runner, snapshot
from tests.pipeline.toy import REGISTRY


def _artifact_files(path: Path) -> list[Path]:
    folders = [path / stage.name for stage in REGISTRY.stages if not stage.volatile]
    return [p for folder in folders for p in sorted(folder.rglob("*")) if p.is_file()]


def _damage(file: Path, how: str, rng: random.Random) -> None:
    data = bytearray(file.read_bytes())
    if how == "delete":
        file.unlink()
    elif how == "truncate":
        file.write_bytes(data[: rng.randrange(len(data))])
    elif how == "extend":
        file.write_bytes(bytes(data) + b"\0")
    else:
        bit = rng.randrange(8 * len(data))
        data[bit // 8] ^= 1 << bit % 8
        file.write_bytes(data)


def test_an_intact_run_verifies(run_path: Path) -> None:
    found = verify(open_runner(run_path), deep=True)
    assert (found.damage, found.remarks, found.artifacts) == ((), (), 15)


def test_verify_finds_every_damage(run_path: Path) -> None:
    rng = random.Random(7)
    files = _artifact_files(run_path)
    runner = open_runner(run_path)
    for trial in range(160):
        file = files[trial % len(files)]
        how = ("flip", "flip", "truncate", "delete", "extend")[trial % 5]
        intact = file.read_bytes()
        _damage(file, how, rng)
        found = verify(Runner(runner.run_dir, REGISTRY, runner.config), deep=True)
        assert found.damage, (how, file)
        assert str(file.parent.relative_to(run_path).parts[0]) in found.damage[0]
        if how != "flip" or file.name == "record.json":
            assert verify(runner, deep=False).damage, (how, file)
        file.write_bytes(intact)
    assert verify(runner, deep=True).damage == ()


def test_verify_finds_a_missing_artifact_and_a_strange_file(run_path: Path) -> None:
    shutil.rmtree(run_path / "planning/round_0001")
    (run_path / "capture/round_0000/extra.txt").write_text("hello")
    found = verify(open_runner(run_path), deep=True)
    assert found.damage == (
        "capture/round_0000: extra.txt does not belong to it", "planning/round_0001: is missing",
    )


def test_verify_misses_what_was_removed_once_and_made_again(run_path: Path) -> None:
    runner, node = open_runner(run_path), NodeId("planning", 1)
    line = next(e for e in runner.run_dir.journal.read()[0] if e["event"] == "commit" and e["node"] == str(node))
    removed = {**line, "event": "remove"}
    shutil.rmtree(run_path / "planning/round_0001")
    with open(run_path / "journal.jsonl", "a", encoding="utf-8") as journal:
        journal.write(json.dumps(removed) + "\n")
    assert not verify(open_runner(run_path), deep=True).damage
    with open(run_path / "journal.jsonl", "a", encoding="utf-8") as journal:
        journal.write(json.dumps(line) + "\n")
    assert verify(open_runner(run_path), deep=True).damage == ("planning/round_0001: is missing",)


@pytest.mark.parametrize("how", ["truncate", "delete", "extend"])
def test_run_heals_damage_that_sizes_show(run_path: Path, finished: Path, how: str) -> None:
    _damage(run_path / "mapping/round_0001/state.npy", how, random.Random(1))
    runner = open_runner(run_path)
    outcome = runner.run()
    assert outcome.executed == (NodeId("mapping", 1),)
    assert any("mapping/round_0001 is damaged: state.npy" in line for line in runner.watcher.lines)
    assert snapshot(run_path) == snapshot(finished)


def test_a_flipped_bit_in_an_input_is_found_before_it_is_read(run_path: Path, finished: Path) -> None:
    file = run_path / "mapping/round_0001/state.npy"
    data = bytearray(file.read_bytes())
    data[-3] ^= 4  # a value, not the header: NumPy reads it without complaint
    file.write_bytes(data)
    runner = open_runner(run_path)
    runner.run_stage("mapping", 2, force=True)
    assert runner.watcher.lines == [
        "mapping/round_0001 is damaged: state.npy has another digest; it is made again from its inputs"
    ]
    assert snapshot(run_path) == snapshot(finished)


def test_damage_that_appears_while_running_is_healed(run_path: Path, finished: Path) -> None:
    runner = open_runner(run_path)
    runner.executor.provide([NodeId("mapping", 1)], 2)  # checked once: trusted from here on
    (run_path / "mapping/round_0001/state.npy").write_bytes(b"no array")
    runner.run_stage("mapping", 2, force=True)
    assert snapshot(run_path) == snapshot(finished)


@pytest.mark.parametrize("name", ["record.json"])
def test_a_damaged_record_is_healed(run_path: Path, finished: Path, name: str) -> None:
    (run_path / "uncertainty/round_0001" / name).write_text("{}")
    runner = open_runner(run_path)
    assert runner.run().executed == (NodeId("uncertainty", 1),)
    assert snapshot(run_path) == snapshot(finished)


def test_a_record_may_not_lead_out_of_its_artifact(run_path: Path) -> None:
    from active3d_pipe.pipeline.keys import digest

    path = run_path / "export/record.json"
    document = json.loads(path.read_text())
    document["files"] = {"../../secret": {"sha256": "0", "bytes": 1}}
    document.pop("digest")
    document["digest"] = digest(document)
    path.write_text(json.dumps(document, indent=1) + "\n")
    with pytest.raises(ArtifactError, match=r"record\.json: is no record of an artifact"):
        open_runner(run_path).run_dir.store.record(NodeId("export"))


def test_pruned_maps_keep_their_record_and_come_back_identical(run_path: Path, finished: Path) -> None:
    policy = ("run.keep.every=0", "run.keep.last=2")
    runner = open_runner(run_path, *policy)
    freed = gc(runner)
    assert [(str(f.node), f.how) for f in freed] == [("mapping/round_0000", "pruned")]
    assert sorted(p.name for p in (run_path / "mapping/round_0000").iterdir()) == ["pruned.json", "record.json"]
    assert verify(open_runner(run_path, *policy), deep=True).damage == ()
    # Pruning changes no key: only the page that prints the configuration is made again.
    assert open_runner(run_path, *policy).run().executed == (NodeId("report"),)

    runner = open_runner(run_path, *SMALL)
    runner.run_stage("uncertainty", 0, force=True)
    assert ("mapping/round_0000", "pruned, needed again") in runner.watcher.ran
    assert snapshot(run_path / "mapping") == snapshot(finished / "mapping")
    assert snapshot(run_path / "uncertainty") == snapshot(finished / "uncertainty")


def test_a_chain_of_pruned_maps_is_rebuilt_from_the_nearest_kept_one(tmp_path: Path) -> None:
    policy = ("run.steps=24", "run.keep.every=3", "run.keep.last=2")  # rounds 0..5; 0, 3, 4, 5 stay whole
    path = tmp_path / "run"
    open_runner(path, *policy).run()
    whole = tmp_path / "whole"
    open_runner(whole, "run.steps=24").run()
    pruned = [k for k in range(6) if (path / f"mapping/round_{k:04d}/pruned.json").exists()]
    assert pruned == [1, 2]
    runner = open_runner(path, *policy)
    runner.run_stage("uncertainty", 2, force=True)
    ran = [node for node, _ in runner.watcher.ran]
    assert ran == ["mapping/round_0001", "mapping/round_0002", "uncertainty/round_0002"]
    assert snapshot(path / "uncertainty") == snapshot(whole / "uncertainty")
    # ... and the policy holds again afterwards.
    assert [k for k in range(6) if (path / f"mapping/round_{k:04d}/pruned.json").exists()] == [1, 2]


def test_a_rebuild_that_gives_other_bytes_is_refused(run_path: Path) -> None:
    policy = ("run.keep.every=0",)
    gc(open_runner(run_path, *policy))

    def other(c: StageContext) -> None:
        np.save(c.out / "state.npy", np.ones(8, np.float32))
        (c.out / "optimiser").mkdir()
        np.save(c.out / "optimiser/moments.npy", np.ones(8))

    loop = tuple(replace(s, run=other) if s.name == "mapping" else s for s in REGISTRY.loop)
    runner = open_runner(run_path, *policy, registry=Registry(loop, REGISTRY.finish))
    with pytest.raises(ArtifactError, match=r"mapping/round_0000: rebuilding it gave other bytes in .*--force` acc"):
        runner.run_stage("uncertainty", 0, force=True)


def test_a_pruned_map_whose_settings_changed_is_not_rebuilt_wrongly(run_path: Path) -> None:
    gc(open_runner(run_path, "run.keep.every=0"))
    runner = open_runner(run_path, "run.keep.every=0", "mapping.window.size=3")
    with pytest.raises(ArtifactError, match="was pruned, and what it is made from changed since"):
        runner.run_stage("uncertainty", 0, force=True)


def test_gc_removes_what_lies_beyond_the_end(run_path: Path) -> None:
    runner = open_runner(run_path, "run.steps=8")
    runner.run()
    assert {str(f.node) for f in gc(runner, dry_run=True)} == {f"{s.name}/round_0002" for s in REGISTRY.loop}
    gc(runner)
    assert not (run_path / "capture/round_0002").exists()
    assert verify(open_runner(run_path, "run.steps=8"), deep=True).damage == ()


def _fork(parent: Path, target: Path, round: int, *overrides: str) -> Runner:
    config = load_config(None, (*SMALL, *overrides), environ={})
    fork(open_runner(parent), round, target, config, resolve_toml(config))
    return Runner(RunDir.open(target), REGISTRY, config, Recorder())


def test_a_fork_keeps_the_past_and_changes_the_future(run_path: Path, finished: Path, tmp_path: Path) -> None:
    runner = _fork(run_path, tmp_path / "fork", 0, "mapping.window.size=4", "run.seed=5")
    outcome = runner.run()
    assert [str(n) for n in outcome.executed] == [str(n) for n in REGISTRY.nodes(2)][4:]
    for stage in REGISTRY.loop:
        name = f"{stage.name}/round_0000"
        assert snapshot(tmp_path / "fork" / name) == snapshot(finished / name)
    assert snapshot(tmp_path / "fork/mapping/round_0001") != snapshot(finished / "mapping/round_0001")
    assert Runner(runner.run_dir, REGISTRY, runner.config).run().executed == ()
    assert verify(runner, deep=True).damage == ()
    assert snapshot(run_path) == snapshot(finished)


def test_a_fork_without_changes_has_the_same_future(run_path: Path, finished: Path, tmp_path: Path) -> None:
    runner = _fork(run_path, tmp_path / "fork", 1)
    runner.run()
    for stage in REGISTRY.loop:
        assert snapshot(tmp_path / "fork" / stage.name) == snapshot(finished / stage.name)


def test_a_fork_of_a_fork_remembers_both_pasts(run_path: Path, tmp_path: Path) -> None:
    first = _fork(run_path, tmp_path / "first", 0, "mapping.window.size=4")
    first.run()
    config = load_config(None, (*SMALL, "mapping.window.size=2"), environ={})
    fork(first, 1, tmp_path / "second", config, resolve_toml(config))
    second = Runner(RunDir.open(tmp_path / "second"), REGISTRY, config, Recorder())
    assert [past.until_round for past in second.run_dir.manifest().lineage] == [0, 1]
    executed = [str(n) for n in second.run().executed]
    assert executed == [str(n) for n in REGISTRY.nodes(2)][8:]


def test_inherited_rounds_are_healed_with_the_settings_they_were_made_with(run_path: Path, tmp_path: Path) -> None:
    runner = _fork(run_path, tmp_path / "fork", 1, "mapping.window.size=4")
    runner.run()
    before = snapshot(tmp_path / "fork")
    (tmp_path / "fork/mapping/round_0001/state.npy").unlink()
    healed = Runner(runner.run_dir, REGISTRY, runner.config, Recorder())
    assert healed.run().executed == (NodeId("mapping", 1),)
    assert snapshot(tmp_path / "fork") == before


def test_fork_refuses_what_it_cannot_do(run_path: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"--round 9: .* has rounds 0 to 2"):
        _fork(run_path, tmp_path / "fork", 9)
    with pytest.raises(OutputError, match="is a run already"):
        _fork(run_path, run_path, 1)


def test_a_state_is_unknown_while_its_parameters_cannot_be_read(run_path: Path) -> None:
    def gone(config: object, inputs: object) -> dict:
        raise ArtifactError("scene.glb: no such file")

    loop = tuple(replace(s, parameters=gone) if s.name == "capture" else s for s in REGISTRY.loop)
    runner = open_runner(run_path, registry=Registry(loop, REGISTRY.finish))
    state = runner.survey()[NodeId("capture", 0)]
    assert (state.state, state.reasons) == (State.UNKNOWN, ("scene.glb: no such file",))
    with pytest.raises(ArtifactError, match=r"scene\.glb"):
        runner.run()


@pytest.mark.parametrize("text", ["{}", '{"total": "x"}', "[]", "{", "null"])
def test_an_input_that_a_key_cannot_be_made_of_is_one_line(run_path: Path, text: str) -> None:
    (run_path / "capture/round_0000/capture.json").write_text(text)
    state = open_runner(run_path).surveyor.assess(NodeId("capture", 1), 2)
    assert state.state is State.UNKNOWN
    said = rf"what it is made from cannot be read \(.*; `active3d verify --deep {run_path}` names the damage"
    with pytest.raises(ArtifactError, match=said) as error:
        open_runner(run_path).surveyor.parts(NodeId("capture", 1), 2)
    assert "\n" not in str(error.value)
    assert open_runner(run_path).run().ended  # damage that a digest shows is healed before it is read
