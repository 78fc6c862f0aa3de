"""A topological graph of known-free space: the generalised Voronoi diagram of its outline on one level.

As ActiveSplat and ANM-S build it (Choset and Nagatani, "Topological SLAM", 2001): outline of the free space,
simplified, sampled along its edges; vertices of the Voronoi diagram of the samples that keep the agent's clearance;
dead-end chains cut; junctions kept. Adaptations: the level is the height of the start pose, in voxels of 0.1 m
instead of a picture of 360 px; nodes closer than `MERGE_M` are one; where fewer than `FEW` junctions remain (a convex
room has hardly any), the vertices of the whole diagram, thinned to `THIN_M`, are the nodes.
"""

import itertools
from dataclasses import dataclass

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import Voronoi
from skimage.measure import approximate_polygon, find_contours

from active3d_pipe.planning.free_space import FreeSpace
from active3d_pipe.planning.policies.base import nearest_reachable
from active3d_pipe.planning.policies.context import PolicyContext
from active3d_pipe.planning.policies.space import level_slice

TOLERANCE_VOXELS, SAMPLES_AN_EDGE = 1.0, 5
MERGE_M, THIN_M, FEW, SUBREGION_M = 0.4, 0.8, 3, 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Topology:
    """Nodes (N, 3) int64 voxels with their world positions (N, 3) m, and the distance between any two, (N, N) m."""

    voxels: np.ndarray
    positions: np.ndarray
    distance_m: np.ndarray

    def subregions(self) -> np.ndarray:
        """(N,) label of each node: average linkage on half the way plus half the straight line, cut at 2 m."""
        n = len(self.voxels)
        if n < 2:
            return np.ones(n, np.int64)
        straight = np.linalg.norm(self.positions[:, None] - self.positions[None], axis=-1)
        mixed = 0.5 * self.distance_m + 0.5 * straight
        upper = np.triu_indices(n, 1)
        return fcluster(linkage(mixed[upper], "average"), SUBREGION_M, "distance").astype(np.int64)


def topology(context: PolicyContext, space: FreeSpace) -> Topology:
    """The graph of the space that is reachable now; at least the node where the agent stands."""
    k = level_slice(space, float(context.walked_poses[0, 2, 3]))
    flat = space.reachable[:, :, k]
    nodes, distance = _junctions(flat, space.grid.voxel_size)
    low, size = space.grid.origin, space.grid.voxel_size
    world = np.column_stack([low[:2] + nodes * size, np.full(len(nodes), low[2] + (k + 0.5) * size)])
    voxels, found = nearest_reachable(space, world, MERGE_M)
    keep = np.flatnonzero(found)
    _, first = np.unique(voxels[keep], axis=0, return_index=True)
    keep = keep[np.sort(first)]
    if not len(keep):
        here = space.start[None]
        return Topology(here, space.grid.centre_of(here), np.zeros((1, 1)))
    return Topology(voxels[keep], space.grid.centre_of(voxels[keep]), distance[np.ix_(keep, keep)] * size)


def _junctions(flat: np.ndarray, voxel_size: float) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (N, 2) in voxel units (corner origin) and their distances along the diagram (N, N), voxels."""
    samples = _outline(flat)
    if len(samples) < 5:
        return np.zeros((0, 2)), np.zeros((0, 0))
    diagram = Voronoi(samples)
    vertices = diagram.vertices
    ij = np.floor(vertices).astype(np.int64)
    inside = ((ij >= 0) & (ij < flat.shape)).all(axis=1)
    inside[inside] = flat[tuple(ij[inside].T)]
    edges = np.array([e for e in diagram.ridge_vertices if e[0] >= 0 and inside[e[0]] and inside[e[1]]]).reshape(-1, 2)
    if not len(edges):
        return np.zeros((0, 2)), np.zeros((0, 0))
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1) + 1e-9
    n = len(vertices)
    graph = coo_array((length, (edges[:, 0], edges[:, 1])), shape=(n, n)).tocsr()
    _, part = connected_components(graph, directed=False)
    largest = np.bincount(part[np.unique(edges)]).argmax()
    used = np.array([v for v in np.unique(edges) if part[v] == largest])
    chosen = _merge(vertices, _branching(edges, used), MERGE_M / voxel_size)
    if len(chosen) < FEW:
        chosen = _merge(vertices, used, THIN_M / voxel_size)
    return vertices[chosen], dijkstra(graph, directed=False, indices=chosen)[:, chosen]


def _outline(flat: np.ndarray) -> np.ndarray:
    """(M, 2) samples along the simplified outline of a plane of free cells, in voxel units (corner origin)."""
    out = []
    for contour in find_contours(np.pad(flat, 1).astype(np.float64), 0.5):
        polygon = approximate_polygon(contour, TOLERANCE_VOXELS)
        for a, b in itertools.pairwise(polygon):
            out.append(a + (b - a) * (np.arange(SAMPLES_AN_EDGE) / SAMPLES_AN_EDGE)[:, None])
    return np.concatenate(out) - 0.5 if out else np.zeros((0, 2))


def _branching(edges: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Vertices with at least three edges after chains that end nowhere are cut."""
    alive = np.isin(edges, used).all(axis=1)
    while True:
        degree = np.bincount(edges[alive].ravel(), minlength=int(edges.max()) + 1)
        ends = alive & (degree[edges] == 1).any(axis=1)
        if not ends.any():
            return np.flatnonzero(degree >= 3)
        alive &= ~ends


def _merge(vertices: np.ndarray, candidates: np.ndarray, spacing: float) -> np.ndarray:
    """Some of the candidates, no two closer than `spacing`, first come first kept."""
    kept: list[int] = []
    for v in candidates:
        if all(np.linalg.norm(vertices[v] - vertices[w]) >= spacing for w in kept):
            kept.append(int(v))
    return np.array(kept, dtype=np.int64)
