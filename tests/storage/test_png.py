"""Images of a log: any PNG reader opens them, any PNG can be read, damage is noticed."""

import io
import zlib

import numpy as np
import pytest
from PIL import Image

from active3d_pipe.storage.png import decode_png, encode_png


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (9, 1), (34, 60)])
def test_pillow_opens_what_is_written(shape: tuple[int, int]) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (*shape, 3), dtype=np.uint8)
    data = encode_png(rgb)
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(data))), rgb)
    np.testing.assert_array_equal(decode_png(data), rgb)
    assert encode_png(rgb.copy()) == data


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L"])
def test_what_pillow_writes_is_read(mode: str) -> None:
    image = Image.fromarray(np.random.default_rng(1).integers(0, 256, (20, 30, 3), dtype=np.uint8)).convert(mode)
    buffer = io.BytesIO()
    image.save(buffer, "PNG")
    np.testing.assert_array_equal(decode_png(buffer.getvalue()), np.asarray(image.convert("RGB")))


def test_a_flipped_bit_or_a_cut_is_an_error() -> None:
    data = encode_png(np.random.default_rng(2).integers(0, 256, (20, 30, 3), dtype=np.uint8))
    flipped = bytearray(data)
    flipped[len(data) // 2] ^= 8
    for bad in (bytes(flipped), data[: len(data) // 2]):
        with pytest.raises((ValueError, OSError, zlib.error)):
            decode_png(bad)
