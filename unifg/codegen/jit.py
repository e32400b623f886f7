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
import itertools
import logging
import os
import secrets
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FunctionType
from typing import Any, TypeVar, cast
from weakref import proxy

import llvmlite
import numba
from numba import types
from numba.core.bytecode import FunctionIdentity
from numba.core.registry import cpu_target
from numba.core.runtime import rtsys
from numba.core.sigutils import normalize_signature

from unifg.codegen import precompiled
from unifg.codegen.artifact import Artifact, finished, header_of, rebuilt
from unifg.codegen.cache_folder import cache_folder, say_not_kept
from unifg.codegen.compile_counter import tally
from unifg.codegen.dispatcher import LINKED, UseDispatcher
from unifg.codegen.fingerprint import fingerprint, uncovered
from unifg.codegen.objects import read_sealed, write_sealed
from unifg.errors import UnifgError

F = TypeVar("F", bound=Callable[..., Any])

logger = logging.getLogger("unifg")

if numba.config.DISABLE_JIT:
    raise UnifgError("NUMBA_DISABLE_JIT is set, and nothing here works without Numba's compiler: unset it")

LIBERTIES = {"contract", "reassoc", "nsz", "arcp"}
NUMBERS = 2**40, 2**62  # of functions: the least first one of a process, and how many there are to choose from


def _number_anew() -> None:
    """Let Numba number functions from where no other process does.

    Symbols consist of names, types and such numbers, and those in files meet in one linker: it takes one function for
    two that are called alike.
    """
    FunctionIdentity._unique_ids = itertools.count(NUMBERS[0] + secrets.randbelow(NUMBERS[1]))


_number_anew()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_number_anew)


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
    options = {"error_model": "numpy", "fastmath": liberties, "nogil": True, "nopython": True, "boundscheck": None}
    dispatcher = UseDispatcher(
        cast(FunctionType, function), targetoptions={**options, "no_cfunc_wrapper": True}
    )  # no callers in C
    dispatcher._cache = cache(dispatcher)
    return cast(F, dispatcher)


def inlined(function: F) -> F:
    """For helpers in the innermost loops: copied into the compiled functions that call them."""
    return cast(F, numba.njit(inline="always")(function))


def written(function: str, lines: Sequence[str], names: dict[str, Any], what: str) -> Callable[..., None]:
    """Compile a function that is put together as source; every operation as it is written.

    It is kept on disk unless it calls something that no fingerprint covers.

    Args:
        function: its name there.
        lines: of the source.
        names: what the source knows; the function joins them.
        what: it is for, shown in tracebacks.
    """
    names["__name__"] = __name__
    exec(compile("\n".join(lines), f"<{function} of {what}>", "exec"), names)
    made = names[function]
    if not (unknown := uncovered(made)):
        return cast(Callable[..., None], in_order(made))
    logger.info("'%s' is compiled in every process: it uses '%s', whose code has no fingerprint", what, unknown)
    return cast(Callable[..., None], numba.njit(error_model="numpy", fastmath=False)(made))


def processor() -> str:
    """Processor that code is generated for."""
    return repr(cpu_target.target_context.codegen().magic_tuple())


