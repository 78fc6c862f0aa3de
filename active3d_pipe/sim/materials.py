"""Materials: a base colour or a texture with its mip pyramid, in display values."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True, eq=False)
class Material:
    """How the faces of one material look.

    Attributes:
        name: as in the file.
        base_color: (3,) float32 display values 0..1 that multiply texture and vertex colours.
        mips: levels of the texture, (h, w, 4) uint8 RGBA each, level 0 first, every level half the size of the one
            before it, the last one 1 x 1; empty = no texture.
        alpha_cutoff: texels with an alpha below it are holes (0..1); None = the alpha channel means nothing.
    """

    name: str
    base_color: np.ndarray
    mips: tuple[np.ndarray, ...] = ()
    alpha_cutoff: float | None = None


def mip_pyramid(image: np.ndarray) -> tuple[np.ndarray, ...]:
    """All levels of an RGBA image (h, w, 4) uint8 down to 1 x 1, each the area average of level 0's pixels.

    Averages are taken of display values, as the supersampled image of the same surface would.
    """
    levels = [np.ascontiguousarray(image)]
    current = image.astype(np.float32)
    while max(current.shape[:2]) > 1:
        current = _halve(_halve(current, 0), 1)
        levels.append(np.clip(np.rint(current), 0, 255).astype(np.uint8))
    return tuple(levels)


def _halve(image: np.ndarray, axis: int) -> np.ndarray:
    """Half the size along `axis` (rounded down, at least 1); odd sizes are averaged with fractional weights."""
    n = image.shape[axis]
    m = max(n // 2, 1)
    if n == m:
        return image
    image = np.moveaxis(image, axis, 0)
    if n == 2 * m:
        out = 0.5 * (image[0::2] + image[1::2])
    else:
        # Output pixel i covers [i, i + 1] * n / m of the input: three pixels, the middle one whole.
        i = np.arange(m, dtype=np.float32)
        shape = (m,) + (1,) * (image.ndim - 1)
        first, last = ((m - i) / n).reshape(shape), ((i + 1) / n).reshape(shape)
        out = first * image[0 : n - 1 : 2] + (m / n) * image[1:n:2] + last * image[2 : n + 1 : 2]
    return np.moveaxis(out, 0, axis)
