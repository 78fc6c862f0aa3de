"""A sweep: variants x scenes x seeds, one ordinary run folder each, some at a time. Knows no 3D.

    OUT/sweep.json                        what was asked for, and how every run ended
    OUT/<scene>/<variant>/seed_<n>/       a run folder as `active3d run` makes it

Interrupted, it goes on where it stopped: what is done with the same settings is skipped, what was begun is taken up
by its own run. A run that fails is marked and does not stop the others; the next call tries it again.
"""

import json
import re
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from threading import Event
from typing import Any

from active3d_pipe.errors import ConfigError
from active3d_pipe.pipeline import files
from active3d_pipe.pipeline.keys import digest
from active3d_pipe.pipeline.layers import read_toml

SWEEP = "sweep.json"
_KINDS = {str: "text", int: "a whole number"}
KEYS = ("title", "base", "steps", "seeds", "scenes", "variants", "set", "metrics")


@dataclass(frozen=True, slots=True)
class Variant:
    """One column of the comparison: settings as `a.b=value` texts on top of the base."""

    name: str
    label: str
    settings: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Spec:
    """What is compared. `base` is a preset or file, `settings` hold for every run, `metrics` names table rows."""

    title: str
    base: str
    scenes: tuple[str, ...]
    seeds: tuple[int, ...]
    variants: tuple[Variant, ...]
    settings: tuple[str, ...] = ()
    metrics: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Cell:
    """One run of a sweep: the names of its folders and all of its settings."""

    scene: str
    variant: str
    seed: int
    base: str
    settings: tuple[str, ...]

    def folder(self, out: Path) -> Path:
        """Its run folder."""
        return out / self.scene / self.variant / f"seed_{self.seed}"

    @property
    def key(self) -> str:
        """Digest of everything that was asked for, the text of a configuration file included."""
        asked = asdict(self)
        if self.base.endswith(".toml") and Path(self.base).is_file():
            asked["base_text"] = Path(self.base).read_text(encoding="utf-8")
        return digest(asked)


@dataclass(frozen=True, slots=True)
class Ended:
    """How a run ended: `done`, or `failed` with one line."""

    state: str
    key: str
    error: str = ""


def scene_name(scene: str) -> str:
    """A folder name for a scene: that of its folder when the file is just called scene or mesh."""
    path = Path(scene)
    generic = path.stem in ("scene", "mesh") and path.suffix and path.parent.name
    is_file = path.suffix in (".glb", ".gltf", ".obj", ".ply")
    plain = path.parent.name if generic else path.stem if is_file else scene
    return re.sub(r"[^A-Za-z0-9._-]+", "_", plain).strip("_") or "scene"


def flat_settings(table: Mapping[str, Any], prefix: str = "") -> tuple[str, ...]:
    """A nested table of settings as `a.b=value` texts, values in TOML."""
    out: list[str] = []
    for name, value in table.items():
        if isinstance(value, Mapping):
            out += flat_settings(value, f"{prefix}{name}.")
        else:
            out.append(f"{prefix}{name}={json.dumps(value, ensure_ascii=False)}")
    return tuple(out)


def read_spec(path: Path, variant_of: Callable[[str], Mapping[str, Any]]) -> Spec:
    """Read a TOML file of a comparison; `variant_of` gives the settings that the name of a variant stands for.

    A variant is a name, or a table with `name` and, if wanted, `label` and `set` (a list of `a.b=value` texts).

    Raises:
        ConfigError: an unknown key, a missing one, or two variants of one name; one line.
    """
    doc = read_toml(path)
    unknown = sorted(set(doc) - set(KEYS))
    if unknown:
        raise ConfigError(f"{path}: {unknown[0]!r} is not known here; expected {', '.join(KEYS)}")
    for key in ("scenes", "variants"):
        if not isinstance(doc.get(key), list) or not doc[key]:
            raise ConfigError(f"{path}: `{key}` is missing; expected a list")
    for key, kind in (("scenes", str), ("seeds", int), ("set", str), ("metrics", str)):
        _check_list(doc.get(key, []), kind, f"{path}: `{key}`")
    if doc.get("seeds") == []:
        raise ConfigError(f"{path}: `seeds` is empty; name at least one, or leave it out for seed 0")
    for key, kind in (("title", str), ("base", str), ("steps", int)):
        if type(doc.get(key, kind())) is not kind:
            raise ConfigError(f"{path}: `{key}` is {doc[key]!r}; expected {_KINDS[kind]}")
    variants = tuple(make_variant(entry, variant_of, str(path)) for entry in doc["variants"])
    steps = (f"run.steps={doc['steps']}",) if "steps" in doc else ()
    return checked(
        Spec(
            doc.get("title", path.stem), doc.get("base", "default"), tuple(doc["scenes"]),
            tuple(doc.get("seeds", [0])), variants, (*steps, *doc.get("set", ())), tuple(doc.get("metrics", ())),
        )
    )


def _check_list(values: Any, kind: type, where: str) -> None:
    """ConfigError unless `values` is a list of `kind`."""
    if not isinstance(values, list) or any(type(v) is not kind for v in values):
        raise ConfigError(f"{where} is {values!r}; expected a list, each of them {_KINDS[kind]}")


