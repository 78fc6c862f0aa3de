import json

import numpy as np
import pytest
import trimesh

from active3d_pipe.errors import InputError
from active3d_pipe.sim import placement
from active3d_pipe.sim.config import SceneSettings
from active3d_pipe.sim.digest import source_digest
from active3d_pipe.sim.scene import load_scene
from tests.sim.scenes import Room, checker, write_glb, write_obj, write_quad_ply

EXTENT = [5.0, 4.0, 2.6]


def load(path, **settings):
    return load_scene(SceneSettings(file=str(path), **settings))


@pytest.mark.parametrize("write", [write_glb, write_obj, write_quad_ply])
def test_every_format_gives_the_same_geometry(write, tmp_path):
    suffix = {write_glb: "glb", write_obj: "obj", write_quad_ply: "ply"}[write]
    scene = load(write(tmp_path / f"room.{suffix}", Room()))
    assert scene.vertices.dtype == np.float32 and scene.faces.dtype == np.int32
    assert len(scene.faces) == 4 * 6 * 2
    assert np.ptp(scene.vertices, axis=0) == pytest.approx(EXTENT, abs=1e-5)
    area = 2 * (5 * 4 + 5 * 2.6 + 4 * 2.6) + 2 * (0.6 + 0.8 + 0.48) + 2 * (1 + 0.5 + 0.5) + 2 * (0.3 + 1.9 + 0.57)
    assert placement.face_areas(scene.vertices, scene.faces)[0].sum() == pytest.approx(area, rel=1e-5)
    assert scene.name == "room"
    assert scene.up_axis == "Z" and scene.unit_scale == 1
    assert scene.bounds_low == pytest.approx([-0.05] * 3)
    assert scene.bounds_high == pytest.approx(np.array(EXTENT) + 0.05)


@pytest.mark.parametrize("write", [write_glb, write_obj])
def test_textures_and_base_colours_are_taken_as_display_values(write, tmp_path):
    scene = load(write(tmp_path / f"room.{'glb' if write is write_glb else 'obj'}", Room()))
    wall = next(m for m in scene.materials if m.mips)
    assert np.array_equal(wall.mips[0][..., :3], checker())
    assert wall.base_color == pytest.approx([1, 1, 1])
    plain = next(m for m in scene.materials if not m.mips)
    assert plain.base_color == pytest.approx([0.2, 0.4, 0.6], abs=0.003)


@pytest.mark.parametrize("write", [write_glb, write_obj])
def test_texture_coordinates_are_image_coordinates(write, tmp_path):
    # In the files v points up, one repetition a metre: on the floor (u, v) = (x, y), rows count downwards from v = 1.
    scene = load(write(tmp_path / f"room.{'glb' if write is write_glb else 'obj'}", Room()))
    floor = np.flatnonzero((np.abs(scene.vertices[scene.faces][..., 2]) < 1e-6).all(axis=1))
    floor = [f for f in floor if scene.materials[scene.face_material[f]].mips]
    assert len(floor) == 2
    for f in floor:
        xy = scene.vertices[scene.faces[f], :2]
        assert scene.uv[f, :, 0] == pytest.approx(xy[:, 0], abs=1e-5)
        assert scene.uv[f, :, 1] == pytest.approx(1 - xy[:, 1], abs=1e-5)


def test_quads_with_vertex_colours(tmp_path):
    for binary in (True, False):
        scene = load(write_quad_ply(tmp_path / "room.ply", Room(), binary=binary))
        assert sorted(map(tuple, np.unique(scene.vertex_colors, axis=0).tolist())) == [(51, 102, 153), (200, 180, 160)]


def test_float_colours_up_to_one_are_display_values(tmp_path):
    scene = load(write_quad_ply(tmp_path / "room.ply", Room(), float_colors=1.0))
    assert sorted(map(tuple, np.unique(scene.vertex_colors, axis=0).tolist())) == [(51, 102, 153), (200, 180, 160)]


def test_high_dynamic_range_colours_are_exposed(tmp_path):
    scene = load(write_quad_ply(tmp_path / "room.ply", Room(), float_colors=12.0))
    wall, box = scene.vertex_colors[0].astype(int), scene.vertex_colors[-1].astype(int)
    assert 220 <= wall.max() <= 235  # the brightest percentiles land near display 0.9
    assert wall[0] > wall[1] > wall[2] and box[0] < box[1] < box[2]
    assert wall.sum() > box.sum()


