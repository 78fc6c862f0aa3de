"""Files that a user names: scenes, trajectories, folders to write to."""

import json
from multiprocessing import get_context
from pathlib import Path

import pytest

from active3d_pipe.errors import ConfigError, InputError
from tests.cli.conftest import RUN

LONG = "x" * 300


def test_scenes_are_found_beside_the_file_by_path_and_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from active3d_pipe.cli.scene_files import resolve

    for folder in ("configs", "scenes/flat", "scenes/replica"):
        (tmp_path / folder).mkdir(parents=True)
    for file in ("configs/room.glb", "scenes/flat/scene.glb", "scenes/replica/mesh.ply"):
        (tmp_path / file).touch()
    assert resolve("room.glb", tmp_path / "configs") == tmp_path / "configs/room.glb"
    assert resolve("room.glb") == tmp_path / "room.glb"
    with pytest.raises(InputError, match=r"scene 'flat': no such file .* names their folder"):
        resolve("flat")
    monkeypatch.setenv("ACTIVE3D_SCENES", str(tmp_path / "scenes"))
    assert resolve("flat") == tmp_path / "scenes/flat/scene.glb"
    assert resolve("replica") == tmp_path / "scenes/replica/mesh.ply"


def test_a_generated_scene_is_made_once(tmp_path: Path) -> None:
    from active3d_pipe.cli.scene_files import generate

    file = generate("generated:rooms=1,seed=3,detail=0.3")
    stamp = file.stat().st_mtime_ns
    assert file.read_bytes()[:4] == b"glTF"
    assert json.loads((file.parent / "scene.json").read_text())["seed"] == 3
    assert generate("generated:rooms=1,seed=3,detail=0.3").stat().st_mtime_ns == stamp
    with pytest.raises(ConfigError, match="cannot read 'room=1'"):
        generate("generated:room=1")


def _make(recipe: str) -> str:
    from active3d_pipe.cli.scene_files import generate

    return str(generate(recipe))


def test_processes_that_need_the_same_scene_make_it_once() -> None:
    with get_context("spawn").Pool(2) as pool:
        a, b = pool.map(_make, ["generated:rooms=1,seed=4,detail=0.3"] * 2, chunksize=1)
    assert a == b and Path(a).read_bytes()[:4] == b"glTF"
    assert sorted(p.name for p in Path(a).parent.iterdir()) == ["scene.glb", "scene.json"]


@pytest.mark.parametrize("text", ['{"name": "mine"}', '{"file": "room.usd"}', '{"file": "ROOM.GLB"}'])
def test_a_scene_never_takes_the_description_of_another(call, tmp_path: Path, text: str) -> None:
    (folder := tmp_path / "rooms").mkdir()
    (folder / "scene.json").write_text(text)
    code, _, err = call("scene", "make", "--rooms", 1, "--detail", 0.3, "--out", folder / "new.glb")
    assert code == 73 and "describes another scene; write new.glb to a folder of its own" in err
    assert [(p.name, p.read_text()) for p in folder.iterdir()] == [("scene.json", text)]


def test_a_scene_may_be_made_again_beside_others(call, tmp_path: Path) -> None:
    make = ("scene", "make", "--rooms", 1, "--detail", 0.3, "--out", tmp_path / "new.glb")
    assert call(*make)[0] == call(*make, "--seed", 1)[0] == 0  # room.glb is there, and has no description
    assert json.loads((tmp_path / "scene.json").read_text())["seed"] == 1
    (tmp_path / "scene.json").write_text("{")
    code, _, err = call(*make)
    assert code == 3 and "scene.json: not readable as JSON" in err


def test_a_relative_trajectory_is_found_from_anywhere(call, run: Path, tmp_path: Path, monkeypatch) -> None:
    import tomllib

    from active3d_pipe.cli.compare import variant_settings

    (tmp_path / "walk.json").write_text("[]")
    assert call(*RUN[:-1], "walked", "--set", "planning.trajectory=walk.json")[0] == 0
    stored = tomllib.loads((tmp_path / "walked/run.toml").read_text())
    assert stored["planning"]["trajectory"] == str(tmp_path / "walk.json")
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep/walked.toml").write_text('[planning]\npolicy = "trajectory"\ntrajectory = "walk"\n')
    assert variant_settings("deep/walked.toml")["planning"]["trajectory"] == "walk"
    (tmp_path / "deep/walk").mkdir()
    assert variant_settings("deep/walked.toml")["planning"]["trajectory"] == str(tmp_path / "deep/walk")
    monkeypatch.chdir(tmp_path / "deep")
    assert call("resume", tmp_path / "walked", "--set", "planning.trajectory=../walk.json")[0] == 0
    assert tomllib.loads((tmp_path / "walked/run.toml").read_text()) == stored
    monkeypatch.chdir(tmp_path)
    code, _, err = call(*RUN, "--set", "planning.trajectory=none.json")
    assert code == 3 and "planning.trajectory = 'none.json': no such file or run folder" in err


def test_the_folder_of_a_run_takes_no_copies(call, run: Path) -> None:
    for to in (run / "export", run, run / "x"):
        code, _, err = call("export", run, "--to", to)
        assert code == 73 and "lies inside the run" in err
    assert not (run / "x").exists()


def test_a_plan_in_json_is_one_document_from_the_first_run_on(call) -> None:
    code, out, _ = call(*RUN, "--dry-run", "--json")
    assert code == 0 and json.loads(out) == {"schema": "active3d.plan/1", "last_round": -1, "ended": None, "nodes": []}
    code, out, _ = call("compare", "active3d", "--scene", "room.glb", "--out", "c", "--dry-run", "--json")
    assert code == 0 and json.loads(out)["runs"] == {"room/active3d/seed_0": "to do"}
    assert not Path("c").exists() and not Path("r").exists()


@pytest.mark.parametrize("arguments", [
    ("status", LONG), ("run", LONG), ("scene", "check", LONG), (*RUN, "--set", f"planning.trajectory={LONG}"),
    ("compare", "random", "--scene", "room.glb", "--out", LONG, "--dry-run"),
])
def test_a_name_that_is_too_long_is_one_line(call, arguments: tuple) -> None:
    code, out, err = call(*arguments)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "the name is too long for the file system; give a shorter one" in err


def test_a_comparison_with_unknown_metrics_runs_nothing(call) -> None:
    Path("c.toml").write_text('scenes = ["room.glb"]\nvariants = ["random"]\nmetrics = ["psnrr"]\n')
    code, _, err = call("compare", "c.toml", "--out", "c")
    assert code == 2 and "metrics: 'psnrr' is not known" in err and not Path("c").exists()


@pytest.mark.parametrize("journal", ["[1]", '{"event": "commit", "seconds": 3}', '{"event": "commit", "seconds": [3]}'])
def test_a_damaged_run_is_one_cell_of_a_comparison(call, journal: str) -> None:
    compare = ("compare", "random", "sweep", "volume", "--scene", "room.glb", "--out", "c", "--tables-only")
    for name, text in (("random", '{"metrics": {"psnr": 2'), ("sweep", '{"metrics": {"psnr": 21.5, "steps": 9}}')):
        (folder := Path("c/room", name, "seed_0/evaluation")).mkdir(parents=True)
        (folder / "metrics.json").write_text(text)
        (folder.parent / "journal.jsonl").write_text(journal)
    code, out, err = call(*compare)
    rows = {line.split("|")[1].strip(): line.split("|")[2].strip() for line in out.splitlines() if "|" in line}
    assert (code, err, rows["random"], rows["sweep"], rows["volume"]) == (0, "", "×", "21.50", "–")
