"""Fixtures shared by all tests."""

import os
from pathlib import Path

import pytest

pytest_plugins = ["tests.tiny_run"]

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def shared_scenes() -> Path:
    """Folder of the real furnished scenes; tests that need it are skipped where it is absent."""
    folder = Path(os.environ.get("ACTIVE3D_SCENES", ROOT.parent / "shared" / "scenes"))
    if not folder.is_dir():
        pytest.skip(f"no scenes at {folder}; set ACTIVE3D_SCENES")
    return folder
