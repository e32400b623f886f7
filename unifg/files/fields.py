"""Words of lines as numbers with names: what readers of text accept, what they refuse, and how they say it.

Compiled code reads what is usual (:mod:`unifg.files.decimals`); Python looks at the words that are left, and names the
first that is wrong.
"""

from __future__ import annotations

import logging
import math
import re
import reprlib
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from unifg.errors import FileFormatError
from unifg.files.decimals import parse_fields
from unifg.typing import Array, IntArray

__all__ = ["decimal", "finite", "integer", "norms", "read_fields"]

logger = logging.getLogger("unifg")
NEAR = 1e-3  # distance from a rotation that is not remarked
_EXACT = float(2**53)  # whole numbers up to here are exact in float64
_WHOLE = re.compile(r"[+-]?[0-9]+")
_SMALLEST_NORM, _LARGEST_NORM = 1e-6, 1e6  # of a quaternion that says something about a rotation
_UNIT = 1e-12  # a squared norm this close to one is one: what was written here is read back unchanged


def decimal(word: str) -> float:
    """``float`` of what files mean by a number: ``1_000`` and the digits of other scripts are for programs.

    Raises:
        ValueError: the word is no number.
    """
    if not word.isascii() or "_" in word:
        raise FileFormatError(f"{reprlib.repr(word)} is no number")
    return float(word)


def finite(place: str, name: str, word: str) -> float:
    """The number that a word of a field stands for.

    Args:
        place: file, line and whatever else says where it stands.
        name: of the field.
        word: in it.

    Raises:
        FileFormatError: the word is no number, or not a finite one.
    """
    try:
        value = decimal(word)
    except ValueError:
        raise FileFormatError(f"{place}: field {name} is {reprlib.repr(word)}, not a number") from None
    if not math.isfinite(value):
        raise FileFormatError(f"{place}: field {name} is {reprlib.repr(word)}, not a finite number")
    return value


def integer(place: str, name: str, word: str) -> int:
    """The integer of 64 bits that a word stands for; whole decimals that float64 holds exactly are integers, too.

    Args:
        place: file, line and whatever else says where it stands.
        name: of the field.
        word: in it.

    Raises:
        FileFormatError: the word is something else.
    """
    value = finite(place, name, word)
    if _WHOLE.fullmatch(word) and -(2**63) <= int(word) < 2**63:
        return int(word)
    if value.is_integer() and abs(value) < _EXACT:
        return int(value)
    raise FileFormatError(f"{place}: field {name} is {reprlib.repr(word)}, not an integer of 64 bits")


def read_fields(
    content: bytes, begin: IntArray, end: IntArray, integers: int, names: str, place: Callable[[int], str]
) -> tuple[NDArray[np.int64], Array]:
    """Read lines of one form.

    Args:
        content: the text.
        begin: (n,) where the lines stand in it.
        end: (n,) where they end.
        integers: how many integers lead, k.
        names: of the k + m fields, separated by blanks.
        place: what says where one of the n lines stands.

    Returns:
        (n, k) integers, exact up to 64 bits, and (n, m) finite numbers.

    Raises:
        FileFormatError: a line has too few or too many fields, or a field that is no finite number.
    """
    fields, count = names.split(), len(begin)
    whole, table = np.empty((count, integers), dtype=np.int64), np.empty((count, len(fields) - integers))
    strange = np.zeros((count, len(fields)), dtype=np.bool_)
    data = np.frombuffer(content, dtype=np.uint8)
    wrong = parse_fields(data, begin, end, integers, whole, table, strange) if count else -1
    if wrong >= 0:
        text = content[begin[wrong] : end[wrong]]
        hint = "; fields are separated by blanks, not commas" if b"," in text else ""
        raise FileFormatError(f"{place(wrong)}: {len(text.split())} fields, expected {len(fields)} ({names}){hint}")
    odd = np.flatnonzero(strange.any(axis=1)) if strange.any() else ()  # nearly always none
    for row in map(int, odd):
        words = [word.decode() for word in content[begin[row] : end[row]].split()]
        for column in np.flatnonzero(strange[row]).tolist():
            if column < integers:
                whole[row, column] = integer(place(row), fields[column], words[column])
            else:
                table[row, column - integers] = finite(place(row), fields[column], words[column])
    return whole, table


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
    found: Array = np.where(np.abs(squared - 1.0) <= _UNIT, 1.0, np.sqrt(squared))
    return found
