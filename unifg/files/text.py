"""The one tokenizer of all text readers: lines, their first words, and their fields as numbers.

One compiled pass over the bytes finds the lines and their tags, another reads the numbers of lines of one form
(:mod:`unifg.files.decimals`). Python reads the few words that are left, and names the first that is wrong.
"""

from __future__ import annotations

import logging
import math
import re
import reprlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten

import numpy as np
from numpy.typing import NDArray

from unifg.codegen.jit import compiled
from unifg.errors import FileFormatError
from unifg.files.contents import LIMITS, Limits, checked_text, legible, read_bytes
from unifg.files.decimals import is_blank, parse_fields
from unifg.typing import Array, BoolArray, IntArray

__all__ = ()  # for readers only

logger = logging.getLogger("unifg")

IGNORED = "-"
"""Name of a field that is not read, which may hold any word."""

NEAR = 1e-3  # distance from a rotation that is not remarked
_EXACT = float(2**53)  # whole numbers up to here are exact in float64
_WHOLE = re.compile(r"[+-]?[0-9]+")
_SMALLEST_NORM, _LARGEST_NORM = 1e-6, 1e6  # of a quaternion that says something about a rotation
_UNIT = 1e-12  # a squared norm this close to one is one: what was written here is read back unchanged
_TAGS = 64  # told apart by compiled code, the others by Python


def number_of(word: str) -> float | None:
    """The number that a word stands for, if any; ``1_000`` and the digits of other scripts are for programs."""
    try:
        return float(word) if word.isascii() and "_" not in word else None
    except ValueError:
        return None


def decimal(place: str, word: str) -> float:
    """The finite number that a word stands for, as :func:`number_of` has it.

    Args:
        place: file, line and field, for messages.
        word: in that field.

    Raises:
        FileFormatError: the word is no number, or not a finite one.
    """
    value = number_of(word)
    if value is None or not math.isfinite(value):
        what = "not a number" if value is None else "not a finite number"
        raise FileFormatError(f"{place} is {reprlib.repr(word)}, {what}")
    return value


def _integer(place: str, word: str) -> int:
    """The integer of 64 bits that a word stands for; whole decimals that float64 holds exactly are integers, too."""
    value = decimal(place, word)
    if _WHOLE.fullmatch(word) and -(2**63) <= int(word) < 2**63:
        return int(word)
    if value.is_integer() and abs(value) < _EXACT:
        return int(value)
    raise FileFormatError(f"{place} is {reprlib.repr(word)}, not an integer of 64 bits")


@dataclass(frozen=True, eq=False)
class Table:
    """Lines of one form.

    Attributes:
        path: name of the file, for messages.
        lines: (n,) numbers of the lines, from 1.
        integers: (n, k) the leading integers, exact up to 64 bits.
        numbers: (n, m) what follows, finite.
    """

    path: str
    lines: IntArray
    integers: NDArray[np.int64]
    numbers: Array

    @classmethod
    def read(cls, path: str | Path, integers: int, names: str, limits: Limits = LIMITS) -> Table:
        """Read a file whose lines are all of one form; arguments as for `TextFile.read` and `TextFile.table`."""
        return TextFile.read(path, limits, tagged=False).table("", integers, names)

    def __len__(self) -> int:
        """Number of lines."""
        return len(self.lines)

    def place(self, row: int) -> str:
        """File and line of one of the rows, for messages."""
        return f"{self.path}, line {self.lines[row]}"

    def refuse(self, wrong: BoolArray, message: str | Callable[[int], str]) -> None:
        """Refuse the first row of which something (n,) is true, with a message or one made for the row.

        Raises:
            FileFormatError: there is one.
        """
        if wrong.any():
            row = int(np.argmax(wrong))
            text = message if isinstance(message, str) else message(row)
            raise FileFormatError(f"{self.place(row)}: {text}")

    def require_lines(self, what: str) -> None:
        """Require that there is a line; ``what`` would stand in it.

        Raises:
            FileFormatError: there is none.
        """
        if not len(self):
            raise FileFormatError(f"{self.path}: no line holds {what}")

    def distinct(self, names: NDArray[np.int64], what: str) -> None:
        """Require that every name (n,) is given once.

        Raises:
            FileFormatError: a name is given twice.
        """
        ordered = np.sort(names, kind="stable")
        if (ordered[1:] == ordered[:-1]).any():
            _, first, which = np.unique(names, return_index=True, return_inverse=True)
            first = first[which]
            again = first != np.arange(len(names))
            self.refuse(again, lambda k: f"{what} {names[k]} is defined twice, first in line {self.lines[first[k]]}")

    def whole(self, column: int, name: str) -> NDArray[np.int64]:
        """(n,) whole numbers of a column behind numbers that are none; files write them as 2 or as 2.0e+000.

        Raises:
            FileFormatError: a number is not whole, or float64 does not hold it exactly.
        """
        found = self.numbers[:, column]
        odd = (found != np.floor(found)) | (np.abs(found) >= _EXACT)
        self.refuse(odd, lambda k: f"field {name} is {found[k]:g}, not a whole number")
        return found.astype(np.int64)

    def in_time(self) -> IntArray:
        """(n,) the rows by the times in the first column of numbers; one warning where the file has another order."""
        time = self.numbers[:, 0]
        self.remark_order(": lines are sorted")
        return np.argsort(time, kind="stable")

    def remark_order(self, done: str = "") -> None:
        """Warn of times in the first column of numbers that run backwards."""
        back = np.flatnonzero(np.diff(self.numbers[:, 0]) < 0.0)
        if len(back):
            where, more = self.place(int(back[0]) + 1), len(back) - 1
            logger.warning("%s: time runs backwards, here and %d times more%s", where, more, done)


