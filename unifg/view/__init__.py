"""Anything that was solved, looked at: scenes in three dimensions, as pages that need nothing else, or live."""

from unifg.view.live import Live
from unifg.view.scene import Scene

__all__ = ["Live", "Scene"]


__dir__ = __all__.copy
