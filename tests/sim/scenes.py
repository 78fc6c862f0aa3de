"""Small generated scenes: a furnished, textured room in every format that is read."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image
from scipy import ndimage


@dataclass
class Box:
    low: tuple
    high: tuple
    inward: bool = False


ROOM = Box((0, 0, 0), (5, 4, 2.6), inward=True)
FURNITURE = [Box((1, 1, 0), (2, 1.6, 0.8)), Box((3.6, 2.6, 0), (4.6, 3.6, 0.5)), Box((4.7, 0.5, 0), (5, 1.5, 1.9))]


def checker(size: int = 256, squares: int = 4, seed: int = 0) -> np.ndarray:
    """(size, size, 3) uint8 checkerboard with blotches of some 8 texels that differ by channel."""
    i, j = np.indices((size, size)) * squares // size
    base = np.where((i + j) % 2, 190.0, 70.0)[..., None]
    noise = np.random.default_rng(seed).normal(0, 200, (size, size, 3))
    blotches = np.stack([ndimage.gaussian_filter(noise[..., c], 4, mode="wrap") for c in range(3)], axis=-1)
    return np.clip(base + blotches, 0, 255).astype(np.uint8)


def box_mesh(box: Box, tile_m: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (24, 3), quads (6, 4) and uv (24, 2) of a box; every side has its own vertices."""
    low, high = np.array(box.low, float), np.array(box.high, float)
    vertices, quads, uv = [], [], []
    for axis in range(3):
        for side in (0, 1):
            a, b = [(1, 2), (2, 0), (0, 1)][axis]
            corners = []
            for s, t in ((0, 0), (1, 0), (1, 1), (0, 1)):
                p = low.copy()
                p[axis] = (low, high)[side][axis]
                p[a], p[b] = (low, high)[s][a], (low, high)[t][b]
                corners.append(p)
                uv.append([p[a] / tile_m, p[b] / tile_m])
            order = [0, 1, 2, 3] if (side == 1) != box.inward else [0, 3, 2, 1]
            quads.append([len(vertices) + k for k in order])
            vertices += corners
    return np.array(vertices), np.array(quads), np.array(uv)


def split_quads(quads: np.ndarray) -> np.ndarray:
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


@dataclass
class Room:
    """Options of a generated room file."""

    scale: float = 1.0
    to_y_up: bool = False
    boxes: list = field(default_factory=lambda: [ROOM, *FURNITURE])

    def points(self, vertices: np.ndarray) -> np.ndarray:
        v = vertices * self.scale
        return np.stack([v[:, 0], v[:, 2], -v[:, 1]], axis=-1) if self.to_y_up else v


def write_glb(path: Path, room: Room, node_transform: np.ndarray | None = None) -> Path:
    """The first box textured, the others in a base colour of display values (0.2, 0.4, 0.6)."""
    scene = trimesh.Scene()
    for k, box in enumerate(room.boxes):
        vertices, quads, uv = box_mesh(box)
        points = room.points(vertices)
        if node_transform is not None:
            inverse = np.linalg.inv(node_transform)
            points = points @ inverse[:3, :3].T + inverse[:3, 3]
        if k == 0:
            material = trimesh.visual.material.PBRMaterial(
                name="wall", baseColorTexture=Image.fromarray(checker()), baseColorFactor=[255, 255, 255, 255]
            )
        else:
            material = trimesh.visual.material.PBRMaterial(name=f"box{k}", baseColorFactor=[51, 102, 153, 255])
        visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
        mesh = trimesh.Trimesh(points, split_quads(quads), visual=visual, process=False)
        scene.add_geometry(mesh, geom_name=f"g{k}", transform=node_transform)
    path.write_bytes(scene.export(file_type="glb"))
    return path


def write_obj(path: Path, room: Room) -> Path:
    """OBJ with quads, a material library and a texture file."""
    Image.fromarray(checker()).save(path.with_name("wall.png"))
    path.with_suffix(".mtl").write_text(
        "newmtl wall\nKd 1 1 1\nmap_Kd wall.png\n\nnewmtl plain\nKd 0.2 0.4 0.6\n", encoding="utf-8"
    )
    lines, base = [f"mtllib {path.with_suffix('.mtl').name}"], 1
    for k, box in enumerate(room.boxes):
        vertices, quads, uv = box_mesh(box)
        lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in room.points(vertices)]
        lines += [f"vt {u:.6f} {v:.6f}" for u, v in uv]
        lines.append("usemtl wall" if k == 0 else "usemtl plain")
        lines += ["f " + " ".join(f"{base + i}/{base + i}" for i in quad) for quad in quads]
        base += len(vertices)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def write_quad_ply(path: Path, room: Room, float_colors: float | None = None, binary: bool = True) -> Path:
    """PLY of quads with vertex colours, as Replica's mesh.ply; `float_colors` = brightness of linear float colours."""
    all_vertices, all_quads, colors, base = [], [], [], 0
    for k, box in enumerate(room.boxes):
        vertices, quads, _ = box_mesh(box)
        all_vertices.append(room.points(vertices))
        all_quads.append(quads + base)
        base += len(vertices)
        colors.append(np.tile([[200, 180, 160], [51, 102, 153]][min(k, 1)], (len(vertices), 1)))
    vertices, quads, color = np.concatenate(all_vertices), np.concatenate(all_quads), np.concatenate(colors)
    kind = "uchar" if float_colors is None else "float"
    header = (
        f"ply\nformat {'binary_little_endian' if binary else 'ascii'} 1.0\nelement vertex {len(vertices)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        + "".join(f"property {kind} {c}\n" for c in ("red", "green", "blue"))
        + f"element face {len(quads)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    color_type = "u1" if float_colors is None else "<f4"
    record = np.zeros(len(vertices), [("p", "<f4", 3), ("c", color_type, 3)])
    record["p"], record["c"] = vertices, color if float_colors is None else color / 255 * float_colors
    face = np.zeros(len(quads), [("n", "u1"), ("i", "<i4", 4)])
    face["n"], face["i"] = 4, quads
    if binary:
        path.write_bytes(header.encode() + record.tobytes() + face.tobytes())
    else:
        rows = [" ".join(map(str, [*p, *c])) for p, c in zip(record["p"], record["c"])]
        rows += ["4 " + " ".join(map(str, q)) for q in quads]
        path.write_text(header + "\n".join(rows) + "\n", encoding="ascii")
    return path
