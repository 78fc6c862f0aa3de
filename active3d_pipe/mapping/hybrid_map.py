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
from active3d_pipe.field.surface_view import SurfaceView
from active3d_pipe.field.tsdf import TsdfField
from active3d_pipe.gaussians.parameters import GaussianParameters
from active3d_pipe.gaussians.raster_pass import may_be_seen
from active3d_pipe.gaussians.rasteriser import RenderedView, render_view
from active3d_pipe.mapping.config import MappingSettings
from active3d_pipe.mapping.keyframes import Keyframe
from active3d_pipe.structures import Camera, Frame, GaussianModel

FIELD_MARGIN_M = 0.2  # the field's box reaches beyond the scene's, so that walls at its border have two sides
OPTIMISER_PREFIXES = ("field.", "gaussians.")


class HybridMap:
    """Both branches, their optimisers' state, and the keyframes. Mutable: only `update_map` and `refine` train it.

    With `geometry = "tsdf"` the field is a `TsdfField` and has no optimiser. `submap` = (first keyframe, first
    primitive) of the submap that is being mapped, see `WindowSettings.submap_keyframes`.
    """

    def __init__(
        self, field: SdfField | TsdfField, optimiser: FieldOptimiser | None, gaussians: GaussianParameters,
        settings: MappingSettings, keyframes: Sequence[Keyframe] = (),
    ) -> None:
        self.field = field
        self.optimiser = optimiser
        self.gaussians = gaussians
        self.settings = settings
        self.keyframes = list(keyframes)
        self.submap = (0, 0)
        self._resting: np.ndarray | None = None
        self._surface_view: SurfaceView | None = None

    @property
    def num_gaussians(self) -> int:
        """Primitives of the map, those outside the working set included."""
        return len(self.gaussians) + (len(self._resting) if self._resting is not None else 0)

    @contextmanager
    def working_set(self, frames: Sequence[Frame]) -> Iterator[None]:
        """Inside, `gaussians` holds only what `frames` may see, so that an iteration costs what is near, not the scene.

        Views of other frames are incomplete meanwhile. Primitives that rest stay as they are, and forget their
        optimiser state: what a checkpoint holds of it is what the last working set needs.
        """
        seen = may_be_seen(
            self.gaussians.values.numpy(), [f.camera for f in frames], [f.T_world_camera for f in frames],
            self.settings.gaussians.dilation_px2,
        )
        with self._only(seen):
            yield

    @contextmanager
    def newest_submap(self) -> Iterator[None]:
        """Inside, `gaussians` holds only the primitives of the submap that is being mapped."""
        with self._only(np.arange(len(self.gaussians)) >= self.submap[1]):
            yield

    @contextmanager
    def _only(self, mask: np.ndarray) -> Iterator[None]:
        self._resting = self.gaussians.rest(~mask)
        try:
            yield
        finally:
            self.gaussians.wake(self._resting)
            self._resting = None

    @classmethod
    def create(
        cls, low: np.ndarray, high: np.ndarray, settings: MappingSettings, rng: np.random.Generator
    ) -> "HybridMap":
        """An untrained map over the box [low, high] (world, m)."""
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        margin = FIELD_MARGIN_M
        gaussians = GaussianParameters.from_model(GaussianModel.empty())
        if settings.geometry == "tsdf":
            fused = TsdfField(np.asarray(low) - margin, np.asarray(high) + margin, settings.tsdf)
            return cls(fused, None, gaussians, settings)
        field = SdfField(np.asarray(low) - margin, np.asarray(high) + margin, settings.field, generator)
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
        if isinstance(self.field, TsdfField):
            self.field = self.field.grown(low, high)
        elif self.optimiser is not None:
            self.field, self.optimiser = grown_field(self.field, self.optimiser, low, high, generator)
        self.field_changed()

    def render(self, camera: Camera, T_world_camera: np.ndarray) -> RenderedView:
        """View of the Gaussians, or of the surface (`views`): rgb 0..1, depth m (0 where alpha < 0.5), alpha."""
        if self.settings.views == "surface":
            if self._surface_view is None:
                self._surface_view = SurfaceView(self.field)
            return RenderedView(*self._surface_view.render(camera, T_world_camera))
        return render_view(self.gaussians, camera, T_world_camera, self.settings.gaussians)

    def field_changed(self) -> None:
        """To be called by who trains the field: views of its surface start from the new one."""
        self._surface_view = None

    def state(self) -> dict[str, dict[str, np.ndarray]]:
        """Arrays by table: `field`, `gaussians` (what the map is) and `optimiser` (what training needs)."""
        gaussians = self.gaussians.state()
        moments = {f"gaussians.{k}": v for k, v in gaussians.items() if k != "values"}
        adam = self.optimiser.state() if self.optimiser is not None else {}
        tables = {
            "field": self.field.state(),
            "gaussians": {"values": gaussians["values"]},
            "optimiser": {**{f"field.{k}": v for k, v in adam.items()}, **moments},
        }
        if self.settings.window.submap_keyframes:
            tables["optimiser"]["submap"] = np.array(self.submap, np.int64)
        return tables

    def to_look_at(self) -> "HybridMap":
        """A copy that does not change with this map; it cannot be trained further."""
        field = copy.deepcopy(self.field)
        gaussians = GaussianParameters.from_values(self.gaussians.values.detach().numpy())
        return HybridMap(field, None, gaussians, self.settings, self.keyframes)

    @classmethod
    def from_state(
        cls, settings: MappingSettings, state: dict[str, dict[str, np.ndarray]], keyframes: Sequence[Keyframe]
    ) -> "HybridMap":
        """Inverse of `state`, exact. Without the table `optimiser` the map can be looked at, not trained further."""
        boxes = state["field"].get("boxes")
        if boxes is None or boxes.shape != (2, 2, 3):
            raise ArtifactError("map: the field's boxes are missing; it was written by another version, map it again")
        anchor, box = boxes
        gaussians = GaussianParameters.from_model(GaussianModel.empty())
        if settings.geometry == "tsdf":
            hybrid = cls(TsdfField(box[0], box[1], settings.tsdf, anchor), None, gaussians, settings)
        else:
            field = SdfField(box[0], box[1], settings.field, torch.Generator().manual_seed(0), anchor)
            hybrid = cls(field, FieldOptimiser(field, settings.field), gaussians, settings)
        hybrid.field.load_state(state["field"])
        hybrid.keyframes = list(keyframes)
        if "optimiser" not in state:
            hybrid.gaussians = GaussianParameters.from_values(state["gaussians"]["values"])
            return hybrid
        tables: dict[str, dict[str, np.ndarray]] = {p: {} for p in OPTIMISER_PREFIXES}
        for name, array in state["optimiser"].items():
            if name == "submap":
                hybrid.submap = (int(array[0]), int(array[1]))
                continue
            prefix = next(p for p in OPTIMISER_PREFIXES if name.startswith(p))
            tables[prefix][name.removeprefix(prefix)] = array
        if hybrid.optimiser is not None:
            hybrid.optimiser.load_state(tables["field."])
        hybrid.gaussians = GaussianParameters.from_state({**state["gaussians"], **tables["gaussians."]})
        return hybrid
