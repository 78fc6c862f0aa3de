"""Scene files to triangle soups: GLB, glTF, OBJ and PLY by one path (trimesh)."""

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from active3d_pipe.errors import InputError
from active3d_pipe.sim.materials import Material, mip_pyramid

FORMATS = (".glb", ".gltf", ".obj", ".ply")
_MAX_TEXTURE = 8192


@dataclass(frozen=True, slots=True, eq=False)
class Soup:
    """All meshes of a file in the file's own axes and units; attributes as in `Scene`, `vertices` float64."""

    vertices: np.ndarray
    faces: np.ndarray
    face_material: np.ndarray
    uv: np.ndarray | None
    vertex_colors: np.ndarray | None
    materials: tuple[Material, ...]
    warnings: tuple[str, ...]


def scene_path(file: str) -> Path:
    """The path of a scene file, or InputError if it is not given, missing, or of a format that is not read."""
    if not file:
        raise InputError(f"scene.file is not set; give a scene ({', '.join(FORMATS)})")
    path = Path(file).expanduser()
    if not path.exists():
        raise InputError(f"scene {path}: no such file")
    if not path.is_file():
        raise InputError(f"scene {path}: is not a file; give the scene file itself ({', '.join(FORMATS)})")
    if path.suffix.lower() not in FORMATS:
        raise InputError(f"scene {path}: unknown format {path.suffix!r}; expected one of {', '.join(FORMATS)}")
    return path


def read_soup(path: Path) -> Soup:
    """Read every mesh of a scene file, node transforms applied, textures decoded.

    Raises:
        InputError: the file cannot be parsed or holds no triangle.
    """
    import trimesh

    logging.getLogger("trimesh").setLevel(logging.ERROR)
    try:
        loaded = trimesh.load_scene(str(path), process=False)
        nodes = [(node, *loaded.graph[node]) for node in loaded.graph.nodes_geometry]
    except Exception as error:  # the reader raises whatever its parsers meet: struct, JSON, index, type errors
        reason = f"{type(error).__name__}: {(str(error).splitlines() or ['no reason given'])[0]}"
        raise InputError(f"scene {path}: cannot be read as {path.suffix[1:]} ({reason})") from error
    parts: list[tuple[Any, ...]] = []
    materials: list[Material] = []
    warnings: list[str] = []
    known: dict[int, int] = {}
    for _, transform, geometry in sorted(nodes, key=lambda item: item[0]):
        geometry_name, mesh = str(geometry), cast(Any, loaded.geometry[geometry])
        if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
            warnings.append(f"{geometry_name}: no faces, ignored")
            continue
        key = id(getattr(mesh.visual, "material", None)) if cast(Any, mesh.visual).kind == "texture" else id(mesh)
        if key not in known:
            known[key] = len(materials)
            materials.append(_material(mesh, geometry_name, warnings))
        parts.append(_part(mesh, transform, known[key], len(materials[known[key]].mips) > 0))
    if not parts:
        raise InputError(f"scene {path}: the file holds no faces; a triangle or quad mesh is needed")
    return _join(parts, tuple(materials), tuple(warnings), path)


def _part(mesh: Any, transform: np.ndarray, material: int, textured: bool) -> tuple[Any, ...]:
    """(vertices, faces, material ids, uv or None, colours or None) of one mesh in file coordinates."""
    vertices = np.asarray(mesh.vertices, dtype=np.float64) @ transform[:3, :3].T + transform[:3, 3]
    faces = np.asarray(mesh.faces, dtype=np.int64)
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"scene: a face refers to vertex {faces.max()} of {len(vertices)}")
    uv = None
    if textured and mesh.visual.uv is not None:
        corners = np.asarray(mesh.visual.uv, dtype=np.float32)[faces]
        uv = np.stack([corners[..., 0], 1 - corners[..., 1]], axis=-1)
    return vertices, faces, np.full(len(faces), material, np.int32), uv, _vertex_colors(mesh)


def _join(parts: list[tuple], materials: tuple[Material, ...], warnings: tuple[str, ...], path: Path) -> Soup:
    offsets = np.cumsum([0] + [len(p[0]) for p in parts])
    vertices = np.concatenate([p[0] for p in parts])
    faces = np.concatenate([p[1] + o for p, o in zip(parts, offsets)]).astype(np.int32)
    face_material = np.concatenate([p[2] for p in parts])
    uv = None
    if any(p[3] is not None for p in parts):
        uv = np.concatenate([np.zeros((len(p[1]), 3, 2), np.float32) if p[3] is None else p[3] for p in parts])
    colors = None
    if any(p[4] is not None for p in parts):
        colors = np.concatenate([np.full((len(p[0]), 3), 255, np.uint8) if p[4] is None else p[4] for p in parts])
    finite = np.isfinite(vertices).all(axis=1)[faces].all(axis=1)
    if uv is not None:
        finite &= np.isfinite(uv).all(axis=(1, 2))
    cross = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
    holes = np.array([m.alpha_cutoff is not None and not m.mips for m in materials])
    keep = finite & (np.abs(cross).max(axis=1, initial=0) > 0) & ~holes[face_material]
    if not keep.any():
        raise InputError(f"scene {path}: no face has an area; a triangle or quad mesh is needed")
    if not finite.all():
        warnings = (*warnings, f"{int((~finite).sum())} faces with coordinates that are no numbers, ignored")
    if not np.isfinite(vertices).all():
        vertices = np.nan_to_num(vertices, nan=0.0, posinf=0.0, neginf=0.0)
    faces, face_material, uv = faces[keep], face_material[keep], None if uv is None else uv[keep]
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    renumber = np.cumsum(used).astype(np.int32) - 1
    colors = None if colors is None else colors[used]
    return Soup(vertices[used], renumber[faces], face_material, uv, colors, materials, warnings)


