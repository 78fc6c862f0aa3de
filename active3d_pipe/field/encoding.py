"""Feature tables over a box, and their differentiable interpolation."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from active3d_pipe.errors import ConfigError
from active3d_pipe.field import kernels, kernels_hash

PLANE_AXES = ((0, 1), (0, 2), (1, 2))


@dataclass(frozen=True, eq=False)
class PlaneLayout:
    """Where the planes of all levels lie in one table.

    Attributes:
        rows: (P, 8) int64, a row a plane: first node, nodes along a, nodes along b, a, b, level, position of the lowest
            node along a and b, in nodes from where the box began.
        inv_resolution: (P,) float32, 1/m.
        nodes: number of nodes of the table.
        levels: number of levels.
    """

    rows: np.ndarray
    inv_resolution: np.ndarray
    nodes: int
    levels: int

    @classmethod
    def of_box(
        cls, extent: np.ndarray, resolutions_m: tuple[float, ...], below: np.ndarray | float = 0.0
    ) -> "PlaneLayout":
        """Three axis-aligned planes a level over a box that reaches `extent` (3,) m above its anchor, `below` under."""
        rows, inv, nodes = [], [], 0
        for level, resolution in enumerate(resolutions_m):
            first = lowest_nodes(below, resolution)
            n = node_counts(extent, resolution) - first
            for a, b in PLANE_AXES:
                rows.append((nodes, n[a], n[b], a, b, level, first[a], first[b]))
                inv.append(1 / resolution)
                nodes += int(n[a] * n[b])
        return cls(np.array(rows, dtype=np.int64), np.array(inv, dtype=np.float32), nodes, len(resolutions_m))


@dataclass(frozen=True, eq=False)
class HashLayout:
    """Where the levels of a hash grid lie in one table.

    Attributes:
        rows: (L, 3) int64, a row a level: first entry, entries, nodes along an axis (0: the level is hashed).
        inv_resolution: (L,) float32, 1/m.
        last: (L,) float32, index of the last node along an axis.
        nodes: entries of the table.
    """

    rows: np.ndarray
    inv_resolution: np.ndarray
    last: np.ndarray
    nodes: int

    @classmethod
    def of_box(
        cls, extent: np.ndarray, levels: int, coarsest_cells: int, finest_m: float, log2_size: int
    ) -> "HashLayout":
        """Levels over the cube on the longest side of a box of `extent` (3,) m.

        The coarsest has `coarsest_cells` cells along a side, the finest cells of about `finest_m`, those between
        follow in geometric progression. A level of more than 2^log2_size nodes is hashed into that many entries.
        """
        side = float(np.max(extent))
        finest = max(side / finest_m, coarsest_cells)
        growth = (finest / coarsest_cells) ** (1 / max(levels - 1, 1))
        cells = [int(np.ceil(coarsest_cells * growth**level - 1e-6)) for level in range(levels)]
        rows, nodes = [], 0
        for n in cells:
            direct = (n + 1) ** 3 <= 2**log2_size
            size = (n + 1) ** 3 if direct else 2**log2_size
            rows.append((nodes, size, n + 1 if direct else 0))
            nodes += size
        counts = np.array(cells, np.float32)
        return cls(np.array(rows, np.int64), counts / np.float32(side), counts, nodes)


def node_counts(extent: np.ndarray, resolution_m: float) -> np.ndarray:
    """(3,) number of nodes, spaced by `resolution_m`, that cover a box of `extent` m."""
    return np.maximum(np.ceil(np.asarray(extent) / resolution_m - 1e-6).astype(np.int64) + 1, 2)


def lowest_nodes(below: np.ndarray | float, resolution_m: float) -> np.ndarray:
    """(3,) int64 <= 0, position of the lowest node of a box that reaches `below` m under its anchor, in nodes."""
    return -np.ceil(np.broadcast_to(below, 3) / resolution_m - 1e-6).astype(np.int64)


@dataclass(frozen=True, eq=False)
class BlobLayout:
    """Where the bins of the OneBlob encoding lie; they keep their width and place when the box grows.

    Attributes:
        low: (3,) float32 lower end of the first bin, world, m.
        inv_extent: (3,) float32 1/m, one over the length of all bins of an axis.
        bins: bins of every axis; an axis that grew less has bins beyond its end.
        first: (3,) int64, bins below those of the initial box.
    """

    low: np.ndarray
    inv_extent: np.ndarray
    bins: int
    first: np.ndarray

    @classmethod
    def of_box(cls, anchor: np.ndarray, box: np.ndarray, bins: int) -> "BlobLayout":
        """`bins` over `anchor` (2, 3), the box at creation, and more of the same width over the present `box`."""
        width = (anchor[1] - anchor[0]) / bins
        first = np.maximum(np.ceil((anchor[0] - box[0]) / width - 1e-3), 0).astype(np.int64)
        more = first + np.maximum(np.ceil((box[1] - anchor[1]) / width - 1e-3), 0).astype(np.int64)
        total = bins + int(more.max())
        low = (anchor[0] - first * width).astype(np.float32)
        return cls(low, (1 / (width * total)).astype(np.float32), total, first)


def check_memory(values: int, limit_megabytes: float) -> None:
    """Raise ConfigError when tables of `values` floats exceed the limit."""
    megabytes = values * 4 / 1e6
    if megabytes > limit_megabytes:
        raise ConfigError(
            f"field: feature tables need {megabytes:.0f} MB, more than field.max_table_megabytes={limit_megabytes:g}; "
            "coarser resolutions of grid and encoder (mapping.field), or smaller bounds, need less"
        )


class EncodePlanes(torch.autograd.Function):
    """Tri-plane features (N, levels * channels) of points (N, 3); gradient to the table only."""

    @staticmethod
    def forward(
        ctx: Any, table: torch.Tensor, points: np.ndarray, low: np.ndarray, layout: PlaneLayout
    ) -> torch.Tensor:
        """`table` (nodes, channels) float32, `points` (N, 3) float32 world m, `low` (3,) float32."""
        ctx.points, ctx.low, ctx.layout, ctx.shape = points, low, layout, table.shape
        out = torch.empty((len(points), layout.levels * table.shape[1]))
        kernels.planes_forward(
            points, low, table.detach().numpy(), layout.rows, layout.inv_resolution, out.numpy(), 0
        )
        return out

    @staticmethod
    def backward(ctx: Any, *d_out: torch.Tensor) -> tuple[torch.Tensor, None, None, None]:
        """Gradient of the table."""
        d_table = torch.zeros(ctx.shape)
        kernels.planes_backward(
            ctx.points, ctx.low, ctx.layout.rows, ctx.layout.inv_resolution,
            d_out[0].contiguous().numpy(), 0, d_table.numpy(),
        )
        return d_table, None, None, None


class EncodeGrid(torch.autograd.Function):
    """Trilinear features (N, channels) of points (N, 3); gradient to the grid only."""

    @staticmethod
    def forward(
        ctx: Any, grid: torch.Tensor, points: np.ndarray, low: np.ndarray, first: np.ndarray, inv_resolution: np.float32
    ) -> torch.Tensor:
        """`grid` (X, Y, Z, channels) float32, `points` (N, 3) float32 world m, `low` (3,) float32, `first` (3,)."""
        ctx.points, ctx.low, ctx.first, ctx.inv_resolution, ctx.shape = points, low, first, inv_resolution, grid.shape
        out = torch.empty((len(points), grid.shape[3]))
        kernels.grid_forward(points, low, first, grid.detach().numpy(), inv_resolution, out.numpy(), 0)
        return out

    @staticmethod
    def backward(ctx: Any, *d_out: torch.Tensor) -> tuple[torch.Tensor, None, None, None, None]:
        """Gradient of the grid."""
        d_grid = torch.zeros(ctx.shape)
        kernels.grid_backward(
            ctx.points, ctx.low, ctx.first, ctx.inv_resolution, d_out[0].contiguous().numpy(), 0, d_grid.numpy()
        )
        return d_grid, None, None, None, None


class EncodeHash(torch.autograd.Function):
    """Hash-grid features (N, levels * channels) of points (N, 3); gradient to the table only."""

    @staticmethod
    def forward(
        ctx: Any, table: torch.Tensor, points: np.ndarray, low: np.ndarray, layout: HashLayout
    ) -> torch.Tensor:
        """`table` (nodes, channels) float32, `points` (N, 3) float32 world m, `low` (3,) float32."""
        ctx.points, ctx.low, ctx.layout, ctx.shape = points, low, layout, table.shape
        out = torch.empty((len(points), len(layout.rows) * table.shape[1]))
        kernels_hash.hash_forward(
            points, low, table.detach().numpy(), layout.rows, layout.inv_resolution, layout.last, out.numpy()
        )
        return out

    @staticmethod
    def backward(ctx: Any, *d_out: torch.Tensor) -> tuple[torch.Tensor, None, None, None]:
        """Gradient of the table."""
        d_table = torch.zeros(ctx.shape)
        layout = ctx.layout
        kernels_hash.hash_backward(
            ctx.points, ctx.low, layout.rows, layout.inv_resolution, layout.last, d_out[0].contiguous().numpy(),
            d_table.numpy(),
        )
        return d_table, None, None, None
