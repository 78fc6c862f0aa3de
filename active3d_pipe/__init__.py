"""active3d: explores an unknown indoor scene by itself and reconstructs it in 3D."""

import os as _os

# Both OpenMP runtimes in the process (torch's and Numba's) spin while they wait. On a loaded
# machine that costs a factor of ten; passive waiting costs a few percent. It only takes effect
# when set before either is imported.
_os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# Numba's default order tries TBB first and warns about versions of it that nobody asked for.
_os.environ.setdefault("NUMBA_THREADING_LAYER_PRIORITY", "omp tbb workqueue")

__version__ = "0.1.0"
