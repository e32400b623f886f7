"""Folder of what is compiled and kept for later processes: one for each user and version of unifg.

What is read from it is run. So a folder that others own or may write to is refused.
"""

from __future__ import annotations

import logging
import os
from functools import cache
from pathlib import Path
from threading import Event

from unifg.errors import UnifgError

logger = logging.getLogger("unifg")

VARIABLE = "UNIFG_CACHE_DIR"
"""Variable of the environment that names another place than the user's folder for caches."""
OTHERS = 0o022  # bits of those who may write besides the owner
_said = Event()


@cache
def cache_folder() -> Path | None:
    """The folder, made if need be; None where there can be none, which is logged once."""
    try:
        folder = place()
        _require_fit(folder)
    except UnifgError as error:
        say_not_kept(str(error))
        return None
    return folder


def place() -> Path:
    """Path of the folder, there or not."""
    if given := os.environ.get(VARIABLE):
        return Path(given) / version()
    from platformdirs import user_cache_path  # where a folder is named, it is not loaded

    try:
        folder = Path(user_cache_path("unifg", appauthor=False))
    except RuntimeError:  # without a home; older ones return "~", a folder of the present one
        folder = Path("~")
    if not folder.is_absolute():
        raise UnifgError(f"there is no home for a folder of compiled functions: name one in {VARIABLE}")
    return folder / version()


def version() -> str:
    """Version of unifg, "0.0.0" in a source tree that was never installed."""
    from importlib import metadata  # which loads a parser of mails

    try:
        return metadata.version("unifg")
    except metadata.PackageNotFoundError:
        return "0.0.0"


def _require_fit(folder: Path) -> None:
    """Make a folder, and refuse one in which nothing can be kept."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.stat()
    except OSError as error:
        raise UnifgError(f"{folder}: {error.strerror}") from error
    if hasattr(os, "getuid") and (status.st_uid != os.getuid() or status.st_mode & OTHERS):
        raise UnifgError(f"{folder} belongs to another user, or others may write to it")
    if not os.access(folder, os.W_OK):
        raise UnifgError(f"{folder} cannot be written")


def say_not_kept(why: str) -> None:
    """Log, once in a process, why nothing is kept."""
    if not _said.is_set():
        _said.set()
        logger.warning(
            "%s: what is compiled is not kept, and every process compiles anew; name a folder in %s", why, VARIABLE
        )
