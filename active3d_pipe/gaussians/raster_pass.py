"""One forward and backward pass of the rasteriser over plain arrays, with buffers that are reused."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numba
import numpy as np

from active3d_pipe.gaussians import kernels_binning, kernels_projection, kernels_tiles
from active3d_pipe.geometry import se3
from active3d_pipe.structures import Camera

TILE_SIZE = (kernels_tiles.TW, kernels_tiles.TH)
# Primitives nearer than this along the optical axis are not drawn, m.
NEAR_M = 0.05
# The projected Jacobian is evaluated at most this far outside the image, as a factor of its half size.
FRUSTUM_CLAMP = 1.3
# Chunks of work per thread-parallel loop. A constant, so that no result depends on the thread count.
CHUNKS = 8
# A tile is left when no pixel transmits more than this.
STOP_TRANSMITTANCE = 1e-4


class Workspace:
    """Named buffers that grow and are handed out again, so that a step allocates (and page-faults) nothing."""

    def __init__(self) -> None:
        self._buffers: dict[str, np.ndarray] = {}

    def get(self, name: str, shape: tuple[int, ...], dtype: type) -> np.ndarray:
        """An uninitialised C-contiguous array, 64-byte aligned; valid until the same name is asked for again."""
        need = math.prod(shape) * np.dtype(dtype).itemsize
        raw = self._buffers.get(name)
        if raw is None or raw.nbytes < need:
            size = need + need // 5
            whole = np.empty(size + 64, np.uint8)
            offset = -whole.ctypes.data % 64
            raw = whole[offset : offset + size]
            self._buffers[name] = raw
        return raw[:need].view(dtype).reshape(shape)


@dataclass(slots=True)
class RasterPass:
    """Forward, then backward, of one view.

    Attributes:
        dilation_px2, compensate: see `GaussianSettings`.
        t_stop: transmittance at which a tile is done.
        workspace: buffers; a second `forward` with the same workspace invalidates what the first returned.
    """

    dilation_px2: float = 0.1
    compensate: bool = True
    t_stop: float = STOP_TRANSMITTANCE
    workspace: Workspace = field(default_factory=Workspace)
    _state: dict = field(default_factory=dict)

    def forward(
        self, values: np.ndarray, camera: Camera, T_world_camera: np.ndarray, tiles: np.ndarray | None = None,
        seen: np.ndarray | None = None, which: np.ndarray | None = None,
    ) -> np.ndarray:
        """Render `values` (N, 14) float32 (see kernels_projection); returns (5, H, W) r, g, b, sum w z, alpha.

        `tiles`: ids (row-major, `tile_grid`) of the tiles to draw, default all; pixels elsewhere are 0.
        `seen`: observed depth (H, W) float32, m; with it a sixth plane is sum w min(|z - seen|, SIGHT_LIMIT_M), how far
        what is drawn lies from there along the line of sight.
        `which`: (L,) int32, ascending, the primitives that may be visible; default all.
        """
        get = self.workspace.get
        which = np.arange(len(values), dtype=np.int32) if which is None else which
        n = len(which)
        grid = tile_grid(camera)
        tile_ids = np.arange(grid[0] * grid[1], dtype=np.int32) if tiles is None else np.asarray(tiles, np.int32)
        tile_slot = get("tile_slot", (grid[0] * grid[1],), np.int32)
        tile_slot.fill(-1)
        tile_slot[tile_ids] = np.arange(len(tile_ids), dtype=np.int32)

        R, t, view = view_arrays(camera, T_world_camera)
        rec = get("rec", (n, 16), np.float32)
        ids, box = get("ids", (n,), np.int32), get("box", (n, 4), np.int16)
        counts = get("counts", (CHUNKS,), np.int64)
        kernels_projection.project(
            values, which, R, t, view, TILE_SIZE, grid, CHUNKS, np.float32(self.dilation_px2), self.compensate,
            rec, ids, box, counts,
        )
        order = get("order", (n,), np.int32)
        m = kernels_binning.depth_order(
            rec, n, CHUNKS, counts, get("keys", (n,), np.uint32), order,
            get("spare_keys", (n,), np.uint32), get("spare_order", (n,), np.int32),
        )
        parts = numba.get_num_threads()
        places = get("places", (parts, len(tile_ids)), np.int64)
        tile_start = get("tile_start", (len(tile_ids) + 1,), np.int64)
        first_entry = get("first_entry", (n + 1,), np.int64)
        entries_of = get("entries_of", (n,), np.int32)
        kernels_binning.count_entries(order, m, box, grid[0], tile_slot, parts, places, entries_of)
        total = kernels_binning.prefix_sums(places, n, CHUNKS, counts, entries_of, tile_start, first_entry)
        entries = get("entries", (total, 2), np.int32)
        kernels_binning.fill_entries(order, m, box, grid[0], tile_slot, parts, places, first_entry, entries)

        out = get("out", (5 if seen is None else 6, camera.height, camera.width), np.float32)
        observed = np.zeros((1, 1), np.float32) if seen is None else np.ascontiguousarray(seen, np.float32)
        if tiles is not None:
            out.fill(0)
        used = get("used", (len(tile_ids),), np.int64)
        bounds = _even_split(tile_start, parts)
        kernels_tiles.forward(
            rec, entries, tile_start, tile_ids, bounds, grid[0], np.float32(self.t_stop), observed, out, used
        )
        self._state = {
            "values": values, "asked": n, "R": R, "t": t, "view": view, "rec": rec, "ids": ids, "counts": counts,
            "first_entry": first_entry, "entries": entries, "tile_start": tile_start, "tile_ids": tile_ids,
            "bounds": bounds, "tiles_x": grid[0], "used": used, "seen": observed, "out": out, "visible": m,
        }
        return out

    def backward(self, out_grad: np.ndarray) -> np.ndarray:
        """dL/dvalues (N, 14) float32 from dL/dout of the last `forward`, as many planes as it gave."""
        rows, found = self.backward_rows(out_grad)
        grad = np.zeros((len(self._state["values"]), 14), np.float32)
        grad[rows] = found
        return grad

    def backward_rows(self, out_grad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same for the visible primitives alone: their indices (M,) int32, ascending, and (M, 14) float32.

        What it returns lives in the workspace.
        """
        s, get = self._state, self.workspace.get
        entry_grad = get("entry_grad", (len(s["entries"]), 12), np.float32)
        kernels_tiles.backward(
            s["rec"], s["entries"], s["tile_start"], s["tile_ids"], s["bounds"], s["tiles_x"], s["used"], s["seen"],
            s["out"], out_grad, entry_grad,
        )
        rows, grad = get("rows", (s["visible"],), np.int32), get("grad", (s["visible"], 14), np.float32)
        kernels_projection.chain_rule(
            s["values"], s["asked"], s["R"], s["t"], s["view"], CHUNKS, np.float32(self.dilation_px2), self.compensate,
            s["rec"], s["ids"], s["counts"], s["first_entry"], entry_grad, rows, grad,
        )
        return rows, grad

    @property
    def num_visible(self) -> int:
        """Number of primitives that the last `forward` projected onto a drawn image."""
        return int(self._state["visible"])


