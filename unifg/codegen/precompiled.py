"""Kernels that come with the library half compiled: LLVM's code after all optimisation, before that of a processor.

Nine tenths of a first compilation are the same on every machine: types are inferred, code is written down, linked and
optimised. An archive beside this file keeps what comes of it, one member per function and signature, so that a first
use generates code for the processor at hand and nothing else. What it made is then in the cache on disk like any other.

A member is found by the fingerprint of a function and by its types; the archive as a whole by the versions of Python,
Numba and llvmlite, by what generates instructions, and by the platform. So code that has changed is never found and is
compiled instead: an archive that is out of date costs time, and nothing else. Comments, docstrings and other functions
of a file change nothing.
``unifg warmup --ship`` writes it anew; :func:`outdated` says what has changed since.
"""

from __future__ import annotations

import importlib
import json
import logging
import pickle
import sys
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from types import FunctionType
from typing import Any

from llvmlite import binding as llvm
from numba.core.bytecode import FunctionIdentity
from numba.core.registry import cpu_target
from numba.core.serialize import dumps

from unifg.atomic_write import replacing
from unifg.codegen.fingerprint import fingerprint, generators

logger = logging.getLogger("unifg")

ARCHIVE = Path(__file__).with_name("kernels.zip")
ABOUT = "about.json"
FIRST_NUMBER = 10**9  # of functions in the archive: Numba numbers those of a process from one, and names hold numbers
LINKED_MANY_TIMES = "linkonce_odr"


def versions() -> dict[str, str]:
    """Versions that code generated here depends on, besides the functions."""
    return {
        "python": f"{sys.version_info.major}.{sys.version_info.minor}",
        "numba": metadata.version("numba"),
        "llvmlite": metadata.version("llvmlite"),
        "platform": str(llvm.get_process_triple()),
        "instructions": generators(),
    }


class Archive:
    """Half compiled kernels in a file.

    Attributes:
        usable: whether there is a file, made for these versions.
    """

    def __init__(self, path: Path) -> None:
        """Look at what the file is for."""
        self.usable, self._path = False, path
        try:
            self._file = zipfile.ZipFile(path)
            self.about = json.loads(self._file.read(ABOUT))
            kind, _ = self.about["versions"], self.about["functions"]
        except FileNotFoundError:  # it is an archive that one may do without
            return
        except Exception as error:  # what is damaged may say anything
            self._say_damaged(error)
            return
        different = [f"{name} {kind.get(name)}" for name, present in versions().items() if kind.get(name) != present]
        self.usable = not different
        if different:
            logger.info("the kernels that come with unifg are of another kind (%s)", ", ".join(different))

    def find(self, key: str) -> Any:
        """Entry of Numba's cache for a function, with code for this processor; None where there is nothing."""
        if not self.usable or key not in self._file.NameToInfo:
            return None
        try:
            (name, bitcode), *others = pickle.loads(self._file.read(key))  # checked against its sum as it is read
            return (name, "object", _generated(bitcode)), *others
        except Exception as error:
            self.usable = False
            self._say_damaged(error)
            return None

    def _say_damaged(self, error: Exception) -> None:
        logger.warning(
            "%s is damaged (%s: %s): functions are compiled instead, which takes longer once; install unifg again",
            self._path, type(error).__name__, error,
        )  # fmt: skip


@lru_cache(1)
def archive() -> Archive:
    """The one beside this file."""
    return Archive(ARCHIVE)


def outdated(path: Path = ARCHIVE) -> list[str]:
    """Names of functions that have changed since an archive was made, or "archive" for the whole."""
    made = Archive(path)
    if not made.usable:
        return ["archive"]
    return [name for name, digest in made.about["functions"].items() if _present(name) != digest]


def _present(name: str) -> str:
    """Fingerprint of a function of a module by its full name; empty where there is none."""
    module, _, qualname = name.partition(":")
    try:
        found: Any = importlib.import_module(module)
        for part in qualname.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError):
        return ""
    return fingerprint(found)


def _generated(bitcode: bytes) -> tuple[bytes, bytes]:
    """Object code for this processor, and what other functions link: the two that Numba's cache keeps."""
    module = llvm.parse_bitcode(bitcode)
    code = cpu_target.target_context.codegen()._tm.emit_object(module)
    for function in module.functions:
        if not function.is_declaration and function.linkage == llvm.Linkage.external:
            function.linkage = LINKED_MANY_TIMES
    return code, module.as_bitcode()


class Recorder:
    """Keeps what is compiled while an archive is made.

    Attributes:
        members: of the archive to be, by their keys.
        functions: fingerprints of what was compiled, by module and name; without those that functions make.
    """

    def __init__(self) -> None:
        """Nothing has been compiled."""
        self.members: dict[str, bytes] = {}
        self.functions: dict[str, str] = {}

    def keep(self, key: str, function: FunctionType, result: Any, reduced: tuple[Any, ...]) -> None:
        """Add a function: its key, what Numba made of it, and what the cache keeps of that."""
        library = result.library
        self.members[key] = dumps(((library.name, library._final_module.as_bitcode()), *reduced[1:]))
        name = f"{function.__module__}:{function.__qualname__}"
        if digest := _present(name):
            self.functions[name] = digest

    def write(self, path: Path) -> None:
        """Write the archive."""
        about = {"versions": versions(), "functions": dict(sorted(self.functions.items()))}
        with replacing(path) as own, zipfile.ZipFile(own, "w", zipfile.ZIP_LZMA) as file:
            for name, data in {ABOUT: json.dumps(about, indent=1).encode(), **self.members}.items():
                file.writestr(zipfile.ZipInfo(name), data, zipfile.ZIP_LZMA)


recorder: Recorder | None = None


@contextmanager
def recording() -> Iterator[Recorder]:
    """Compile everything anew meanwhile, and keep it."""
    global recorder
    numbers = FunctionIdentity._unique_ids
    FunctionIdentity._unique_ids = iter(range(FIRST_NUMBER, 2 * FIRST_NUMBER))
    recorder = Recorder()
    try:
        yield recorder
    finally:
        recorder = None
        FunctionIdentity._unique_ids = numbers
