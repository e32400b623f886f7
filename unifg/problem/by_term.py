"""Numbers of the constraint rows, as multipliers and penalties are, by the names of their terms."""

from __future__ import annotations

from collections.abc import Sequence
from operator import is_

from unifg.typing import Array

Places = Sequence[tuple[str, slice, tuple[int, int]]]


class ByTerm(dict[str, Array]):
    """(n, m) arrays by constraint term, all of them views of one flat array.

    Attributes:
        places: name, rows and shape of each term.
        flat: (M,) the rows of all terms in their order.
    """

    def __init__(self, places: Places, flat: Array) -> None:
        """View ``flat`` by terms."""
        self.places = places
        self.flat = flat
        for name, rows, shape in places:
            self[name] = flat[rows].reshape(shape)
        self._views = tuple(self.values())

    @property
    def intact(self) -> bool:
        """True if ``flat`` still says it all: nobody has put another array in the place of a term's."""
        return len(self) == len(self._views) and all(map(is_, self.values(), self._views))

    def __reduce__(self) -> tuple[type[dict[str, Array]], tuple[dict[str, Array]]]:
        """Pickle plain arrays: views of one array would become arrays of their own."""
        return dict, ({name: array.copy() for name, array in self.items()},)
