"""Smoothing while a robot drives: incremental over the whole history, or over a window of fixed length."""

from unifg.smoothing.fixed_lag import FixedLag
from unifg.smoothing.incremental import Incremental

__all__ = ["FixedLag", "Incremental"]


__dir__ = __all__.copy
