"""Generated apartments: furnished, textured, closed scenes of 1 to 8 rooms, made from a seed.

Nothing is loaded: geometry and textures are procedural, so a scene is free of anyone's rights and there is no end of
them. World frame: metres, Z up, floor at z = 0, the floor plan centred on the origin.
"""

import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial

from active3d_pipe.errors import ConfigError
from active3d_pipe.geometry.raycasting import SurfaceIndex
from active3d_pipe.sim.apartment_furnishing import Furnisher
from active3d_pipe.sim.apartment_layout import Room, make_layout
from active3d_pipe.sim.apartment_look import make_look, make_shared
from active3d_pipe.sim.apartment_mesh import Material, MeshBuilder
from active3d_pipe.sim.apartment_noise import HUES
from active3d_pipe.sim.apartment_placement import Floor
from active3d_pipe.sim.apartment_shell import build_outer_shell, build_room_shell

START_HEIGHT = 1.3  # m
MAX_ROOMS = 8


@dataclass(frozen=True, eq=False)
class Surface:
    """All triangles of one material: vertices (V, 3) float32 world m, faces (F, 3) int32, uv (V, 2) float32, v up."""

    material: Material
    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray


@dataclass(frozen=True, eq=False)
class Apartment:
    """A generated apartment.

    Attributes:
        count, seed, detail: the arguments it was made with.
        rooms: floor plan, types, openings.
        surfaces: triangles by material, in order of the materials' names.
        start: (position, target) of the first view, (3,) world m each.
    """

    count: int
    seed: int
    detail: float
    rooms: tuple[Room, ...]
    surfaces: tuple[Surface, ...]
    start: tuple[np.ndarray, np.ndarray]

    @property
    def name(self) -> str:
        """`apartment_<rooms>r_<seed>`, with the detail if it is not 1."""
        tail = "" if self.detail == 1.0 else f"_d{self.detail:g}"
        return f"apartment_{self.count}r_{self.seed}{tail}"

    @property
    def triangles(self) -> int:
        """Number of triangles."""
        return sum(len(s.faces) for s in self.surfaces)

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest corner, (3,) float64 world m."""
        low = np.min([s.vertices.min(axis=0) for s in self.surfaces], axis=0).astype(np.float64)
        high = np.max([s.vertices.max(axis=0) for s in self.surfaces], axis=0).astype(np.float64)
        return low, high

    def texture(self, material: Material) -> Image.Image:
        """The image of a material; it depends on the seed and the material's name alone."""
        pixels = max(64, int(material.pixels * min(1.0, max(0.25, self.detail)) // 32) * 32)
        rng = np.random.default_rng([self.seed, zlib.crc32(material.name.encode())])
        values = np.clip(material.paint(rng, pixels), 0, 1)
        return Image.fromarray(np.rint(values * 255).astype(np.uint8), "RGB")

    def to_glb(self) -> bytes:
        """The scene as binary glTF: Z-up coordinates, one mesh per material, JPEG textures; always the same bytes."""
        scene = trimesh.Scene()
        for surface in self.surfaces:
            image = self.texture(surface.material)
            image.format = "JPEG"  # what the writer encodes
            material = PBRMaterial(
                name=surface.material.name,
                baseColorTexture=image,
                baseColorFactor=[255, 255, 255, 255],
                metallicFactor=0.0,
                roughnessFactor=1.0,
                doubleSided=True,
            )
            mesh = trimesh.Trimesh(
                surface.vertices,
                surface.faces,
                process=False,
                validate=False,
                visual=trimesh.visual.TextureVisuals(uv=surface.uv, material=material),
            )
            scene.add_geometry(mesh, node_name=surface.material.name, geom_name=surface.material.name)

        def describe(tree: dict[str, Any]) -> None:
            tree["asset"] = {
                "version": "2.0",
                "generator": "active3d",
                "extras": {"up": "Z", "units": "m", "name": self.name, "licence": "CC0-1.0"},
            }

        data = trimesh.exchange.gltf.export_glb(scene, include_normals=False, tree_postprocessor=describe)
        return data if isinstance(data, bytes) else bytes(data)

    def metadata(self) -> dict[str, Any]:
        """What `scene.json` beside the GLB says: name, licence, units, bounds, start pose, rooms."""
        low, high = self.bounds
        position, target = self.start

        def rounded(v: np.ndarray) -> list[float]:
            return [round(float(x), 4) for x in v]

        return {
            "name": self.name,
            "source": f"active3d scene make --rooms {self.count} --seed {self.seed}",
            "licence": "CC0-1.0",
            "kind": "single room" if self.count == 1 else "multi-room",
            "rooms": self.count,
            "room_types": [room.kind for room in self.rooms],
            "room_rectangles": [rounded(np.array(room.inner)) for room in self.rooms],
            "seed": self.seed,
            "detail": self.detail,
            "color_encoding": "textures hold display (sRGB) values",
            "texture_v": "glTF convention (v down)",
            "units": "m",
            "up_axis": "Z",
            "bbox_min": rounded(low),
            "bbox_max": rounded(high),
            "extent_m": rounded(high - low),
            "triangles": self.triangles,
            "materials": len(self.surfaces),
            "floor_z": 0.0,
            "enclosed_floor_area_m2": round(sum(room.area for room in self.rooms), 1),
            "start_pose": {"position": rounded(position), "look_at": rounded(target), "up": [0, 0, 1]},
        }


def make_apartment(rooms: int, seed: int, *, detail: float = 1.0) -> Apartment:
    """Generate an apartment.

    Args:
        rooms: number of rooms, 1..8.
        seed: any non-negative integer; the same arguments give the same apartment.
        detail: scales segments of curves, numbers of small things and (up to 1) texture resolution; 0.3 is a small
            scene for tests.

    Raises:
        ConfigError: an argument is out of range.
    """
    if not 1 <= rooms <= MAX_ROOMS:
        raise ConfigError(f"rooms={rooms}: expected 1..{MAX_ROOMS}")
    if seed < 0:
        raise ConfigError(f"seed={seed}: expected a non-negative integer")
    if not 0.1 <= detail <= 4:
        raise ConfigError(f"detail={detail}: expected 0.1..4")
    rng = np.random.default_rng([seed, rooms])
    layout = make_layout(rooms, rng)
    shared = make_shared(rng)
    builder = MeshBuilder(np.random.default_rng([seed, rooms, 1]), detail)
    hues = rng.permutation(HUES)
    floors = []
    for k, room in enumerate(layout):
        look = make_look(room.kind, f"{k}", float(hues[k]), shared, rng)
        build_room_shell(builder, k, room, look, int(rng.integers(4)), rng)
        furnisher = Furnisher(builder, room, look, rng, 4 * k)
        furnisher.furnish()
        floors.append(furnisher.floor)
    build_outer_shell(builder, layout, shared.shell)
    surfaces = _surfaces(builder)
    living = next(f for f in floors if f.room.kind == "living")
    return Apartment(rooms, seed, detail, tuple(layout), surfaces, _start(living, surfaces))


def _surfaces(builder: MeshBuilder) -> tuple[Surface, ...]:
    """The builder's triangles by material; those without area (poles of surfaces of revolution) are left out."""
    surfaces = []
    for _, part in sorted(builder.parts.items()):
        vertices = np.concatenate(part.vertices).astype(np.float32)
        faces = np.concatenate(part.faces).astype(np.int32)
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        solid = np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-10
        surfaces.append(Surface(part.material, vertices, faces[solid], np.concatenate(part.uv).astype(np.float32)))
    return tuple(surfaces)


def _start(floor: Floor, surfaces: tuple[Surface, ...]) -> tuple[np.ndarray, np.ndarray]:
    """A first view: from a roomy place as far to the side as possible, across the room."""
    index = SurfaceIndex(
        np.concatenate([s.vertices[s.faces].reshape(-1, 3) for s in surfaces]),
        np.arange(3 * sum(len(s.faces) for s in surfaces)).reshape(-1, 3),
    )
    region = floor.region(floor.blocked)
    reach = np.ones_like(floor.blocked) if region is None else region
    cells = np.stack([*np.meshgrid(floor.xs, floor.ys, indexing="ij"), np.full(reach.shape, START_HEIGHT)], -1)
    distance = np.zeros(reach.shape)
    distance[reach] = index.distance(cells[reach])
    x0, y0, x1, y1 = floor.room.inner
    cx, cy = (x0 + x1) / 2, (y0 + y1) / 2
    away = np.hypot(cells[..., 0] - cx, cells[..., 1] - cy)
    score = np.where(distance >= min(0.45, float(distance.max())), away, -1.0)
    i, j = np.unravel_index(int(np.argmax(score)), score.shape)
    position = cells[i, j]
    target = np.array([cx, cy, 1.1]) if away[i, j] > 0.2 else np.array([x1, y1, 1.1])
    return position, target
