"""Smoothing while a robot drives: incremental over the whole history, or over a window of fixed length."""

from unifg.smoothing.fixed_lag import FixedLag
from unifg.smoothing.incremental import Incremental

__all__ = ["FixedLag", "Incremental"]


def __dir__() -> list[str]:
    """List what is public."""
    return list(__all__)
