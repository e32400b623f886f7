"""The state of the code as a digest: results of two states are told apart, machines that run another are refused."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path

__all__ = ["fingerprint"]

COUNTED = (".py", ".pgm", ".png", ".yaml", ".csv", ".json")
_SIDES = ("unifg.solvers", "unifg.models", "unifg.scenarios")


@cache
def fingerprint(*modules: str) -> str:
    """Digest of all sources of the library with the maps beside them.

    Args:
        modules: that are used besides; of those that are not of the library, the whole package is counted, too.
    """
    total = hashlib.sha256()
    for name in dict.fromkeys(("unifg", *_SIDES, *(module.partition(".")[0] for module in modules))):
        for path, inside in sorted((path, inside) for path, inside in _files(name) if path.suffix in COUNTED):
            if name == "unifg" and f"unifg.{inside.partition('/')[0]}" in _SIDES:
                continue  # installed, or reached by a link, they lie inside
            total.update(f"{name}/{inside}".encode() + b"\0" + path.read_bytes() + b"\0")
    return total.hexdigest()[:12]


def _files(package: str) -> Iterator[tuple[Path, str]]:
    """Files of a package, or of a module that is one file, each with its name below the package."""
    spec = find_spec(package)
    if spec is not None and spec.submodule_search_locations:
        folder = Path(next(iter(spec.submodule_search_locations))).resolve()
        for path in folder.rglob("*"):
            yield path, path.relative_to(folder).as_posix()
    elif spec is not None and spec.origin is not None:
        yield Path(spec.origin), ""
