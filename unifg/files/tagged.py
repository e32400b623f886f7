"""Text files whose lines begin with a tag, parsed a tag at a time: what g2o and TORO files have in common.

One compiled pass over the bytes finds where the lines of every tag stand (:mod:`unifg.files.lines`); another reads the
numbers of a tag (:mod:`unifg.files.fields`). Python looks at a line only where something about it is unusual.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unifg.errors import FileFormatError
from unifg.files.contents import LIMITS, Limits, legible
from unifg.files.fields import read_fields
from unifg.files.lines import read_lines
from unifg.typing import Array, IntArray

__all__ = [
    "Block",
    "Places",
    "TaggedFile",
    "decimal_lines",
    "distinct",
    "from_triangle",
    "report_isolated",
    "report_skipped",
    "some",
    "triangle_names",
    "upper_triangle",
]

logger = logging.getLogger("unifg")

_TAGS = 64  # told apart by compiled code; who has more has them counted by Python


@dataclass(frozen=True)
class Block:
    """The lines of one tag.

    Attributes:
        tag: the tag.
        integers: (n, k) the leading integers (identifiers), exact up to 64 bits.
        numbers: (n, m) what follows.
        lines: (n,) numbers of the lines, from 1.
    """

    tag: str
    integers: NDArray[np.int64]
    numbers: Array
    lines: IntArray

    def __len__(self) -> int:
        """Number of lines."""
        return len(self.lines)


class _Lines(NamedTuple):
    """Starts of lines after their tag and their ends, (n,) places in the text, and (n,) their numbers, from 1."""

    begin: IntArray
    end: IntArray
    numbers: IntArray

    def of(self, chosen: IntArray) -> _Lines:
        """Some of them."""
        return _Lines(self.begin[chosen], self.end[chosen], self.numbers[chosen])


_NONE = _Lines(*(np.zeros(0, dtype=np.intp) for _ in range(3)))


@dataclass(frozen=True, eq=False)
class TaggedFile:
    """Lines of a file by their first word; comments and empty lines are gone.

    Attributes:
        path: name of the file, for messages.
        content: bytes of the text, in UTF-8.
        lines: where the lines of every tag stand.
    """

    path: str
    content: bytes
    lines: dict[str, _Lines]

    @classmethod
    def read(cls, path: str | Path, limits: Limits = LIMITS) -> TaggedFile:
        """Read a text file, gzipped or not.

        Raises:
            FileFormatError: the file is missing, is no text, or exceeds a limit.
        """
        found = read_lines(path, _TAGS, limits)
        content, rows = found.content, _Lines(found.begin, found.end, found.number)
        result = {tag: rows.of(np.flatnonzero(found.kind == k)) for k, tag in enumerate(found.tags)}
        more: dict[str, list[int]] = {}
        for row in np.flatnonzero(found.kind == _TAGS).tolist():
            more.setdefault(content[found.first[row] : found.begin[row]].decode(), []).append(row)
        result |= {tag: rows.of(np.array(chosen)) for tag, chosen in more.items()}
        return cls(legible(path), content, result)

    def __contains__(self, tag: str) -> bool:
        """Test whether there is a line with a tag."""
        return tag in self.lines

    def counts(self) -> dict[str, int]:
        """Lines per tag."""
        return {tag: len(where.numbers) for tag, where in self.lines.items()}

    def words(self, tag: str) -> Iterator[tuple[int, list[str]]]:
        """Number and words of every line of a tag."""
        for begin, end, number in zip(*(part.tolist() for part in self.lines.get(tag, _NONE)), strict=True):
            yield number, [word.decode() for word in self.content[begin:end].split()]

    def block(self, tag: str, integers: int, names: str) -> Block:
        """The lines of one tag as arrays; an empty block where there are none.

        Args:
            tag: the tag.
            integers: how many integers lead.
            names: the fields after the tag, separated by blanks, for their count and for messages.

        Raises:
            FileFormatError: a line, named in the message, has too few or too many fields, or no numbers.
        """
        where = self.lines.get(tag, _NONE)
        whole, table = read_fields(
            self.content, where.begin, where.end, integers, names,
            lambda row: f"{self.path}, line {where.numbers[row]}: {tag}",
        )  # fmt: skip
        return Block(tag, whole, table, where.numbers)

    def refuse(self, line: int, message: str) -> FileFormatError:
        """The error for one line."""
        return FileFormatError(f"{self.path}, line {line}: {message}")


class Places:
    """Positions of identifiers among the vertices of a file."""

    def __init__(self, file: TaggedFile, identifiers: NDArray[np.int64]) -> None:
        """Of distinct identifiers (n,); the file is for messages."""
        self._file = file
        self._order: IntArray = np.argsort(identifiers, kind="stable")
        self._sorted = identifiers[self._order]

    def find(self, identifiers: NDArray[np.int64]) -> IntArray:
        """Positions of identifiers; -1 for unknown ones."""
        if not len(self._sorted):
            return np.full(len(identifiers), -1, dtype=np.intp)
        place = np.minimum(np.searchsorted(self._sorted, identifiers), len(self._sorted) - 1)
        return np.where(self._sorted[place] == identifiers, self._order[place], -1)

    def of(self, identifiers: NDArray[np.int64], lines: IntArray, what: str) -> IntArray:
        """Positions of identifiers (n,) that stand in lines (n,) and should be what is said.

        Raises:
            FileFormatError: an identifier is unknown.
        """
        found = self.find(identifiers)
        unknown = np.flatnonzero(found < 0)
        if len(unknown):
            k = int(unknown[0])
            raise self._file.refuse(int(lines[k]), f"there is no {what} {identifiers[k]} in the file")
        return found


def distinct(file: TaggedFile, identifiers: NDArray[np.int64], lines: IntArray) -> None:
    """See that every identifier is given once.

    Raises:
        FileFormatError: an identifier is given twice.
    """
    ordered = np.sort(identifiers, kind="stable")
    if (ordered[1:] != ordered[:-1]).all():
        return
    seen: dict[int, int] = {}
    for identifier, line in zip(identifiers.tolist(), lines.tolist(), strict=True):
        if identifier in seen:
            raise file.refuse(line, f"vertex {identifier} is defined twice, first in line {seen[identifier]}")
        seen[identifier] = line


def report_isolated(file: TaggedFile, what: str, identifiers: NDArray[np.int64], used: IntArray) -> None:
    """One warning that names vertices which nothing has measured.

    Args:
        file: for the message.
        what: they are.
        identifiers: (n,) of all.
        used: positions of those that something speaks of.
    """
    lonely = np.flatnonzero(np.bincount(used, minlength=len(identifiers)) == 0)
    if len(lonely):
        named = some(identifiers[lonely].tolist())
        logger.warning("%s: nothing has measured %d of the %ss: %s", file.path, len(lonely), what, named)


def some(names: list[int]) -> str:
    """The first of them."""
    return ", ".join(map(str, names[:5])) + (", ..." if len(names) > 5 else "")


def report_skipped(file: TaggedFile, known: set[str], where: str) -> dict[str, int]:
    """Tags that are not read in a graph in the plane or in space (``where``), with counts; a warning names them."""
    skipped = {tag: count for tag, count in file.counts().items() if tag not in known}
    if skipped:
        named = ", ".join(f"{tag} ({count})" for tag, count in sorted(skipped.items()))
        logger.warning("%s: lines left out because their tags are not read %s: %s", file.path, where, named)
    return skipped


def triangle_names(dim: int, matrix: str = "I") -> str:
    """Names of the entries of the upper triangle of a matrix, row by row."""
    return " ".join(f"{matrix}{row}{column}" for row in range(1, dim + 1) for column in range(row, dim + 1))


def from_triangle(entries: Array, dim: int) -> Array:
    """Symmetric matrices (n, dim, dim) from their upper triangles (n, dim (dim + 1) / 2), row by row."""
    rows, columns = np.triu_indices(dim)
    places = np.empty((dim, dim), dtype=np.intp)
    places[rows, columns] = places[columns, rows] = np.arange(len(rows))
    return np.take(entries, places.ravel(), axis=1).reshape(-1, dim, dim)


def upper_triangle(information: Array) -> Array:
    """The inverse of `from_triangle`."""
    rows, columns = np.triu_indices(information.shape[-1])
    return information[:, rows, columns]


def decimal_lines(path: Path, tag: str, integers: list[NDArray[np.int64]], numbers: Array) -> list[str]:
    """Lines of one tag; the shortest decimals that are read back exactly."""
    if not np.isfinite(numbers).all():
        row = int(np.flatnonzero(~np.isfinite(numbers).all(axis=1))[0])
        raise FileFormatError(f"{path}: {tag} {integers[0][row]} is not finite: {numbers[row]}")
    names = [" ".join(map(str, row)) for row in zip(*(part.tolist() for part in integers), strict=True)]
    values = [" ".join(map(_decimal, row)) for row in numbers.tolist()]
    return [f"{tag} {name} {value}" for name, value in zip(names, values, strict=True)]


def _decimal(value: float) -> str:
    """The shortest exact decimal, whole numbers without a point."""
    text = repr(value)
    return text[:-2] if text.endswith(".0") else text
