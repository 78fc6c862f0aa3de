"""The implicit branch F_theta: a neural signed distance field with colour and uncertainty (paper, eq. sdf_mlp)."""

import math
from typing import NamedTuple

import numpy as np
import torch

from active3d_pipe.errors import ArtifactError, ConfigError
from active3d_pipe.field import kernels
from active3d_pipe.field.config import FieldSettings
from active3d_pipe.field.encoders import Planes, make_encoders
from active3d_pipe.field.encoding import BlobLayout, EncodeGrid, check_memory, lowest_nodes, node_counts
from active3d_pipe.field.fused_decoder import FusedDecoder
from active3d_pipe.field.normals import unit_gradients
from active3d_pipe.geometry.lattice import LatticePoints, Points


class FieldSamples(NamedTuple):
    """Values of the field at N points: sdf (N,) m, sigma (N,) m, color (N, 3) in 0..1; all float32."""

    sdf: np.ndarray
    sigma: np.ndarray
    color: np.ndarray


class Geometry(NamedTuple):
    """What the geometry decoder and the uncertainty head give at N points, in truncation units.

    sdf (N,), sigma (N,), features (N, G) for the colour decoder, oneblob (N, 3 * bins).
    """

    sdf: torch.Tensor
    sigma: torch.Tensor
    features: torch.Tensor
    oneblob: torch.Tensor


