"""Rows on file: one JSON object a line, on the disk as soon as it is written, by one process at a time.

A process that is killed leaves at most half of its last line; the next one cuts it off and goes on.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

from unifg.errors import ScenarioError

__all__ = ["Journal", "lines_of"]


class Journal:
    """File of rows, locked for this process.

    Attributes:
        path: of the file; beside it lies one that ends in ``.lock``.
        mended: what was wrong with the last line, for people; empty if nothing was.
    """

    def __init__(self, path: Path) -> None:
        """Name the file; the context opens it."""
        self.path, self.mended = path, ""

    def __enter__(self) -> Journal:
        """Make the folder, keep others out, and mend what a process that was killed has left.

        Raises:
            ScenarioError: the folder cannot be written, or another process writes the file.
        """
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._lock = self.path.with_suffix(".lock").open("a+b")
        except OSError as error:
            raise ScenarioError(f"{self.path.parent}: cannot write into this folder ({error.strerror})") from None
        try:
            if not _locked(self._lock):
                self._lock.seek(0)
                who = self._lock.read(200).decode("utf-8", "replace").strip() or "another process"
                raise ScenarioError(f"{self.path.parent}: {who} is at work here; wait for it, or choose another folder")
            self._lock.truncate(0)
            self._lock.write(f"process {os.getpid()} on {socket.gethostname()}".encode())
            self._lock.flush()
            self._file = self.path.open("a+b", buffering=0)
            self._mend()
        except OSError as error:
            self._lock.close()
            raise ScenarioError(f"{self.path}: cannot be written ({error.strerror})") from None
        except BaseException:
            self._lock.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Let others in."""
        self._file.close()
        with contextlib.suppress(OSError):  # the words in it are for people
            self._lock.truncate(0)
        self._lock.close()

    def add(self, line: str) -> None:
        """Put a line on the disk; where there is no room for all of it, none of it stays.

        Raises:
            ScenarioError: the disk is full or gone.
        """
        before, data = self._file.seek(0, os.SEEK_END), line.encode() + b"\n"
        try:
            done = 0
            while done < len(data):
                done += self._file.write(data[done:]) or 0
            _synced(self._file)
        except OSError as error:
            with contextlib.suppress(OSError):
                self._file.truncate(before)
            raise ScenarioError(
                f"{self.path}: cannot be written ({error.strerror}); what ended before is on file: make room and start "
                "the same command again"
            ) from None

    def _mend(self) -> None:
        rest = self.path.read_bytes().rpartition(b"\n")[2]
        if not rest:
            return
        if _row(rest) is not None:
            self._file.write(b"\n")
            self.mended = "the last line had no end: it is complete"
        else:
            self._file.truncate(self._file.seek(0, os.SEEK_END) - len(rest))
            self.mended = "the last line was cut off: it is taken away, and its episode repeated"
        _synced(self._file)


def lines_of(
    path: Path, unreadable: list[int] | None = None, *, whole: Callable[[dict[str, Any]], bool] = lambda row: True
) -> Iterator[dict[str, Any]]:
    """The rows of a file, one after the other; a file that is not there has none.

    Args:
        path: of the file.
        unreadable: is given the numbers of lines that hold no row.
        whole: whether an object has all that a row has.
    """
    if not path.is_file():
        return
    with path.open("rb") as file:
        for number, line in enumerate(file, start=1):
            row = _row(line)
            if row is not None and whole(row):
                yield row
            elif unreadable is not None and line.strip():
                unreadable.append(number)


def _row(line: bytes) -> dict[str, Any] | None:
    try:
        found = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def _synced(file: BinaryIO) -> None:
    with contextlib.suppress(OSError) if sys.platform == "win32" else contextlib.nullcontext():
        os.fsync(file.fileno())


if sys.platform == "win32":
    import msvcrt

    def _locked(file: BinaryIO) -> bool:
        """Lock the file as long as it is open; False if it is locked already. The byte lies behind the words."""
        file.seek(1 << 20)
        try:
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        except OSError:
            return False
        return True

else:
    import fcntl

    def _locked(file: BinaryIO) -> bool:
        """Lock the file as long as it is open; False if it is locked already."""
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True
