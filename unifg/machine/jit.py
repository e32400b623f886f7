"""The one way functions are compiled here: Numba, cached on disk, with floating-point liberties that keep NaN.

``fastmath`` in full may delete the checks for NaN that solvers rely on; contraction, reassociation, signed zeros
and reciprocals are what loops need to vectorise. Differences take none of these: reassociated, (x + h) - (x - h) is 2 h
whatever was stored, and y - x loses its digits far from the origin.

Compiled functions let other threads run while they do: who calls one sees to it that nobody else writes to its arrays
(:mod:`unifg.turns`).

Numba's own cache looks at the file a function stands in and nothing else: it would go on running old code of a
callee in another file, and never find again a function that closes over another one. It believes what it reads, and
two processes that compile at once may take each other's files. Here the stamp of a function covers the files of
everything it calls, and each signature has a file of its own that is read whole or not at all. Where none can be
written, functions are compiled for the process at hand. What the cache does not have may have come with the library,
half compiled (:mod:`unifg.machine.shipped`).
"""

from __future__ import annotations

import hashlib
import logging
import os
import pickle
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from threading import Event
from types import FunctionType, ModuleType
from typing import Any, ClassVar, TypeVar, cast

import llvmlite
import numba
import numpy as np
from numba import types
from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator
from numba.core.dispatcher import Dispatcher
from numba.core.registry import cpu_target
from numba.core.runtime import rtsys
from numba.core.serialize import dumps
from numba.core.sigutils import normalize_signature

from unifg.machine import shipped
from unifg.machine.objects import read_sealed, write_sealed
from unifg.machine.tally import tally

F = TypeVar("F", bound=Callable[..., Any])

logger = logging.getLogger("unifg")

LIBERTIES = {"contract", "reassoc", "nsz", "arcp"}
_HOME = os.path.expanduser("~") != "~"
_said = Event()


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
    dispatcher = numba.njit(error_model="numpy", fastmath=liberties, nogil=True)(function)
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


def folder_of(function: Any) -> Path | None:
    """Where the cache keeps a compiled function; None where nothing can be written."""
    path = function._cache.cache_path
    return None if path is None else Path(path)


def processor() -> str:
    """What code is generated for."""
    return repr(cpu_target.target_context.codegen().magic_tuple())


def source_of(function: Any) -> FunctionType:
    """The function in Python of a compiled one; any other as it is."""
    return cast(FunctionType, getattr(function, "py_func", function))


class _Nowhere(_CacheLocator):  # type: ignore[misc]
    """For functions whose code is kept in no file."""

    def __init__(self, file: str) -> None:
        """Of a file, or of what is none, as an interpreter's prompt."""
        self._py_file = file

    @classmethod
    def from_function(cls, function: Any, file: str) -> _Nowhere:
        """Take any function; say so where it might have been otherwise."""
        if os.path.exists(file):
            _say_unwritable()
        return cls(file)

    def get_cache_path(self) -> None:
        """There is none."""

    def get_source_stamp(self) -> None:
        """Nobody asks."""

    def get_disambiguator(self) -> str:
        """Nobody asks."""
        return ""


def _say_unwritable(where: str = "no folder for compiled functions can be written") -> None:
    """Once in a process."""
    if not _said.is_set():
        _said.set()
        logger.warning(
            "%s: what is compiled is not kept, and every process compiles anew; name a folder in NUMBA_CACHE_DIR", where
        )


class _Implementation(CompileResultCacheImpl):  # type: ignore[misc]
    """Where files stand, as Numba finds it, or nowhere."""

    _locator_classes: ClassVar[list[Any]] = [
        # without a home, "~" would be a folder of the working directory
        *(c for c in CompileResultCacheImpl._locator_classes if _HOME or "UserWide" not in c.__name__),
        _Nowhere,
    ]


