"""Bytes of a file, unpacked, and its text, within limits that a file cannot exceed by itself.

A few kilobytes may unpack to gigabytes, an image of one line may claim 1e10 pixels, and a number may have a million
digits. Who has such files raises the limit that the error names.
"""

from __future__ import annotations

import gzip
import io
import os
import stat
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unifg.atomic_write import write_atomically
from unifg.errors import FileFormatError

__all__ = ["LIMITS"]

_GZIP = b"\x1f\x8b"
_ALLOWED = bytes([9, 10, 13, *range(32, 127), *range(128, 256)])
_SEPARATORS = (b"\xc2\x85", b"\xe2\x80\xa8", b"\xe2\x80\xa9")  # lines end here for some programs, and not for others


@dataclass(frozen=True)
class Limits:
    """Upper limits of a file's content.

    Attributes:
        unpacked: bytes, after unpacking.
        pixels: of an image.
        digits: characters of a word, such as a number.
        depth: of what is nested in what.
    """

    unpacked: int = 2**29
    pixels: int = 50_000_000
    digits: int = 400
    depth: int = 20


LIMITS = Limits()
"""Where nobody says otherwise."""


def legible(path: str | os.PathLike[str]) -> str:
    """The name of a file for people; bytes that are no text are spelled by their numbers."""
    return os.fspath(path).encode("utf-8", errors="surrogateescape").decode("utf-8", errors="backslashreplace")


def suffix_of(path: Path) -> str:
    """The ending of a name in small letters, without that of compression."""
    return (path.with_suffix("") if path.suffix == ".gz" else path).suffix.lower()


def read_bytes(path: str | os.PathLike[str], limits: Limits = LIMITS) -> bytes:
    """The content of a file, unpacked when it is gzipped.

    Raises:
        FileFormatError: the file is missing, unreadable, a damaged archive, or holds more than the limit.
    """
    most = limits.unpacked
    try:
        with open(path, "rb") as file:
            status = os.fstat(file.fileno())
            regular = stat.S_ISREG(status.st_mode)  # memory for what may come is asked for before anything comes
            content = file.read(min(most, status.st_size) + 1 if regular else most + 1)
        if content.startswith(_GZIP):
            with gzip.GzipFile(fileobj=io.BytesIO(content)) as packed:
                content = packed.read(most + 1)
    except FileNotFoundError as error:
        raise FileFormatError(f"{legible(path)}: no such file") from error
    except (OSError, EOFError, ValueError, zlib.error) as error:
        raise FileFormatError(f"{legible(path)}: cannot be read ({error})") from error
    if len(content) > most:
        raise FileFormatError(
            f"{legible(path)}: holds more than {most} bytes when it is unpacked: limits=Limits(unpacked=...) reads more"
        )
    return content


def read_text(path: str | os.PathLike[str], limits: Limits = LIMITS) -> str:
    """Text in UTF-8, with or without a byte-order mark, gzipped or not, whose lines end in line feeds.

    Raises:
        FileFormatError: as :func:`read_bytes`; also for what is no text, a control character, or a word beyond the
            limit of digits, each with its line.
    """
    return checked_text(path, read_bytes(path, limits), limits)


def checked_text(path: str | os.PathLike[str], content: bytes, limits: Limits = LIMITS) -> str:
    """The text that bytes stand for; see :func:`read_text`.

    Args:
        path: the file they are from, for messages.
        content: of the file, unpacked.
        limits: of what a text may hold.

    Raises:
        FileFormatError: as :func:`read_text`.
    """

    def refuse(place: int, what: str) -> FileFormatError:
        return FileFormatError(f"{legible(path)}, line {content.count(10, 0, place) + 1}: {what}")

    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise refuse(
            error.start, f"cannot be read as text: the byte 0x{content[error.start]:02x} is none in UTF-8"
        ) from None
    if odd := content.translate(None, _ALLOWED):
        raise refuse(content.index(odd[:1]), f"the control character 0x{odd[0]:02x} has no place in a text")
    for separator in _SEPARATORS:
        if (place := content.find(separator)) >= 0:
            raise refuse(place, f"the separator {separator.decode()!r}: lines end in line feeds")
    if b"\r" in content and (place := content.replace(b"\r\n", b"\n\n").find(b"\r")) >= 0:
        raise refuse(place, "a carriage return without a line feed")
    for number, line in enumerate(text.split("\n"), start=1):
        if len(line) > limits.digits and (longest := max(map(len, line.split()), default=0)) > limits.digits:
            if not line.lstrip().startswith("#"):
                raise FileFormatError(
                    f"{legible(path)}, line {number}: a word of {longest} characters: see limits=Limits(digits=...)"
                )
    return text


def write_text(path: Path, text: str) -> Path:
    """Write text, gzipped when the name ends in ``.gz``; the same text gives the same bytes."""
    data = text.encode("ascii")
    write_atomically(path, gzip.compress(data, mtime=0) if path.suffix == ".gz" else data)
    return path


def require_finite(path: str | Path, what: str, rows: NDArray[Any]) -> None:
    """Require that numbers (n, k) to be written are finite; ``what`` names a row in the message.

    Raises:
        FileFormatError: one is not.
    """
    bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if bad.size:
        raise FileFormatError(f"{legible(path)}: {what} {bad[0]} is not finite: {rows[bad[0]]}")


def write_rows(
    path: str | Path,
    columns: Sequence[NDArray[Any]],
    names: str = "",
    spelled: Callable[[Any], str] = repr,
    separator: str = "\t",
) -> Path:
    """Write a table of numbers.

    Args:
        path: file to write; an existing one is replaced, and a name that ends in ``.gz`` is gzipped.
        columns: (n,) or (n, k) each, side by side; integers stay integers.
        names: of all fields, for a comment in the first line.
        spelled: text of a number; by default the shortest decimal that is read back exactly.
        separator: of numbers.

    Returns:
        The path written.

    Raises:
        FileFormatError: a number is not finite, or the columns differ in length.
    """
    parts = [part[:, None] if part.ndim == 1 else part for part in columns]
    lengths = sorted({len(part) for part in parts})
    if len(lengths) > 1:
        raise FileFormatError(f"{legible(path)}: columns of {', '.join(map(str, lengths))} rows do not fit")
    for part in parts:
        require_finite(path, "row", part)
    rows = zip(*(part.tolist() for part in parts), strict=True)
    lines = [separator.join(spelled(value) for part in row for value in part) for row in rows]
    return write_text(Path(path), "".join(f"{line}\n" for line in ([f"# {names}"] if names else []) + lines))
