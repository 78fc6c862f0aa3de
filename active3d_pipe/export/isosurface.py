"""The zero level of the SDF as a triangle mesh: blocked, coarse to fine, only where surface was observed."""

import numpy as np
from scipy.ndimage import binary_dilation

from active3d_pipe.errors import ConfigError, InputError
from active3d_pipe.export import kernels_marching as kernels
from active3d_pipe.export.config import MeshSettings
from active3d_pipe.geometry.lattice import LatticePoints, SdfQuery
from active3d_pipe.structures import TriangleMesh, VoxelGrid

UNKNOWN = np.float32(1e3)  # SDF of nodes that no marked cell has


def near_surface(hit_evidence: np.ndarray, dilate_voxels: int) -> np.ndarray:
    """(X, Y, Z) bool, voxels that a depth ray ended in and their neighbours up to `dilate_voxels` (26-connected)."""
    hit = np.asarray(hit_evidence) > 0
    if dilate_voxels == 0:
        return hit
    return binary_dilation(hit, structure=np.ones((3, 3, 3), bool), iterations=dilate_voxels)


def extract_mesh(
    query_sdf: SdfQuery,
    low: np.ndarray,
    high: np.ndarray,
    settings: MeshSettings,
    *,
    grid: VoxelGrid | None = None,
    observed: np.ndarray | None = None,
) -> TriangleMesh:
    """Marching cubes over the box [low, high].

    Args:
        query_sdf: SDF, asked at nodes of lattices of one block each.
        low, high: (3,) corners of the box, world, m.
        settings: cell size and block size; see `MeshSettings`.
        grid, observed: a voxel grid and a bool volume on it (`near_surface`, `near_readings`); outside of it no
            surface is extracted. Without them the whole box counts as observed.

    Returns:
        Mesh without colours; the faces' normals (right-hand rule) point into free space. Blocks are welded, small
        loose pieces are dropped.

    A cell of two by two by two is refined when the signs at its corners differ or a corner is within `refine_margin`
    fine cells of the surface: a plane through the cell parts its corners, a bent surface may pass between them.
    """
    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    if not (high > low).all():
        raise ConfigError(f"mesh bounds {low.tolist()} .. {high.tolist()}: expected low < high on every axis")
    if (grid is None) != (observed is None) or (grid is not None and observed is not None
                                                and observed.shape != grid.shape):
        raise InputError("mesh: `grid` and `observed` must be given together and have one shape")
    size, block = settings.voxel_size_m, settings.block_cells
    cells = np.maximum(np.ceil((high - low) / size - 1e-9).astype(int), 2)
    pieces, count = [], 0
    for start in np.ndindex(*(-(-int(n) // block) for n in cells)):
        base = np.array(start, np.int64) * block
        shape = np.minimum(base + block, cells + cells % 2) - base
        coarse = _observed_cells(low, base, shape // 2, size, grid, observed)
        piece = _block(query_sdf, low, base, coarse, settings) if coarse.any() else None
        if piece is not None:
            pieces.append((piece[0], piece[1], piece[2] + np.int32(count)))
            count += len(piece[0])
    if not pieces:
        return TriangleMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    vertices, keys, faces = (np.concatenate(parts) for parts in zip(*pieces, strict=True))
    mesh = TriangleMesh((low + vertices * size).astype(np.float32), faces)
    return drop_small_components(_weld(mesh, keys, block), settings.min_component_m2)


def _observed_cells(
    low: np.ndarray, base: np.ndarray, shape: np.ndarray, size: float, grid: VoxelGrid | None,
    observed: np.ndarray | None,
) -> np.ndarray:
    """(X, Y, Z) bool, which cells of two fine cells have their centre in an observed voxel."""
    if grid is None or observed is None:
        return np.ones(tuple(shape), bool)
    index, inside = [], []
    for d in range(3):
        centre = low[d] + (base[d] + 2 * np.arange(shape[d]) + 1) * size
        i = np.floor((centre - grid.origin[d]) / grid.voxel_size).astype(np.int64)
        inside.append((i >= 0) & (i < grid.shape[d]))
        index.append(np.clip(i, 0, grid.shape[d] - 1))
    x, y, z = inside
    return observed[np.ix_(*index)] & x[:, None, None] & y[:, None] & z


def _block(
    query_sdf: SdfQuery, low: np.ndarray, base: np.ndarray, coarse: np.ndarray, settings: MeshSettings
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Vertices (V, 3) float64 in lattice units, their keys (V, 4) and faces of one block; None if it is empty."""
    size = settings.voxel_size_m
    values, known = _blank(coarse.shape)
    _evaluate(query_sdf, coarse, low, base, 2, size, values, known)
    fine = np.zeros(tuple(2 * n for n in coarse.shape), bool)
    sdf, known = _blank(fine.shape)
    if not kernels.refine(coarse, values, settings.refine_margin * size, fine, sdf, known):
        return None
    _evaluate(query_sdf, fine, low, base, 1, size, sdf, known)
    triangles = kernels.count_triangles(fine, sdf, kernels.TRIANGLE_COUNT)
    if triangles == 0:
        return None
    vertices, keys = np.empty((3 * triangles, 3)), np.empty((3 * triangles, 4), np.int64)
    faces = np.empty((triangles, 3), np.int32)
    made = kernels.triangulate(
        fine, sdf, kernels.TRIANGLE_COUNT, kernels.TRIANGLE_EDGES, kernels.EDGE_CORNER, kernels.EDGE_AXIS, base,
        np.full((*sdf.shape, 3), -1, np.int32), vertices, keys, faces,
    )
    return vertices[:made].copy(), keys[:made].copy(), faces


def _blank(cells: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """SDF of the nodes of a block of cells, unknown everywhere, and which are known."""
    shape = tuple(n + 1 for n in cells)
    return np.full(shape, UNKNOWN), np.zeros(shape, bool)


def _evaluate(
    query_sdf: SdfQuery, cells: np.ndarray, low: np.ndarray, base: np.ndarray, step: int, size: float,
    sdf: np.ndarray, known: np.ndarray,
) -> None:
    """SDF at the nodes of the marked cells that are not known yet."""
    nodes = np.empty(sdf.size, np.int64)
    nodes = nodes[: kernels.gather_nodes(cells, known, nodes)]
    if len(nodes):
        x, y, z = (low[d] + (base[d] + step * np.arange(sdf.shape[d])) * size for d in range(3))
        sdf.reshape(-1)[nodes] = query_sdf(LatticePoints((x, y, z), nodes))


def _weld(mesh: TriangleMesh, keys: np.ndarray, block: int) -> TriangleMesh:
    """Merge the vertices that neighbouring blocks share on their common plane; keys (V, 4) name lattice edges."""
    across = keys[:, :3] % block == 0
    axis = keys[:, 3]
    border = ((across[:, 0] & (axis != 0)) | (across[:, 1] & (axis != 1)) | (across[:, 2] & (axis != 2)))
    picked = np.flatnonzero(border)
    extent = keys[:, :3].max(axis=0) + 1
    flat = ((keys[picked, 0] * extent[1] + keys[picked, 1]) * extent[2] + keys[picked, 2]) * 3 + axis[picked]
    _, first, inverse = np.unique(flat, return_index=True, return_inverse=True)
    target = np.arange(len(mesh.vertices), dtype=np.int32)
    target[picked] = picked[first[inverse.reshape(-1)]]
    return keep_faces(TriangleMesh(mesh.vertices, target[mesh.faces]), np.ones(len(mesh.faces), bool))


def keep_faces(mesh: TriangleMesh, keep: np.ndarray) -> TriangleMesh:
    """The mesh of the faces with `keep` (F,) bool, without unused vertices."""
    numbers = np.full(len(mesh.vertices), -1, np.int32)
    faces = np.empty((int(np.count_nonzero(keep)), 3), np.int32)
    kernels.keep_faces(mesh.faces, keep, numbers, faces)
    used = numbers >= 0
    colors = None if mesh.colors is None else mesh.colors[used]
    return TriangleMesh(mesh.vertices[used], faces, colors)


def drop_small_components(mesh: TriangleMesh, min_area_m2: float) -> TriangleMesh:
    """Drop the connected pieces (by shared vertices) of less than `min_area_m2`."""
    if min_area_m2 <= 0 or len(mesh.faces) == 0:
        return mesh
    labels = np.empty(len(mesh.vertices), np.int64)
    kernels.component_labels(mesh.faces, labels)
    area = np.zeros(len(labels))
    kernels.component_areas(mesh.vertices, mesh.faces, labels, area)
    return keep_faces(mesh, (area >= min_area_m2)[labels[mesh.faces[:, 0]]])
