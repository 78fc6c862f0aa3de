"""Small helpers shared by the formats: JSON documents, safetensors tables, error translation."""

import errno
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from active3d_pipe.errors import ArtifactError, DiskError

COMPRESSION_THREADS = 2  # compression lets other threads run; the bytes do not depend on their number


@contextmanager
def reading(path: Path, expected: str) -> Iterator[None]:
    """Turn whatever a damaged file makes a library raise into one ArtifactError that names the file."""
    try:
        yield
    except ArtifactError:
        raise
    except FileNotFoundError as error:
        raise ArtifactError(f"{path}: missing; expected {expected}") from error
    except Exception as error:
        # The libraries raise dozens of types on malformed bytes; to the user they are one case.
        raise ArtifactError(f"{path}: cannot be read ({type(error).__name__}: {error}); expected {expected}") from error


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn a full disk into DiskError."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO):
            raise DiskError(f"{path}: writing failed ({error.strerror}); free some space and resume") from error
        raise


def write_json(path: Path, document: Any) -> None:
    """Write JSON with sorted keys and a trailing newline: equal documents give equal bytes."""
    with writing(path):
        path.write_text(json.dumps(document, indent=1, sort_keys=True, allow_nan=False) + "\n", encoding="utf-8")


def read_json(path: Path) -> Any:
    """Read a JSON document; ArtifactError when it is missing or malformed."""
    with reading(path, "a JSON document"):
        return json.loads(path.read_text(encoding="utf-8"))


def write_tensors(path: Path, tensors: dict[str, np.ndarray], document: Any = None) -> None:
    """Write named arrays as safetensors, with one JSON document in the metadata.

    One metadata key only: with more, the order of keys and so the bytes change from save to save.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import save_file

    contiguous = {name: np.asarray(a, order="C") for name, a in sorted(tensors.items())}
    with writing(path):
        path.touch()  # no permission, no folder: an OSError of its own kind; what save_file says is text
    try:
        # Straight from the arrays to the file: `save` first copies everything twice, five times as slow.
        save_file(contiguous, path, metadata={"active3d": json.dumps(document, sort_keys=True)})
    except SafetensorError as error:
        raise DiskError(f"{path}: writing failed ({error}); free some space and resume") from error


def read_tensors(path: Path) -> tuple[dict[str, np.ndarray], Any]:
    """Read what `write_tensors` wrote: (arrays, document)."""
    from safetensors import safe_open

    with reading(path, "a safetensors file"), safe_open(str(path), framework="numpy") as f:
        document = json.loads((f.metadata() or {}).get("active3d", "null"))
        return {name: f.get_tensor(name) for name in f.keys()}, document  # noqa: SIM118 (not a mapping)
