"""Text files whose lines begin with a tag, parsed a tag at a time: what g2o and TORO files have in common.

One compiled pass over the bytes finds where the lines of every tag stand; another reads the numbers of a tag
(:mod:`unifg.files.decimals`). Python looks at a line only where something about it is unusual.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unifg.errors import FileFormatError
from unifg.files.contents import LIMITS, Limits, checked_text, legible, read_bytes
from unifg.files.decimals import is_blank, parse_fields
from unifg.machine.jit import compiled
from unifg.typing import Array, BoolArray, IntArray

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

_EXACT = float(2**53)  # whole numbers up to here are exact in float64
_WHOLE = re.compile(r"[+-]?[0-9]+")
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
    """Where lines begin after their tag and end, (n,) places in the text, and (n,) their numbers, from 1."""

    begin: IntArray
    end: IntArray
    numbers: IntArray


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
        content = read_bytes(path, limits)
        found = _split(content, limits.digits)
        if found is None:  # nearly all files are plain text
            content = checked_text(path, content, limits).encode()
            found = _split(content)
        return cls(legible(path), content, found or {})

    def __contains__(self, tag: str) -> bool:
        """Whether there is a line with a tag."""
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
        fields, where = names.split(), self.lines.get(tag, _NONE)
        count, width = len(where.numbers), len(fields)
        whole = np.empty((count, integers), dtype=np.int64)
        table, strange = np.empty((count, width - integers)), np.zeros((count, width), dtype=np.bool_)
        data = np.frombuffer(self.content, dtype=np.uint8)
        wrong = parse_fields(data, where.begin, where.end, integers, whole, table, strange) if count else -1
        if wrong >= 0:
            text = self.content[where.begin[wrong] : where.end[wrong]]
            hint = "; fields are separated by blanks, not commas" if b"," in text else ""
            raise self.refuse(
                int(where.numbers[wrong]), f"{tag} has {len(text.split())} fields, expected {width} ({names}){hint}"
            )
        if strange.any():
            self._read_one_by_one(tag, where, fields, whole, table, strange)
        return Block(tag, whole, table, where.numbers)

    def refuse(self, line: int, message: str) -> FileFormatError:
        """The error for one line."""
        return FileFormatError(f"{self.path}, line {line}: {message}")

    def _read_one_by_one(
        self, tag: str, where: _Lines, fields: list[str], whole: NDArray[np.int64], table: Array, strange: BoolArray
    ) -> None:
        """Words that no compiled code reads: many digits, far exponents, identifiers as decimals, and what is wrong."""
        leading = whole.shape[1]
        for row in np.flatnonzero(strange.any(axis=1)).tolist():
            words = [word.decode() for word in self.content[where.begin[row] : where.end[row]].split()]
            line = int(where.numbers[row])
            for column in np.flatnonzero(strange[row]).tolist():
                word, name = words[column], fields[column]
                try:
                    value = float(word if word.isascii() and "_" not in word else "none")  # 1_000 is for programs
                except ValueError:
                    raise self.refuse(line, f"{tag}: field {name} is {word!r}, not a number") from None
                if not np.isfinite(value):
                    raise self.refuse(line, f"{tag}: field {name} is {word}, not a finite number")
                if column >= leading:
                    table[row, column - leading] = value
                elif _WHOLE.fullmatch(word) and -(2**63) <= int(word) < 2**63:
                    whole[row, column] = int(word)
                elif value.is_integer() and abs(value) < _EXACT:
                    whole[row, column] = int(value)
                else:
                    raise self.refuse(line, f"{tag}: field {name} is {word!r}, not an integer of 64 bits")


def _split(content: bytes, longest: int | None = None) -> dict[str, _Lines] | None:
    """Where the lines of every tag stand.

    Args:
        content: the text.
        longest: characters of a line; None for text that has been checked.

    Returns:
        None where the text needs a closer look: characters beyond ASCII or below the blank, or a longer line.
    """
    if not content:
        return {}
    data = np.frombuffer(content, dtype=np.uint8)
    most, plain = _look(data)
    if longest is not None and not plain:
        return None
    first, begin, end, number, kind = (np.empty(most + 1, dtype=np.intp) for _ in range(5))
    tag_begin, tag_end = np.empty(_TAGS, dtype=np.intp), np.empty(_TAGS, dtype=np.intp)
    words = np.frombuffer(content, dtype=np.uint64, count=len(content) // 8)
    kept, tags, long = _find_lines(data, words, first, begin, end, number, kind, tag_begin, tag_end)
    if longest is not None and long > longest:
        return None
    begin, end, number, kind = begin[:kept], end[:kept], number[:kept], kind[:kept]
    result = {}
    for k in range(tags):
        chosen = np.flatnonzero(kind == k)
        tag = content[tag_begin[k] : tag_end[k]].decode()
        result[tag] = _Lines(begin[chosen], end[chosen], number[chosen])
    more: dict[str, list[int]] = {}
    for row in np.flatnonzero(kind == _TAGS).tolist():
        more.setdefault(content[first[row] : begin[row]].decode(), []).append(row)
    for tag, rows in more.items():
        result[tag] = _Lines(begin[rows], end[rows], number[rows])
    return result


@compiled
def _look(data: NDArray[np.uint8]) -> tuple[int, bool]:
    """The number of line feeds, and whether all else are blanks, tabulators and visible ASCII."""
    feeds, odd = 0, 0
    for k in range(len(data)):
        byte = data[k]
        feeds += byte == 10
        odd += ((byte < 32) & (byte != 10) & (byte != 9)) | (byte > 126)
    return feeds, odd == 0


@compiled
def _line_end(data: NDArray[np.uint8], words: NDArray[np.uint64], at: int) -> int:
    """The next line feed, or the end; words are the same bytes by eights."""
    size = len(data)
    while at < size and at & 7:
        if data[at] == 10:
            return at
        at += 1
    k = at >> 3
    while k < len(words):
        # A byte of zero, and none else, borrows from its uppermost bit (Mycroft 1987).
        found = words[k] ^ np.uint64(0x0A0A0A0A0A0A0A0A)
        if (found - np.uint64(0x0101010101010101)) & ~found & np.uint64(0x8080808080808080):
            break
        k += 1
    at = max(at, 8 * k)
    while at < size and data[at] != 10:
        at += 1
    return at


@compiled
def _find_lines(
    data: NDArray[np.uint8],
    words: NDArray[np.uint64],
    first: IntArray,
    begin: IntArray,
    end: IntArray,
    number: IntArray,
    kind: IntArray,
    tag_begin: IntArray,
    tag_end: IntArray,
) -> tuple[int, int, int]:
    """Find lines that are neither empty nor comments, and their first words.

    Args:
        data: bytes of the text.
        words: the same bytes by eights, as far as they go.
        first: (n,) takes where the first word of a line begins,
        begin: (n,) where it ends,
        end: (n,) where the line ends.
        number: (n,) takes the numbers of the lines, from 1.
        kind: (n,) takes the numbers of the tags, from 0; their limit for all that are too many.
        tag_begin: takes where the tags stand first,
        tag_end: and where they end there.

    Returns:
        The number of lines kept, the number of tags, and the length of the longest line.
    """
    size, at, line, kept, tags, last, longest = len(data), 0, 0, 0, 0, -1, 0
    while at < size:
        line += 1
        stop = _line_end(data, words, at)
        longest = max(longest, stop - at)
        while at < stop and is_blank(data[at]):
            at += 1
        tag = at
        while at < stop and not is_blank(data[at]):
            at += 1
        word, at = at, stop + 1
        if word == tag or data[tag] == 35:  # "#"
            continue
        if last < 0 or not _same(data, tag, word, tag_begin[last], tag_end[last]):
            last = 0
            while last < tags and not _same(data, tag, word, tag_begin[last], tag_end[last]):
                last += 1
            if last == tags and tags < len(tag_begin):
                tag_begin[tags], tag_end[tags] = tag, word
                tags += 1
        first[kept], begin[kept], end[kept], number[kept], kind[kept] = tag, word, stop, line, last
        kept += 1
        if last == len(tag_begin):
            last = -1
    return kept, tags, longest


@compiled
def _same(data: NDArray[np.uint8], first: int, end: int, other: int, other_end: int) -> bool:
    """Whether two pieces of text are alike."""
    if end - first != other_end - other:
        return False
    for k in range(end - first):
        if data[first + k] != data[other + k]:
            return False
    return True


class Places:
    """Where identifiers stand among the vertices of a file."""

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


def report_skipped(file: TaggedFile, known: set[str]) -> dict[str, int]:
    """Tags that nobody reads, with their counts, after one warning that names them."""
    skipped = {tag: count for tag, count in file.counts().items() if tag not in known}
    if skipped:
        named = ", ".join(f"{tag} ({count})" for tag, count in sorted(skipped.items()))
        logger.warning("%s: lines left out because their tags are not read: %s", file.path, named)
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
