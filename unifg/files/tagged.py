"""Text files whose lines begin with a tag, parsed a tag at a time: what g2o and TORO files have in common."""

from __future__ import annotations

import logging
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from unifg.errors import FileFormatError
from unifg.files.contents import LIMITS, Limits, legible, read_text
from unifg.typing import Array, IntArray

__all__ = [
    "Block",
    "TaggedFile",
    "decimal_lines",
    "distinct",
    "from_triangle",
    "positions_of",
    "report_isolated",
    "report_skipped",
    "triangle_names",
    "upper_triangle",
]

logger = logging.getLogger("unifg")

_EXACT = float(2**53)  # whole numbers up to here are exact in float64
_WHOLE = re.compile(r"[+-]?[0-9]+")


@dataclass(frozen=True)
class Block:
    """The lines of one tag.

    Attributes:
        integers: (n, k) the leading integers (identifiers), exact up to 64 bits.
        numbers: (n, m) what follows.
        lines: (n,) numbers of the lines, from 1.
    """

    integers: NDArray[np.int64]
    numbers: Array
    lines: IntArray

    def __len__(self) -> int:
        """Number of lines."""
        return len(self.lines)


@dataclass
class TaggedFile:
    """Lines of a file by their first word; comments and empty lines are gone.

    Attributes:
        path: name of the file, for messages.
        texts: what follows the tag, line by line.
        lines: numbers of these lines, from 1.
    """

    path: str
    texts: dict[str, list[str]] = field(default_factory=dict)
    lines: dict[str, list[int]] = field(default_factory=dict)

    @classmethod
    def read(cls, path: str | Path, limits: Limits = LIMITS) -> TaggedFile:
        """Read a text file, gzipped or not.

        Raises:
            FileFormatError: the file is missing, is no text, or exceeds a limit.
        """
        found = cls(legible(path))
        for number, line in enumerate(read_text(path, limits).split("\n"), start=1):
            words = line.split(None, 1)
            if not words or words[0].startswith("#"):
                continue
            tag = words[0]
            if tag not in found.texts:
                found.texts[tag], found.lines[tag] = [], []
            found.texts[tag].append(words[1] if len(words) == 2 else "")
            found.lines[tag].append(number)
        return found

    def counts(self) -> dict[str, int]:
        """Lines per tag."""
        return {tag: len(texts) for tag, texts in self.texts.items()}

    def block(self, tag: str, integers: int, names: str) -> Block:
        """The lines of one tag as arrays; an empty block where there are none.

        Args:
            tag: the tag.
            integers: how many integers lead.
            names: the fields after the tag, separated by blanks, for their count and for messages.

        Raises:
            FileFormatError: a line, named in the message, has too few or too many fields, or no numbers.
        """
        fields = names.split()
        texts, lines = self.texts.get(tag, []), self.lines.get(tag, [])
        width = len(fields)
        for text, line in zip(texts, lines, strict=True):
            words = text.split()
            if len(words) != width:
                hint = "; fields are separated by blanks, not commas" if "," in text else ""
                raise FileFormatError(
                    f"{self.path}, line {line}: {tag} has {len(words)} fields, expected {width} ({names}){hint}"
                )
        table = self._numbers(tag, texts, fields)
        leading = table[:, :integers]
        if (np.abs(leading) >= _EXACT).any() or (leading != np.floor(leading)).any():
            whole = self._integers(tag, texts, integers, fields)
        else:
            whole = leading.astype(np.int64)
        return Block(whole, np.ascontiguousarray(table[:, integers:]), np.array(lines, dtype=np.intp))

    def refuse(self, line: int, message: str) -> FileFormatError:
        """The error for one line."""
        return FileFormatError(f"{self.path}, line {line}: {message}")

    def _numbers(self, tag: str, texts: list[str], fields: list[str]) -> Array:
        """All numbers of a tag by one call of the C parser, one by one only to say which is wrong."""
        width = len(fields)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", DeprecationWarning)  # what NumPy before 2.4 says instead of raising
                flat = np.fromstring(" ".join(texts), dtype=np.float64, sep=" ")
        except (ValueError, DeprecationWarning):
            flat = np.zeros(0)
        if len(flat) == width * len(texts) and np.isfinite(flat).all():
            return flat.reshape(-1, width)
        for text, line in zip(texts, self.lines[tag], strict=True):
            for name, word in zip(fields, text.split(), strict=True):
                try:
                    value = float(word if word.isascii() and "_" not in word else "none")  # 1_000 is for programs
                except ValueError:
                    raise self.refuse(line, f"{tag}: field {name} is {word!r}, not a number") from None
                if not np.isfinite(value):
                    raise self.refuse(line, f"{tag}: field {name} is {word}, not a finite number")
        raise FileFormatError(f"{self.path}: a number of the {tag} lines is written in an unusual way")

    def _integers(self, tag: str, texts: list[str], count: int, fields: list[str]) -> NDArray[np.int64]:
        """Identifiers read as integers: float64 holds 53 bits, identifiers may have 64."""
        rows = []
        for text, line in zip(texts, self.lines[tag], strict=True):
            words = text.split(None, count)[:count]
            for name, word in zip(fields, words, strict=False):
                if not _WHOLE.fullmatch(word) or not -(2**63) <= int(word) < 2**63:
                    raise self.refuse(line, f"{tag}: field {name} is {word!r}, not an integer of 64 bits")
            rows.append([int(word) for word in words])
        return np.array(rows, dtype=np.int64).reshape(-1, count)


