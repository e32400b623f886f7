"""One thread for the BLAS that fronts use: they are small, and threads waiting for each other cost more than they do."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import scipy.linalg.cython_blas


@cache
def _controls() -> tuple[Any, Any] | None:
    """Functions of SciPy's OpenBLAS that get and set the number of threads; None with another BLAS."""
    try:
        library = ctypes.CDLL(scipy.linalg.cython_blas.__file__)
        return library.scipy_openblas_get_num_threads, library.scipy_openblas_set_num_threads
    except (OSError, AttributeError):
        return None


@contextmanager
def one_thread() -> Iterator[None]:
    """Within this context SciPy's BLAS runs on one thread; afterwards on as many as before."""
    controls = _controls()
    before = 1 if controls is None else controls[0]()
    if controls is None or before == 1:
        yield
        return
    controls[1](1)
    try:
        yield
    finally:
        controls[1](before)
