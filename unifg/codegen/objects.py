"""Object code on disk: what one process has generated, later ones only load.

A file for each function, named by a digest of all that its code depends on; nothing is ever looked at that has another
one, so what is out of date is not found. It begins with a digest of the rest: one that is cut off or damaged counts as
none. Files appear at once or not at all, whoever else writes them at the same time. Those that nobody has read for
longest go when there are too many.
"""

from __future__ import annotations

import hashlib
import logging
import os
from contextlib import suppress
from pathlib import Path

from unifg.atomic_write import write_atomically

logger = logging.getLogger("unifg")

SWITCH = "UNIFG_KEEP_CODE"
"""Variable of the environment: "0" keeps nothing on disk, and reads nothing."""
MOST = 32 * 2**20  # bytes
BLOCK = 4096  # bytes that the shortest file takes
EVERY = 64  # files written before the folder is looked through again
_DIGEST = hashlib.sha256().digest_size


def write_sealed(path: Path, content: bytes) -> None:
    """Write a file that :func:`read_sealed` knows to be whole."""
    write_atomically(path, hashlib.sha256(content).digest() + content)


def read_sealed(path: Path) -> bytes | None:
    """Content of a file; None where nothing is, nothing can be read, or what is there is damaged, which is logged."""
    try:
        read = path.read_bytes()
    except OSError:
        return None
    content = read[_DIGEST:]
    if hashlib.sha256(content).digest() != read[:_DIGEST]:
        logger.warning("%s is damaged: it counts as none and is written anew", path)
        return None
    return content


class Objects:
    """Object code in the files of one folder.

    Attributes:
        folder: which need not exist; None where nothing is kept.
    """

    def __init__(self, folder: Path | None, most: int = MOST) -> None:
        """Touch nothing."""
        self.folder = folder
        self._most, self._written, self._writable = most, 0, True

    def find(self, key: str) -> bytes | None:
        """Content kept under a key, if it is there and whole."""
        if self.folder is None or os.environ.get(SWITCH) == "0":
            return None
        path = self.folder / key
        code = read_sealed(path)
        if code is not None:
            with suppress(OSError):  # a folder that others fill
                os.utime(path)
        return code

    def keep(self, key: str, code: bytes) -> None:
        """Write; where that is not possible it is not tried again."""
        if self.folder is None or os.environ.get(SWITCH) == "0" or not self._writable:
            return
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_sealed(self.folder / key, code)
        except FileNotFoundError:  # another process has found it old
            return
        except OSError as error:
            logger.info("derived code is not kept on disk: %s", error)
            self._writable = False
            return
        self._written += 1
        if self._written % EVERY == 1:
            self._shrink()

    def _shrink(self) -> None:
        """Delete the oldest files, so that there is room for a while."""
        found = []
        with suppress(OSError):
            for entry in os.scandir(self.folder):
                with suppress(OSError):  # another process has been quicker
                    status = entry.stat()
                    found.append((status.st_mtime_ns, max(status.st_size, BLOCK), entry.path))
        total = sum(size for _, size, _ in found)
        if total <= self._most:
            return
        for _, size, path in sorted(found):
            with suppress(OSError):
                os.unlink(path)
            total -= size
            if total <= 0.75 * self._most:
                return
