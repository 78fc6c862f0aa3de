"""Recorded trajectories: camera poses from a file, or from the captures of a run folder."""

import hashlib
import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from active3d_pipe.errors import InputError
from active3d_pipe.structures.frame import check_pose

EXPECTED = "a JSON list of 4x4 T_world_camera, an .npy (N, 4, 4), a text file of 16 numbers a line, or a run folder"


def read_poses(path: Path) -> np.ndarray:
    """(N, 4, 4) float64 T_world_camera, in order.

    A file holds a JSON list of 4x4 matrices (or an object with the key `poses`), a NumPy array (N, 4, 4), or text with
    16 numbers a line, row by row (the form of the Replica trajectories). A run folder gives every captured pose.

    Raises:
        InputError: there is no such file, or it holds something else.
    """
    try:
        if path.is_dir():
            files = _captures(path)
            poses: Any = [T for file in files for T in json.loads(file.read_text())["poses"]]
        elif path.suffix == ".npy":
            poses = np.load(io.BytesIO(path.read_bytes()), allow_pickle=False)
        elif path.suffix == ".json":
            document = json.loads(path.read_text())
            poses = document["poses"] if isinstance(document, dict) else document
        else:
            poses = np.loadtxt(io.BytesIO(path.read_bytes()), ndmin=2).reshape(-1, 4, 4)
        out = np.asarray(poses, dtype=np.float64).reshape(-1, 4, 4)
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}; expected {EXPECTED}") from error
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: holds no poses ({type(error).__name__}); expected {EXPECTED}") from error
    if not len(out):
        raise InputError(f"{path}: holds no poses; expected {EXPECTED}")
    for i, T in enumerate(out):
        check_pose(T, f"{path}: pose {i}")
    return out


def poses_digest(path: Path) -> str:
    """SHA-256 of the poses that `read_poses` gives: what a decision depends on, wherever the file lies."""
    return hashlib.sha256(np.ascontiguousarray(read_poses(path)).tobytes()).hexdigest()


def _captures(run: Path) -> list[Path]:
    files = sorted((run / "capture").glob("round_*/capture.json"))
    if not files:
        raise InputError(f"{run}: has no captures; expected {EXPECTED}")
    return files
