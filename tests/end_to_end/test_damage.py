"""Damaged runs and malformed scenes: found, named in one line, mended to the same bytes or refused."""

import shutil
import struct
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

Cli = Callable[..., subprocess.CompletedProcess]

ARTIFACTS = {
    "log": "capture/round_0001/frames.mcap",
    "volume": "uncertainty/round_0001/volume.zarr/scale0/u_final/c/0/0/0/0",
    "field": "mapping/round_0001/field.safetensors",
    "keyframes": "mapping/round_0001/keyframes.json",
    "decision": "planning/round_0001/decision.json",
    "mesh": "export/mesh.ply",
}


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-7])


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0x10
    path.write_bytes(content)


@pytest.fixture(scope="module")
def copy(tiny_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy that tests may damage; each leaves it mended."""
    return Path(shutil.copytree(tiny_run, tmp_path_factory.mktemp("damage") / "run"))


def split(name: str) -> tuple[str, str]:
    """Artifact and file: `mapping/round_0001`, `keyframes.json`; a finishing stage's artifact has no round."""
    parts = name.split("/")
    depth = 2 if parts[1].startswith("round_") else 1
    return "/".join(parts[:depth]), "/".join(parts[depth:])


def named(cli: Cli, run: Path, name: str) -> None:
    """`verify --deep` finds damage, and names this file alone."""
    artifact, file = split(name)
    found = cli("verify", "--deep", run)
    assert found.returncode == 5, found.stdout + found.stderr
    lines = found.stdout.splitlines()
    assert len(lines) == 1, found.stdout
    assert lines[0].startswith(f"{artifact}: {file} "), found.stdout
    assert len(found.stderr.strip().splitlines()) == 1, found.stderr


@pytest.mark.parametrize("kind", sorted(ARTIFACTS))
def test_a_flipped_bit_is_named_and_made_again(copy: Path, tiny_run: Path, run_cli: Cli, kind: str) -> None:
    name = ARTIFACTS[kind]
    artifact, file = split(name)
    flip(copy / name)
    named(run_cli, copy, name)
    resumed = run_cli("resume", copy)
    assert resumed.returncode == 0, resumed.stderr
    lines = resumed.stderr.splitlines()
    assert "Traceback" not in resumed.stderr
    assert len([line for line in lines if artifact in line and file in line and "made again" in line]) == 1, lines
    assert (copy / name).read_bytes() == (tiny_run / name).read_bytes()
    assert run_cli("verify", "--deep", copy).returncode == 0


@pytest.mark.parametrize("kind", sorted(ARTIFACTS))
def test_a_shortened_file_is_named(copy: Path, tiny_run: Path, run_cli: Cli, kind: str) -> None:
    name = ARTIFACTS[kind]
    cut(copy / name)
    named(run_cli, copy, name)
    (copy / name).write_bytes((tiny_run / name).read_bytes())


def refused(done: subprocess.CompletedProcess, path: Path) -> None:
    assert done.returncode == 3, done.stderr
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr
    assert "Traceback" not in done.stderr
    assert path.name in done.stderr


def test_a_missing_scene_is_refused(tmp_path: Path, run_cli: Cli) -> None:
    scene = tmp_path / "nowhere.glb"
    refused(run_cli("run", "demo", "--out", tmp_path / "run", "--set", f"scene.file={scene}"), scene)


def test_a_mesh_without_faces_is_refused(tmp_path: Path, run_cli: Cli) -> None:
    scene = tmp_path / "points.ply"
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    scene.write_text(f"ply\nformat ascii 1.0\nelement vertex 3\n{axes}end_header\n"
                     "0 0 0\n1 0 0\n0 1 0\n")
    refused(run_cli("run", "demo", "--out", tmp_path / "run", "--set", f"scene.file={scene}"), scene)


@pytest.mark.parametrize("damage", ["cut", "noise", "length"])
def test_a_malformed_glb_is_refused(tmp_path: Path, tiny_config: Path, run_cli: Cli, damage: str) -> None:
    whole = (tiny_config.parent / "room" / "scene.glb").read_bytes()
    scene = tmp_path / "broken.glb"
    scene.write_bytes(
        {"cut": whole[:1000], "noise": b"glTF" + bytes(range(256)) * 4,
         "length": whole[:8] + struct.pack("<I", 12) + whole[12:40]}[damage]
    )
    refused(run_cli("run", "demo", "--out", tmp_path / "run", "--set", f"scene.file={scene}"), scene)
