"""The one way functions are compiled here: Numba, cached on disk, with floating-point liberties that keep NaN.

``fastmath`` in full may delete the checks for NaN that solvers rely on; contraction, reassociation, signed zeros
and reciprocals are what loops need to vectorise. Differences take none of these: reassociated, (x + h) - (x - h) is 2 h
whatever was stored, and y - x loses its digits far from the origin.

Numba's own cache looks at the file a function stands in and nothing else: it would go on running old code of a
callee in another file, and never find again a function that closes over another one. Here the stamp of a function
covers the files of everything it calls. What the cache does not have may have come with the library, half compiled
(:mod:`unifg.machine.shipped`).
"""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba import types
from numba.core.caching import FunctionCache
from numba.core.dispatcher import Dispatcher
from numba.core.registry import cpu_target
from numba.core.sigutils import normalize_signature

from unifg.machine import shipped
from unifg.machine.tally import tally

F = TypeVar("F", bound=Callable[..., Any])

logger = logging.getLogger("unifg")

LIBERTIES = {"contract", "reassoc", "nsz", "arcp"}


def compiled(function: F) -> F:
    """Compile on the first call, from the cache where there is one; callable from other compiled functions.

    The function may close over other compiled functions and numbers.
    """
    return _cached(function, _Cache, LIBERTIES)


def in_order(function: F) -> F:
    """Like :func:`compiled`, every operation as it is written: for functions that difference.

    Numba compiles what a function calls with the liberties of that function, unless these are refused.
    """
    return _cached(function, _CacheInOrder, False)


def _cached(function: F, cache: type[_Cache], liberties: set[str] | bool) -> F:
    dispatcher = numba.njit(error_model="numpy", fastmath=liberties)(function)
    dispatcher._cache = cache(function)
    dispatcher.targetoptions["no_cfunc_wrapper"] = True  # for callers in C
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


def folder_of(function: Any) -> Path:
    """Where the cache keeps a compiled function."""
    return Path(function._cache.cache_path)


def processor() -> str:
    """What code is generated for."""
    return repr(cpu_target.target_context.codegen().magic_tuple())


def source_of(function: Any) -> FunctionType:
    """The function in Python of a compiled one; any other as it is."""
    return cast(FunctionType, getattr(function, "py_func", function))


class _Cache(FunctionCache):  # type: ignore[misc]
    """A cache that asks for the stamp of the function and of everything it calls, and that comes half filled."""

    def load_overload(self, signature: Any, target: Any) -> Any:
        if shipped.recorder is not None:
            return None
        name = f"{self._py_func.__module__}.{self._py_func.__qualname__}"
        try:
            found = super().load_overload(signature, target)
        except Exception as error:  # unpickling what is cut off, or names classes that have moved, may raise anything
            logger.info("the cache of %s cannot be read and begins anew: %s", self._py_func.__qualname__, error)
            self.flush()
            found = None
        if found is not None:
            tally.read.append(name)
            tally.files.append(self._cache_file._index_path)
            return found
        if (half := shipped.archive().find(self._shipping_key(signature, target.codegen()))) is None:
            return None
        found = self._impl.rebuild(target, half)
        with self._guard_against_spurious_io_errors():
            self._impl.locator.ensure_cache_path()
            self._cache_file.save(self._index_key(signature, target.codegen()), half)
        tally.generated.append(name)
        tally.files.append(self._cache_file._index_path)
        return found

    def save_overload(self, signature: Any, result: Any) -> None:
        result = result._replace(type_annotation="")  # half of what would be written, and nobody reads it
        super().save_overload(signature, result)
        tally.files.append(self._cache_file._index_path)
        if shipped.recorder is not None:
            key, source = self._shipping_key(signature, result.codegen), self._py_func.__code__.co_filename
            shipped.recorder.keep(key, source, result, self._impl.reduce(result))

    def _index_key(self, signature: Any, codegen: Any) -> Any:
        return signature, codegen.magic_tuple(), stamp(self._py_func)

    def _shipping_key(self, signature: Any, codegen: Any) -> str:
        """What the function is called in an archive that is made elsewhere: no date and no processor."""
        function, (_, _, _, *more) = self._py_func, self._index_key(signature, codegen)
        arguments, _ = normalize_signature(signature)  # a dispatcher, too, tells functions by their arguments alone
        parts = (function.__module__, function.__qualname__, *map(spelled, arguments), *more)
        return hashlib.sha256(repr((*parts, stamp(function, shipped.content))).encode()).hexdigest()


class _CacheInOrder(_Cache):
    """Tells what is compiled without liberties from what once was compiled with them."""

    def _index_key(self, signature: Any, codegen: Any) -> Any:
        return *super()._index_key(signature, codegen), "in order"


def spelled(kind: Any) -> str:
    """A type in full: Numba's own name of a named tuple leaves out what its parts are called."""
    if isinstance(kind, types.BaseTuple):
        names = getattr(kind, "fields", ())
        return f"{type(kind).__name__} {kind.name if names else ''} {names} ({', '.join(map(spelled, kind.types))})"
    return str(kind)


def _date(path: str) -> str:
    """What changes when a file is written."""
    status = os.stat(path)
    return f"{status.st_mtime_ns} {status.st_size}"


def stamp(function: Any, of_file: Callable[[str], str] = _date) -> str:
    """Digest of the source files of a function and of every compiled function it calls or closes over.

    Args:
        function: compiled or not.
        of_file: what stands for a file; raises OSError where there is none.
    """
    digest = hashlib.sha256()
    for part in sorted(_parts(function, set(), of_file)):
        digest.update(part.encode())
    return digest.hexdigest()


def _parts(function: Any, seen: set[int], of_file: Callable[[str], str]) -> Iterator[str]:
    """What identifies a function: its name, its file, the numbers it closes over, its callees."""
    python = source_of(function)
    if id(python) in seen:
        return
    seen.add(id(python))
    if getattr(function, "targetoptions", {}).get("fastmath") is False:
        yield f"{python.__qualname__} in order"
    code = python.__code__
    try:
        yield f"{python.__qualname__} {code.co_firstlineno} {of_file(code.co_filename)}"
    except OSError:  # typed into an interpreter
        yield f"{python.__qualname__} {code.co_code!r} {code.co_consts!r}"
    for cell in python.__closure__ or ():
        if is_compiled(cell.cell_contents):
            yield from _parts(cell.cell_contents, seen, of_file)
        else:
            yield f"{python.__qualname__} {_constant(cell.cell_contents)}"
    for name in code.co_names:
        found = python.__globals__.get(name)
        if isinstance(found, int | float | str | tuple | np.ndarray):  # constants are compiled in
            yield f"{name} = {_constant(found)}"
        candidates = [getattr(found, n, None) for n in code.co_names] if isinstance(found, ModuleType) else [found]
        for callee in candidates:
            if is_compiled(callee):
                yield from _parts(callee, seen, of_file)


def _constant(value: Any) -> str:
    """A number or an array in full: printed arrays leave out digits, and large ones their middle."""
    return f"{value.shape} {value.tobytes().hex()}" if isinstance(value, np.ndarray) else repr(value)
