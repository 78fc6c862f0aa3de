"""A run of toy stages, made by the command line."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from active3d_pipe.cli.main import _main
from tests.pipeline import toy

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def toy_stages(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "stages.registry", toy)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ACTIVE3D_SCENES", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "room.glb").touch()


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str]):
    """Run a command line; returns (exit code, stdout, stderr)."""
    def call(*arguments: object) -> tuple[int, str, str]:
        capsys.readouterr()
        code = _main([str(a) for a in arguments])
        out, err = capsys.readouterr()
        assert "Traceback" not in out + err
        return code, out, err

    return call


RUN = (
    "run", "default", "--set", "scene.file=room.glb", "--set", "run.steps=10", "--set", "camera.height=8", "--out", "r",
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A complete run made by the command line."""
    folder = tmp_path_factory.mktemp("cli")
    (folder / "room.glb").touch()
    drive = ROOT / "tests" / "pipeline" / "drive.py"
    subprocess.run([sys.executable, str(drive), *RUN], cwd=folder, check=True, capture_output=True)
    return folder / "r"


@pytest.fixture
def run(made: Path, tmp_path: Path) -> Path:
    return shutil.copytree(made, tmp_path / "r")
