"""Smoothing while a robot drives: incremental over the whole history, or over a window of fixed length."""

from unifg.smoothing.families import GrowingFamily
from unifg.smoothing.fixed_lag import FixedLag
from unifg.smoothing.incremental import Incremental
from unifg.smoothing.smoother import Effort

__all__ = ["Effort", "FixedLag", "GrowingFamily", "Incremental"]


def __dir__() -> list[str]:
    """List what is public."""
    return list(__all__)
