"""Text files whose lines all hold the same fields: numbers separated by blanks, and comments that begin with ``#``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from unifg.errors import FileFormatError
from unifg.files.contents import LIMITS, Limits, legible
from unifg.files.fields import read_fields
from unifg.files.lines import read_lines
from unifg.typing import Array, IntArray

__all__ = ["Table"]


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
