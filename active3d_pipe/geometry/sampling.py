"""Choosing a few of many."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

T = TypeVar("T")


def spread(items: Sequence[T], most: int) -> list[T]:
    """At most `most` items, evenly spread over the sequence, first and last included."""
    if len(items) <= most:
        return list(items)
    chosen = np.unique(np.linspace(0, len(items) - 1, most).round().astype(int))
    return [items[int(i)] for i in chosen]
