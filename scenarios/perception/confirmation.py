"""Confirmation of new tracks by M of the last N readings, the usual rule against false detections.

Few false detections that are spread out are in one place M times in N readings (Bar-Shalom and Li,
Multitarget-Multisensor Tracking, 1995).
"""

from __future__ import annotations

from collections import deque

from unifg.typing import IntArray


class Confirmation:
    """Names that were seen in enough of the last readings."""

    def __init__(self, needed: int, readings: int) -> None:
        """Begin with nothing seen."""
        self._needed = needed
        self._seen: deque[frozenset[int]] = deque(maxlen=readings)

    def note(self, names: IntArray) -> None:
        """Take in the names of a reading."""
        self._seen.append(frozenset(names.tolist()))

    def holds(self, name: int) -> bool:
        """Test whether a name was seen often enough."""
        return sum(name in names for names in self._seen) >= self._needed
