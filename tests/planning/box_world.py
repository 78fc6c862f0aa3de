"""A small true world for closed-loop tests: boxes in rooms, depth traced through its voxels, evidence carved."""

from dataclasses import dataclass, field

import numpy as np

from active3d_pipe.geometry import se3
from active3d_pipe.geometry.voxel_traversal import carve, trace_depth
from active3d_pipe.information.entropy import bernoulli_entropy
from active3d_pipe.information.gain import entropy_drop
from active3d_pipe.structures import Camera, Frame, UncertaintyVolume, VoxelGrid
from active3d_pipe.uncertainty.carving import integrate_depth
from active3d_pipe.uncertainty.config import UncertaintySettings

# Map voxels are 0.1 m; the world is built from voxels half as large, off the map's grid by a quarter.
VOXEL, FINE = 0.1, 0.05
EVERY_PIXEL = UncertaintySettings(ray_stride=1)


@dataclass
class BoxWorld:
    """Solid fine voxels and what the agent has learnt of them."""

    solid: np.ndarray
    fine: VoxelGrid
    grid: VoxelGrid
    camera: Camera
    free: np.ndarray = field(init=False)
    hit: np.ndarray = field(init=False)
    quality: np.ndarray = field(init=False)
    passed: np.ndarray = field(init=False)
    ended: np.ndarray = field(init=False)
    seen: np.ndarray = field(init=False)
    last: UncertaintyVolume | None = field(init=False, default=None)

    def __post_init__(self):
        self.free, self.hit = np.zeros(self.grid.shape, np.int32), np.zeros(self.grid.shape, np.int32)
        self.quality = np.zeros(self.grid.shape, np.float32)
        self.passed, self.ended = np.zeros(self.grid.shape, np.uint8), np.zeros(self.grid.shape, np.uint8)
        self.seen = np.zeros(self.fine.shape, bool)

    def capture(self, T, *, max_range_m=10.0):
        """One frame at a true pose; `seen` marks true surface voxels that it shows."""
        depth = trace_depth(self.solid, self.fine, T, self.camera, max_range_m=max_range_m)
        carve(self.grid, T, self.camera, depth, counts=(self.free, self.hit))
        blank = np.zeros((*depth.shape, 3), np.uint8)
        new = integrate_depth(self.grid, [Frame(0, 0, self.camera, T, blank, depth)], EVERY_PIXEL)
        self.passed |= new.passed
        self.ended |= new.ended
        rows, columns = np.nonzero(depth)
        rays = np.stack([
            (columns + 0.5 - self.camera.cx) / self.camera.fx, (rows + 0.5 - self.camera.cy) / self.camera.fy,
            np.ones(len(rows)),
        ], -1)
        points = se3.transform_points(T, rays * depth[rows, columns][:, None])
        d = rays @ T[:3, :3].T
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        ijk = self.fine.index_of(points + 1e-4 * d)
        inside = self.fine.contains_index(ijk)
        self.seen[tuple(ijk[inside].T)] = True
        # The face that was entered is the axis on which the point lies on a grid plane.
        local = (points - self.fine.origin) / FINE
        axis = np.abs(local - np.round(local)).argmin(axis=1)
        cos = np.abs(d[np.arange(len(d)), axis])
        distance = np.linalg.norm(points - T[:3, 3], axis=1)
        q = (cos * np.minimum(1, 0.005 * self.camera.fx / distance)).astype(np.float32)
        v = self.grid.index_of(points)
        ok = self.grid.contains_index(v)
        np.maximum.at(self.quality, tuple(v[ok].T), q[ok])
        return depth

    def volume(self, round_index=0, sdf=None):
        """The uncertainty volume that this evidence gives."""
        free, hit = self.free.astype(np.float32), self.hit.astype(np.float32)
        log_odds = np.clip(1.4 * np.minimum(hit, 20) - 0.4 * np.minimum(free, 20), -5, 5)
        occupancy = (1 / (1 + np.exp(-log_odds))).astype(np.float32)
        entropy = bernoulli_entropy(occupancy)
        unseen = (free + hit == 0).astype(np.float32)
        arrays = {name: np.zeros(self.grid.shape, np.float32) for name in ("u_imp", "u_exp", "u_time")}
        if sdf is None:
            sdf = np.where(free > hit, 0.1, -0.1).astype(np.float32)
        arrays.update(
            u_final=unseen, occupancy=occupancy, entropy_imp=entropy, entropy_exp=entropy, entropy=entropy,
            sdf=sdf, free_evidence=free, hit_evidence=hit, view_quality=self.quality,
            cells_passed=self.passed.astype(np.float32), cells_hit=self.ended.astype(np.float32),
        )
        drop = None if self.last is None else entropy_drop(self.last.arrays, arrays)
        self.last = UncertaintyVolume(self.grid, round_index, arrays, drop_bits=drop)
        return self.last

    def clearance(self, points):
        """True distance (m) of world points (N, 3) to the nearest solid fine voxel's cube."""
        out = np.empty(len(points))
        solid = np.argwhere(self.solid)
        low = self.fine.origin + solid * FINE
        for n, p in enumerate(points):
            near = (np.abs(low + FINE / 2 - p) < 0.7).all(axis=1)
            gap = np.maximum(np.maximum(low[near] - p, p - (low[near] + FINE)), 0)
            out[n] = np.linalg.norm(gap, axis=1).min(initial=0.7)
        return out


