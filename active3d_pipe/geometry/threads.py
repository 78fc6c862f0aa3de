"""Work on many frames at a time: whole frames on threads, where a parallel loop within each would mostly wait."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numba

T = TypeVar("T")
Result = TypeVar("Result")


def on_threads(function: Callable[[T], Result], items: Iterable[T]) -> list[Result]:
    """`function` of every item, in their order, on as many threads as parallel loops use.

    The function must release the interpreter for most of its time (`nogil` kernels that are not parallel themselves),
    and what it writes must be its own, or the same whoever comes last.
    """
    with ThreadPoolExecutor(numba.get_num_threads()) as pool:
        return list(pool.map(function, items))
