"""Folder of what is compiled and kept for later processes: one for each user and version of unifg.

What is read from it is run. So a folder that others own or may write to is refused.
"""

from __future__ import annotations

import logging
import os
from functools import cache
from pathlib import Path
from threading import Event

logger = logging.getLogger("unifg")

VARIABLE = "UNIFG_CACHE_DIR"
"""Variable of the environment that names another place than the user's folder for caches."""
OTHERS = 0o022  # bits of those who may write besides the owner
_said = Event()


@cache
def cache_folder() -> Path | None:
    """The folder, made if need be; None where there can be none, which is logged once."""
    folder = place()
    if why := _refused(folder):
        say_not_kept(why)
        return None
    return folder


def place() -> Path:
    """Path of the folder, there or not."""
    if given := os.environ.get(VARIABLE):
        return Path(given) / version()
    from platformdirs import user_cache_path  # where a folder is named, it is not loaded

    return Path(user_cache_path("unifg", appauthor=False)) / version()


def version() -> str:
    """Version of unifg, "0.0.0" in a source tree that was never installed."""
    from importlib import metadata  # which loads a parser of mails

    try:
        return metadata.version("unifg")
    except metadata.PackageNotFoundError:
        return "0.0.0"


def _refused(folder: Path) -> str:
    """Reason for which nothing is kept in a folder; empty where it is fit, and then it is there."""
    if not folder.is_absolute() and VARIABLE not in os.environ:  # without a home, "~" is a folder of the present one
        return "there is no home for a folder of compiled functions"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.stat()
    except OSError as error:
        return f"{folder}: {error.strerror}"
    if hasattr(os, "getuid") and (status.st_uid != os.getuid() or status.st_mode & OTHERS):
        return f"{folder} belongs to another user, or others may write to it"
    return "" if os.access(folder, os.W_OK) else f"{folder} cannot be written"


def say_not_kept(why: str) -> None:
    """Log, once in a process, why nothing is kept."""
    if not _said.is_set():
        _said.set()
        logger.warning(
            "%s: what is compiled is not kept, and every process compiles anew; name a folder in %s", why, VARIABLE
        )
