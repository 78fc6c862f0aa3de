"""PNG images (8-bit RGB) written and read fast: one filter for all rows, so that encoding needs no search.

Filter "up" (every row minus the one above) and zlib level 1: a third of the time of Pillow's adaptive filter, the same
size. `zlib` lets other threads run meanwhile. Any PNG can be read; those written here are read faster.
"""

import io
import struct
import zlib

import numpy as np
from PIL import Image

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_UP = 2
_RGB8 = bytes([8, 2, 0, 0, 0])  # bit depth, colour type RGB, deflate, filter method, not interlaced


def encode_png(rgb: np.ndarray) -> bytes:
    """The PNG file of an image (H, W, 3) uint8; equal images give equal bytes."""
    height, width = rgb.shape[:2]
    rows = np.ascontiguousarray(rgb).reshape(height, 3 * width)
    filtered = np.empty((height, 1 + 3 * width), np.uint8)
    filtered[:, 0] = _UP
    filtered[0, 1:] = rows[0]
    np.subtract(rows[1:], rows[:-1], out=filtered[1:, 1:])  # modulo 256, as the format has it
    header = struct.pack(">II", width, height) + _RGB8
    packed = zlib.compress(filtered.data, 1)
    return _SIGNATURE + _chunk(b"IHDR", header) + _chunk(b"IDAT", packed) + _chunk(b"IEND", b"")


def decode_png(data: bytes) -> np.ndarray:
    """The image (H, W, 3) uint8 of a PNG file; raises ValueError, OSError or zlib.error when it is damaged."""
    image = _decode_up(data)
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")) if image is None else image


def _chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(content, zlib.crc32(kind)))


def _decode_up(data: bytes) -> np.ndarray | None:
    """The image of a file as `encode_png` writes it, None for any other; ValueError when a checksum is wrong."""
    content: dict[bytes, bytes] = {}
    at = len(_SIGNATURE)
    while at + 12 <= len(data):
        (size,) = struct.unpack_from(">I", data, at)
        kind, body = data[at + 4 : at + 8], data[at + 8 : at + 8 + size]
        if kind in content or kind not in (b"IHDR", b"IDAT", b"IEND"):
            return None
        if data[at + 8 + size : at + 12 + size] != struct.pack(">I", zlib.crc32(body, zlib.crc32(kind))):
            raise ValueError(f"checksum of PNG chunk {kind.decode()} is wrong")
        content[kind] = body
        at += 12 + size
    header = content.get(b"IHDR", b"")
    if b"IDAT" not in content or header[8:] != _RGB8:
        return None
    width, height = struct.unpack(">II", header[:8])
    raw = zlib.decompress(content[b"IDAT"], bufsize=height * (1 + 3 * width))
    if len(raw) != height * (1 + 3 * width):
        raise ValueError(f"PNG of {width}x{height} holds {len(raw)} bytes")
    filtered = np.frombuffer(raw, np.uint8).reshape(height, 1 + 3 * width)
    if (filtered[:, 0] != _UP).any():
        return None
    return np.add.accumulate(filtered[:, 1:], axis=0, dtype=np.uint8).reshape(height, width, 3)
