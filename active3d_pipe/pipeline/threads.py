"""The number of threads of every numeric library, set once for the process.

Sums over threads depend on how many there are, so the number is part of every key. The environment variables
work only before NumPy, Numba and torch are imported: the command line calls this first, and this module imports
nothing.
"""

import os
import sys

_VARIABLES = (
    "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "VECLIB_MAXIMUM_THREADS",
)


def set_threads(count: int) -> None:
    """Use `count` threads in NumPy, Numba, torch and OpenMP libraries, whether or not they are loaded yet."""
    for name in _VARIABLES:
        os.environ[name] = str(count)
    torch = sys.modules.get("torch")
    if torch is not None and torch.get_num_threads() != count:
        torch.set_num_threads(count)
    numba = sys.modules.get("numba")
    if numba is not None:
        # Numba cannot use more threads than it was loaded with.
        numba.set_num_threads(min(count, int(numba.config.NUMBA_NUM_THREADS)))
