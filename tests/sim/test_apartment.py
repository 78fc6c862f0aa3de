"""Generated apartments: same bytes, closed, reachable in every room, honest metadata."""

import json
import struct
from functools import cache

import numpy as np
import pytest
from scipy import ndimage

from active3d_pipe.errors import ConfigError
from active3d_pipe.geometry.raycasting import SurfaceIndex
from active3d_pipe.sim.apartment import Apartment, make_apartment
from active3d_pipe.sim.apartment_layout import HEIGHT

AGENT_RADIUS = 0.2
CELL = 0.1
CASES = [(1, 0), (2, 3), (3, 7), (4, 1), (5, 11), (6, 2), (8, 5)]


@cache
def apartment(rooms: int, seed: int) -> Apartment:
    return make_apartment(rooms, seed, detail=0.3)


@cache
def surface(rooms: int, seed: int) -> SurfaceIndex:
    flat = apartment(rooms, seed)
    offsets = np.cumsum([0, *(len(s.vertices) for s in flat.surfaces)])
    vertices = np.concatenate([s.vertices for s in flat.surfaces])
    faces = np.concatenate([s.faces + o for s, o in zip(flat.surfaces, offsets)])
    return SurfaceIndex(vertices, faces)


@cache
def clearance_grid(rooms: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Free cells (X, Y, Z) connected to the start pose, and the centres of all cells.

    A cell is free when its clearance is half a cell more than the radius: clearance changes by at most the distance
    moved, so the agent fits everywhere on the way between two neighbouring free cells too.
    """
    flat = apartment(rooms, seed)
    low, high = flat.bounds
    axes = [np.arange(low[i] + CELL / 2, high[i], CELL) for i in range(2)] + [np.arange(0.5, 1.81, CELL)]
    centres = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    free = surface(rooms, seed).distance(centres.reshape(-1, 3)).reshape(centres.shape[:3]) >= AGENT_RADIUS + CELL / 2
    regions, _ = ndimage.label(free)
    start = np.asarray(flat.metadata()["start_pose"]["position"])
    index = tuple(int(np.argmin(np.abs(axes[i] - start[i]))) for i in range(3))
    assert regions[index] > 0
    return regions == regions[index], centres


@pytest.mark.parametrize(("rooms", "seed"), CASES)
def test_every_room_is_reachable_at_every_height(rooms, seed):
    reached, centres = clearance_grid(rooms, seed)
    for room in apartment(rooms, seed).rooms:
        x0, y0, x1, y1 = room.inner
        xy = centres[:, :, 0, :2]
        inside = (xy[..., 0] > x0) & (xy[..., 0] < x1) & (xy[..., 1] > y0) & (xy[..., 1] < y1)
        share = reached[inside].mean(axis=0)
        assert share.min() > 0.1, (room.kind, share)
        assert share.max() > 0.3, (room.kind, share)


@pytest.mark.parametrize(("rooms", "seed"), CASES)
def test_no_ray_escapes(rooms, seed):
    reached, centres = clearance_grid(rooms, seed)
    rng = np.random.default_rng(0)
    points = centres[reached]
    origins = points[rng.integers(0, len(points), 40_000)]
    directions = rng.standard_normal((len(origins), 3))
    t, _, _ = surface(rooms, seed).cast(np.concatenate([origins, directions], axis=1))
    assert np.isfinite(t).all()
    # The inner skin alone is closed: nothing is hit beyond the inner faces of the outside walls and the panes.
    hits = origins + t[:, None] * directions
    low, high = apartment(rooms, seed).bounds
    assert (hits[:, 2] > -0.01).all() and (hits[:, 2] < HEIGHT + 0.01).all()
    assert (hits[:, :2] > low[:2] + 0.01).all() and (hits[:, :2] < high[:2] - 0.01).all()


@pytest.mark.parametrize(("rooms", "seed"), CASES)
def test_start_pose_has_room(rooms, seed):
    pose = apartment(rooms, seed).metadata()["start_pose"]
    position, target = np.asarray(pose["position"]), np.asarray(pose["look_at"])
    assert surface(rooms, seed).distance(position[None])[0] >= 0.4
    assert np.linalg.norm(target - position) > 0.3


@pytest.mark.parametrize(("rooms", "seed"), CASES)
def test_plan(rooms, seed):
    flat = apartment(rooms, seed)
    assert len(flat.rooms) == rooms
    assert sum(room.kind == "living" for room in flat.rooms) == 1
    for room in flat.rooms:
        x0, y0, x1, y1 = room.inner
        assert 2.6 < x1 - x0 < 5.7 and 2.6 < y1 - y0 < 5.7
    for a in range(rooms):
        for b in range(a):
            p, q = flat.rooms[a].rect, flat.rooms[b].rect
            overlap = min(p[2], q[2]) - max(p[0], q[0]), min(p[3], q[3]) - max(p[1], q[1])
            assert min(overlap) < 1e-9


def test_same_arguments_give_the_same_bytes():
    first, second = make_apartment(1, 4, detail=0.3), make_apartment(1, 4, detail=0.3)
    assert first.to_glb() == second.to_glb()
    assert first.metadata() == second.metadata()
    assert make_apartment(1, 5, detail=0.3).to_glb() != first.to_glb()


def read_glb(data: bytes) -> tuple[dict, bytes]:
    assert data[:4] == b"glTF" and struct.unpack("<I", data[8:12])[0] == len(data)
    length = struct.unpack("<I", data[12:16])[0]
    return json.loads(data[20 : 20 + length]), data[20 + length + 8 :]


def test_glb_holds_z_up_metres_one_textured_mesh_per_material():
    flat = apartment(1, 0)
    tree, blob = read_glb(flat.to_glb())
    assert tree["asset"]["extras"]["up"] == "Z"
    assert len(tree["meshes"]) == len(tree["materials"]) == len(flat.surfaces)
    for node in tree["nodes"]:
        assert "rotation" not in node
        assert np.allclose(node.get("matrix", np.eye(4).ravel()), np.eye(4).ravel())
    for material in tree["materials"]:
        assert "baseColorTexture" in material["pbrMetallicRoughness"]
        assert material["doubleSided"]
    accessors = [tree["accessors"][m["primitives"][0]["attributes"]["POSITION"]] for m in tree["meshes"]]
    meta = flat.metadata()
    assert np.allclose(np.min([a["min"] for a in accessors], axis=0), meta["bbox_min"], atol=1e-3)
    assert np.allclose(np.max([a["max"] for a in accessors], axis=0), meta["bbox_max"], atol=1e-3)
    faces = sum(tree["accessors"][m["primitives"][0]["indices"]]["count"] for m in tree["meshes"]) // 3
    assert faces == meta["triangles"] == flat.triangles
    assert len(blob) < 3_000_000


def test_metadata():
    meta = apartment(3, 7).metadata()
    assert json.loads(json.dumps(meta)) == meta
    assert (meta["units"], meta["up_axis"], meta["licence"]) == ("m", "Z", "CC0-1.0")
    assert (meta["rooms"], meta["seed"]) == (3, 7)
    assert 35 < meta["enclosed_floor_area_m2"] < 60
    assert 2.8 < meta["extent_m"][2] < 3.0
    low, high = np.array(meta["bbox_min"]), np.array(meta["bbox_max"])
    assert np.allclose(low[:2] + high[:2], 0, atol=1e-3)
    position = np.array(meta["start_pose"]["position"])
    assert (position > low).all() and (position < high).all()


def test_full_detail_has_the_promised_size():
    flat = make_apartment(3, 7)
    assert 20_000 < flat.triangles < 150_000
    kinds = {room.kind for room in flat.rooms}
    assert len(kinds) == 3


def test_textures_have_detail_at_all_scales():
    """Contrast between neighbouring texels and between blocks of 16: neither is lost."""
    flat = apartment(2, 3)
    for surface_ in flat.surfaces:
        image = np.asarray(flat.texture(surface_.material), dtype=np.float32).mean(axis=2)
        n = image.shape[0] // 16 * 16
        blocks = image[:n, :n].reshape(n // 16, 16, n // 16, 16).mean(axis=(1, 3))
        fine = image[:n, :n] - np.kron(blocks, np.ones((16, 16)))
        assert fine.std() > 1.0, surface_.material.name
        assert blocks.std() > 0.5, surface_.material.name


def test_normals_of_the_shell_face_the_room():
    """The renderer lights both sides, other viewers do not."""
    flat = apartment(1, 0)
    surfaces = {s.material.name: s for s in flat.surfaces}
    for name, sign in (("floor_0", 1), ("ceiling", -1)):
        s = surfaces[name]
        a, b, c = (s.vertices[s.faces[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        biggest = np.argmax(np.linalg.norm(normal, axis=1))
        assert sign * normal[biggest, 2] > 0


@pytest.mark.parametrize("arguments", [(0, 1), (9, 1), (2, -1)])
def test_bad_arguments(arguments):
    with pytest.raises(ConfigError, match="expected"):
        make_apartment(*arguments)


def test_bad_detail():
    with pytest.raises(ConfigError, match="detail"):
        make_apartment(1, 1, detail=0.0)