class _Cache(FunctionCache):  # type: ignore[misc]
    """A cache that asks for the stamp of the function and of everything it calls, and that comes half filled."""

    _impl_class = _Implementation

    def __init__(self, function: Any) -> None:
        """Find the place of the files."""
        self._name, self._py_func, self._impl = repr(function), function, self._impl_class(function)
        self._cache_path = self._impl.locator.get_cache_path()
        self.enable()

    def load_overload(self, signature: Any, target: Any) -> Any:
        if shipped.recorder is not None:
            return None
        self._ready(target)
        name = f"{self._py_func.__module__}.{self._py_func.__qualname__}"
        path = self._file(signature, target.codegen())
        found = None if path is None else self._read(path, signature, target)
        if found is not None:
            tally.read.append(name)
            tally.files.append(str(path))
            return found
        if (half := shipped.archive().find(self._shipping_key(signature))) is None:
            return None
        found = self._impl.rebuild(target, half)
        self._keep(path, half)
        tally.generated.append(name)
        return found

    def _ready(self, target: Any) -> None:
        """Set up what code needs to run: with Numba's own types, and what can be made of them, a third of a second.

        The library's own code needs its memory alone. The rest waits for something to compile, which asks for it.
        """
        if self._py_func.__module__.startswith("unifg."):
            rtsys.initialize(target)
        else:
            target.refresh()

    def save_overload(self, signature: Any, result: Any) -> None:
        result = result._replace(type_annotation="")  # half of what would be written, and nobody reads it
        if self._impl.check_cachable(result):
            self._keep(self._file(signature, result.codegen), self._impl.reduce(result))
        if shipped.recorder is not None:
            key, source = self._shipping_key(signature), self._py_func.__code__.co_filename
            shipped.recorder.keep(key, source, result, self._impl.reduce(result))

    def flush(self) -> None:
        """What is kept is found by what it was made of: there is nothing to begin anew."""

    def _read(self, path: Path, signature: Any, target: Any) -> Any:
        """What a file keeps of the function as it is now, None if it is of another or cannot be read."""
        if (content := read_sealed(path)) is None or not content.startswith(made := self._made()):
            return None
        try:
            found = self._impl.rebuild(target, pickle.loads(content[len(made) :]))
        except Exception as error:  # unpickling what names classes that have moved may raise anything
            logger.warning("%s cannot be read and is written anew: %s: %s", path, type(error).__name__, error)
            return None
        return found if found.signature.args == normalize_signature(signature)[0] else None

    def _keep(self, path: Path | None, reduced: tuple[Any, ...]) -> None:
        """Write what Numba keeps of a function, if that is possible."""
        if path is None:
            return
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_sealed(path, self._made() + dumps(reduced))
        except OSError as error:  # a full disk
            _say_unwritable(f"{path.parent}: {error.strerror}")
            return
        tally.files.append(str(path))

    def _file(self, signature: Any, codegen: Any) -> Path | None:
        """One for each signature, closure and processor."""
        if self._cache_path is None:
            return None
        arguments, alike = normalize_signature(signature)[0], stamp(self._py_func, lambda path: "")  # but for dates
        parts = (*map(spelled, arguments), codegen.magic_tuple(), alike, *self._variant())
        digest = hashlib.sha256(repr(parts).encode()).hexdigest()[:20]
        return Path(self._cache_path, f"{self._impl.filename_base}.{digest}.code")

    def _made(self) -> bytes:
        """What code is made of: versions and sources."""
        stated = f"{numba.__version__} {llvmlite.__version__} {stamp(self._py_func)}"
        return hashlib.sha256(stated.encode()).digest()

    def _variant(self) -> tuple[str, ...]:
        """What else code depends on."""
        return ()

    def _shipping_key(self, signature: Any) -> str:
        """What the function is called in an archive that is made elsewhere: no date and no processor."""
        function = self._py_func
        arguments, _ = normalize_signature(signature)  # a dispatcher, too, tells functions by their arguments alone
        parts = (function.__module__, function.__qualname__, *map(spelled, arguments), *self._variant())
        return hashlib.sha256(repr((*parts, stamp(function, shipped.content))).encode()).hexdigest()


class _CacheInOrder(_Cache):
    """Tells what is compiled without liberties from what once was compiled with them."""

    def _variant(self) -> tuple[str, ...]:
        return *super()._variant(), "in order"


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
        candidates = [vars(found).get(n) for n in code.co_names] if isinstance(found, ModuleType) else [found]
        for callee in candidates:
            if is_compiled(callee):
                yield from _parts(callee, seen, of_file)


def _constant(value: Any) -> str:
    """A number or an array in full: printed arrays leave out digits, and large ones their middle."""
    return f"{value.shape} {value.tobytes().hex()}" if isinstance(value, np.ndarray) else repr(value)
