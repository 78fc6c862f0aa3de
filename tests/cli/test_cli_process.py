"""What only a process of its own shows: streams that are closed, threads that are set in time."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from stages.registry import FINISH, LOOP
from tests.cli.conftest import ROOT, RUN

DRIVE = (sys.executable, str(ROOT / "tests" / "pipeline" / "drive.py"))


@pytest.mark.parametrize("options", [(), ("--debug",)])
def test_a_run_whose_reader_has_gone_goes_on(tmp_path: Path, options: tuple) -> None:
    running = [*DRIVE, *options, *RUN]
    process = subprocess.Popen(running, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    assert process.stderr is not None
    process.stderr.close()
    assert process.wait() == 0
    assert (tmp_path / "r/report/index.html").is_file()
    failing = [*DRIVE, *options, "status", "nowhere"]
    process = subprocess.Popen(failing, cwd=tmp_path, stderr=subprocess.PIPE)
    assert process.stderr is not None
    process.stderr.close()
    assert process.wait() == 3


def test_nothing_for_stderr_reaches_stdout_when_stderr_is_closed(tmp_path: Path) -> None:
    command = " ".join([*DRIVE, *RUN, "--json", "2>&-"])
    done = subprocess.run(["/bin/sh", "-c", command], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert json.loads(done.stdout)["schema"] == "active3d.outcome/1"


THREADS = """
import sys
from active3d_pipe.cli.main import _main
from active3d_pipe.pipeline import threads

def set_threads(count):
    print(count, sorted({"numpy", "numba", "torch"} & set(sys.modules)))
    sys.exit()

threads.set_threads = set_threads
_main(sys.argv[1:])
"""


@pytest.mark.parametrize(("arguments", "count"), [
    (("resume", "r", "--set", "run.threads=3"), 3),
    (("run-stage", "mapping", "--run", "r", "--set", "run.threads=3"), 3),
    (("evaluate", "r"), 2), (("report", "r"), 2), (("export", "r", "--to", "out"), 2),
])
def test_threads_are_set_before_any_library_that_has_them(run: Path, arguments: tuple, count: int) -> None:
    line, env = [sys.executable, "-c", THREADS, *arguments], {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(line, cwd=run.parent, capture_output=True, text=True, check=True, env=env)
    assert done.stdout == f"{count} []\n"


def test_commands_that_only_read_pass_over_settings_of_another_version(call, run: Path) -> None:
    text = (run / "run.toml").read_text()
    (run / "run.toml").write_text(text.replace("[planning]\n", "[planning]\nforesight = 3\n", 1))
    for command in (("status", run, "--json"), ("verify", run, "--json")):
        code, out, err = call(*command)
        assert (code, json.loads(out)["run"]) == (0, str(run))
        assert err == f"{run}/run.toml: planning.foresight not known to this version, ignored\n"
    for command in (("resume", run), ("evaluate", run), ("fork", run, "--round", 0), ("gc", run)):
        code, out, err = call(*command)
        assert (code, out, err.count("\n")) == (3, "", 1)
        assert "planning.foresight not known to this version; go on with the version that made the run" in err


@pytest.mark.parametrize("arguments", [(), ("scene",), ("config",)])
def test_without_a_command_the_help_is_shown_as_it_is(call, arguments: tuple) -> None:
    code, out, err = call(*arguments)
    assert (code, err) == (2, "") and out.startswith("Usage: active3d") and out.count("\n") > 5


def test_the_help_names_every_stage(call) -> None:
    code, out, _ = call("run-stage", "--help")
    listed = " ".join(out.split()).partition("Arguments: stage <str> ")[2].partition(".")[0]
    assert code == 0
    assert listed.replace(" or ", ", ").split(", ") == [stage.name for stage in (*LOOP, *FINISH)]
