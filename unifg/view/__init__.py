"""Anything that was solved, looked at: scenes in three dimensions, as pages that need nothing else, or live."""

from unifg.view.live import Live
from unifg.view.scene import Scene

__all__ = ["Live", "Scene"]


def __dir__() -> list[str]:
    """List what is public."""
    return list(__all__)