class _Cache:
    """Compiled functions that Numba asks for: in files found by fingerprints, and in the archive of the library."""

    def __init__(self, dispatcher: UseDispatcher) -> None:
        """Touch nothing."""
        self._dispatcher, self._py_func = proxy(dispatcher), cast(FunctionType, dispatcher.py_func)

    @property
    def cache_path(self) -> str | None:
        """Folder of the files, for messages."""
        folder = cache_folder()
        return None if folder is None else str(folder)

    def load_overload(self, signature: Any, target: Any) -> Any:
        if precompiled.recorder is not None:
            return None
        try:
            return self._found(signature, target)
        except AttributeError as error:  # Numba does not promise what is used here
            return _say_unknown(error)

    def _found(self, signature: Any, target: Any) -> Any:
        """Numba's result for a signature, from the disk or from the archive; None where there is nothing."""
        self._ready(target)
        name = f"{self._py_func.__module__}.{self._py_func.__qualname__}"
        arguments, digest = normalize_signature(signature)[0], fingerprint(self._py_func)
        path = self._file(arguments, digest, target.codegen())
        found = None if path is None else self._read(path, arguments, digest, target)
        if found is not None:
            tally.read.append(name)
            tally.files.append(str(path))
            return found
        if (half := precompiled.archive().find(self._shipping_key(arguments, digest))) is None:
            return None
        target.refresh()  # wrappers for Python are made here, of Numba's own types
        made = finished(target, *half, self._py_func, arguments, self._dispatcher.use)
        found = rebuilt(target, made, self._py_func, arguments)
        self._keep(path, self._made(arguments, digest), made)
        tally.generated.append(name)
        return found

    def _ready(self, target: Any) -> None:
        """Set up what code needs to run: with Numba's own types, and what can be made of them, a third of a second.

        The library's own code needs its memory alone. The rest waits for something to compile or to generate.
        """
        if self._py_func.__module__.startswith("unifg."):
            rtsys.initialize(target)
        else:
            target.refresh()

    def save_overload(self, signature: Any, result: Any) -> None:
        arguments, digest = normalize_signature(signature)[0], fingerprint(self._py_func)
        use = self._dispatcher.use
        if not result.library.has_dynamic_globals and (header := header_of(result, use)) is not None:
            try:
                code, linkable = b"", result.library._get_module_for_linking().as_bitcode()
                if use > LINKED:
                    _, _, (code, _) = result.library.serialize_using_object_code()
            except AttributeError as error:
                return _say_unknown(error)
            path = self._file(arguments, digest, result.codegen)
            self._keep(path, self._made(arguments, digest), Artifact(header, code, linkable))
        if precompiled.recorder is not None:
            precompiled.recorder.keep(self._shipping_key(arguments, digest), self._py_func, result)

    def flush(self) -> None:
        """Do nothing: code is found by its fingerprint, so there is nothing to begin anew."""

    def _read(self, path: Path, arguments: tuple[Any, ...], digest: str, target: Any) -> Any:
        """Read the code of the function as it is now; None if a file is of another or cannot be read."""
        made = self._made(arguments, digest)
        if (content := read_sealed(path)) is None or not content.startswith(made):
            return None
        try:
            artifact = Artifact.unpacked(content[len(made) :])
            if artifact.header["use"] < self._dispatcher.use:
                return None
            return rebuilt(target, artifact, self._py_func, arguments)
        except (UnifgError, ValueError, KeyError, TypeError, RuntimeError) as error:
            logger.warning("%s cannot be read and is written anew: %s: %s", path, type(error).__name__, error)
            return None

    def _keep(self, path: Path | None, made: bytes, artifact: Artifact) -> None:
        """Write what Numba keeps of a function, if that is possible."""
        if path is None:
            return
        try:
            write_sealed(path, made + artifact.packed())
        except OSError as error:  # a full disk
            say_not_kept(f"{path.parent}: {error.strerror}")
            return
        tally.files.append(str(path))

    def _file(self, arguments: tuple[Any, ...], digest: str, codegen: Any) -> Path | None:
        """One for each signature and processor; of functions made by another function, one for each that is made."""
        folder, function = cache_folder(), self._py_func
        if folder is None:
            return None
        name = f"{function.__module__.rpartition('.')[2]}.{function.__qualname__}".replace("<", "").replace(">", "")
        place = function.__module__, function.__code__.co_filename
        made = digest if "<" in function.__qualname__ + place[1] or function.__closure__ else ""
        parts = (sys.version_info[:2], *place, *map(spelled, arguments), codegen.magic_tuple(), made)
        number = hashlib.sha256(repr((*parts, *self._variant())).encode()).hexdigest()[:20]
        return folder / f"{name}.{number}.code"

    def _made(self, arguments: tuple[Any, ...], digest: str) -> bytes:
        """Digest of versions, the types of the arguments, the function and its callees."""
        kinds = " ".join(map(spelled, arguments))
        stated = f"{NUMBERS} {numba.__version__} {llvmlite.__version__} {kinds} {digest}"
        return hashlib.sha256(stated.encode()).digest()

    def _variant(self) -> tuple[str, ...]:
        """Further parts of the key."""
        return ()

    def _shipping_key(self, arguments: tuple[Any, ...], digest: str) -> str:
        """Key of the function in an archive that is made elsewhere: no date and no processor."""
        parts = (*map(spelled, arguments), *self._variant(), digest)  # a dispatcher, too, tells by arguments alone
        return hashlib.sha256(repr(parts).encode()).hexdigest()


def _say_unknown(error: AttributeError) -> None:
    """Log, once in a process, that this Numba has no way to keep functions that is known here."""
    owner = error.obj if isinstance(error.obj, type) else type(error.obj)
    if not any(base.__module__.partition(".")[0] in ("numba", "llvmlite") for base in owner.__mro__):
        raise error
    say_not_kept(f"Numba {numba.__version__} is newer than unifg knows ({error})")


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
