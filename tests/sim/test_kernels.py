import numpy as np
import pytest
from scipy import ndimage

from active3d_pipe.sim import kernels, kernels_mesh, reference, shading
from active3d_pipe.sim.materials import mip_pyramid


def texture(height: int, width: int, sigma: float, seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, 1, (height, width, 3))
    smooth = np.stack([ndimage.gaussian_filter(noise[..., c], sigma, mode="wrap") for c in range(3)], axis=-1)
    rgb = np.clip(128 + 60 * smooth / smooth.std(), 0, 255).astype(np.uint8)
    return np.concatenate([rgb, np.full((height, width, 1), 255, np.uint8)], axis=-1)


def packed(mips) -> tuple[np.ndarray, np.ndarray]:
    texels, _ = shading.pack_texels(list(mips))
    sizes = [(m.shape[1], m.shape[0]) for m in mips]
    offsets = np.concatenate([[0], np.cumsum([w * h for w, h in sizes])[:-1]])
    return texels, np.array([(o, w, h) for o, (w, h) in zip(offsets, sizes)], dtype=np.int64)


def footprints(rng: np.random.Generator, count: int, size: int):
    """Random centres and footprints: sheared, rotated, from a tenth of a texel to sixty texels."""
    for _ in range(count):
        angle, turn = rng.uniform(0, 2 * np.pi, 2)
        long = 10 ** rng.uniform(-1, 1.8)
        short = long / rng.uniform(1, 12)
        a, b = (np.array([[np.cos(x), -np.sin(x)], [np.sin(x), np.cos(x)]]) for x in (angle, turn))
        yield rng.uniform(-3, 3, 2), a @ np.diag([long, short]) @ b / size


def kernel_value(texels, levels, uv, du_dv, bias, probes) -> np.ndarray:
    args = [np.float32(x) for x in (*uv, du_dv[0, 0], du_dv[1, 0], du_dv[0, 1], du_dv[1, 1], bias)]
    return np.array(kernels.filtered_texture(texels, levels, 0, len(levels), *args, probes))


@pytest.mark.parametrize("shape", [(64, 64), (50, 33), (1, 8)])
def test_texture_filter_matches_the_reference(shape):
    mips = mip_pyramid(texture(*shape, 1.0))
    texels, levels = packed(mips)
    for uv, du_dv in footprints(np.random.default_rng(1), 150, 64):
        expected = reference.filtered_texture(mips, uv, du_dv, -0.6, 8, float(kernels._SINGLE_LEVEL))
        # float32 coordinates, and a choice of level or probe count that may fall either way at a boundary.
        assert kernel_value(texels, levels, uv, du_dv, -0.6, 8) == pytest.approx(expected, abs=1.0)


def test_texture_filter_matches_the_reference_closely_on_average():
    mips = mip_pyramid(texture(64, 64, 1.0))
    texels, levels = packed(mips)
    differences = [
        kernel_value(texels, levels, uv, d, -0.6, 8)
        - reference.filtered_texture(mips, uv, d, -0.6, 8, float(kernels._SINGLE_LEVEL))
        for uv, d in footprints(np.random.default_rng(2), 150, 64)
    ]
    assert np.sqrt(np.mean(np.square(differences))) < 0.1


def test_texture_filter_comes_near_the_supersampled_pixel():
    image = texture(64, 64, 1.5)
    mips = mip_pyramid(image)
    texels, levels = packed(mips)
    filtered, point = [], []
    for uv, du_dv in footprints(np.random.default_rng(3), 60, 64):
        truth = reference.box_filtered_texture(image, uv, du_dv)
        filtered.append(kernel_value(texels, levels, uv, du_dv, shading.TEXTURE_BIAS, shading.MAX_PROBES) - truth)
        point.append(kernel_value(texels, levels, uv, np.zeros((2, 2)), 0.0, 8) - truth)
    filtered_error, point_error = (np.sqrt(np.mean(np.square(x))) for x in (filtered, point))
    assert filtered_error < 6
    assert filtered_error < 0.25 * point_error


