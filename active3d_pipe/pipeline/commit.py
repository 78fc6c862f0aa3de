"""Artifacts on disk: written aside, made durable, renamed into place as a whole.

    <stage>/.tmp-round_0007/   being written; removed when the next writer opens the run
    <stage>/round_0007/        committed: holds `record.json`
    <stage>/.old-round_0007/   what a replacement moved out of the way, where names cannot be swapped in one step;
                               put back if the new one never arrived

A committed artifact is never written to. Replacing or pruning one swaps the whole folder.
"""

import json
import os
import re
from pathlib import Path

from active3d_pipe.errors import ArtifactError
from active3d_pipe.pipeline import files
from active3d_pipe.pipeline.record import PRUNED, RECORD, Record, read_record
from active3d_pipe.pipeline.stage import NodeId

TMP, OLD = ".tmp-", ".old-"
_ROUND = re.compile(r"round_(\d{4,})")


class ArtifactStore:
    """The artifacts of one run folder."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def folder(self, node: NodeId) -> Path:
        """Where the artifact of a node is, or will be."""
        return self.root / str(node)

    def record(self, node: NodeId) -> Record | None:
        """The record of a node; None if it is not committed, ArtifactError if its record is damaged."""
        record = read_record(self.folder(node))
        if record is not None and record.node != node:
            raise ArtifactError(f"{self.folder(node)}: holds the record of {record.node}; it is damaged")
        return record

    def is_pruned(self, node: NodeId) -> bool:
        """Whether only the record of the artifact was kept."""
        return (self.folder(node) / PRUNED).is_file()

    def rounds(self, stage: str) -> list[int]:
        """Rounds for which a folder of a loop stage exists, sorted."""
        try:
            names = [path.name for path in (self.root / stage).iterdir()]
        except (FileNotFoundError, NotADirectoryError):
            return []
        return sorted(int(found[1]) for name in names if (found := _ROUND.fullmatch(name)))

    def begin(self, node: NodeId) -> Path:
        """An empty folder to write the artifact of a node into."""
        final = self.folder(node)
        aside = final.with_name(TMP + final.name)
        with files.writing(aside):
            if not final.parent.is_dir():
                files.make_folder(final.parent)
                files.sync_folder(final.parent.parent)
            if aside.exists():
                files.remove_tree(aside)
            files.make_folder(aside)
        return aside

    def discard(self, aside: Path) -> None:
        """Give up what `begin` handed out."""
        with files.writing(aside):
            files.remove_tree(aside)

    def commit(self, aside: Path, record: Record) -> None:
        """Make the folder from `begin` the artifact of `record.node`; replaces an earlier one."""
        with files.writing(aside):
            files.sync_tree(aside)
            files.write_file(aside / RECORD, record.to_bytes())
            files.sync_folder(aside)
            self._swap_in(aside, self.folder(record.node))

    def prune(self, record: Record) -> None:
        """Keep only the record of an artifact, with a mark that says so."""
        aside = self.begin(record.node)
        mark = {"schema": "active3d.pruned/1", "content": record.content, "bytes": record.size}
        with files.writing(aside):
            files.write_file(aside / PRUNED, (json.dumps(mark, indent=1) + "\n").encode("ascii"))
            files.write_file(aside / RECORD, record.to_bytes())
            files.sync_folder(aside)
            self._swap_in(aside, self.folder(record.node))

    def remove(self, node: NodeId) -> None:
        """Remove an artifact as a whole."""
        final = self.folder(node)
        aside = final.with_name(TMP + final.name)
        with files.writing(final):
            files.rename(final, aside)
            files.sync_folder(final.parent)
            files.remove_tree(aside)

    def clean(self) -> list[str]:
        """Repair what a crash left behind; returns one short text for each thing done."""
        said: list[str] = []
        folders = [self.root, *(p for p in sorted(self.root.iterdir()) if p.is_dir() and not p.name.startswith("."))]
        with files.writing(self.root):
            for folder in folders:
                for path in sorted(folder.iterdir()):
                    if path.name.startswith(OLD):
                        final = path.with_name(path.name.removeprefix(OLD))
                        if final.exists():
                            files.remove_tree(path)
                        else:
                            files.rename(path, final)
                            files.sync_folder(folder)
                            said.append(f"put {final.relative_to(self.root)} back, its replacement was interrupted")
                for path in sorted(folder.iterdir()):
                    if path.name.startswith(TMP):
                        files.remove_tree(path)
                        said.append(f"removed the unfinished {path.relative_to(self.root)}")
        return said

    @staticmethod
    def _swap_in(aside: Path, final: Path) -> None:
        if not os.path.lexists(final):
            files.rename(aside, final)
            files.sync_folder(final.parent)
        elif files.exchange(aside, final):  # now the old artifact has the unfinished one's name
            files.sync_folder(final.parent)
            files.remove_tree(aside)
        else:
            old = final.with_name(OLD + final.name)
            files.rename(final, old)
            files.rename(aside, final)
            files.sync_folder(final.parent)
            files.remove_tree(old)
