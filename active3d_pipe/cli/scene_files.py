"""From what a user writes in `scene.file` to a file: a path, the name of a scene, or a recipe for a generated one."""

import hashlib
import json
import os
from importlib.resources import files as package_files
from pathlib import Path
from typing import TYPE_CHECKING

from active3d_pipe.cli.console import say
from active3d_pipe.errors import ConfigError, InputError, OutputError
from active3d_pipe.pipeline import files
from active3d_pipe.pipeline.lock import one_at_a_time

if TYPE_CHECKING:
    from active3d_pipe.pipeline.config import Config
    from active3d_pipe.pipeline.layers import Layers

GENERATED = "generated:"
SCENES = "ACTIVE3D_SCENES"
_MESHES = ("scene.glb", "scene.gltf", "scene.obj", "scene.ply", "mesh.ply")


def with_files(config: "Config", layers: "Layers") -> "Config":
    """The configuration with `scene.file` and `planning.trajectory` as absolute paths, as `layers` mean them.

    Raises:
        ConfigError, InputError: no scene is given, or there is none of that name; there is no such trajectory.
    """
    from active3d_pipe.pipeline.config import with_values

    if not config.scene.file:
        raise ConfigError(
            "scene.file is not given; give a file, the name of a scene in "
            f"${SCENES}, or a recipe like {GENERATED}rooms=2,seed=7 (for example --set scene.file=room.glb)"
        )
    scene = resolve(config.scene.file, layers.folder_of("scene.file"))
    config = with_values(config, scene={"file": str(scene)})
    walk = config.planning.trajectory
    if not walk:
        return config
    beside = (layers.folder_of("planning.trajectory") or Path.cwd()) / Path(walk).expanduser()
    found = (beside if beside.exists() else Path(walk).expanduser()).resolve()
    if not found.exists():
        raise InputError(f"planning.trajectory = {walk!r}: no such file or run folder (looked at {beside}, {found})")
    return with_values(config, planning={"trajectory": str(found)})


def resolve(text: str, folder: Path | None = None) -> Path:
    """The scene file that `text` means: relative to `folder` (of the configuration file), else here, else by name."""
    if text.startswith(GENERATED):
        return generate(text)
    given = Path(text).expanduser()
    roots = [folder, Path.cwd()] if folder is not None else [Path.cwd()]
    scenes = os.environ.get(SCENES)
    candidates = [root / given for root in roots if root is not None]
    if scenes:
        candidates.append(Path(scenes) / given)
    for candidate in candidates:
        if candidate.is_file():
            return candidate.resolve()
        for name in _MESHES:
            if (candidate / name).is_file():
                return (candidate / name).resolve()
    looked = ", ".join(str(candidate) for candidate in dict.fromkeys(candidates))
    hint = "" if scenes else f"; scenes are found by name when ${SCENES} names their folder"
    raise InputError(f"scene {text!r}: no such file (looked at {looked}){hint}")


def generate(recipe: str) -> Path:
    """Make the apartment of `generated:rooms=2,seed=7` in the cache, unless it is there; returns its GLB file.

    The folder is named after the recipe and the generator's code, so that no stale scene is ever used.
    """
    values: dict[str, float] = {"rooms": 1, "seed": 0, "detail": 1.0}
    for part in recipe.removeprefix(GENERATED).split(","):
        name, _, value = part.partition("=")
        try:
            if name.strip() not in values:
                raise ValueError
            values[name.strip()] = float(value) if name.strip() == "detail" else int(value)
        except ValueError:
            raise ConfigError(
                f"scene.file = {recipe!r}: cannot read {part!r}; expected a recipe like {GENERATED}rooms=2,seed=7"
            ) from None
    name = "_".join(f"{key}{value:g}" for key, value in values.items())
    folder = cache_folder() / f"apartment_{name}_{_generator_digest()}"
    file = folder / "scene.glb"
    if not file.is_file():
        with files.writing(folder), one_at_a_time(folder):
            if not file.is_file():  # by another process meanwhile
                say(f"making the scene {recipe} ...")
                write_apartment(int(values["rooms"]), int(values["seed"]), file, values["detail"])
    return file


def write_apartment(rooms: int, seed: int, file: Path, detail: float = 1.0) -> dict:
    """Write a generated apartment to `file` (.glb) and its `scene.json` beside it; returns the metadata.

    Raises:
        OutputError: the folder holds a `scene.json` that is not known to be of this file.
        InputError: that `scene.json` cannot be read.
    """
    from active3d_pipe.sim.apartment import make_apartment
    from active3d_pipe.sim.scene import read_sidecar

    sidecar = file.with_name("scene.json")
    if sidecar.exists() and read_sidecar(file).get("file") != file.name:
        raise OutputError(f"{sidecar}: describes another scene; write {file.name} to a folder of its own")
    apartment = make_apartment(rooms, seed, detail=detail)
    metadata = {**apartment.metadata(), "file": file.name}
    with files.writing(file):
        file.parent.mkdir(parents=True, exist_ok=True)
        files.replace_file(sidecar, (json.dumps(metadata, indent=1) + "\n").encode())
        files.replace_file(file, apartment.to_glb())
    return metadata


def cache_folder() -> Path:
    """Where generated scenes are kept: $XDG_CACHE_HOME/active3d/scenes."""
    root = os.environ.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path.home() / ".cache") / "active3d" / "scenes"


def _generator_digest() -> str:
    code = hashlib.sha256()
    room = package_files("active3d_pipe.sim")
    for entry in sorted(room.iterdir(), key=lambda e: e.name):
        if entry.name.startswith(("apartment", "noise")) and entry.name.endswith(".py"):
            code.update(entry.read_bytes())
    return code.hexdigest()[:12]