def make_variant(entry: Any, variant_of: Callable[[str], Mapping[str, Any]], where: str) -> Variant:
    """A variant from a name or a table."""
    table = entry if isinstance(entry, Mapping) else {"name": entry}
    named = isinstance(table.get("name"), str) and isinstance(table.get("label", ""), str)
    if not named or set(table) - {"name", "label", "set"}:
        raise ConfigError(f"{where}: variant {entry!r}; expected a name, or a table with name, label, set")
    _check_list(table.get("set", []), str, f"{where}: `set` of variant {table['name']!r}")
    texts = flat_settings(variant_of(table["name"]))
    name = re.sub(r"[^A-Za-z0-9._-]+", "_", Path(table["name"]).stem)
    return Variant(name, str(table.get("label", name)), (*texts, *table.get("set", ())))


def checked(spec: Spec) -> Spec:
    """The spec itself; ConfigError when two runs would share a folder."""
    for what, names in (
        ("variant", [v.name for v in spec.variants]), ("scene", [scene_name(s) for s in spec.scenes]),
        ("seed", [str(s) for s in spec.seeds]),
    ):
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise ConfigError(f"{what} {twice[0]!r} is given twice; every {what} needs a folder of its own")
    return spec


def cells(spec: Spec) -> list[Cell]:
    """Every run, seed by seed, so that a sweep that is stopped early has whole columns."""
    return [
        Cell(
            scene_name(scene), variant.name, seed, spec.base,
            (*spec.settings, *variant.settings, f"scene.file={json.dumps(scene)}", f"run.seed={seed}"),
        )
        for seed in spec.seeds for scene in spec.scenes for variant in spec.variants
    ]


class Sweep:
    """A sweep and its state on disk."""

    def __init__(self, out: Path, spec: Spec) -> None:
        self.out = out
        self.spec = spec
        self.cells = cells(spec)
        self.ended = self._read()

    def state(self, cell: Cell) -> Ended | None:
        """How the run ended, or None when it did not yet (or was asked for with other settings)."""
        ended = self.ended.get(self._name(cell))
        return ended if ended is not None and ended.key == cell.key else None

    def is_outdated(self, cell: Cell) -> bool:
        """Whether the run in its folder was asked for with other settings: no result of this sweep."""
        return self._name(cell) in self.ended and self.state(cell) is None

    def run(
        self, execute: Callable[[Cell, Path], str], say: Callable[[str], None], is_complete: Callable[[Path], bool],
        jobs: int = 1,
    ) -> int:
        """Run what is not done, `jobs` runs at a time; returns how many failed.

        Args:
            execute: makes one run; returns "" or one line that says why it failed. It may raise to stop the sweep;
                what runs beside it ends first. Called from threads.
            say: called with one line before and after every run.
            is_complete: whether a run folder holds what the tables are made of.
        """
        self._write()
        failed, stopped = 0, Event()
        left: list[tuple[str, Cell]] = []
        for n, cell in enumerate(self.cells, 1):
            place = f"[{n}/{len(self.cells)}] {cell.scene} {cell.variant} seed {cell.seed}"
            before = self.state(cell)
            if before is not None and before.state == "done" and is_complete(cell.folder(self.out)):
                say(f"{place}: done before")
            else:
                left.append((place, cell))

        def one(place: str, cell: Cell) -> str | None:
            if stopped.is_set():
                return None
            say(f"{place} ...")
            try:
                return execute(cell, cell.folder(self.out))
            except BaseException:
                stopped.set()  # before this thread takes the next run
                raise

        with ThreadPoolExecutor(max(1, jobs)) as pool:
            futures = {pool.submit(one, place, cell): (place, cell) for place, cell in left}
            for future in as_completed(futures):
                place, cell = futures[future]
                error = future.result()
                if error is None:
                    continue
                self.ended[self._name(cell)] = Ended("failed" if error else "done", cell.key, error)
                failed += bool(error)
                self._write()
                say(f"{place}: {'FAILED: ' + error if error else 'done'}")
        return failed

    def _name(self, cell: Cell) -> str:
        return f"{cell.scene}/{cell.variant}/seed_{cell.seed}"

    def _read(self) -> dict[str, Ended]:
        path = self.out / SWEEP
        if not path.is_file():
            return {}
        try:
            ended = {name: Ended(**e) for name, e in json.loads(path.read_text(encoding="utf-8"))["ended"].items()}
            if any(type(value) is not str for e in ended.values() for value in asdict(e).values()):
                raise TypeError("expected text")
            return ended
        except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
            raise ConfigError(f"{path}: cannot be read ({error}); remove it, finished runs are found again") from error

    def _write(self) -> None:
        document = {
            "schema": "active3d.sweep/1", "spec": asdict(self.spec),
            "ended": {name: asdict(e) for name, e in sorted(self.ended.items())},
        }
        with files.writing(self.out):
            files.make_folder(self.out)
            files.replace_file(self.out / SWEEP, (json.dumps(document, indent=1) + "\n").encode())

