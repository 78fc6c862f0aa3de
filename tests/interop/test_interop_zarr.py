"""Uncertainty volumes open in xarray and in tensorstore, with our reader's numbers."""

import importlib
from pathlib import Path

import numpy as np
import pytest

from active3d_pipe.storage import volumes
from active3d_pipe.structures import VOLUMES
from tests.interop.conftest import need_module

pytestmark = pytest.mark.interop


def stores(run: Path) -> list[Path]:
    found = sorted(run.glob("uncertainty/round_*/volume.zarr"))
    assert found, run
    return found


def test_xarray_opens_volumes_with_coordinates_in_metres(tiny_run: Path) -> None:
    need_module("xarray")
    xarray = importlib.import_module("xarray")
    for path in stores(tiny_run):
        ours = volumes.read_volume(path)
        with xarray.open_zarr(path, group="scale0", consolidated=False) as data:
            assert set(data.data_vars) == set(VOLUMES)
            for name in VOLUMES:
                array = data[name]
                assert array.dims == ("round", "x", "y", "z")
                assert array.attrs["units"] == VOLUMES[name][0]
                np.testing.assert_array_equal(array.values[0], ours[name])
            for i, axis in enumerate("xyz"):
                np.testing.assert_array_equal(data[axis].values, ours.grid.axis(i))
                assert data[axis].attrs["units"] == "m"
            assert data["round"].values.tolist() == [ours.round]


def test_xarray_joins_the_rounds_along_their_axis(tiny_run: Path) -> None:
    need_module("xarray")
    xarray = importlib.import_module("xarray")
    paths = stores(tiny_run)
    joined = xarray.concat([xarray.open_zarr(p, group="scale0", consolidated=False) for p in paths], dim="round")
    assert joined["u_final"].shape == (len(paths), *volumes.read_volume(paths[0]).grid.shape)


def test_tensorstore_reads_the_same_numbers(tiny_run: Path) -> None:
    need_module("tensorstore")
    tensorstore = importlib.import_module("tensorstore")
    for path in stores(tiny_run):
        ours = volumes.read_volume(path)
        for name in VOLUMES:
            spec = {"driver": "zarr3", "kvstore": {"driver": "file", "path": str(path / volumes.GROUP / name)}}
            array = tensorstore.open(spec, open=True, read=True).result()
            assert array.domain.labels == ("round", "x", "y", "z")
            np.testing.assert_array_equal(array.read().result()[0], ours[name])
