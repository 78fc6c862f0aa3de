"""Uncertainty volumes as Zarr v3: opens in xarray (`group="scale0"`), tensorstore and OME-Zarr readers.

`volume.zarr/scale0/<name>` is float32 [round, x, y, z] with the round as leading axis (length 1: stores of
several rounds concatenate), beside 1-D coordinate arrays of the same names as the dimensions.
"""

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from active3d_pipe.errors import ArtifactError
from active3d_pipe.storage.files import COMPRESSION_THREADS, reading, writing
from active3d_pipe.structures import VOLUMES, UncertaintyVolume, VoxelGrid
from active3d_pipe.structures.uncertainty_volume import ZERO_BY_DEFAULT

GROUP = "scale0"
MAX_VOXELS = 2**31


def write_volume(path: Path, volume: UncertaintyVolume) -> None:
    """Write a volume as a new Zarr group at `path`."""
    import zarr
    from zarr.codecs import ZstdCodec

    grid = volume.grid
    shape = (1, *grid.shape)
    # Checksums: the default codecs pass every single-bit flip silently. Level 1 is twice as fast as 3, for 1 % more.
    codec = ZstdCodec(level=1, checksum=True)
    with writing(path):
        root: Any = zarr.create_group(store=str(path), zarr_format=3, attributes=_attributes(volume))
        attributes: dict[str, Any] = {"grid": _grid_document(grid), "fusion": volume.fusion}
        if volume.drop_bits is not None:
            attributes["drop_bits"] = list(volume.drop_bits)
        group = root.create_group(GROUP, attributes=attributes)

        def write(name: str) -> None:
            unit, meaning = VOLUMES[name]
            array = group.create_array(
                name, shape=shape, chunks=shape, dtype="float32", compressors=codec, fill_value=float("nan"),
                dimension_names=("round", "x", "y", "z"), attributes={"units": unit, "long_name": meaning},
                config={"write_empty_chunks": True},
            )
            array[...] = volume[name][None]

        with ThreadPoolExecutor(COMPRESSION_THREADS) as pool:
            list(pool.map(write, VOLUMES))
        _write_axis(group, "round", np.array([volume.round], np.int64), "1", codec)
        for i, axis in enumerate("xyz"):
            _write_axis(group, axis, grid.axis(i), "m", codec)


def read_volume(path: Path) -> UncertaintyVolume:
    """Read a volume; ArtifactError when it is missing, damaged, or has another form."""
    import zarr

    with reading(path, "a Zarr group written by active3d"):
        if not path.is_dir():
            raise FileNotFoundError(path)
        root: Any = zarr.open_group(store=str(path), mode="r", zarr_format=3)
        group = root[GROUP]
        doc = group.attrs["grid"]
        grid = VoxelGrid(np.array(doc["origin"]), float(doc["voxel_size"]), tuple(doc["shape"]))
        if grid.size > MAX_VOXELS:
            raise ArtifactError(f"{path}: grid {grid.shape} is larger than any that active3d writes")
        arrays = {}
        for name in VOLUMES:
            if name in ZERO_BY_DEFAULT and name not in group:
                continue  # written before there was such a layer
            array = group[name]
            if array.shape != (1, *grid.shape):
                raise ArtifactError(f"{path}: {name} has shape {array.shape}, expected {(1, *grid.shape)}")
            values = np.ascontiguousarray(array[0], dtype=np.float32)
            if np.isnan(values).any():  # the fill value: a chunk is missing
                raise ArtifactError(f"{path}: {name} has missing chunks; restore the file or re-run the stage")
            arrays[name] = values
        drop = group.attrs.get("drop_bits")
        return UncertaintyVolume(
            grid, int(group["round"][0]), arrays, json.loads(json.dumps(group.attrs["fusion"])),
            None if drop is None else (float(drop[0]), float(drop[1])),
        )


def read_fusion(path: Path) -> dict[str, Any]:
    """What evidence maximisation found, without reading the volumes."""
    import zarr

    with reading(path, "a Zarr group written by active3d"):
        root: Any = zarr.open_group(store=str(path), mode="r", zarr_format=3)
        return dict(root[GROUP].attrs["fusion"])


def _write_axis(group: Any, name: str, values: np.ndarray, unit: str, codec: Any) -> None:
    array = group.create_array(
        name, shape=values.shape, chunks=values.shape, dtype=values.dtype, compressors=codec,
        dimension_names=(name,), attributes={"units": unit}, config={"write_empty_chunks": True},
    )
    array[...] = values


def _grid_document(grid: VoxelGrid) -> dict:
    return {"origin": grid.origin.tolist(), "voxel_size": grid.voxel_size, "shape": list(grid.shape)}


def _attributes(volume: UncertaintyVolume) -> dict:
    """OME-NGFF 0.5 multiscales, so that image viewers place the volume in metres."""
    grid, size = volume.grid, volume.grid.voxel_size
    first = [float(grid.axis(i)[0]) for i in range(3)]
    axes = [{"name": "round", "type": "time"}]
    axes += [{"name": a, "type": "space", "unit": "meter"} for a in "xyz"]
    datasets = [
        {
            "path": f"{GROUP}/u_final",
            "coordinateTransformations": [
                {"type": "scale", "scale": [1.0, size, size, size]},
                {"type": "translation", "translation": [float(volume.round), *first]},
            ],
        }
    ]
    ome = {"version": "0.5", "multiscales": [{"name": "u_final", "axes": axes, "datasets": datasets}]}
    return {"ome": ome, "schema": "active3d.volume/1"}