@dataclass(frozen=True, eq=False)
class TextFile:
    """Lines of a text file; comments and empty lines are gone.

    Attributes:
        path: name of the file, for messages.
        content: bytes of the text, in UTF-8.
        begin: (n,) where the fields of each line begin, behind its tag.
        end: (n,) where the line ends.
        number: (n,) of the line in the file, from 1.
        kind: (n,) number of its tag.
        tags: numbers of the first words of lines, in the order of the file; "" where lines have no tags.
    """

    path: str
    content: bytes
    begin: IntArray
    end: IntArray
    number: IntArray
    kind: IntArray
    tags: dict[str, int]

    @classmethod
    def read(cls, path: str | Path, limits: Limits = LIMITS, *, tagged: bool = True) -> TextFile:
        """Find the lines of a text file, gzipped or not.

        Args:
            path: the file.
            limits: of what it may hold.
            tagged: whether the first word of a line says what the others are.

        Raises:
            FileFormatError: the file is missing, is no text, or exceeds a limit.
        """
        content = read_bytes(path, limits)
        data = np.frombuffer(content, dtype=np.uint8)
        ends = _line_ends(data)
        if not _is_plain(data) or np.diff(ends, prepend=-1).max() > limits.digits:
            content = checked_text(path, content, limits).encode()
            data = np.frombuffer(content, dtype=np.uint8)
            ends = _line_ends(data)
        rows = np.empty((5, len(ends)), dtype=np.intp)
        names = np.empty((2, _TAGS if tagged else 0), dtype=np.intp)
        kept, count = _find_lines(data, ends, rows, names)
        first, begin, end, number, kind = rows[:, :kept]
        if not tagged:
            return cls(legible(path), content, first, end, number, kind, {"": 0})
        tags = {content[names[0, k] : names[1, k]].decode(): k for k in range(count)}
        for row in np.flatnonzero(kind == _TAGS).tolist():
            kind[row] = tags.setdefault(content[first[row] : begin[row]].decode(), len(tags))
        return cls(legible(path), content, begin, end, number, kind, tags)

    def __contains__(self, tag: str) -> bool:
        """Test whether there is a line with a tag."""
        return tag in self.tags

    def rows(self, tag: str) -> IntArray:
        """Positions of the lines of a tag."""
        return np.flatnonzero(self.kind == self.tags.get(tag, -1))

    def place(self, row: int) -> str:
        """File and line of a row, for messages."""
        return f"{self.path}, line {self.number[row]}"

    def words(self, row: int) -> list[str]:
        """Fields of a line."""
        return [word.decode() for word in self.content[self.begin[row] : self.end[row]].split()]

    def others(self, known: set[str]) -> dict[str, int]:
        """Tags that are not known, with the number of their lines."""
        counts = np.bincount(self.kind, minlength=len(self.tags)).tolist()
        return {tag: counts[k] for tag, k in self.tags.items() if tag not in known}

    def table(self, tag: str, integers: int, names: str, rows: IntArray | None = None) -> Table:
        """The lines of one tag as arrays, or some of them.

        Args:
            tag: the tag.
            integers: how many integers lead, k.
            names: the k + m fields after the tag, separated by blanks, for their count and for messages.
            rows: positions of the lines; all with the tag by default, of which there may be none.

        Raises:
            FileFormatError: a line, named in the message, has too few or too many fields, or a field that is no finite
                number.
        """
        rows = self.rows(tag) if rows is None else rows
        begin, end, fields = self.begin[rows], self.end[rows], names.split()
        whole = np.empty((len(rows), integers), dtype=np.int64)
        numbers = np.empty((len(rows), len(fields) - integers))
        strange = np.zeros((len(rows), len(fields)), dtype=np.bool_)
        data = np.frombuffer(self.content, dtype=np.uint8)
        wrong = parse_fields(data, begin, end, integers, whole, numbers, strange) if len(rows) else -1
        about = f": {tag}" if tag else ""
        if wrong >= 0:
            text = self.content[begin[wrong] : end[wrong]]
            hint = "; fields are separated by blanks, not commas" if b"," in text else ""
            raise FileFormatError(
                f"{self.place(rows[wrong])}{about}: {len(text.split())} fields, expected {len(fields)} "
                f"({shorten(names, 200)}){hint}"
            )
        if strange.any():  # nearly never
            strange &= np.array([name != IGNORED for name in fields])
            for row in np.flatnonzero(strange.any(axis=1)).tolist():
                words = self.words(rows[row])
                for column in np.flatnonzero(strange[row]).tolist():
                    place = f"{self.place(rows[row])}{about}: field {fields[column]}"
                    if column < integers:
                        whole[row, column] = _integer(place, words[column])
                    else:
                        numbers[row, column - integers] = decimal(place, words[column])
        return Table(self.path, self.number[rows], whole, numbers)