class SdfField(torch.nn.Module):
    """SDF, its standard deviation and colour over a box.

    OneBlob(x), the encoder's features gamma(x) (tri-planes, or see `encoders`) and dense grid features V_alpha(x)
    feed the geometry decoder; the uncertainty head (eq. global_uncertainty) sees gamma(x) and V_alpha(x) only, so that
    what it learned at one place reaches another only through features. Both are one matrix product. The SDF
    starts at +truncation (free) and sigma at its prior; `visits` counts the training samples that fell into every grid
    cell, and cells without any are where the prior is held (`losses.prior_loss`).

    Args:
        low, high: (3,) corners of the box in the world, m. Points outside take the values of its border.
        settings: see `FieldSettings`.
        generator: draws the initial weights.
        anchor: (2, 3) the box with which the field was created, when it has grown since (`growth.grown_field`): nodes
            and bins keep their places in it.
    """

    def __init__(
        self, low: np.ndarray, high: np.ndarray, settings: FieldSettings, generator: torch.Generator,
        anchor: np.ndarray | None = None,
    ) -> None:
        super().__init__()
        self.box = np.stack([low, high]).astype(np.float64)
        self.anchor = self.box if anchor is None else np.asarray(anchor, dtype=np.float64)
        self.low, self.high = self.box.astype(np.float32)
        self._origin, top = self.anchor.astype(np.float32)
        self.settings = settings
        if self.low.shape != (3,) or not (self.high > self.low).all():
            raise ConfigError(f"field bounds {self.low.tolist()} .. {self.high.tolist()}: expected low < high")
        extent, below = self.high - self._origin, np.maximum(self._origin - self.low, 0)
        self.blob = BlobLayout.of_box(
            np.stack([self._origin, top]), np.stack([self.low, self.high]), settings.oneblob_bins
        )
        self.encoder, self.color_encoder = make_encoders(self._origin, extent, settings, below)
        self._inv_grid = np.float32(1 / settings.grid_voxel_m)
        self.grid_first = lowest_nodes(below, settings.grid_voxel_m)
        nodes = node_counts(extent, settings.grid_voxel_m) - self.grid_first
        g = settings.grid_channels
        encoders = [e for e in (self.encoder, self.color_encoder) if e is not None]
        check_memory(sum(math.prod(e.shape) for e in encoders) + int(nodes.prod()) * g, settings.max_table_megabytes)
        self.visits = np.zeros(tuple(nodes - 1), dtype=np.uint32)

        def normal(*shape: int, std: float) -> torch.nn.Parameter:
            return torch.nn.Parameter(torch.randn(*shape, generator=generator) * std)

        def zeros(*shape: int, value: float = 0.0) -> torch.nn.Parameter:
            return torch.nn.Parameter(torch.full(shape, value))

        bins, hidden = 3 * self.blob.bins, settings.hidden
        width = (self.encoder.width if self.encoder else 0) + g
        # The tables are called after the planes, the paper's encoder, whatever they hold.
        if self.encoder is not None:
            self.planes = torch.nn.Parameter(self.encoder.initial(generator))
        if self.color_encoder is not None:
            self.color_planes = torch.nn.Parameter(self.color_encoder.initial(generator))
        if g:
            self.grid = zeros(*(int(n) for n in nodes), g)
        # First layers of the geometry decoder (columns [:hidden]) and the uncertainty head ([hidden:]).
        self.blob_weight = normal(bins, hidden, std=math.sqrt(2 / 3))
        self.feature_weight = normal(width, 2 * hidden, std=math.sqrt(2 / width))
        self.bias = zeros(2 * hidden)
        self.geometry_weight = normal(hidden, 1 + settings.geometry_features, std=0.1 / math.sqrt(hidden))
        self.geometry_bias = torch.nn.Parameter(
            torch.cat([torch.ones(1), torch.zeros(settings.geometry_features)])
        )
        self.sigma_weight = normal(hidden, 1, std=0.1 / math.sqrt(hidden))
        sigma_prior = max(settings.sigma_prior_m - settings.sigma_floor_m, 1e-4) / settings.truncation_m
        self.sigma_bias = zeros(1, value=sigma_prior + math.log(-math.expm1(-sigma_prior)))
        color_width = settings.geometry_features + (self.color_encoder.width if self.color_encoder else 0)
        self.color_blob_weight = normal(bins, hidden, std=math.sqrt(2 / 3))
        self.color_feature_weight = normal(color_width, hidden, std=math.sqrt(2 / color_width))
        self.color_hidden_bias = zeros(hidden)
        self.color_weight = normal(hidden, 3, std=0.1 / math.sqrt(hidden))
        self.color_bias = zeros(3)

    @property
    def truncation_m(self) -> float:
        """Distance at which the SDF is truncated, m."""
        return self.settings.truncation_m

    def oneblob(self, points: np.ndarray) -> torch.Tensor:
        """(N, 3 * bins) OneBlob encoding of world points (N, 3) float32."""
        out = torch.empty((len(points), 3 * self.blob.bins))
        kernels.oneblob(points, self.blob.low, self.blob.inv_extent, self.blob.bins, out.numpy())
        return out

    def _heads(self, points: np.ndarray) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Decoded geometry (N, 1 + G), sigma before its softplus (N,), OneBlob: differentiable."""
        hidden = self.settings.hidden
        blob, parts = self.oneblob(points), []
        if self.encoder is not None:
            parts.append(self.encoder.encode(self.planes, points))
        if self.settings.grid_channels:
            parts.append(EncodeGrid.apply(self.grid, points, self._origin, self.grid_first, self._inv_grid))
        features = torch.cat(parts, dim=1)
        h = torch.addmm(self.bias, features, self.feature_weight)
        h_geometry = torch.relu(torch.addmm(h[:, :hidden], blob, self.blob_weight))
        h_sigma = torch.relu(h[:, hidden:])
        decoded = torch.addmm(self.geometry_bias, h_geometry, self.geometry_weight)
        return decoded, torch.addmm(self.sigma_bias, h_sigma, self.sigma_weight)[:, 0], blob

    def geometry(self, points: np.ndarray) -> Geometry:
        """Differentiable geometry and uncertainty at world points (N, 3) float32, truncation units."""
        decoded, raw_sigma, blob = self._heads(points)
        sigma = torch.nn.functional.softplus(raw_sigma) + self.settings.sigma_floor_m / self.truncation_m
        return Geometry(decoded[:, 0], sigma, decoded[:, 1:], blob)

    def color(self, points: np.ndarray, oneblob: torch.Tensor, features: torch.Tensor) -> torch.Tensor:
        """Differentiable colour (N, 3) in 0..1 of points (N, 3), given their OneBlob and geometry features."""
        if self.color_encoder is not None:
            features = torch.cat([features, self.color_encoder.encode(self.color_planes, points)], dim=1)
        h = torch.addmm(self.color_hidden_bias, oneblob, self.color_blob_weight)
        h = torch.addmm(h, features, self.color_feature_weight)
        return torch.sigmoid(torch.addmm(self.color_bias, torch.relu(h), self.color_weight))

    def _decode(self, points: Points, with_sigma: bool) -> np.ndarray:
        """(N, 1 or 2) raw SDF and sigma before its softplus; tri-planes with V_alpha have fused kernels for it."""
        if not isinstance(points, LatticePoints):
            points = _as_points(points)
        if not isinstance(self.encoder, Planes) or not self.settings.grid_channels:
            return self._decode_by_parts(np.asarray(points), with_sigma)
        planes, grid, blob, feature, bias, *layers = (
            p.detach().numpy() for p in (
                self.planes, self.grid, self.blob_weight, self.feature_weight, self.bias, self.geometry_weight,
                self.sigma_weight, self.geometry_bias, self.sigma_bias,
            )
        )
        outputs = 2 if with_sigma else 1
        columns = outputs * self.settings.hidden
        return FusedDecoder(
            self._origin, self.blob, self.encoder.layout, planes, grid, self.grid_first, self._inv_grid, blob,
            np.ascontiguousarray(feature[:, :columns]), bias[:columns],
            np.concatenate([layers[0][:, 0], layers[1][:, 0]])[:columns],
            np.concatenate([layers[2][:1], layers[3]])[:outputs],
        ).at(points)

    def _decode_by_parts(self, points: np.ndarray, with_sigma: bool, batch: int = 65536) -> np.ndarray:
        out = np.empty((len(points), 2 if with_sigma else 1), np.float32)
        with torch.no_grad():
            for i in range(0, len(points), batch):
                decoded, raw_sigma, _ = self._heads(points[i : i + batch])
                out[i : i + batch, 0] = decoded[:, 0].numpy()
                if with_sigma:
                    out[i : i + batch, 1] = raw_sigma.numpy()
        return out

    def query_sdf(self, points: Points) -> np.ndarray:
        """(N,) float32 SDF in m at world points (N, 3), cut at +-truncation.

        Some 3 M points a second, 10 M of a lattice.
        """
        sdf = self._decode(points, with_sigma=False)[:, 0]
        return np.clip(sdf, -1, 1) * np.float32(self.truncation_m)

    def query_geometry(self, points: Points) -> tuple[np.ndarray, np.ndarray]:
        """(sdf, sigma), both (N,) float32 m, at world points (N, 3)."""
        raw = self._decode(points, with_sigma=True)
        sigma = np.logaddexp(0, raw[:, 1]) * np.float32(self.truncation_m) + np.float32(self.settings.sigma_floor_m)
        return np.clip(raw[:, 0], -1, 1) * np.float32(self.truncation_m), sigma.astype(np.float32)

    def query(self, points: np.ndarray, batch: int = 65536) -> FieldSamples:
        """SDF (m), sigma (m) and colour at world points (N, 3), without gradients, `batch` points at a time."""
        points = _as_points(points)
        sdf, sigma = self.query_geometry(points)
        return FieldSamples(sdf, sigma, self.query_color(points, batch))

    def query_color(self, points: np.ndarray, batch: int = 65536) -> np.ndarray:
        """(N, 3) float32 colour in 0..1 at world points (N, 3)."""
        points = _as_points(points)
        color = np.empty((len(points), 3), np.float32)
        with torch.no_grad():
            for i in range(0, len(points), batch):
                part = points[i : i + batch]
                g = self.geometry(part)
                color[i : i + batch] = self.color(part, g.oneblob, g.features).numpy()
        return color

    def normals(self, points: np.ndarray, step_m: float = 0.01) -> np.ndarray:
        """(N, 3) float32 unit SDF gradients at world points (N, 3), pointing into free space.

        Differences over a tetrahedron of edge vectors (+-1, +-1, +-1) * step_m; zero where the field is flat.
        """
        points = _as_points(points)
        return unit_gradients(lambda at: self._decode(at, with_sigma=False)[:, 0], points, step_m)

    def count_visits(self, points: np.ndarray) -> None:
        """Count training samples (N, 3) in the cells of `visits`; counts saturate."""
        ijk = self._cells(points)
        inside = ((points >= self.low) & (points <= self.high)).all(axis=1)
        flat = np.ravel_multi_index(tuple(ijk[inside].T), self.visits.shape)
        cells, counts = np.unique(flat, return_counts=True)
        visits = self.visits.reshape(-1)
        visits[cells] = np.minimum(visits[cells].astype(np.int64) + counts, 2**31)

    def _cells(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) int64 cells of `visits`, the nearest ones for points outside."""
        ijk = np.floor((points - self._origin) * self._inv_grid).astype(np.int64) - self.grid_first
        return np.clip(ijk, 0, np.asarray(self.visits.shape) - 1)

    def visited(self, points: np.ndarray) -> np.ndarray:
        """(N,) bool, whether training samples fell into the cell of each world point (N, 3)."""
        ijk = self._cells(points)
        return self.visits[ijk[:, 0], ijk[:, 1], ijk[:, 2]] > 0

    def state(self) -> dict[str, np.ndarray]:
        """Every parameter and counter as an array (copies); `load_state` restores them exactly.

        `boxes` (2, 2, 3) float64 are the boxes at creation and now, world, m.
        """
        arrays = {name: p.detach().numpy().copy() for name, p in self.named_parameters()}
        return {**arrays, "visits": self.visits.copy(), "boxes": np.stack([self.anchor, self.box])}

    def load_state(self, arrays: dict[str, np.ndarray]) -> None:
        """Inverse of `state`; ArtifactError when an array is missing or has another form."""
        expected = self.state()
        for name, old in expected.items():
            new = arrays.get(name)
            if name == "boxes" and new is not None and not np.array_equal(new, old):
                raise ArtifactError(f"field state: its box is {new[1].tolist()}, expected {old[1].tolist()}")
            if new is None or new.shape != old.shape or new.dtype != old.dtype:
                got = "missing" if new is None else f"{new.shape} {new.dtype}"
                raise ArtifactError(
                    f"field state: {name} is {got}, expected {old.shape} {old.dtype}; "
                    "it belongs to other bounds or settings"
                )
        with torch.no_grad():
            for name, p in self.named_parameters():
                p.copy_(torch.from_numpy(np.ascontiguousarray(arrays[name])))
        self.visits = arrays["visits"].copy()


def _as_points(points: Points) -> np.ndarray:
    return np.ascontiguousarray(points, dtype=np.float32).reshape(-1, 3)
