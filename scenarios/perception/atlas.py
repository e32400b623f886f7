"""Slots of landmarks: names, kinds and radii, and the landmarks that had to leave their slot."""

from __future__ import annotations

import numpy as np

from unifg.models.matching import NEW
from unifg.scenarios.perception.belief import Landmarks
from unifg.typing import Array, BoolArray, IntArray

FREE = -1


class Atlas:
    """The book of the landmarks; their positions are the window's.

    Attributes:
        names: (K,) of what each slot holds, ``FREE`` for nothing.
        kinds: (K,) cylinder or corner.
        radii: (K,) mean of those measured [m].
    """

    def __init__(self, slots: int) -> None:
        """Begin empty."""
        self.names: IntArray = np.full(slots, FREE, dtype=np.intp)
        self.kinds: IntArray = np.zeros(slots, dtype=np.intp)
        self.radii = np.zeros(slots)
        self._counts = np.zeros(slots)
        self._first: IntArray = np.zeros(slots, dtype=np.intp)
        self._last: IntArray = np.zeros(slots, dtype=np.intp)
        self._slots: dict[int, int] = {}
        self._now = self._known = 0
        self._retired: list[tuple[int, int, Array, Array, float, int]] = []

    @property
    def used(self) -> BoolArray:
        """(K,) which slots hold a landmark."""
        return np.not_equal(self.names, FREE)

    def tick(self) -> None:
        """Time goes on."""
        self._now += 1

    def slot_of(self, name: int) -> int:
        """The slot of a landmark, or ``NEW``."""
        return self._slots.get(name, NEW)

    def free_slot(self) -> int | None:
        """A slot that holds nothing."""
        free = np.flatnonzero(self.names == FREE)
        return int(free[0]) if len(free) else None

    def oldest(self, among: BoolArray) -> int | None:
        """The slot, of those marked (K,), whose landmark has not been seen for longest."""
        candidates = np.flatnonzero(among & self.used)
        return int(candidates[np.argmin(self._last[candidates])]) if len(candidates) else None

    def admit(self, slot: int, kind: int, name: int | None) -> None:
        """Enter a landmark; without a name it gets the next number."""
        if name is None:
            name = self._known
        self._known += 1
        self.names[slot], self.kinds[slot], self.radii[slot] = name, kind, 0.0
        self._counts[slot], self._first[slot] = 0, self._known
        self._slots[name] = slot

    def sight(self, slot: int, radius: float) -> None:
        """Note that a landmark was seen, with that radius [m]."""
        self._counts[slot] += 1
        self.radii[slot] += (radius - self.radii[slot]) / self._counts[slot]
        self._last[slot] = self._now

    def retire(self, slot: int, position: Array, covariance: Array) -> None:
        """Free a slot; what it held stays on the map as it was last believed."""
        first, name, kind = int(self._first[slot]), int(self.names[slot]), int(self.kinds[slot])
        self._retired.append((first, name, position.copy(), covariance.copy(), float(self.radii[slot]), kind))
        self.strike(slot)

    def strike(self, slot: int) -> None:
        """Free a slot; what it held was no landmark."""
        del self._slots[int(self.names[slot])]
        self.names[slot] = FREE

    def landmarks(self, positions: Array, covariance: Array) -> Landmarks:
        """All that has been seen, in the order of first sight.

        Args:
            positions: (K, 2) of the slots [m].
            covariance: (2 K, 2 K) [m^2].
        """
        slots = np.flatnonzero(self.used)
        columns = 2 * slots[:, None] + np.arange(2)
        rows = [
            (int(self._first[s]), int(self.names[s]), positions[s], block, float(self.radii[s]), int(self.kinds[s]))
            for s, block in zip(slots.tolist(), covariance[columns[:, :, None], columns[:, None, :]], strict=True)
        ]
        # A landmark that was given up and seen again stands in a slot: its old entry does not count.
        known = {row[1] for row in rows}
        rows = sorted([row for row in self._retired if row[1] not in known] + rows, key=lambda row: row[0])
        if not rows:
            return Landmarks.none()
        _, names, means, covariances, radii, kinds = zip(*rows, strict=True)
        return Landmarks(
            np.array(names, dtype=np.intp),
            np.array(means),
            np.array(covariances),
            np.array(radii),
            np.array(kinds, dtype=np.intp),
        )