def test_one_probe_comes_near_the_supersampled_pixel_on_round_footprints():
    image = texture(64, 64, 1.5)
    mips = mip_pyramid(image)
    texels, levels = packed(mips)
    rng, errors = np.random.default_rng(4), []
    for _ in range(40):
        uv, size = rng.uniform(0, 1, 2), rng.uniform(0.2, 2)
        du_dv = np.eye(2) * size / 64
        truth = reference.box_filtered_texture(image, uv, du_dv)
        errors.append(kernel_value(texels, levels, uv, du_dv, shading.TEXTURE_BIAS, 1) - truth)
    assert np.sqrt(np.mean(np.square(errors))) < 6


@pytest.mark.parametrize("shape", [(8, 8), (7, 5), (1, 6), (13, 1), (1, 1)])
def test_mip_levels_keep_the_mean(shape):
    image = np.random.default_rng(0).integers(0, 256, (*shape, 4)).astype(np.uint8)
    levels = mip_pyramid(image)
    assert levels[-1].shape == (1, 1, 4)
    for level in levels:
        assert level.reshape(-1, 4).mean(axis=0) == pytest.approx(image.reshape(-1, 4).mean(axis=0), abs=1.0)


def test_corner_normals_match_the_reference():
    # A wavy sheet (smooth) beside a step (crease), with some faces wound the other way.
    x, y = np.meshgrid(np.arange(6.0), np.arange(4.0), indexing="ij")
    z = 0.2 * np.sin(x) + np.where(x > 3, 3.0, 0.0) * (y > 1)
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    index = np.arange(24).reshape(6, 4)
    a, b, c, d = (q.ravel() for q in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    faces[::5] = faces[::5, ::-1]
    normals = shading.corner_normals(vertices, faces.astype(np.int32), 40.0) / 32767
    assert normals == pytest.approx(reference.corner_normals(vertices, faces, 40.0), abs=1e-4)


def test_corners_of_equal_position_but_other_index_are_smoothed_together():
    vertices = np.array([[0, 0, 0], [1, 0, 0.1], [0, 1, 0], [1, 0, 0.1], [0, 1, 0], [1, 1, 0.3]])
    faces = np.array([[0, 1, 2], [3, 5, 4]], dtype=np.int32)
    normals = shading.corner_normals(vertices, faces)
    assert np.array_equal(normals[0, 1], normals[1, 0])


def test_holes_are_texels_below_the_cutoff(masked_scene, room_sim):
    from active3d_pipe.sim.raycast import RaycastSimulator

    sim = RaycastSimulator(masked_scene, room_sim.camera, room_sim._settings)
    rays = np.array([[1, 2.5, 1, 1, 0, 0], [1, 1.5, 1, 1, 0, 0]], np.float32)
    from active3d_pipe.sim.rendering import Hits

    hits = Hits(rays, *sim.surface.cast(rays))
    assert hits.t == pytest.approx([2, 2])
    assert sim._holes(hits).tolist() == [True, False]


def test_plane_hits_match_the_ray_caster(room_sim):
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(500, 3))
    rays = np.concatenate([np.tile([2.5, 2.0, 1.3], (500, 1)), directions], axis=1).astype(np.float32)
    t, face, bary = room_sim.surface.cast(rays)
    scene = room_sim.scene
    t2, bary2 = np.empty_like(t), np.empty_like(bary)
    kernels_mesh.plane_hits(rays, face, scene.vertices, scene.faces, t2, bary2)
    assert t2 == pytest.approx(t, rel=1e-5)
    assert bary2 == pytest.approx(bary, abs=1e-4)
    corner = scene.vertices[scene.faces[face]]
    b1, b2 = bary2[:, :1], bary2[:, 1:]
    on_face = (1 - b1 - b2) * corner[:, 0] + b1 * corner[:, 1] + b2 * corner[:, 2]
    assert on_face == pytest.approx(rays[:, :3] + t2[:, None] * rays[:, 3:], abs=1e-4)
