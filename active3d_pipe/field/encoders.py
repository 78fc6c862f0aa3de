"""The encoders gamma(x) that the field can be built on: tri-planes (the paper's), a hash grid, dense grids, none."""

import math
from typing import Protocol

import numpy as np
import torch

from active3d_pipe.field.config import FieldSettings
from active3d_pipe.field.encoding import (
    EncodeGrid,
    EncodeHash,
    EncodePlanes,
    HashLayout,
    PlaneLayout,
    lowest_nodes,
    node_counts,
)

HASH_INITIAL = 1e-4  # hash tables start uniform within +- this (Mueller et al. 2022)


class Encoder(Protocol):
    """Features of world points from one table of parameters.

    Attributes:
        width: features of a point.
        shape: (nodes, channels) of the table.
    """

    width: int
    shape: tuple[int, int]

    def initial(self, generator: torch.Generator) -> torch.Tensor:
        """A table to start from, float32."""

    def encode(self, table: torch.Tensor, points: np.ndarray) -> torch.Tensor:
        """(N, width) features of world points (N, 3) float32, differentiable with respect to the table."""


class Planes:
    """Multi-resolution tri-planes over a box, the three planes of a level summed."""

    def __init__(
        self, low: np.ndarray, extent: np.ndarray, resolutions_m: tuple[float, ...], channels: int,
        below: np.ndarray | float = 0.0,
    ) -> None:
        self.low = low
        self.layout = PlaneLayout.of_box(extent, resolutions_m, below)
        self.shape = (self.layout.nodes, channels)
        self.width = self.layout.levels * channels

    def initial(self, generator: torch.Generator) -> torch.Tensor:
        """Normal, standard deviation 0.01."""
        return torch.randn(*self.shape, generator=generator) * 0.01

    def encode(self, table: torch.Tensor, points: np.ndarray) -> torch.Tensor:
        """See `Encoder`."""
        return EncodePlanes.apply(table, points, self.low, self.layout)


class HashGrid:
    """Multi-resolution hash grid (Mueller et al. 2022): cubes, levels in geometric progression."""

    def __init__(self, low: np.ndarray, extent: np.ndarray, settings: FieldSettings) -> None:
        self.low = low
        self.layout = HashLayout.of_box(
            extent, settings.hash_levels, settings.hash_coarsest_cells, settings.hash_finest_m, settings.hash_log2_size
        )
        self.shape = (self.layout.nodes, settings.hash_features)
        self.width = settings.hash_levels * settings.hash_features

    def initial(self, generator: torch.Generator) -> torch.Tensor:
        """Uniform within +-`HASH_INITIAL`."""
        return (2 * torch.rand(*self.shape, generator=generator) - 1) * HASH_INITIAL

    def encode(self, table: torch.Tensor, points: np.ndarray) -> torch.Tensor:
        """See `Encoder`."""
        return EncodeHash.apply(table, points, self.low, self.layout)


class DenseGrids:
    """Dense grids of several resolutions, one table for all; features of the levels side by side."""

    def __init__(
        self, low: np.ndarray, extent: np.ndarray, resolutions_m: tuple[float, ...], channels: int,
        below: np.ndarray | float = 0.0,
    ) -> None:
        self.low = low
        self.first = [lowest_nodes(below, r) for r in resolutions_m]
        self.levels = [
            (tuple(int(n) for n in node_counts(extent, r) - first), np.float32(1 / r))
            for r, first in zip(resolutions_m, self.first, strict=True)
        ]
        self.sizes = [math.prod(nodes) for nodes, _ in self.levels]
        self.shape = (sum(self.sizes), channels)
        self.width = len(self.levels) * channels

    def initial(self, generator: torch.Generator) -> torch.Tensor:
        """Normal, standard deviation 0.01."""
        return torch.randn(*self.shape, generator=generator) * 0.01

    def encode(self, table: torch.Tensor, points: np.ndarray) -> torch.Tensor:
        """See `Encoder`."""
        parts = zip(torch.split(table, self.sizes), self.first, self.levels, strict=True)
        return torch.cat(
            [
                EncodeGrid.apply(part.view(*nodes, -1), points, self.low, first, inv)
                for part, first, (nodes, inv) in parts
            ],
            dim=1,
        )


def make_encoders(
    low: np.ndarray, extent: np.ndarray, settings: FieldSettings, below: np.ndarray | float = 0.0
) -> tuple[Encoder | None, Encoder | None]:
    """The encoder of the geometry and that of the colour; None = there is none.

    With a hash grid or without an encoder, colour has no table of its own: it comes from OneBlob and the geometry
    features. The box reaches `extent` (3,) m above `low`, where it began, and `below` under it.
    """
    if settings.encoder == "triplane":
        c = settings.plane_channels
        return (
            Planes(low, extent, settings.plane_resolutions_m, c, below),
            Planes(low, extent, settings.color_plane_resolutions_m, c, below),
        )
    if settings.encoder == "hash":
        return HashGrid(low, extent, settings), None
    if settings.encoder == "grids":
        c = settings.level_channels
        return (
            DenseGrids(low, extent, settings.level_resolutions_m, c, below),
            DenseGrids(low, extent, settings.color_level_resolutions_m, c, below),
        )
    return None, None
