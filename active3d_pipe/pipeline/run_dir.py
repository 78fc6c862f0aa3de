"""The run folder: `run.toml`, `manifest.json`, `journal.jsonl`, `run.lock`, and one folder for every stage.

A run may descend from another (`fork`): its manifest then lists, for every stretch of inherited rounds, the
configuration that they were made with, so that their keys stay what they are.
"""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from active3d_pipe.errors import ArtifactError, OutputError
from active3d_pipe.pipeline import files
from active3d_pipe.pipeline.commit import TMP, ArtifactStore
from active3d_pipe.pipeline.journal import JOURNAL, Journal
from active3d_pipe.pipeline.lock import LOCK
from active3d_pipe.pipeline.versions import library_versions

RUN_TOML = "run.toml"
MANIFEST = "manifest.json"
SCHEMA = "active3d.run/1"


@dataclass(frozen=True, slots=True)
class Inherited:
    """Rounds up to and including `until_round` were made with `config` (plain JSON values)."""

    until_round: int
    config: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Manifest:
    """What a run is: seed and threads, the libraries that began it, and what it inherited."""

    seed: int
    threads: int
    versions: dict[str, str]
    lineage: tuple[Inherited, ...] = ()

    def to_bytes(self) -> bytes:
        """The text of `manifest.json`."""
        lineage = [{"until_round": past.until_round, "config": past.config} for past in self.lineage]
        doc = {
            "schema": SCHEMA, "seed": self.seed, "threads": self.threads, "versions": self.versions, "lineage": lineage
        }
        return (json.dumps(doc, indent=1) + "\n").encode("ascii")

    @classmethod
    def from_bytes(cls, data: bytes, where: Path) -> "Manifest":
        """Read a manifest; ArtifactError names `where` when it is damaged or of another version."""
        try:
            doc = json.loads(data)
            schema = doc["schema"]
            if schema != SCHEMA:
                raise ArtifactError(
                    f"{where}: has the form {schema!r}, this version reads {SCHEMA}; use the active3d that made it"
                )
            lineage = tuple(Inherited(int(past["until_round"]), dict(past["config"])) for past in doc["lineage"])
            return cls(int(doc["seed"]), int(doc["threads"]), dict(doc["versions"]), lineage)
        except (KeyError, TypeError, ValueError) as error:
            raise ArtifactError(
                f"{where}: is no manifest of a run ({type(error).__name__}); restore it, or start a new run"
            ) from error


class RunDir:
    """A run folder that exists."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.store = ArtifactStore(path)
        self.journal = Journal(path)

    @classmethod
    def open(cls, path: Path) -> "RunDir":
        """An existing run; ArtifactError when there is none."""
        if not (path / MANIFEST).is_file() or not (path / RUN_TOML).is_file():
            hint = "is no run folder" if path.exists() else "does not exist"
            raise ArtifactError(f"{path}: {hint}; expected one made by `active3d run` (with {RUN_TOML} and {MANIFEST})")
        return cls(path)

    @classmethod
    def prepare(cls, path: Path, may_hold: Iterable[str] = ()) -> "RunDir":
        """The folder of a new or existing run; OutputError when it holds anything but a run, or `may_hold`."""
        with files.writing(path):
            if path.exists() and not (path / MANIFEST).is_file():
                if not path.is_dir():
                    raise OutputError(f"{path}: is a file; a run needs a folder, choose another with --out")
                known = {LOCK, RUN_TOML, JOURNAL, *may_hold}
                foreign = sorted(p.name for p in path.iterdir() if p.name not in known and not p.name.startswith(TMP))
                if foreign:
                    raise OutputError(
                        f"{path}: holds {foreign[0]!r} and is no run folder; choose an empty or new folder with --out"
                    )
            if not path.is_dir():
                files.make_folder(path)
                files.sync_folder(path.parent)
        return cls(path)

    @property
    def exists(self) -> bool:
        """Whether the run was begun: its manifest is written last."""
        return (self.path / MANIFEST).is_file()

    def manifest(self) -> Manifest:
        """Read `manifest.json`."""
        path = self.path / MANIFEST
        try:
            data = path.read_bytes()
        except OSError as error:
            raise ArtifactError(f"{path}: cannot be read: {error.strerror}") from error
        return Manifest.from_bytes(data, path)

    def write(self, toml: str, manifest: Manifest) -> None:
        """Write `run.toml`, then `manifest.json`; files that hold these bytes already are left alone."""
        with files.writing(self.path):
            for name, data in ((RUN_TOML, toml.encode()), (MANIFEST, manifest.to_bytes())):
                path = self.path / name
                if not path.is_file() or path.read_bytes() != data:
                    files.replace_file(path, data)


def new_manifest(seed: int, threads: int, lineage: tuple[Inherited, ...] = ()) -> Manifest:
    """The manifest of a run that begins now."""
    return Manifest(seed, threads, library_versions(), lineage)
