"""Measurements of whole runs; each module is started with ``python -m benchmarks.<name>`` from the checkout.

Matrices here are small: more than one thread per process only makes processes wait for each other, and this must be
said before NumPy is loaded. Problems that tests and measurements share live with the tests, and are imported as there.
"""

import os
import sys
from pathlib import Path

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"):
    os.environ[_variable] = "1"
sys.path.append(str(Path(__file__).resolve().parent.parent / "tests"))
