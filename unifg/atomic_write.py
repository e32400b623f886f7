"""Files that appear whole or not at all: written beside their place, then renamed.

A full disk, a kill or an exception leaves what stood there before.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import get_ident


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path that atomically replaces ``path`` on success.

    The name ends as that of ``path`` does, for writers that look at it. Links are followed; what is no file, such as
    ``/dev/stdout``, is written to directly. Errors name ``path``.
    """
    target = Path(os.path.realpath(path))
    if target.exists() and not target.is_file():
        yield target
        return
    name = f".{target.stem}.{os.getpid()}.{get_ident()}{target.suffix}"
    own = target.with_name(name if len(os.fsencode(name)) < 255 else f".{os.getpid()}.{get_ident()}{target.suffix}")
    try:
        yield own
        with suppress(OSError):  # there was none before
            os.chmod(own, target.stat().st_mode)
        os.replace(own, target)
    except BaseException as error:
        if isinstance(error, OSError) and str(error.filename) == str(own):
            error.filename = os.fspath(path)  # for people
        with suppress(OSError):
            own.unlink()
        raise


def write_atomically(path: str | os.PathLike[str], content: str | bytes) -> None:
    """Write bytes, or text as UTF-8."""
    with replacing(path) as own:
        own.write_bytes(content.encode() if isinstance(content, str) else content)
