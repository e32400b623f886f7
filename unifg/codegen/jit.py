"""The one way functions are compiled here: Numba, cached on disk, with floating-point liberties that keep NaN.

``fastmath`` in full may delete the checks for NaN that solvers rely on; contraction, reassociation, signed zeros
and reciprocals are what loops need to vectorise. Differences take none of these: reassociated, (x + h) - (x - h) is 2 h
whatever was stored, and y - x loses its digits far from the origin.

Compiled functions let other threads run while they do: who calls one sees to it that nobody else writes to its arrays
(:mod:`unifg.locks`).

Numba's own cache looks at the file a function stands in and nothing else: it would go on running old code of a
callee in another file, compile anew after a comment, and never find again a function that closes over another one. It
believes what it reads, and two processes that compile at once may take each other's files. Here a function is found by
the fingerprint of its code and of everything it calls (:mod:`unifg.codegen.fingerprint`), and each signature has a file
of its own that is read whole or not at all. Where none can be written, functions are compiled for the process at hand.
What the cache does not have may have come with the library, half compiled (:mod:`unifg.codegen.precompiled`).
"""

from __future__ import annotations

import hashlib
import logging
import os
import pickle
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Event
from typing import Any, ClassVar, TypeVar, cast

import llvmlite
import numba
from numba import types
from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator
from numba.core.registry import cpu_target
from numba.core.runtime import rtsys
from numba.core.serialize import dumps
from numba.core.sigutils import normalize_signature

from unifg.codegen import precompiled
from unifg.codegen.compile_counter import tally
from unifg.codegen.fingerprint import fingerprint, generators
from unifg.codegen.objects import read_sealed, write_sealed

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


def folder_of(function: Any) -> Path | None:
    """Cache folder of a compiled function; None where nothing can be written."""
    path = function._cache.cache_path
    return None if path is None else Path(path)


def processor() -> str:
    """Processor that code is generated for."""
    return repr(cpu_target.target_context.codegen().magic_tuple())


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
        """Stamp that the index would compare, if it were read."""

    def get_disambiguator(self) -> str:
        """Part of a file name, if there were one."""
        return ""


def _say_unwritable(where: str = "no folder for compiled functions can be written") -> None:
    """Once in a process."""
    if not _said.is_set():
        _said.set()
        logger.warning(
            "%s: what is compiled is not kept, and every process compiles anew; name a folder in NUMBA_CACHE_DIR", where
        )


class _Implementation(CompileResultCacheImpl):  # type: ignore[misc]
    """Folders of the cache, as Numba finds them, or none."""

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
        if precompiled.recorder is not None:
            return None
        self._ready(target)
        name = f"{self._py_func.__module__}.{self._py_func.__qualname__}"
        path = self._file(signature, target.codegen())
        found = None if path is None else self._read(path, signature, target)
        if found is not None:
            tally.read.append(name)
            tally.files.append(str(path))
            return found
        if (half := precompiled.archive().find(self._shipping_key(signature))) is None:
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
        if precompiled.recorder is not None:
            precompiled.recorder.keep(self._shipping_key(signature), self._py_func, result, self._impl.reduce(result))

    def flush(self) -> None:
        """Do nothing: code is found by its fingerprint, so there is nothing to begin anew."""

    def _read(self, path: Path, signature: Any, target: Any) -> Any:
        """Read the code of the function as it is now; None if a file is of another or cannot be read."""
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
        """One for each signature and processor; of functions made by another function, one for each that is made."""
        if self._cache_path is None:
            return None
        function = self._py_func
        name = f"{function.__module__.rpartition('.')[2]}.{function.__qualname__}".replace("<", "").replace(">", "")
        made = fingerprint(function) if "<" in function.__qualname__ else ""
        arguments = normalize_signature(signature)[0]
        parts = (sys.version_info[:2], function.__module__, *map(spelled, arguments), codegen.magic_tuple(), made)
        digest = hashlib.sha256(repr((*parts, *self._variant())).encode()).hexdigest()[:20]
        return Path(self._cache_path, f"{name}.{digest}.code")

    def _made(self) -> bytes:
        """Digest of versions, the function and its callees."""
        stated = f"{numba.__version__} {llvmlite.__version__} {generators()} {fingerprint(self._py_func)}"
        return hashlib.sha256(stated.encode()).digest()

    def _variant(self) -> tuple[str, ...]:
        """Further parts of the key."""
        return ()

    def _shipping_key(self, signature: Any) -> str:
        """Key of the function in an archive that is made elsewhere: no date and no processor."""
        function = self._py_func
        arguments, _ = normalize_signature(signature)  # a dispatcher, too, tells functions by their arguments alone
        parts = (function.__module__, function.__qualname__, *map(spelled, arguments), *self._variant())
        return hashlib.sha256(repr((*parts, fingerprint(function))).encode()).hexdigest()


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
