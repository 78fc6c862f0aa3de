"""`record.json`: what an artifact is, written last. No record, no artifact.

The bytes are the same for equal runs: no wall-clock time enters (seconds go to the journal). The last field is the
digest of all the others, so that damage to the record itself is found as well.
"""

import json
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from active3d_pipe.errors import ArtifactError
from active3d_pipe.pipeline.files import list_files, sha256_file
from active3d_pipe.pipeline.keys import digest
from active3d_pipe.pipeline.stage import NodeId

RECORD = "record.json"
PRUNED = "pruned.json"
SCHEMA = "active3d.record/1"
HASHING_THREADS = 2  # hashing lets other threads run


@dataclass(frozen=True, slots=True)
class FileEntry:
    """One file of an artifact: sha256 (hexadecimal) and size in bytes."""

    sha256: str
    bytes: int


@dataclass(frozen=True, slots=True)
class Record:
    """The record of one artifact.

    Attributes:
        node: the node that made it.
        key, parts: its key and the parts that the key is made of.
        files: relative POSIX path -> digest and size of every file, the record excepted.
        notes: what the stage noted (`steps`, `stop`, coverage, ...).
        versions: versions of the libraries that made it.
    """

    node: NodeId
    key: str
    parts: dict[str, Any]
    files: dict[str, FileEntry]
    notes: dict[str, Any]
    versions: dict[str, str]

    @property
    def content(self) -> str:
        """Digest of what later stages can see of the artifact: its files and notes."""
        return digest({"files": {name: f.sha256 for name, f in self.files.items()}, "notes": self.notes})

    @property
    def size(self) -> int:
        """Size of the payload, bytes."""
        return sum(f.bytes for f in self.files.values())

    def to_bytes(self) -> bytes:
        """The text of `record.json`."""
        body = {
            "schema": SCHEMA,
            "stage": self.node.stage,
            "round": self.node.round,
            "key": self.key,
            "content": self.content,
            "parts": self.parts,
            "files": {name: {"sha256": f.sha256, "bytes": f.bytes} for name, f in sorted(self.files.items())},
            "notes": self.notes,
            "versions": self.versions,
        }
        return _dump({**body, "digest": digest(body)})

    @classmethod
    def from_bytes(cls, data: bytes, where: Path) -> "Record":
        """Read a record; ArtifactError names `where` when it is damaged or of another version."""
        try:
            doc = json.loads(data)
            if doc["schema"] != SCHEMA:
                raise ArtifactError(f"{where}: has the form {doc['schema']!r}, this version reads {SCHEMA}")
            body = {name: value for name, value in doc.items() if name != "digest"}
            if doc["digest"] != digest(body) or data != _dump(doc):
                raise ArtifactError(f"{where}: its own digest does not match, the record is damaged")
            files = {_safe(name): FileEntry(f["sha256"], f["bytes"]) for name, f in doc["files"].items()}
            return cls(
                NodeId(doc["stage"], doc["round"]), doc["key"], doc["parts"], files, doc["notes"], doc["versions"]
            )
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise ArtifactError(f"{where}: is no record of an artifact ({type(error).__name__})") from error


def _dump(doc: Mapping[str, Any]) -> bytes:
    return (json.dumps(doc, indent=1, allow_nan=False) + "\n").encode("ascii")


def _safe(name: str) -> str:
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or str(path) != name or name in ("", "."):
        raise ValueError(f"file name {name!r} leaves the artifact")
    return name


def measure(folder: Path) -> dict[str, FileEntry]:
    """Digest and size of every file of a folder; symbolic links and special files are refused."""
    paths = list_files(folder)
    for path in paths:
        if path.is_symlink() or not path.is_file():
            raise ArtifactError(f"{path}: an artifact may hold plain files only")
    with ThreadPoolExecutor(HASHING_THREADS) as pool:
        digests = pool.map(sha256_file, paths)
        return {
            path.relative_to(folder).as_posix(): FileEntry(digest, path.stat().st_size)
            for path, digest in zip(paths, digests, strict=True)
        }


def read_record(folder: Path) -> Record | None:
    """The record of an artifact folder; None if there is none, ArtifactError if it is damaged."""
    path = folder / RECORD
    try:
        data = path.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise ArtifactError(f"{path}: cannot be read: {error.strerror}") from error
    return Record.from_bytes(data, path)


def damage(folder: Path, record: Record, deep: bool) -> list[str]:
    """What is wrong with the payload of an artifact, one short text each; empty when whole.

    Sizes are compared always, digests only when `deep`; names that the record does not know count as damage.
    """
    wrong: list[str] = []
    for name, entry in record.files.items():
        path = folder / name
        try:
            size = path.lstat().st_size
            if path.is_symlink() or not path.is_file():
                wrong.append(f"{name} is no plain file")
            elif size != entry.bytes:
                wrong.append(f"{name} has {size} bytes instead of {entry.bytes}")
            elif deep and sha256_file(path) != entry.sha256:
                wrong.append(f"{name} has another digest")
        except FileNotFoundError:
            wrong.append(f"{name} is missing")
        except OSError as error:
            wrong.append(f"{name} cannot be read ({error.strerror})")
    if deep:
        known = {*record.files, RECORD}
        names = (path.relative_to(folder).as_posix() for path in list_files(folder))
        wrong += [f"{name} does not belong to it" for name in names if name not in known]
    return wrong
