"""The pipeline from photos to a textured mesh, usable without the command line. `pipeline.py` is its contents page."""

import os

# Numba tries TBB first and warns where it is too old; nothing here needs it. Read when numba is first imported.
os.environ.setdefault("NUMBA_THREADING_LAYER_PRIORITY", "omp workqueue tbb")
# Waiting threads of OpenMP (PyTorch's and numba's own pools) sleep after some microseconds instead of spinning for
# milliseconds: each would take the cores from the other's, and from other programs. Read when PyTorch is imported.
os.environ.setdefault("GOMP_SPINCOUNT", "2000")