def test_mixed_polygons_in_a_ply(tmp_path):
    points = ["0 0 0", "4 0 0", "4 4 0", "0 4 0", "0 0 3", "4 0 3", "4 4 3", "0 4 3"]
    polygons = ["4 0 1 2 3", "4 4 5 6 7", "4 0 1 5 4", "3 1 2 6", "3 1 6 5", "4 2 3 7 6", "4 3 0 4 7"]
    header = ["ply", "format ascii 1.0", "element vertex 8", "property float x", "property float y", "property float z",
              f"element face {len(polygons)}", "property list uchar int vertex_indices", "end_header"]
    path = tmp_path / "mixed.ply"
    path.write_text("\n".join(header + points + polygons) + "\n")
    scene = load(path)
    assert len(scene.faces) == 12
    assert placement.face_areas(scene.vertices, scene.faces)[0].sum() == pytest.approx(2 * 16 + 4 * 12)


def test_node_transforms_are_applied(tmp_path):
    transform = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3], [4, 5, 6])
    plain = load(write_glb(tmp_path / "a.glb", Room()))
    moved = load(write_glb(tmp_path / "b.glb", Room(), node_transform=transform))
    assert moved.vertices == pytest.approx(plain.vertices, abs=1e-4)


@pytest.mark.parametrize(("scale", "unit"), [(1, 1), (1000, 0.001), (100, 0.01), (39.3701, 0.0254)])
@pytest.mark.parametrize("to_y_up", [False, True])
def test_units_and_up_axis_are_found(tmp_path, scale, unit, to_y_up):
    scene = load(write_glb(tmp_path / "room.glb", Room(scale=scale, to_y_up=to_y_up)))
    assert scene.up_axis == ("Y" if to_y_up else "Z")
    assert scene.unit_scale == unit
    assert np.ptp(scene.vertices, axis=0) == pytest.approx(EXTENT, rel=1e-4)
    assert scene.vertices[:, 2].min() == pytest.approx(0, abs=1e-4)


@pytest.mark.parametrize("axis", list(placement.UP_AXES))
def test_given_axis_and_unit_win(tmp_path, axis):
    rotation = placement.UP_AXES[axis]
    assert np.linalg.det(rotation) == pytest.approx(1)
    sign, name = (-1, axis[1]) if axis.startswith("-") else (1, axis)
    unit = sign * np.eye(3)["XYZ".index(name)]
    assert rotation @ unit == pytest.approx([0, 0, 1])
    scene = load(write_glb(tmp_path / "room.glb", Room()), up_axis="-Z", unit_scale=2.0)
    assert np.ptp(scene.vertices, axis=0) == pytest.approx(2 * np.array(EXTENT), rel=1e-5)
    assert scene.vertices[:, 2].max() == pytest.approx(0, abs=1e-5)


def test_start_pose_is_found_in_free_space(room_scene, room_sim):
    position = room_scene.start_pose[:3, 3]
    assert position[2] == pytest.approx(1.3, abs=0.01)
    assert room_sim.clearance(position[None])[0] > 0.6
    assert (np.median(room_sim.depth(room_scene.start_pose))) > 1.0


def test_settings_and_sidecar_decide_the_start_pose(tmp_path):
    path = write_glb(tmp_path / "scene.glb", Room())
    document = {"units": "m", "up_axis": "Z", "start_pose": {"position": [3, 2, 1.5], "look_at": [3, 3, 1.5]}}
    path.with_name("scene.json").write_text(json.dumps(document))
    scene = load(path)
    assert scene.name == tmp_path.name
    assert scene.start_pose[:3, 3] == pytest.approx([3, 2, 1.5])
    assert scene.start_pose[:3, 2] == pytest.approx([0, 1, 0])
    given = load(path, start_position=(2.5, 2.2, 1.0), start_look_at=(1.5, 2.2, 1.0))
    assert given.start_pose[:3, 3] == pytest.approx([2.5, 2.2, 1.0])
    assert given.start_pose[:3, 2] == pytest.approx([-1, 0, 0])
    bounded = load(path, bounds=((0, 0, 0), (4, 4, 2)))
    assert bounded.bounds_high == pytest.approx([4, 4, 2])


def test_bounds_leave_out_far_debris(tmp_path):
    path = write_glb(tmp_path / "room.glb", Room())
    scene = trimesh.load_scene(str(path), process=False)
    speck = trimesh.creation.box((0.01, 0.01, 0.01))
    speck.apply_translation([40, 0, 1])
    scene.add_geometry(speck)
    path.write_bytes(scene.export(file_type="glb"))
    assert load(path, up_axis="Z").bounds_high == pytest.approx(np.array(EXTENT) + 0.05)


def test_faces_without_area_or_number_are_left_out(tmp_path):
    path = write_obj(tmp_path / "room.obj", Room())
    text = path.read_text() + "v nan 0 0\nv 1 1 1\nv 2 2 2\nusemtl plain\nf -3 -2 -1\nf -2 -2 -1\nf -1 -2 -1\n"
    path.write_text(text)
    assert len(load(path).faces) == 48


def test_digest_covers_what_the_file_refers_to(tmp_path):
    path = write_obj(tmp_path / "room.obj", Room())
    first = source_digest(str(path))
    assert load(path).source_digest == first
    path.with_suffix(".mtl").write_text(path.with_suffix(".mtl").read_text().replace("0.2", "0.3"))
    assert source_digest(str(path)) != first


