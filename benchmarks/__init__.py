"""Measurements of whole runs; each module is started with ``python -m benchmarks.<name>`` from the checkout.

Matrices here are small: more than one thread per process only makes processes wait for each other, and this must be
said before NumPy is loaded.
"""

import os

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"):
    os.environ[_variable] = "1"
