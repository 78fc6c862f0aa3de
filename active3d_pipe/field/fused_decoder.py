"""SDF and uncertainty without gradients: tri-planes, V_alpha and OneBlob through two layers in one pass."""

from dataclasses import dataclass

import numpy as np

from active3d_pipe.field import kernels, kernels_lattice
from active3d_pipe.field.encoding import PLANE_AXES, BlobLayout, PlaneLayout
from active3d_pipe.geometry.lattice import LatticePoints


@dataclass(frozen=True, eq=False)
class FusedDecoder:
    """The state of a field, as the kernels take it; arrays are float32.

    Attributes:
        origin: (3,) where planes and grid begin, world, m.
        planes: (nodes, channels) of `layout`.
        grid: (X, Y, Z, g) V_alpha, its lowest nodes `grid_first` (3,) and 1 / spacing `inv_grid`, 1/m.
        blob_weight: (3 * bins, hidden) first layer of the geometry decoder; the uncertainty head does not see OneBlob.
        feature_weight: (levels * channels + g, columns) first layer of the geometry decoder and, with as many columns
            again, of the uncertainty head.
        bias: (columns,); weight: (columns,) second layer, hidden columns for each output; out_bias: (outputs,).
    """

    origin: np.ndarray
    blob: BlobLayout
    layout: PlaneLayout
    planes: np.ndarray
    grid: np.ndarray
    grid_first: np.ndarray
    inv_grid: np.float32
    blob_weight: np.ndarray
    feature_weight: np.ndarray
    bias: np.ndarray
    weight: np.ndarray
    out_bias: np.ndarray

    def at(self, points: np.ndarray | LatticePoints) -> np.ndarray:
        """(N, outputs) float32, before any activation, at world points (N, 3) float32."""
        out = np.empty((len(points), len(self.out_bias)), np.float32)
        if isinstance(points, LatticePoints):
            self._at_nodes(points, out)
        else:
            self._at_points(points, out)
        return out

    def _at_points(self, points: np.ndarray, out: np.ndarray) -> None:
        (rows, hidden), (outputs, columns) = self.blob_weight.shape, (len(self.out_bias), len(self.bias))
        first = np.zeros((rows + len(self.feature_weight), columns), np.float32)
        first[:rows, :hidden], first[rows:] = self.blob_weight, self.feature_weight
        second = np.zeros((outputs, columns), np.float32)
        for o in range(outputs):
            second[o, o * hidden : (o + 1) * hidden] = self.weight[o * hidden : (o + 1) * hidden]
        kernels.decode_points(
            points, self.origin, self.blob.low, self.blob.inv_extent, self.blob.bins, self.planes, self.layout.rows,
            self.layout.inv_resolution, self.grid_first, self.grid, self.inv_grid, first, self.bias, second,
            self.out_bias, out,
        )

    def _at_nodes(self, points: LatticePoints, out: np.ndarray) -> None:
        axes, width = points.axes, self.layout.levels * self.planes.shape[1]
        (of_x, of_y, of_z), cells, shares = zip(*(self._along(axis, x) for axis, x in enumerate(axes)), strict=True)
        # What an axis gives is added once: x and y with their plane, z with that of x and z.
        firsts, seconds = (of_x, np.zeros_like(of_x), np.zeros_like(of_y)), (of_y, of_z, np.zeros_like(of_z))
        wanted = [np.zeros((len(axes[a]), len(axes[b])), bool) for a, b in PLANE_AXES]
        kernels_lattice.mark_pairs(points.index, *wanted)
        sums = [np.zeros((*pair.shape, len(self.bias)), np.float32) for pair in wanted]
        for (a, b), pair, of_a, of_b, total in zip(PLANE_AXES, wanted, firsts, seconds, sums, strict=True):
            these = (self.layout.rows[:, 3] == a) & (self.layout.rows[:, 4] == b)
            kernels_lattice.pair_terms(
                axes[a], axes[b], pair, self.origin[a], self.origin[b], self.planes, self.layout.rows[these],
                self.layout.inv_resolution[these], self.feature_weight[:width], of_a, of_b, total,
            )
        kernels_lattice.decode_nodes(
            points.index, sums[0], sums[1], sums[2], cells, shares, self.grid, self.feature_weight[width:], self.weight,
            self.out_bias, out,
        )

    def _along(self, axis: int, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of coordinates x (N,) of one axis: first-layer sums (N, columns), cells of the grid and fractions."""
        rows, columns = slice(axis * self.blob.bins, (axis + 1) * self.blob.bins), len(self.bias)
        sums, cells, shares = np.empty((len(x), columns), np.float32), np.empty(len(x), np.int64), np.empty_like(x)
        kernels_lattice.axis_terms(
            x, self.blob.low[axis], self.blob.inv_extent[axis], self.blob_weight[rows],
            self.bias if axis == 0 else np.zeros_like(self.bias), self.origin[axis], self.inv_grid,
            self.grid_first[axis], self.grid.shape[axis], sums, cells, shares,
        )
        return sums, cells, shares
