"""Every format: what is written is what is read, equal input gives equal bytes, damage is one clear error."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from active3d_pipe.errors import ArtifactError
from active3d_pipe.geometry import se3
from active3d_pipe.storage import capture_log, files, meshes, splats, volumes
from active3d_pipe.structures import VOLUMES, Camera, Frame, GaussianModel, TriangleMesh, UncertaintyVolume, VoxelGrid


def digest(path: Path) -> str:
    """One digest for a file or a folder tree."""
    h = hashlib.sha256()
    for p in sorted([path, *path.rglob("*")] if path.is_dir() else [path]):
        if p.is_file():
            h.update(p.relative_to(path).as_posix().encode() + p.read_bytes())
    return h.hexdigest()


def frames(n: int = 3) -> list[Frame]:
    rng = np.random.default_rng(1)
    camera = Camera.from_fov(32, 18, 90.0, far=7.5)
    return [
        Frame(
            10 + i, (10 + i) * capture_log.STEP_NS, camera, se3.look_at([i * 0.1, 0, 1], [1, 2, 0.5]),
            rng.integers(0, 256, (18, 32, 3), dtype=np.uint8), rng.uniform(0, 5, (18, 32)).astype(np.float32),
        )
        for i in range(n)
    ]


def volume() -> UncertaintyVolume:
    rng = np.random.default_rng(2)
    grid = VoxelGrid(np.array([-1.0, 0.5, 0]), 0.1, (7, 5, 4))
    arrays = {name: rng.uniform(0, 1, grid.shape).astype(np.float32) for name in VOLUMES}
    return UncertaintyVolume(grid, 3, arrays, {"alphas": [0.2, 0.3, 0.5], "noise": 0.25}, (120.5, -3.25))


def gaussians(n: int = 20) -> GaussianModel:
    rng = np.random.default_rng(3)
    return GaussianModel(*(rng.normal(size=s).astype(np.float32) for s in ((n, 3), (n, 3), (n, 4), (n,), (n, 3))))


def test_capture_log_round_trip_and_same_bytes(tmp_path: Path) -> None:
    written, path = frames(), np.stack([f.T_world_camera for f in frames()])
    for name in ("a.mcap", "b.mcap"):
        capture_log.write_frames(tmp_path / name, written, path)
    assert digest(tmp_path / "a.mcap") == hashlib.sha256(b"." + (tmp_path / "a.mcap").read_bytes()).hexdigest()
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()
    read = capture_log.read_frames(tmp_path / "a.mcap")
    assert [f.step for f in read] == [10, 11, 12]
    for a, b in zip(written, read, strict=True):
        assert a.camera == b.camera
        assert a.stamp_ns == b.stamp_ns
        np.testing.assert_array_equal(a.rgb, b.rgb)
        np.testing.assert_array_equal(a.depth, b.depth)
        np.testing.assert_allclose(a.T_world_camera, b.T_world_camera, atol=1e-12)
        # What a process keeps in memory instead of reading the log must be the same to the last bit.
        kept = capture_log.as_logged(a)
        assert kept.T_world_camera.tobytes() == b.T_world_camera.tobytes()
        assert (kept.step, kept.stamp_ns, kept.camera) == (b.step, b.stamp_ns, b.camera)


@pytest.mark.parametrize("damage", ["truncate", "flip", "empty", "missing"])
def test_damaged_capture_log_is_one_error(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "frames.mcap"
    capture_log.write_frames(path, frames(), np.zeros((0, 4, 4)))
    blob = bytearray(path.read_bytes())
    if damage == "missing":
        path.unlink()
    else:
        if damage == "truncate":
            blob = blob[: len(blob) // 2]
        elif damage == "flip":
            blob[len(blob) // 2] ^= 4
        else:
            blob = bytearray()
        path.write_bytes(blob)
    with pytest.raises(ArtifactError, match=r"frames\.mcap"):
        capture_log.read_frames(path)


def test_volume_round_trip_and_same_bytes(tmp_path: Path) -> None:
    v = volume()
    volumes.write_volume(tmp_path / "a.zarr", v)
    volumes.write_volume(tmp_path / "b.zarr", v)
    assert digest(tmp_path / "a.zarr") == digest(tmp_path / "b.zarr")
    w = volumes.read_volume(tmp_path / "a.zarr")
    assert w.round == 3
    assert w.grid.shape == v.grid.shape
    assert w.fusion == v.fusion and w.drop_bits == v.drop_bits
    np.testing.assert_array_equal(w.grid.origin, v.grid.origin)
    for name in VOLUMES:
        np.testing.assert_array_equal(v[name], w[name])


def test_volume_opens_in_xarray_with_names_and_metres(tmp_path: Path) -> None:
    xr = pytest.importorskip("xarray")
    v = volume()
    volumes.write_volume(tmp_path / "v.zarr", v)
    ds = xr.open_zarr(tmp_path / "v.zarr", group="scale0", consolidated=False)
    assert ds["u_final"].dims == ("round", "x", "y", "z")
    np.testing.assert_allclose(ds["x"].values, v.grid.axis(0))
    at = ds["u_final"].sel(x=v.grid.axis(0)[2], y=v.grid.axis(1)[1], z=v.grid.axis(2)[3], method="nearest")
    assert float(at.squeeze()) == v["u_final"][2, 1, 3]


@pytest.mark.parametrize("damage", ["flip", "delete", "metadata"])
def test_damaged_volume_is_one_error(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "v.zarr"
    volumes.write_volume(path, volume())
    chunk = path / "scale0" / "sdf" / "c" / "0" / "0" / "0" / "0"
    if damage == "flip":
        blob = bytearray(chunk.read_bytes())
        blob[len(blob) // 2] ^= 1
        chunk.write_bytes(blob)
    elif damage == "delete":
        chunk.unlink()
    else:
        (path / "scale0" / "sdf" / "zarr.json").write_text("{")
    with pytest.raises(ArtifactError, match=r"v\.zarr"):
        volumes.read_volume(path)


def test_splats_round_trip(tmp_path: Path) -> None:
    g = gaussians()
    splats.write_splats(tmp_path / "g.ply", g)
    h = splats.read_splats(tmp_path / "g.ply")
    np.testing.assert_array_equal(g.means, h.means)
    np.testing.assert_array_equal(g.log_scales, h.log_scales)
    np.testing.assert_allclose(g.colors, h.colors, atol=1e-6)
    np.testing.assert_allclose(g.quats / np.linalg.norm(g.quats, axis=1, keepdims=True), h.quats, atol=1e-6)
    (tmp_path / "g.ply").write_bytes((tmp_path / "g.ply").read_bytes()[:-3])
    with pytest.raises(ArtifactError, match=r"g\.ply"):
        splats.read_splats(tmp_path / "g.ply")


def test_mesh_round_trip_and_glb_stands_upright(tmp_path: Path) -> None:
    import trimesh

    mesh = TriangleMesh(
        np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 2]], np.float32),
        np.array([[0, 1, 2], [0, 1, 3]], np.int32), np.full((4, 3), 90, np.uint8),
    )
    meshes.write_mesh_ply(tmp_path / "m.ply", mesh)
    back = meshes.read_mesh(tmp_path / "m.ply")
    np.testing.assert_array_equal(mesh.vertices, back.vertices)
    np.testing.assert_array_equal(mesh.faces, back.faces)
    np.testing.assert_array_equal(mesh.colors, back.colors)
    meshes.write_mesh_glb(tmp_path / "m.glb", mesh)
    low, high = trimesh.load(tmp_path / "m.glb").bounds
    np.testing.assert_allclose(high - low, [1, 2, 1], atol=1e-6)  # height along glTF's y


def test_an_empty_mesh_comes_back_empty(tmp_path):
    nothing = TriangleMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.uint8))
    meshes.write_mesh_ply(tmp_path / "m.ply", nothing)
    back = meshes.read_mesh(tmp_path / "m.ply")
    assert back.vertices.shape == back.faces.shape == back.colors.shape == (0, 3)


def test_tensors_round_trip_same_bytes_and_damage(tmp_path: Path) -> None:
    tensors = {"b": np.arange(5, dtype=np.float32), "a": np.ones((2, 3), np.int64), "scalar": np.array(2.0)}
    files.write_tensors(tmp_path / "t1", tensors, {"step": 3, "names": ["x"]})
    files.write_tensors(tmp_path / "t2", dict(reversed(tensors.items())), {"names": ["x"], "step": 3})
    assert (tmp_path / "t1").read_bytes() == (tmp_path / "t2").read_bytes()
    read, document = files.read_tensors(tmp_path / "t1")
    assert document == {"step": 3, "names": ["x"]}
    for name, array in tensors.items():
        assert read[name].shape == array.shape
        np.testing.assert_array_equal(read[name], array)
    (tmp_path / "t1").write_bytes(b"\xff" * 40)
    with pytest.raises(ArtifactError, match="t1"):
        files.read_tensors(tmp_path / "t1")


def test_tensors_are_the_file_that_the_library_writes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from safetensors.numpy import save

    rng = np.random.default_rng(0)
    types = ("bool", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f2", "f4", "f8")
    tensors = {f"{i % 3}_{t}": (50 * rng.random((i % 4, 3, 5))).astype(t) for i, t in enumerate(types)}
    tensors["turned"] = np.arange(12, dtype=np.float32).reshape(3, 4).T
    monkeypatch.setattr(files, "PIECE", 7)
    files.write_tensors(tmp_path / "t", tensors, {"a": "b\u00e4"})
    contiguous = {name: np.ascontiguousarray(a) for name, a in tensors.items()}
    assert (tmp_path / "t").read_bytes() == save(contiguous, {"active3d": json.dumps({"a": "b\u00e4"})})
    assert {n: (a.dtype, a.shape) for n, a in files.read_tensors(tmp_path / "t")[0].items()} == {
        n: (a.dtype, a.shape) for n, a in tensors.items()
    }


def test_tensors_into_a_missing_folder_keep_their_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        files.write_tensors(tmp_path / "missing" / "t", {"a": np.zeros(2)})
    with pytest.raises(IsADirectoryError):
        files.write_tensors(tmp_path, {"a": np.zeros(2)})