def camera():
    """90 x 60 degrees, few pixels."""
    return Camera(120, 69, 60.0, 60.0, 60.0, 34.5, 0.05, 10.0)


def build(size, boxes, walls=()):
    """A room of `size` (m) with outer walls of 0.2 m, inner walls with doors, and furniture boxes (low, high)."""
    size = np.asarray(size, float)
    thick = 0.2
    fine = VoxelGrid.from_bounds(np.full(3, -thick), size + thick, FINE)
    centre = fine.centres().astype(np.float64)
    solid = ((centre < 0) | (centre > size)).any(axis=-1)
    for low, high, doors in walls:
        inside = ((centre >= low) & (centre <= high)).all(axis=-1)
        for a, b in doors:
            inside &= ~((centre >= a) & (centre <= b)).all(axis=-1)
        solid |= inside
    for low, high in boxes:
        solid |= ((centre >= low) & (centre <= high)).all(axis=-1)
    grid = VoxelGrid.from_bounds(np.full(3, -0.225), size + 0.225, VOXEL)
    return BoxWorld(solid, fine, grid, camera())


def two_rooms():
    """7.4 x 4 x 2.4 m: two rooms, a door 0.8 m wide, a table, shelves, a sofa, a pillar."""
    wall = ((3.9, 0, 0), (4.05, 4, 2.4), [((3.8, 2.6, 0), (4.2, 3.4, 2.0))])
    boxes = [
        ((1.4, 1.2, 0.65), (2.6, 2.2, 0.75)), ((1.45, 1.25, 0), (1.55, 1.35, 0.7)),
        ((2.45, 2.05, 0), (2.55, 2.15, 0.7)),
        ((0, 3.2, 0), (1.2, 3.6, 1.8)), ((5.0, 0, 0), (6.6, 0.7, 0.8)), ((5.6, 2.0, 0), (5.9, 2.3, 2.4)),
        ((6.9, 3.0, 0.9), (7.4, 4.0, 1.6)),
    ]
    return build((7.4, 4.0, 2.4), boxes, [wall])


def reachable_surface(world, start, radius=0.2, heights=None):
    """True surface voxels (fine) that a camera inside the reachable true free space can see at all.

    Air is grown from the start by the agent's radius; a surface voxel counts when a fan of rays from some
    reachable place on a 0.4 m lattice meets it.
    """
    from scipy.ndimage import binary_dilation, distance_transform_edt, label

    clear = distance_transform_edt(~world.solid) * FINE - FINE / 2
    if heights is not None:
        z = world.fine.axis(2)
        clear[:, :, (z < heights[0]) | (z > heights[1])] = 0
    parts, _ = label(clear >= radius)
    i = tuple(world.fine.index_of(np.asarray(start)))
    air = parts == parts[i]
    places = np.argwhere(air)
    _, first = np.unique(places // 8, axis=0, return_index=True)
    places = places[first]
    n = 8000
    k = np.arange(n) + 0.5
    polar, azimuth = np.arccos(1 - 2 * k / n), np.pi * (1 + 5**0.5) * k
    sphere = np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)], -1)
    from active3d_pipe.geometry import kernels_traversal as kernels

    seen = np.zeros(world.fine.size, np.uint8)
    opaque = world.solid.view(np.uint8).ravel()
    directions = (sphere / FINE).astype(np.float32)
    for p in places:
        kernels.mark_visible(
            opaque, (p + 0.5).astype(np.float32), directions, np.float32(12), world.fine.shape, seen
        )
    surface = world.solid & binary_dilation(~world.solid)
    return surface & (seen.reshape(world.fine.shape) > 0), air
