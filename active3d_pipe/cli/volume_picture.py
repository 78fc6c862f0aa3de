"""Numbers and a picture of one slice of an uncertainty volume."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from active3d_pipe.errors import ConfigError
from active3d_pipe.structures import VOLUMES, UncertaintyVolume, VoxelGrid


@dataclass(frozen=True, slots=True)
class Slice:
    """A slice across `axis` ("x", "y" or "z") at voxel `index`, whose centre is at `metres` (world)."""

    axis: str
    index: int
    metres: float


def parse_slice(text: str | None, grid: VoxelGrid) -> Slice:
    """`z=1.2` -> the slice that holds z = 1.2 m; None -> the middle of the height."""
    if text is None:
        text = f"z={grid.axis(2)[grid.shape[2] // 2]}"
    axis, _, value = text.partition("=")
    try:
        if axis not in ("x", "y", "z"):
            raise ValueError
        metres = float(value)
    except ValueError:
        raise ConfigError(f"--slice {text}: expected an axis and metres, as in --slice z=1.2") from None
    i = "xyz".index(axis)
    low, high = grid.low[i], grid.high[i]
    if not low <= metres <= high:
        raise ConfigError(f"--slice {text}: the volume spans {axis} = {low:.2f} to {high:.2f} m")
    index = min(int((metres - low) / grid.voxel_size + 1e-9), grid.shape[i] - 1)
    return Slice(axis, index, float(grid.axis(i)[index]))


def plane(values: np.ndarray, cut: Slice) -> np.ndarray:
    """The two-dimensional array of a slice; its axes are the other two in the order x, y, z."""
    return np.take(values, cut.index, axis="xyz".index(cut.axis))


def describe(volume: UncertaintyVolume, name: str, cut: Slice) -> dict[str, Any]:
    """Statistics of a volume: everywhere, where observed, and in the slice."""
    values, observed = volume[name], volume.observed
    return {
        "schema": "active3d.inspect/1", "volume": name, "unit": VOLUMES[name][0], "round": volume.round,
        "grid": {
            "shape": list(volume.grid.shape), "voxel_size_m": volume.grid.voxel_size, "low_m": volume.grid.low.tolist()
        },
        "slice": {"axis": cut.axis, "index": cut.index, "metres": cut.metres},
        "fusion": volume.fusion,
        "regions": {
            "everywhere": _statistics(values),
            "observed": _statistics(values[observed]),
            f"slice {cut.axis}={cut.metres:.2f}": _statistics(plane(values, cut)),
        },
    }


def draw(volume: UncertaintyVolume, name: str, cut: Slice, png: Path) -> None:
    """Write the slice as a picture: metric axes, colour scale, unobserved voxels hatched out in grey."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from active3d_pipe.pipeline.files import writing

    grid = volume.grid
    across, up = [a for a in "xyz" if a != cut.axis]
    i, j = "xyz".index(across), "xyz".index(up)
    extent = (grid.low[i], grid.high[i], grid.low[j], grid.high[j])
    values = plane(volume[name], cut)
    unseen = ~plane(volume.observed, cut)
    figure, axes = plt.subplots(figsize=(7.2, 6.0), layout="constrained")
    limit = float(np.abs(values).max()) or 1.0
    scale: dict[str, Any] = {"cmap": "viridis"}
    if name == "sdf":
        scale = {"cmap": "coolwarm_r", "vmin": -limit, "vmax": limit}
    image = axes.imshow(values.T, origin="lower", extent=extent, interpolation="nearest", **scale)
    shade = np.zeros((*unseen.T.shape, 4))
    shade[unseen.T] = (0.6, 0.6, 0.6, 0.45)
    axes.imshow(shade, origin="lower", extent=extent, interpolation="nearest")
    axes.set(
        xlabel=f"{across} [m]", ylabel=f"{up} [m]",
        title=f"{name}, round {volume.round}, {cut.axis} = {cut.metres:.2f} m (greyed: not observed)",
    )
    unit = VOLUMES[name][0]
    figure.colorbar(image, label=name if unit == "1" else f"{name} [{unit}]")
    with writing(png):
        png.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(png, dpi=110)
    plt.close(figure)


def _statistics(values: np.ndarray) -> dict[str, float]:
    if values.size == 0:
        return {"voxels": 0, "min": 0.0, "mean": 0.0, "median": 0.0, "p95": 0.0, "max": 0.0}
    return {
        "voxels": int(values.size), "min": float(values.min()), "mean": float(values.mean(dtype=np.float64)),
        "median": float(np.median(values)), "p95": float(np.percentile(values, 95)), "max": float(values.max()),
    }
