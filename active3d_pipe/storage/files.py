"""Small helpers shared by the formats: JSON documents, safetensors tables, error translation."""

import errno
import json
from collections.abc import Iterator
from contextlib import contextmanager
from io import RawIOBase
from pathlib import Path
from typing import Any

import numpy as np

from active3d_pipe.errors import ArtifactError, DiskError

PIECE = 1 << 20  # bytes written at a time
TENSOR_TYPES = {  # NumPy's name of a type: safetensors' name, in the order in which that library puts arrays
    "<u8": "U64", "<i8": "I64", "<f8": "F64", "<f4": "F32", "<u4": "U32", "<i4": "I32", "<f2": "F16", "<u2": "U16",
    "<i2": "I16", "|i1": "I8", "|u1": "U8", "|b1": "BOOL",
}
COMPRESSION_THREADS = 4  # compression lets other threads run; the bytes do not depend on their number


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

    The library writes an array at a time; some file systems are ten times slower at pieces of tens of megabytes
    than at pieces of one (docs/performance.md), so the file is put together here: eight bytes with the length of the
    header, the header (JSON, padded to eight bytes), the arrays in its order. Equal arrays give equal bytes.
    """
    arrays = {name: np.asarray(a, order="C") for name, a in sorted(tensors.items())}
    header: dict[str, Any] = {"__metadata__": {"active3d": json.dumps(document, sort_keys=True)}}
    at = 0
    order = list(TENSOR_TYPES)
    for name, a in sorted(arrays.items(), key=lambda item: (order.index(item[1].dtype.str), item[0])):
        header[name] = {"dtype": TENSOR_TYPES[a.dtype.str], "shape": a.shape, "data_offsets": (at, at + a.nbytes)}
        at += a.nbytes
    head = json.dumps(header, separators=(",", ":")).encode("ascii")
    head += b" " * (-len(head) % 8)
    with writing(path), open(path, "wb", buffering=0) as file:
        _write_pieces(file, len(head).to_bytes(8, "little") + head)
        for name in list(header)[1:]:
            _write_pieces(file, arrays[name].reshape(-1).view(np.uint8).data)


def write_bytes(path: Path, *parts: bytes) -> None:
    """Write a file in pieces that every file system takes quickly."""
    with writing(path), open(path, "wb", buffering=0) as file:
        for part in parts:
            _write_pieces(file, part)


def _write_pieces(file: RawIOBase, data: bytes | memoryview) -> None:
    view = memoryview(data)
    while view:
        view = view[file.write(view[:PIECE]) or 0 :]


def read_tensors(path: Path) -> tuple[dict[str, np.ndarray], Any]:
    """Read what `write_tensors` wrote: (arrays, document)."""
    from safetensors import safe_open

    with reading(path, "a safetensors file"), safe_open(str(path), framework="numpy") as f:
        document = json.loads((f.metadata() or {}).get("active3d", "null"))
        return {name: f.get_tensor(name) for name in f.keys()}, document  # noqa: SIM118 (not a mapping)
