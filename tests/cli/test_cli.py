"""The command line as a user meets it: one line for every error, the documented code, one JSON document."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from active3d_pipe.cli import console
from active3d_pipe.cli.main import _main
from tests.cli.conftest import ROOT, RUN
from tests.pipeline.conftest import snapshot


def test_run_resume_and_again(call, tmp_path: Path) -> None:
    code, out, err = call(*RUN)
    assert code == 0
    assert out.startswith("r: 15 artifacts made; 10 steps in 3 rounds\nended because the budget of 10 steps is spent\n")
    assert out.rstrip().endswith("report: r/report/index.html")
    assert "score" in out
    assert "planning/round_0001" in err
    assert "[step 8/10, about" in err
    before = snapshot(tmp_path / "r")
    code, out, err = call(*RUN)
    assert (code, out.splitlines()[0]) == (0, "r: complete already, nothing to do; 10 steps in 3 rounds")
    assert call("resume", "r", "--json")[0] == 0
    assert snapshot(tmp_path / "r") == before


def test_run_says_what_changed(call, run: Path) -> None:
    code, _, err = call("resume", run, "--set", "camera.width=320")
    assert code == 0
    assert "configuration: camera.width 600 -> 320" in err
    assert "evaluation: camera.width 600 -> 320" in err or "evaluation" in err
    assert 'width = 320' in (run / "run.toml").read_text()
    assert call("verify", run, "--deep")[0] == 0


def test_dry_run_changes_nothing(call, run: Path) -> None:
    before = snapshot(run)
    code, out, _ = call("resume", run, "--set", "motion.max_step_m=0.05", "--dry-run", "--json")
    plan = {node["node"]: node for node in json.loads(out)["nodes"]}
    assert code == 0
    assert plan["planning/round_0000"] == {
        "node": "planning/round_0000", "state": "stale", "hit": False, "reasons": ["motion.max_step_m 0.1 -> 0.05"],
    }
    assert plan["capture/round_0000"]["hit"] is True
    assert plan["capture/round_0001"]["reasons"] == ["follows planning/round_0000"]
    assert snapshot(run) == before
    assert call("run", "default", "--set", "scene.file=room.glb", "--out", "new", "--dry-run")[0] == 0
    assert not Path("new").exists()


def test_run_stage(call, run: Path) -> None:
    before = snapshot(run)
    code, out, _ = call("run-stage", "mapping", "--run", run, "--round", 1)
    assert (code, out) == (0, "mapping: up to date, nothing to do (--force runs it anyway)\n")
    code, out, err = call("run-stage", "mapping", "--run", run, "--round", 1, "--force", "--until", "planning")
    assert (code, out) == (0, "mapping/round_0001, uncertainty/round_0001, planning/round_0001: done\n")
    assert "same bytes as before" in err
    assert snapshot(run) == before
    code, out, _ = call("run-stage", "mapping", "--run", run, "--round", 1, "--dry-run", "--force")
    assert out == "mapping/round_0001  miss  stale  forced\n1 of 1 would run\n"


@pytest.mark.parametrize("arguments", [
    ("run-stage", "mapping", "--round", 99, "--set", "run.seed=4"),
    ("resume", "--set", "camera.near=20"),
    ("resume", "--set", "scene.file=nowhere.glb"),
])
def test_a_refused_command_leaves_no_trace(call, run: Path, arguments: tuple) -> None:
    before = snapshot(run)
    name, *rest = arguments
    code, _, err = call(name, *rest[:1], "--run", run, *rest[1:]) if name == "run-stage" else call(name, run, *rest)
    assert code in (2, 3) and len(err.strip().splitlines()) == 1
    assert snapshot(run) == before
    assert call("resume", run)[0] == 0


def test_another_scene_is_stored_as_a_path_that_lasts(call, run: Path, tmp_path: Path) -> None:
    (tmp_path / "other.glb").touch()
    assert call("resume", run, "--set", "scene.file=other.glb")[0] == 0
    assert f'file = "{tmp_path / "other.glb"}"' in (run / "run.toml").read_text()


@pytest.mark.parametrize("command", ["status", "verify", "gc", "evaluate", "report", "resume"])
def test_json_is_one_document(call, run: Path, command: str) -> None:
    code, out, _ = call(command, run, "--json")
    assert code == 0
    assert json.loads(out)["schema"].startswith("active3d.")


def test_status(call, run: Path) -> None:
    code, out, err = call("status", run)
    assert (code, err) == (0, "")
    assert out.startswith(f"{run}: complete; 3 rounds, 10 of 10 steps\n")
    assert "mapping              3" in out
    assert "coverage  0.875" in out


def test_verify_gc_fork_export(call, run: Path, tmp_path: Path) -> None:
    assert call("verify", run)[0] == 0
    code, out, _ = call("gc", run, "--set", "run.keep.every=0", "--dry-run")
    assert code == 0
    assert out == "mapping/round_0000: pruned, 16.3 kB\n16.3 kB would be freed\n" or "pruned" in out
    code, out, err = call("fork", run, "--round", 1, "--to", "f", "--set", "mapping.window.size=3")
    assert (code, out) == (0, f"f: begins with rounds 0 to 1 of {run}; go on with: active3d resume f\n")
    assert "configuration: mapping.window.size 10 -> 3" in err
    code, out, _ = call("resume", "f", "--json")
    assert json.loads(out)["executed"][0] == "capture/round_0002"
    code, out, _ = call("export", run, "--to", tmp_path / "result")
    assert (code, out) == (0, f"{tmp_path}/result/mesh.npy\n")
    (run / "export/mesh.npy").write_bytes(b"x")
    code, out, err = call("verify", run)
    assert code == 5
    assert out == "export: mesh.npy has 1 bytes instead of 160\n"
    assert err.startswith(f"active3d: {run}: 1 of its files or folders are not what was committed; `active3d resume")


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("run", "dmo"), 2, "'dmo' is neither a TOML file nor a preset; did you mean 'demo'?"),
        (("run", "default"), 2, "scene.file is not given; give a file, the name of a scene"),
        (("run", "default", "--set", "scene.file=none.glb"), 3, "scene 'none.glb': no such file (looked at"),
        (("run", "default", "--set", "scene.file=generated:rooms=x"), 2, "cannot read 'rooms=x'; expected a recipe"),
        (("run", "default", "--set", "run.stps=3"), 2, "run.stps: unknown key (--set); did you mean 'run.steps'?"),
        (("run",), 2, "Missing argument"),
        (("run", "default", "--bogus"), 2, "No such option"),
        (("explore",), 2, "No such command"),
        (("resume", "nowhere"), 3, "nowhere: does not exist; expected one made by `active3d run`"),
        (("status", "."), 3, ".: is no run folder; expected one made by `active3d run`"),
        (("run-stage", "maping", "--run", "r"), 2, "'maping' is no stage; did you mean 'mapping'?; the stages are"),
        (("run-stage", "mapping", "--run", "r", "--round", "9"), 2, "--round 9: the run has rounds 0 to 2"),
        (("run-stage", "mapping", "--run", "r", "--round", "x"), 2, "Invalid value for '--round'"),
        (("inspect", "r", "--volume", "u_finale"), 2, "--volume u_finale: no such volume; did you mean 'u_final'?"),
        (("fork", "r", "--round", "7"), 2, "--round 7: r has rounds 0 to 2"),
        (("scene", "make", "--out", "room.obj"), 2, "--out room.obj: expected a name that ends in .glb"),
        (("scene", "make", "--rooms", "99", "--out", "x.glb"), 2, "rooms=99: expected 1..8"),
        (("config", "show", "none.toml"), 2, "none.toml: cannot be read: No such file or directory"),
    ],
)
def test_errors_are_one_line_and_a_code(call, run: Path, arguments: tuple, code: int, message: str) -> None:
    got, out, err = call(*arguments)
    assert (got, out) == (code, "")
    assert message in err
    assert err.startswith("active3d: ")
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("name", "text", "code", "message"),
    [
        ("manifest.json", "{", 3, "manifest.json: is no manifest of a run (JSONDecodeError)"),
        ("manifest.json", '{"schema": "active3d.run/9"}', 3, "has the form 'active3d.run/9', this version reads"),
        ("run.toml", "[run]\nsteps = 'x'\n", 2, "run.toml): expected a valid integer"),
        ("run.toml", "[run\n", 2, "run.toml: is not valid TOML"),
    ],
)
def test_a_damaged_run_folder(call, run: Path, name: str, text: str, code: int, message: str) -> None:
    (run / name).write_text(text)
    for command in ("status", "resume"):
        got, out, err = call(command, run)
        assert (got, out) == (code, "")
        assert message in err
        assert err.count("\n") == 1


def test_an_internal_error_is_one_line_with_a_log(call, run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from active3d_pipe.pipeline.runner import Runner

    def boom(self: object) -> None:
        raise ZeroDivisionError("division\nby zero")

    monkeypatch.setattr(Runner, "run", boom)
    code, out, err = call("resume", run)
    assert (code, out) == (1, "")
    assert err == (
        f"active3d: internal error: ZeroDivisionError: division by zero; the traceback is in {run}/logs/error.log\n"
    )
    assert "def boom" not in (run / "logs/error.log").read_text()
    assert 'raise ZeroDivisionError("division' in (run / "logs/error.log").read_text()
    assert call("verify", run, "--deep")[0] == 0  # the log harms nothing


def test_debug_shows_the_traceback(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _main(["--debug", "fork", str(run), "--round", "7"]) == 2
    assert "Traceback" in capsys.readouterr().err


def test_quiet(call) -> None:
    code, _, err = call("--quiet", *RUN)
    assert (code, err) == (0, "")


def test_config_show_and_schema(call) -> None:
    import tomllib

    code, out, _ = call("config", "show", "demo", "--set", "run.seed=5")
    values = tomllib.loads(out)
    assert (code, values["run"]["seed"], values["camera"]["width"]) == (0, 5, 320)
    assert "# seed that every random choice" in out
    assert 'terms = ["imp", "exp", "time"]  # terms that enter u_final; words: "imp" | "exp" | "time"' in out
    code, out, _ = call("config", "schema")
    assert json.loads(out)["properties"].keys() >= {"run", "scene", "camera", "mapping", "planning"}
    assert "demo" in call("config", "presets")[1].split()
    for verb in ("show", "presets"):
        assert json.loads(call("config", verb, "--json")[1])["schema"].startswith("active3d.")


def test_inspect_draws_a_volume(call, run: Path, tmp_path: Path) -> None:
    import numpy as np
    from PIL import Image

    from active3d_pipe.storage.volumes import write_volume
    from active3d_pipe.structures import VOLUMES, UncertaintyVolume, VoxelGrid

    grid = VoxelGrid(np.array([-1.0, 0.0, 0.0]), 0.25, (8, 6, 10))
    ramp = np.broadcast_to(np.arange(10, dtype=np.float32), grid.shape).copy()
    arrays = {name: np.zeros(grid.shape, np.float32) for name in VOLUMES} | {"u_final": ramp, "hit_evidence": ramp}
    write_volume(run / "uncertainty/round_0002/volume.zarr", UncertaintyVolume(grid, 2, arrays))
    code, out, _ = call("inspect", run, "--volume", "u_final", "--slice", "z=1.2", "--out", "s.png", "--json")
    found = json.loads(out)
    assert code == 0
    assert found["slice"] == {"axis": "z", "index": 4, "metres": 1.125}
    assert found["regions"]["slice z=1.12"]["mean"] == 4.0
    assert found["regions"]["everywhere"]["max"] == 9.0
    assert found["regions"]["observed"]["voxels"] == 8 * 6 * 9
    assert Image.open("s.png").size[0] > 400
    assert call("inspect", run, "--slice", "z=9")[2] == "active3d: --slice z=9: the volume spans z = 0.00 to 2.50 m\n"
    assert "expected an axis and metres" in call("inspect", run, "--slice", "w=1")[2]
    assert "there is no volume of that round; there are 0 to 2" in call("inspect", run, "--round", "7")[2]
    code, _, err = call("inspect", run, "--out", "s.foo")
    assert code == 2 and "expected a picture's name, ending in .png" in err
    os.chdir(run)
    assert call("inspect", ".")[0] == 0
    assert call("fork", ".", "--round", "0")[0] == 0 and (run.parent / "r_fork_0").is_dir()


def test_a_fork_of_a_run_with_unknown_settings_says_so(call, run: Path) -> None:
    assert call("fork", run, "--round", 0, "--to", run.with_name("f"))[0] == 0
    manifest = run.with_name("f") / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"steps": 10', '"stepz": 10', 1))
    code, _, err = call("status", run.with_name("f"))
    assert code == 3 and "not known to this version" in err


@pytest.mark.parametrize(("value", "text"), [(0, "0 B"), (999, "999 B"), (12_345, "12.3 kB"), (5e9, "5.0 GB")])
def test_sizes(value: float, text: str) -> None:
    assert console.size(int(value)) == text


@pytest.mark.parametrize(("value", "text"), [(4.25, "4.2 s"), (185, "3 min 05 s"), (7800, "2 h 10 min")])
def test_durations(value: float, text: str) -> None:
    assert console.seconds(value) == text


HEAVY = {"torch", "numba", "scipy", "zarr", "mcap", "open3d", "trimesh", "matplotlib"}


def _imported(code: str) -> set[str]:
    script = f"import sys\n{code}\nprint(' '.join(sys.modules))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT)
    return set(done.stdout.split())


def test_help_imports_nothing_heavy() -> None:
    loaded = _imported("import active3d_pipe.cli.main")
    assert not loaded & {"numpy", "pydantic", *HEAVY}


def test_a_no_op_imports_nothing_heavy() -> None:
    """Configuration, keys and the stages' page are known before any numeric library is loaded."""
    loaded = _imported("import active3d_pipe.pipeline.config, active3d_pipe.pipeline.runner")
    assert not loaded & HEAVY


def test_a_closed_pipe_is_no_error(run: Path) -> None:
    drive = ROOT / "tests" / "pipeline" / "drive.py"
    process = subprocess.Popen(
        [sys.executable, str(drive), "status", str(run), "--json"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert process.stdout is not None
    process.stdout.close()
    assert process.wait() == 0
    assert process.stderr is not None
    assert process.stderr.read() == b""
    assert os.path.isdir(run)