def _no_faces(path):
    path.write_text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
                    "end_header\n0 0 0\n")


def _flat(path):
    path.write_text("ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
                    "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
                    "0 0 0\n1 0 0\n2 0 0\n3 0 1 2\n")


@pytest.mark.parametrize(
    ("name", "write", "message"),
    [
        ("", None, "scene.file is not set"),
        ("missing.glb", None, "no such file"),
        ("folder.glb", lambda p: p.mkdir(), "is not a file"),
        ("scene.fbx", lambda p: p.write_bytes(b"x"), "unknown format '.fbx'"),
        ("broken.glb", lambda p: p.write_bytes(b"glTF" + bytes(range(90))), "cannot be read as glb"),
        ("empty.glb", lambda p: p.write_bytes(b""), "cannot be read as glb"),
        ("broken.gltf", lambda p: p.write_text("{"), "cannot be read as gltf"),
        ("broken.ply", lambda p: p.write_bytes(b"ply\nformat nonsense\n"), "cannot be read as ply"),
        ("points.ply", _no_faces, "holds no faces"),
        ("flat.ply", _flat, "no face has an area"),
        ("empty.obj", lambda p: p.write_text("# nothing\n"), "empty.obj"),
    ],
)
def test_bad_files_are_one_clear_line(tmp_path, name, write, message):
    path = tmp_path / name if name else ""
    if write is not None:
        write(path)
    with pytest.raises(InputError, match=message) as caught:
        load(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("cut", [0.05, 0.3, 0.7, 0.98])
def test_truncated_glb(room_file, tmp_path, cut):
    data = room_file.read_bytes()
    path = tmp_path / "cut.glb"
    path.write_bytes(data[: int(cut * len(data))])
    with pytest.raises(InputError) as caught:
        load(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"unit_scale": 0.001}, "is no indoor scene"),
        ({"unit_scale": 1e4}, "is no indoor scene"),
        ({"start_position": (9.0, 0.0, 0.0)}, "outside the bounds"),
        ({"start_position": (1.5, 1.3, 0.82)}, "2.0 cm from a surface"),
        ({"start_position": (2.5, 2.0, 1.3), "start_look_at": (2.5, 2.0, 1.3)}, "equals the start position"),
        ({"bounds": ((0, 0, 0), (0, 1, 1))}, "low < high"),
    ],
)
def test_settings_that_do_not_fit(room_file, settings, message):
    with pytest.raises(InputError, match=message):
        load(room_file, up_axis="Z", **settings)


def test_a_scale_that_fits_no_unit(tmp_path):
    with pytest.raises(InputError, match=r"set scene\.unit_scale"):
        load(write_glb(tmp_path / "room.glb", Room(scale=1e-4)))


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ("{", "not readable as JSON"),
        ("[]", "JSON object"),
        ('{"up_axis": "W"}', "up_axis"),
        ('{"units": "li"}', "units"),
        ('{"start_pose": {"position": [1, 2]}}', "3 numbers"),
    ],
)
def test_bad_sidecar(tmp_path, document, message):
    path = write_glb(tmp_path / "scene.glb", Room())
    path.with_name("scene.json").write_text(document)
    with pytest.raises(InputError, match=message):
        load(path)


def test_no_free_space(tmp_path):
    # A pile of slabs leaves gaps of 10 cm.
    slab = trimesh.creation.box((3, 3, 0.1))
    vertices = np.concatenate([slab.vertices + np.array([0, 0, 0.2 * k]) for k in range(12)])
    faces = np.concatenate([slab.faces + 8 * k for k in range(12)])
    path = tmp_path / "pile.ply"
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    with pytest.raises(InputError, match="no free space"):
        load(path, up_axis="Z")


def test_a_scene_without_ceiling_is_accepted_with_a_warning(tmp_path):
    path = write_glb(tmp_path / "room.glb", Room())
    scene = trimesh.load_scene(str(path), process=False)
    mesh = next(g for g in scene.geometry.values() if len(g.visual.uv) and g.bounds[1][2] > 2.5)
    mesh.update_faces(~(mesh.triangles[..., 2] > 2.5).all(axis=1))
    path.write_bytes(scene.export(file_type="glb"))
    loaded = load(path, up_axis="Z")
    assert any("ceiling" in w for w in loaded.warnings)


def test_the_simulator_knows_the_scene_whatever_the_map_is_told(tmp_path):
    path = tmp_path / "room.ply"
    trimesh.creation.box(extents=EXTENT).export(path)
    told, unknown = load(path, up_axis="Z"), load(path, up_axis="Z", bounds="auto")
    np.testing.assert_array_equal(unknown.bounds_low, told.bounds_low)
    np.testing.assert_array_equal(unknown.bounds_high, told.bounds_high)