def may_be_seen(
    values: np.ndarray, cameras: Sequence[Camera], poses: Sequence[np.ndarray], dilation_px2: float
) -> np.ndarray:
    """(N,) bool, a superset of the primitives of `values` (N, 14) that the views at `poses` show; a cheap test."""
    out = np.zeros(len(values), bool)
    if not len(poses):
        return out
    Rs, ts, views = (np.stack(a) for a in zip(*map(view_arrays, cameras, poses), strict=True))
    kernels_projection.may_be_seen(values, Rs, ts, views, CHUNKS, np.float32(dilation_px2), out)
    return out


def tile_grid(camera: Camera) -> tuple[int, int]:
    """Number of tiles (across, down); tile id = row * across + column."""
    return -(-camera.width // TILE_SIZE[0]), -(-camera.height // TILE_SIZE[1])


def view_arrays(camera: Camera, T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """R (3, 3), t (3,) world to camera and the intrinsics as the kernels want them, float32."""
    T_camera_world = se3.inverse(np.asarray(T_world_camera, dtype=np.float64))
    R = np.ascontiguousarray(T_camera_world[:3, :3], dtype=np.float32)
    t = np.ascontiguousarray(T_camera_world[:3, 3], dtype=np.float32)
    lim_x = FRUSTUM_CLAMP * max(camera.cx, camera.width - camera.cx) / camera.fx
    lim_y = FRUSTUM_CLAMP * max(camera.cy, camera.height - camera.cy) / camera.fy
    view = [camera.fx, camera.fy, camera.cx, camera.cy, lim_x, lim_y, camera.width, camera.height, NEAR_M]
    return R, t, np.array(view, dtype=np.float32)


def _even_split(tile_start: np.ndarray, parts: int) -> np.ndarray:
    """(parts + 1,) bounds of consecutive tiles with about equal numbers of entries."""
    slots = len(tile_start) - 1
    # An empty tile still costs its clearing and writing, about as much as 8 entries.
    cost = tile_start + 8 * np.arange(slots + 1)
    bounds = np.searchsorted(cost, cost[-1] * np.arange(1, parts) / parts)
    return np.concatenate([[0], bounds, [slots]]).astype(np.int64)
