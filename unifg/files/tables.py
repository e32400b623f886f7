"""Text files whose lines all hold the same fields: numbers separated by blanks, and comments that begin with ``#``."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unifg.errors import FileFormatError
from unifg.files.contents import LIMITS, Limits, legible, write_text
from unifg.files.fields import read_fields
from unifg.files.lines import read_lines
from unifg.typing import Array, BoolArray, IntArray

__all__ = ["Table", "write_rows"]

logger = logging.getLogger("unifg")

_EXACT = float(2**53)  # whole numbers up to here are exact in float64


@dataclass(frozen=True, eq=False)
class Table:
    """The lines of a file.

    Attributes:
        path: name of the file, for messages.
        integers: (n, k) the leading integers, exact up to 64 bits.
        numbers: (n, m) what follows, finite.
        lines: (n,) numbers of the lines, from 1.
    """

    path: str
    integers: NDArray[np.int64]
    numbers: Array
    lines: IntArray

    @classmethod
    def read(cls, path: str | Path, integers: int, names: str, limits: Limits = LIMITS) -> Table:
        """Read a file, gzipped or not; empty lines and comments are skipped.

        Args:
            path: the file.
            integers: how many integers lead.
            names: of all fields, separated by blanks.
            limits: of what the file may hold.

        Raises:
            FileFormatError: the file is missing, is no text or exceeds a limit, or a line, named in the message, has
                too few or too many fields, or a field that is no finite number.
        """
        name = legible(path)
        found = read_lines(path, 0, limits)
        begin, end, numbers = found.first, found.end, found.number
        whole, table = read_fields(
            found.content, begin, end, integers, names, lambda row: f"{name}, line {numbers[row]}"
        )
        return cls(name, whole, table, numbers)

    def __len__(self) -> int:
        """Number of lines."""
        return len(self.lines)

    def place(self, row: int) -> str:
        """File and line of one of the rows, for messages."""
        return f"{self.path}, line {self.lines[row]}"

    def refuse(self, row: int, message: str) -> FileFormatError:
        """The error for one of the rows."""
        return FileFormatError(f"{self.place(row)}: {message}")

    def refuse_first(self, wrong: BoolArray, message: str) -> None:
        """Refuse the first row of which something (n,) is true.

        Raises:
            FileFormatError: there is one.
        """
        if wrong.any():
            raise self.refuse(int(np.argmax(wrong)), message)

    def whole(self, column: int, name: str) -> NDArray[np.int64]:
        """(n,) whole numbers of a column behind numbers that are none; files write them as 2 or as 2.0e+000.

        Raises:
            FileFormatError: a number is not whole, or float64 does not hold it exactly.
        """
        found = self.numbers[:, column]
        odd = (found != np.floor(found)) | (np.abs(found) >= _EXACT)
        if odd.any():
            k = int(np.argmax(odd))
            raise self.refuse(k, f"field {name} is {found[k]:g}, not a whole number")
        return found.astype(np.int64)

    def in_time(self) -> IntArray:
        """(n,) the rows by the times in the first column of numbers; one warning where the file has another order."""
        time = self.numbers[:, 0]
        back = np.flatnonzero(np.diff(time) < 0.0)
        if len(back):
            logger.warning(
                "%s: time runs backwards, here and %d times more: lines are sorted",
                self.place(int(back[0]) + 1), len(back) - 1,
            )  # fmt: skip
        order: IntArray = np.argsort(time, kind="stable")
        return order


def write_rows(path: str | Path, names: str, columns: Sequence[NDArray[Any]]) -> None:
    """Write a table: a comment that names the fields, and the shortest decimals that are read back exactly.

    Args:
        path: file to write; an existing one is replaced.
        names: of all fields, separated by blanks.
        columns: (n,) or (n, k) each, side by side; integers stay integers.

    Raises:
        FileFormatError: a number is not finite, or the columns differ in length.
    """
    parts = [part[:, None] if part.ndim == 1 else part for part in columns]
    lengths = {len(part) for part in parts}
    if len(lengths) > 1:
        raise FileFormatError(f"{legible(path)}: columns of {', '.join(map(str, sorted(lengths)))} rows do not fit")
    for part in parts:
        bad = np.flatnonzero(~np.isfinite(part).all(axis=1))
        if len(bad):
            raise FileFormatError(f"{legible(path)}: row {bad[0]} is not finite: {part[bad[0]]}")
    rows = zip(*(part.tolist() for part in parts), strict=True)
    lines = ["\t".join(repr(value) for part in row for value in part) for row in rows]
    write_text(Path(path), "\n".join([f"# {names}", *lines]) + "\n")
