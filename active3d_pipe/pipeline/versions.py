"""Versions of the libraries whose code can change an artifact's bytes; read from metadata, nothing is imported."""

import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version

from active3d_pipe import __version__

LIBRARIES = (
    "numpy", "scipy", "torch", "numba", "open3d-cpu", "open3d", "trimesh", "pyrender", "mcap",
    "mcap-protobuf-support", "foxglove-schemas-protobuf", "protobuf", "zarr", "numcodecs", "safetensors",
    "scikit-image", "matplotlib", "pillow",
)


@cache
def library_versions() -> dict[str, str]:
    """Name -> version of everything installed among `LIBRARIES`, with Python and active3d."""
    found = {"active3d": __version__, "python": platform.python_version(), "machine": platform.machine()}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