def _material(mesh: Any, name: str, warnings: list[str]) -> Material:
    """The material of a mesh; base colours and textures are display values and taken as they are."""
    material = getattr(mesh.visual, "material", None)
    if mesh.visual.kind != "texture" or material is None:
        return Material(name, np.ones(3, np.float32))
    label = str(getattr(material, "name", None) or name)
    image = getattr(material, "baseColorTexture", None)
    factor = getattr(material, "baseColorFactor", None)
    if image is None and factor is None:
        image, factor = getattr(material, "image", None), getattr(material, "diffuse", None)
    factor = _unit_color(factor)
    mode = str(getattr(material, "alphaMode", None) or "OPAQUE").upper()
    cutoff = None
    if mode in ("MASK", "BLEND"):
        given = getattr(material, "alphaCutoff", None)
        cutoff = 0.5 if given is None or mode == "BLEND" else float(given)
    mips: tuple[np.ndarray, ...] = ()
    if image is not None and mesh.visual.uv is None:
        warnings.append(f"material {label}: texture without texture coordinates, ignored")
    elif image is not None:
        mips = _texture(image, label, factor[3], warnings)
    if not mips and cutoff is not None and factor[3] >= cutoff:
        cutoff = None
    return Material(label, factor[:3].astype(np.float32), mips, cutoff)


def _texture(image: Any, label: str, alpha: float, warnings: list[str]) -> tuple[np.ndarray, ...]:
    try:
        rgba = image.convert("RGBA")
        if max(rgba.size) > _MAX_TEXTURE:
            rgba.thumbnail((_MAX_TEXTURE, _MAX_TEXTURE))
        pixels = np.asarray(rgba).copy()
    except (OSError, ValueError, SyntaxError) as error:  # Pillow reports a damaged image in these ways
        warnings.append(f"material {label}: texture cannot be decoded ({error}), ignored")
        return ()
    if alpha < 1:
        pixels[..., 3] = np.rint(pixels[..., 3] * alpha)
    return mip_pyramid(pixels)


def _unit_color(color: Any) -> np.ndarray:
    """(4,) float64 RGBA in 0..1 of a colour given as None, integers 0..255 or floats 0..1."""
    if color is None:
        return np.ones(4)
    values = np.asarray(color)
    out = np.ones(4)
    scaled = values / 255.0 if np.issubdtype(values.dtype, np.integer) else values.astype(np.float64)
    out[: min(len(values), 4)] = scaled[:4]
    return np.clip(out, 0, 1)


def _vertex_colors(mesh: Any) -> np.ndarray | None:
    """(V, 3) uint8 display values of a mesh's vertex colours, or None.

    Float colours are 0..1; with larger values they are linear radiance (HDR) and are exposed so that the 95th
    percentile of brightness becomes display 0.9, with the sRGB curve.
    """
    raw = mesh.metadata.get("_ply_raw", {}).get("vertex", {}).get("data")
    names = getattr(getattr(raw, "dtype", None), "names", None) or (raw.keys() if isinstance(raw, dict) else ())
    if raw is not None and {"red", "green", "blue"} <= set(names):
        rgb = np.stack([np.asarray(raw[c]).reshape(-1) for c in ("red", "green", "blue")], axis=-1)
        if np.issubdtype(rgb.dtype, np.floating):
            return _expose(rgb.astype(np.float64))
    colors = None
    if mesh.visual.kind == "vertex":
        colors = mesh.visual.vertex_colors
    elif mesh.visual.kind == "texture":
        colors = mesh.visual.vertex_attributes.get("color")
    if colors is None or len(colors) != len(mesh.vertices):
        return None
    colors = np.asarray(colors)[:, :3]
    if np.issubdtype(colors.dtype, np.floating):
        return _expose(colors.astype(np.float64))
    return np.ascontiguousarray(colors if colors.dtype == np.uint8 else colors >> 8, dtype=np.uint8)


def _expose(rgb: np.ndarray) -> np.ndarray:
    rgb = np.clip(np.nan_to_num(rgb), 0, None)
    if rgb.max(initial=0) > 1:
        if rgb.max() <= 255 and np.array_equal(rgb, np.rint(rgb)):
            return rgb.astype(np.uint8)
        white = max(float(np.percentile(rgb.max(axis=1), 95)) / 0.787, 1e-6)  # 0.787 linear = display 0.9
        linear = np.clip(rgb / white, 0, 1)
        rgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.rint(np.clip(rgb, 0, 1) * 255).astype(np.uint8)