def positions_of(
    file: TaggedFile, places: Mapping[int, int], identifiers: NDArray[np.int64], lines: IntArray, what: str
) -> IntArray:
    """Positions of identifiers among the vertices.

    Args:
        file: for messages.
        places: identifier to position.
        identifiers: (n,) to look up.
        lines: (n,) where they stand.
        what: what they should be, for messages.

    Raises:
        FileFormatError: an identifier is unknown.
    """
    try:
        return np.array([places[i] for i in identifiers.tolist()], dtype=np.intp)
    except KeyError as error:
        line = int(lines[identifiers.tolist().index(error.args[0])])
        raise file.refuse(line, f"there is no {what} {error.args[0]} in the file") from None


def distinct(file: TaggedFile, identifiers: NDArray[np.int64], lines: IntArray) -> dict[int, int]:
    """Identifier to position.

    Raises:
        FileFormatError: an identifier is given twice.
    """
    places = {identifier: k for k, identifier in enumerate(identifiers.tolist())}
    if len(places) < len(identifiers):
        seen: dict[int, int] = {}
        for identifier, line in zip(identifiers.tolist(), lines.tolist(), strict=True):
            if identifier in seen:
                raise file.refuse(line, f"vertex {identifier} is defined twice, first in line {seen[identifier]}")
            seen[identifier] = line
    return places


def report_isolated(file: TaggedFile, what: str, identifiers: NDArray[np.int64], used: IntArray) -> None:
    """One warning that names vertices which nothing has measured.

    Args:
        file: for the message.
        what: they are.
        identifiers: (n,) of all.
        used: positions of those that something speaks of.
    """
    lonely = np.setdiff1d(np.arange(len(identifiers)), used)
    if len(lonely):
        first = ", ".join(map(str, identifiers[lonely[:5]].tolist())) + (", ..." if len(lonely) > 5 else "")
        logger.warning("%s: nothing has measured %d of the %ss: %s", file.path, len(lonely), what, first)


def report_skipped(file: TaggedFile, known: set[str]) -> dict[str, int]:
    """Tags that nobody reads, with their counts, after one warning that names them."""
    skipped = {tag: count for tag, count in file.counts().items() if tag not in known}
    if skipped:
        named = ", ".join(f"{tag} ({count})" for tag, count in sorted(skipped.items()))
        logger.warning("%s: lines left out because their tags are not read: %s", file.path, named)
    return skipped


def triangle_names(dim: int) -> str:
    """Names of the entries of an upper triangle, row by row."""
    return " ".join(f"I{row}{column}" for row in range(1, dim + 1) for column in range(row, dim + 1))


def from_triangle(entries: Array, dim: int) -> Array:
    """Symmetric matrices (n, dim, dim) from their upper triangles (n, dim (dim + 1) / 2), row by row."""
    rows, columns = np.triu_indices(dim)
    full = np.empty((len(entries), dim, dim))
    full[:, rows, columns] = entries
    full[:, columns, rows] = entries
    return full


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
