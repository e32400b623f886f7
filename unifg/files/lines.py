"""Lines of a text file and their first words: one compiled pass over its bytes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from unifg.codegen.jit import compiled
from unifg.files.contents import LIMITS, Limits, checked_text, read_bytes
from unifg.files.decimals import is_blank
from unifg.typing import IntArray

__all__ = ["Lines", "read_lines"]


@dataclass(frozen=True, eq=False)
class Lines:
    """Lines of a text; comments and empty lines are gone.

    Attributes:
        content: bytes of the text, in UTF-8.
        first: (n,) where the first word of each line begins,
        begin: (n,) where that word ends,
        end: (n,) where the line ends.
        number: (n,) of the line in the file, from 1.
        kind: (n,) position of its first word in `tags`; their greatest number where they were too many.
        tags: first words of lines, in the order of the file.
    """

    content: bytes
    first: IntArray
    begin: IntArray
    end: IntArray
    number: IntArray
    kind: IntArray
    tags: tuple[str, ...]


def read_lines(path: str | Path, most: int, limits: Limits = LIMITS) -> Lines:
    """Find the lines of a text file, gzipped or not.

    Args:
        path: the file.
        most: number of first words that are told apart.
        limits: of what it may hold.

    Raises:
        FileFormatError: the file is missing, is no text, or exceeds a limit.
    """
    content = read_bytes(path, limits)
    found = _split(content, most, limits.digits)
    if found is None:  # nearly all files are plain text
        found = _split(checked_text(path, content, limits).encode(), most)
        assert found is not None
    return found


def _split(content: bytes, most: int, longest: int | None = None) -> Lines | None:
    """Find the lines of a text.

    Args:
        content: the text.
        most: number of first words that are told apart.
        longest: characters of a line; None for text that has been checked.

    Returns:
        None where the text needs a closer look: characters beyond ASCII or below the blank, or a longer line.
    """
    data = np.frombuffer(content, dtype=np.uint8)
    feeds, plain = _look(data)
    if longest is not None and not plain:
        return None
    first, begin, end, number, kind = (np.empty(feeds + 1, dtype=np.intp) for _ in range(5))
    tag_begin, tag_end = np.empty(most, dtype=np.intp), np.empty(most, dtype=np.intp)
    words = np.frombuffer(content, dtype=np.uint64, count=len(content) // 8)
    kept, tags, long = _find_lines(data, words, first, begin, end, number, kind, tag_begin, tag_end)
    if longest is not None and long > longest:
        return None
    names = tuple(content[tag_begin[k] : tag_end[k]].decode() for k in range(tags))
    return Lines(content, first[:kept], begin[:kept], end[:kept], number[:kept], kind[:kept], names)


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
    """Test whether two pieces of text are alike."""
    if end - first != other_end - other:
        return False
    for k in range(end - first):
        if data[first + k] != data[other + k]:
            return False
    return True
