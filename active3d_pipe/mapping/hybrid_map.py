"""The hybrid scene state M_k = {F_theta, G_k} (paper, eq. hybrid_state) with all that a resume needs."""

import copy
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import torch

from active3d_pipe.errors import ArtifactError
from active3d_pipe.field.growth import grown_field
from active3d_pipe.field.optimise import FieldOptimiser
from active3d_pipe.field.sdf_field import SdfField
from active3d_pipe.gaussians.parameters import GaussianParameters
from active3d_pipe.gaussians.raster_pass import RasterPass
from active3d_pipe.gaussians.rasteriser import RenderedView, render_view
from active3d_pipe.mapping.config import MappingSettings
from active3d_pipe.mapping.keyframes import Keyframe
from active3d_pipe.structures import Camera, Frame, GaussianModel

FIELD_MARGIN_M = 0.2  # the field's box reaches beyond the scene's, so that walls at its border have two sides
OPTIMISER_PREFIXES = ("field.", "gaussians.")


class HybridMap:
    """Both branches, their optimisers' state, and the keyframes. Mutable: only `update_map` and `refine` train it."""

    def __init__(
        self, field: SdfField, optimiser: FieldOptimiser, gaussians: GaussianParameters, settings: MappingSettings,
        keyframes: Sequence[Keyframe] = (),
    ) -> None:
        self.field = field
        self.optimiser = optimiser
        self.gaussians = gaussians
        self.settings = settings
        self.keyframes = list(keyframes)
        self._resting: GaussianParameters | None = None

    @property
    def num_gaussians(self) -> int:
        """Primitives of the map, those outside the working set included."""
        return len(self.gaussians) + (len(self._resting) if self._resting is not None else 0)

    @contextmanager
    def working_set(self, frames: Sequence[Frame]) -> Iterator[None]:
        """Inside, `gaussians` holds only what `frames` see, so that an iteration costs what is near, not the scene.

        Views of other frames are incomplete meanwhile. Primitives that rest stay as they are, and forget their
        optimiser state: what a checkpoint holds of it is what the last working set needs.
        """
        settings, values = self.settings.gaussians, self.gaussians.values.numpy()
        raster = RasterPass(
            dilation_px2=settings.dilation_px2, compensate=settings.opacity_compensation,
            workspace=self.gaussians.workspace,
        )
        seen = np.zeros(len(values), bool)
        for frame in frames:
            seen |= raster.project(values, frame.camera, frame.T_world_camera)
        self._resting = self.gaussians.split(seen)
        self._resting.forget()
        try:
            yield
        finally:
            self.gaussians.join(self._resting)
            self._resting = None

    @classmethod
    def create(
        cls, low: np.ndarray, high: np.ndarray, settings: MappingSettings, rng: np.random.Generator
    ) -> "HybridMap":
        """An untrained map over the box [low, high] (world, m)."""
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        margin = FIELD_MARGIN_M
        field = SdfField(np.asarray(low) - margin, np.asarray(high) + margin, settings.field, generator)
        gaussians = GaussianParameters.from_model(GaussianModel.empty())
        return cls(field, FieldOptimiser(field, settings.field), gaussians, settings)

    @property
    def bounds(self) -> np.ndarray:
        """(2, 3) float64 corners of the map's box, world, m."""
        margin = np.array([[FIELD_MARGIN_M], [-FIELD_MARGIN_M]])
        return np.round(self.field.box + margin, 9)

    def grow(self, bounds: np.ndarray, rng: np.random.Generator) -> None:
        """Extend the box to `bounds` (2, 3), world, m; the map of what is known stays as it is."""
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        low, high = bounds[0] - FIELD_MARGIN_M, bounds[1] + FIELD_MARGIN_M
        self.field, self.optimiser = grown_field(self.field, self.optimiser, low, high, generator)

    def render(self, camera: Camera, T_world_camera: np.ndarray) -> RenderedView:
        """View of the Gaussians: rgb 0..1, depth m (0 where alpha < 0.5), alpha."""
        return render_view(self.gaussians, camera, T_world_camera, self.settings.gaussians)

    def state(self) -> dict[str, dict[str, np.ndarray]]:
        """Arrays by table: `field`, `gaussians` (what the map is) and `optimiser` (what training needs)."""
        gaussians = self.gaussians.state()
        moments = {f"gaussians.{k}": v for k, v in gaussians.items() if k != "values"}
        return {
            "field": self.field.state(),
            "gaussians": {"values": gaussians["values"]},
            "optimiser": {**{f"field.{k}": v for k, v in self.optimiser.state().items()}, **moments},
        }

    def to_look_at(self) -> "HybridMap":
        """A copy that does not change with this map; it cannot be trained further."""
        field = copy.deepcopy(self.field)
        gaussians = GaussianParameters.from_values(self.gaussians.values.detach().numpy())
        return HybridMap(field, FieldOptimiser(field, self.settings.field), gaussians, self.settings, self.keyframes)

    @classmethod
    def from_state(
        cls, settings: MappingSettings, state: dict[str, dict[str, np.ndarray]], keyframes: Sequence[Keyframe]
    ) -> "HybridMap":
        """Inverse of `state`, exact. Without the table `optimiser` the map can be looked at, not trained further."""
        boxes = state["field"].get("boxes")
        if boxes is None or boxes.shape != (2, 2, 3):
            raise ArtifactError("map: the field's boxes are missing; it was written by another version, map it again")
        anchor, box = boxes
        field = SdfField(box[0], box[1], settings.field, torch.Generator().manual_seed(0), anchor)
        gaussians = GaussianParameters.from_model(GaussianModel.empty())
        hybrid = cls(field, FieldOptimiser(field, settings.field), gaussians, settings)
        hybrid.field.load_state(state["field"])
        hybrid.keyframes = list(keyframes)
        if "optimiser" not in state:
            hybrid.gaussians = GaussianParameters.from_values(state["gaussians"]["values"])
            return hybrid
        tables: dict[str, dict[str, np.ndarray]] = {p: {} for p in OPTIMISER_PREFIXES}
        for name, array in state["optimiser"].items():
            prefix = next(p for p in OPTIMISER_PREFIXES if name.startswith(p))
            tables[prefix][name.removeprefix(prefix)] = array
        hybrid.optimiser.load_state(tables["field."])
        hybrid.gaussians = GaussianParameters.from_state({**state["gaussians"], **tables["gaussians."]})
        return hybrid
