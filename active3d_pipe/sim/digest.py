"""The digest of a scene's files: it enters the key of everything captured from them. Light to import."""

import hashlib
from pathlib import Path

from active3d_pipe.errors import AccessError, InputError

SIDECARS = {".obj": (".mtl", ".png", ".jpg", ".jpeg"), ".gltf": (".bin", ".png", ".jpg", ".jpeg")}

_known: dict[tuple, str] = {}


def scene_name(path: Path) -> str:
    """Name of a scene by its file: the folder's name for `<name>/scene.glb`, else the file's stem."""
    stem = path.stem
    return path.resolve().parent.name if stem in ("scene", "mesh", "mesh_semantic") else stem


def source_digest(file: str) -> str:
    """sha256 over the scene file, the `scene.json` beside it, and the files that an OBJ or glTF refers to.

    Raises InputError when the file is missing, AccessError when it may not be read.
    """
    path = Path(file)
    if not path.is_file():
        raise InputError(f"scene file {path}: no such file; give scene.file, or make one with `active3d scene make`")
    found = [path, path.with_name("scene.json"), path.with_suffix(".json")]
    endings = SIDECARS.get(path.suffix.lower(), ())
    found += sorted(p for p in path.parent.rglob("*") if p.suffix.lower() in endings)
    files = [p for p in dict.fromkeys(found) if p.is_file()]
    key = tuple((str(p), p.stat().st_mtime_ns, p.stat().st_size) for p in files)
    if key not in _known:
        h = hashlib.sha256()
        try:
            for p in files:
                h.update(p.relative_to(path.parent).as_posix().encode() + b"\0" + p.read_bytes())
        except PermissionError as error:
            raise AccessError(f"scene file {error.filename}: permission denied") from error
        _known[key] = h.hexdigest()
    return _known[key]
