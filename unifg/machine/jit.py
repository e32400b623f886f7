"""The one way functions are compiled here: Numba, cached on disk, with floating-point liberties that keep NaN.

``fastmath`` in full may delete the checks for NaN that solvers rely on; contraction, reassociation, signed zeros
and reciprocals are what loops need to vectorise. Differences take none of these: reassociated, (x + h) - (x - h) is 2 h
whatever was stored, and y - x loses its digits far from the origin.

Numba's own cache looks at the file a function stands in and nothing else: it would go on running old code of a
callee in another file, and never find again a function that closes over another one. Here the stamp of a function
covers the files of everything it calls.
"""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from types import FunctionType, ModuleType
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba.core.caching import FunctionCache
from numba.core.dispatcher import Dispatcher

F = TypeVar("F", bound=Callable[..., Any])

logger = logging.getLogger("unifg")

LIBERTIES = {"contract", "reassoc", "nsz", "arcp"}


def compiled(function: F) -> F:
    """Compile on the first call, from the cache where there is one; callable from other compiled functions.

    The function may close over other compiled functions and numbers.
    """
    dispatcher = numba.njit(error_model="numpy", fastmath=LIBERTIES)(function)
    dispatcher._cache = _Cache(function)
    return cast(F, dispatcher)


def in_order(function: F) -> F:
    """Like :func:`compiled`, every operation as it is written: for functions that difference.

    Numba compiles what a function calls with the liberties of that function, unless these are refused.
    """
    dispatcher = numba.njit(error_model="numpy", fastmath=False)(function)
    dispatcher._cache = _CacheInOrder(function)
    return cast(F, dispatcher)


def inlined(function: F) -> F:
    """For helpers in the innermost loops: copied into the compiled functions that call them."""
    return cast(F, numba.njit(inline="always")(function))


def written(function: str, lines: Sequence[str], names: dict[str, Any], what: str) -> Callable[..., None]:
    """Compile a function that is put together as source; every operation as it is written, and no cache on disk.

    Args:
        function: its name there.
        lines: of the source.
        names: what the source knows; the function joins them.
        what: it is for, shown in tracebacks.
    """
    exec(compile("\n".join(lines), f"<{function} of {what}>", "exec"), names)
    dispatcher = numba.njit(error_model="numpy", fastmath=False)(names[function])
    return cast(Callable[..., None], dispatcher)


def is_compiled(function: object) -> bool:
    """Whether a function runs under Numba, whoever compiled it."""
    return isinstance(function, Dispatcher)


def source_of(function: Any) -> FunctionType:
    """The function in Python of a compiled one; any other as it is."""
    return cast(FunctionType, getattr(function, "py_func", function))


class _Cache(FunctionCache):  # type: ignore[misc]
    """A cache that asks for the stamp of the function and of everything it calls, and says when it has to wait."""

    announced = False

    def load_overload(self, signature: Any, target: Any) -> Any:
        try:
            found = super().load_overload(signature, target)
        except Exception as error:  # unpickling what is cut off, or names classes that have moved, may raise anything
            logger.info("the cache of %s cannot be read and begins anew: %s", self._py_func.__qualname__, error)
            self.flush()
            found = None
        if found is None and not _Cache.announced:
            _Cache.announced = True
            logger.warning("unifg compiles its kernels for this machine: some ten seconds, once; later runs reuse them")
        return found

    def _index_key(self, signature: Any, codegen: Any) -> Any:
        return signature, codegen.magic_tuple(), stamp(self._py_func)


class _CacheInOrder(_Cache):
    """Tells what is compiled without liberties from what once was compiled with them."""

    def _index_key(self, signature: Any, codegen: Any) -> Any:
        return *super()._index_key(signature, codegen), "in order"


def stamp(function: Any) -> str:
    """Digest of the source files of a function and of every compiled function it calls or closes over."""
    digest = hashlib.sha256()
    for part in sorted(_parts(function, set())):
        digest.update(part.encode())
    return digest.hexdigest()


def _parts(function: Any, seen: set[int]) -> Iterator[str]:
    """What identifies a function: its name, its file's date and size, the numbers it closes over, its callees."""
    python = source_of(function)
    if id(python) in seen:
        return
    seen.add(id(python))
    if getattr(function, "targetoptions", {}).get("fastmath") is False:
        yield f"{python.__qualname__} in order"
    code = python.__code__
    try:
        status = os.stat(code.co_filename)
        yield f"{python.__qualname__} {code.co_firstlineno} {status.st_mtime_ns} {status.st_size}"
    except OSError:  # typed into an interpreter
        yield f"{python.__qualname__} {code.co_code!r} {code.co_consts!r}"
    for cell in python.__closure__ or ():
        if is_compiled(cell.cell_contents):
            yield from _parts(cell.cell_contents, seen)
        else:
            yield f"{python.__qualname__} {_constant(cell.cell_contents)}"
    for name in code.co_names:
        found = python.__globals__.get(name)
        if isinstance(found, int | float | str | tuple | np.ndarray):  # constants are compiled in
            yield f"{name} = {_constant(found)}"
        candidates = [getattr(found, n, None) for n in code.co_names] if isinstance(found, ModuleType) else [found]
        for callee in candidates:
            if is_compiled(callee):
                yield from _parts(callee, seen)


def _constant(value: Any) -> str:
    """A number or an array in full: printed arrays leave out digits, and large ones their middle."""
    return f"{value.shape} {value.tobytes().hex()}" if isinstance(value, np.ndarray) else repr(value)
