"""A field whose box grows: what it says inside the old box stays as it was."""

import numpy as np
import torch

from active3d_pipe.errors import ConfigError
from active3d_pipe.field.encoders import DenseGrids, Encoder, Planes
from active3d_pipe.field.encoding import BlobLayout, PlaneLayout
from active3d_pipe.field.optimise import FieldOptimiser
from active3d_pipe.field.sdf_field import SdfField


def grown_field(
    field: SdfField, optimiser: FieldOptimiser, low: np.ndarray, high: np.ndarray, generator: torch.Generator
) -> tuple[SdfField, FieldOptimiser]:
    """The field and its optimiser over a larger box.

    Nodes of planes and grid and bins of the encoding keep their places in the world and their values; new nodes are
    drawn as at creation, new bins have weight 0, new moments are 0. So the function inside the old box is unchanged.

    Args:
        field, optimiser: as trained so far; left as they are.
        low, high: (3,) corners of the new box, world, m; what they leave out of the old one is kept.
        generator: draws the new nodes.

    Raises:
        ConfigError: the field's encoder is a hash grid, whose tables are bound to their box.
    """
    if not isinstance(field.encoder, Planes | DenseGrids | None):
        raise ConfigError(
            f"mapping.field.encoder={field.settings.encoder}: its box cannot grow; "
            'expected triplane, grids or none with scene.bounds="auto", or give scene.bounds'
        )
    box = np.stack([np.minimum(low, field.box[0]), np.maximum(high, field.box[1])])
    new = SdfField(box[0], box[1], field.settings, generator, field.anchor)
    with torch.no_grad():
        for name, p in new.named_parameters():
            if name.endswith("blob_weight"):
                p.zero_()
            _carry(name, field, new, getattr(field, name).detach().numpy(), p.numpy())
    first = field.grid_first - new.grid_first
    new.visits[_window(first, field.visits.shape)] = field.visits

    moments = {}
    shapes = {name: tuple(p.shape) for name, p in new.named_parameters()}
    for key, old in optimiser.state().items():
        name = key.rpartition(".")[0]
        if old.ndim == 0:  # the step count
            moments[key] = old
        else:
            moments[key] = np.zeros(shapes[name], np.float32)
            _carry(name, field, new, old, moments[key])
    adam = FieldOptimiser(new, field.settings)
    adam.load_state(moments)
    return new, adam


def _carry(name: str, old: SdfField, new: SdfField, source: np.ndarray, target: np.ndarray) -> None:
    """Copy what belongs to parameter `name` (its values or a moment of them) to its place in the larger table."""
    if name == "grid":
        target[_window(old.grid_first - new.grid_first, source.shape[:3])] = source
    elif name == "planes":
        _carry_nodes(old.encoder, new.encoder, source, target)
    elif name == "color_planes":
        _carry_nodes(old.color_encoder, new.color_encoder, source, target)
    elif name.endswith("blob_weight"):
        _carry_bins(old.blob, new.blob, source, target)
    else:
        target[...] = source


def _carry_nodes(old: Encoder | None, new: Encoder | None, source: np.ndarray, target: np.ndarray) -> None:
    if isinstance(old, Planes) and isinstance(new, Planes):
        _carry_planes(old.layout, new.layout, source, target)
    elif isinstance(old, DenseGrids) and isinstance(new, DenseGrids):
        at = to = 0
        for level, ((nodes, _), (room, _)) in enumerate(zip(old.levels, new.levels, strict=True)):
            grid = target[to : to + new.sizes[level]].reshape(*room, -1)  # a view
            part = source[at : at + old.sizes[level]].reshape(*nodes, -1)
            grid[_window(old.first[level] - new.first[level], nodes)] = part
            at, to = at + old.sizes[level], to + new.sizes[level]


def _carry_planes(old: PlaneLayout, new: PlaneLayout, source: np.ndarray, target: np.ndarray) -> None:
    for was, row in zip(old.rows, new.rows, strict=True):
        (at, na, nb), (to, ma, mb) = was[:3], row[:3]
        plane = target[to : to + ma * mb].reshape(ma, mb, -1)  # a view
        plane[_window(was[6:8] - row[6:8], (na, nb))] = source[at : at + na * nb].reshape(na, nb, -1)


def _carry_bins(old: BlobLayout, new: BlobLayout, source: np.ndarray, target: np.ndarray) -> None:
    rows = target.reshape(3, new.bins, -1)
    for axis, bins in enumerate(source.reshape(3, old.bins, -1)):
        # Bins beyond the end of an axis hold no point inside the box: those that no longer fit have no say.
        start = int(new.first[axis] - old.first[axis])
        count = min(old.bins, new.bins - start)
        rows[axis, start : start + count] = bins[:count]


def _window(start: np.ndarray, shape: tuple[int, ...]) -> tuple[slice, ...]:
    return tuple(slice(int(s), int(s) + int(n)) for s, n in zip(start, shape, strict=True))