def norms(quaternions: Array, place: Callable[[int], str], say: Callable[[str], None] = logger.warning) -> Array:
    """Norms to divide quaternions by; those farther than 1e-3 from one are remarked.

    Args:
        quaternions: (n, 4).
        place: what says where one of them stands.
        say: takes the remark.

    Returns:
        (n,), exactly one where a quaternion is of norm one but for rounding.

    Raises:
        FileFormatError: a quaternion is nearly zero or huge.
    """
    with np.errstate(over="ignore", under="ignore"):
        squared = np.einsum("ni,ni->n", quaternions, quaternions)
    bad = np.flatnonzero(~((squared >= _SMALLEST_NORM**2) & (squared <= _LARGEST_NORM**2)))
    if bad.size:
        k = int(bad[0])
        long = math.hypot(*quaternions[k].tolist())
        raise FileFormatError(f"{place(k)}: the quaternion {quaternions[k]} has norm {long:g}, not one")
    far = np.flatnonzero(np.abs(np.sqrt(squared) - 1.0) > NEAR)
    if far.size:
        say(
            f"{far.size} of {len(quaternions)} quaternions have norms farther than {NEAR:g} from one and were "
            f"normalised, first {place(int(far[0]))} of norm {np.sqrt(squared[far[0]]):.6g}"
        )
    return np.where(np.abs(squared - 1.0) <= _UNIT, 1.0, np.sqrt(squared))


def _line_ends(data: NDArray[np.uint8]) -> IntArray:
    return np.append(np.flatnonzero(data == 10), len(data))


@compiled
def _is_plain(data: NDArray[np.uint8]) -> bool:
    """Test whether all bytes are line feeds, blanks, tabulators and visible ASCII."""
    odd = 0
    for k in range(len(data)):
        byte = data[k]
        odd += ((byte < 32) & (byte != 10) & (byte != 9)) | (byte > 126)
    return odd == 0


@compiled
def _find_lines(data: NDArray[np.uint8], ends: IntArray, rows: IntArray, tags: IntArray) -> tuple[int, int]:
    """Find lines that are neither empty nor comments, and their first words.

    Args:
        data: bytes of the text.
        ends: (n,) where its lines end.
        rows: (5, n) takes where the first word of a line begins and ends, where the line ends, its number, from 1, and
            the number of its tag, from 0, or t.
        tags: (2, t) takes where the tags begin and end, where they stand first.

    Returns:
        The number of lines kept, and the number of tags.
    """
    at, kept, count, last, most = 0, 0, 0, -1, tags.shape[1]
    for line in range(len(ends)):
        stop = ends[line]
        while at < stop and is_blank(data[at]):
            at += 1
        begin = at
        while at < stop and not is_blank(data[at]):
            at += 1
        end, at = at, stop + 1
        if end == begin or data[begin] == 35:  # "#"
            continue
        if last < 0 or not _same(data, begin, end, tags[0, last], tags[1, last]):
            last = 0
            while last < count and not _same(data, begin, end, tags[0, last], tags[1, last]):
                last += 1
            if last == count and count < most:
                tags[0, count], tags[1, count] = begin, end
                count += 1
        rows[0, kept], rows[1, kept], rows[2, kept], rows[3, kept], rows[4, kept] = begin, end, stop, line + 1, last
        kept += 1
        if last == most:
            last = -1
    return kept, count


@compiled
def _same(data: NDArray[np.uint8], first: int, end: int, other: int, other_end: int) -> bool:
    """Test whether two pieces of text are alike."""
    if end - first != other_end - other:
        return False
    for k in range(end - first):
        if data[first + k] != data[other + k]:
            return False
    return True
