"""Kernels that come with the library half compiled: LLVM's code after all optimisation, before that of a processor.

Nine tenths of a first compilation are the same on every machine and for every Python: types are inferred, code is
written down, linked and optimised. An archive beside this file keeps what comes of it, one member per function and
signature, so that a first use generates code for the processor at hand and nothing else. What it made is then in the
cache on disk like any other.

A member is found by the fingerprint of a function and by its types; the archive as a whole is for a version of LLVM, a
platform, and what Numba's compiled code expects of its surroundings. So code that has changed is never found and is
compiled instead: an archive that is out of date costs time, and nothing else. Members are text that LLVM reads, without
anything of Python: they are checked against digests, and say nothing about what runs but machine code.
``unifg warmup --ship`` writes the archive anew; :func:`outdated` says what has changed since.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import logging
import lzma
import re
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cache, lru_cache
from pathlib import Path
from types import FunctionType
from typing import Any

import numba
from llvmlite import binding as llvm
from numba import types
from numba.core.registry import cpu_target

from unifg.atomic_write import replacing
from unifg.codegen.artifact import header_of
from unifg.codegen.dispatcher import LINKED
from unifg.codegen.errors import PREFIX, without_errors
from unifg.codegen.fingerprint import SHAPES, SHIPPED, fingerprint, parsed
from unifg.errors import UnifgError

logger = logging.getLogger("unifg")

ARCHIVE = SHIPPED
ABOUT, CODE = "about.json", "code.xz"
WRAPPER = "_ZN7cpython"  # prefix of what Python calls
MATHEMATICS = (
    r"(a?(sin|cos|tan)h?|atan2|exp2?|expm1|log(10|1p|2)?|sqrt|cbrt|pow|hypot|fmod|floor|ceil|"
    r"rint|erfc?|mem(set|cpy|move))"
)
OUTSIDE = re.compile(rf"llvm\.|NRT_|numba_|{PREFIX}|{MATHEMATICS}$")
"""Symbols that members may expect from outside: of LLVM, of Numba's own library, and of C's for mathematics."""


def versions() -> dict[str, str]:
    """Circumstances that code in the archive depends on, besides the functions."""
    return {
        "llvm": ".".join(map(str, llvm.llvm_version_info)),
        "platform": str(llvm.get_process_triple()),
        "surroundings": surroundings(),
    }


@cache
def surroundings() -> str:
    """Digest of what Numba's compiled code expects: layout of arrays, calling convention, functions of its library."""
    context = cpu_target.target_context
    kinds = (
        types.Array(types.float64, 2, "C"), types.Optional(types.float64), types.Tuple((types.int64, types.boolean)),
        types.none, types.float64,
    )  # fmt: skip
    stated = [str(context.get_value_type(kind)) for kind in kinds]
    stated += [str(context.call_conv.get_function_type(kind, kinds)) for kind in kinds]
    try:
        from numba import _helperlib
        from numba.core.runtime import _nrt_python

        stated += [*sorted(vars(_helperlib)["c_helpers"]), *sorted(_nrt_python.c_helpers)]
    except (ImportError, AttributeError, KeyError) as error:  # a Numba that keeps them elsewhere is another one
        return f"unknown: {error}"
    return hashlib.sha256(repr(stated).encode()).hexdigest()


class Archive:
    """Half compiled kernels in a file.

    Attributes:
        usable: whether there is a file, made for these versions.
    """

    def __init__(self, path: Path) -> None:
        """Look at what the file is for."""
        self.usable, self._path = False, path
        self._code: bytes | None = None
        try:
            self._file = zipfile.ZipFile(path)
            self.about = json.loads(self._file.read(ABOUT))
            kind, _, self._members = (self.about[part] for part in ("versions", "functions", "members"))
        except FileNotFoundError:  # it is an archive that one may do without
            return
        except Exception as error:  # what is damaged may say anything
            self._say_damaged(error)
            return
        different = [f"{name} {kind.get(name)}" for name, present in versions().items() if kind.get(name) != present]
        self.usable = not different
        if different:
            logger.info(
                "the kernels that come with unifg are not for Numba %s here (%s): functions are compiled instead",
                numba.__version__, ", ".join(different),
            )  # fmt: skip

    def find(self, key: str) -> tuple[dict[str, Any], str] | None:
        """Header and code, in LLVM's language, of a function; None where there is nothing."""
        if not self.usable or key not in self._members:
            return None
        try:
            if self._code is None:
                self._code = lzma.decompress(self._file.read(CODE))
            member = self._members[key]
            code = self._code[member["first"] : member["end"]]
            if hashlib.sha256(code).hexdigest() != member["sha256"]:
                raise UnifgError(f"member {key[:12]} is not what its digest says")
            return member["header"], code.decode()
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


def undefined(text: str) -> Iterable[str]:
    """Names of functions and variables that code expects from outside."""
    module = llvm.parse_assembly(text)
    yield from (function.name for function in module.functions if function.is_declaration)
    yield from (variable.name for variable in module.global_variables if variable.is_declaration)


def leave_out_unused(module: Any, machine: Any) -> None:
    """Take away what nothing refers to that is seen from outside."""
    passes = llvm.create_new_module_pass_manager()
    passes.add_global_dead_code_eliminate_pass()
    passes.run(module, llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options()))


class Recorder:
    """Keeps what is compiled while an archive is made.

    Attributes:
        members: of the archive to be, headers and code by their keys.
        functions: fingerprints of what was compiled, by module and name; without those that functions make.
        left_out: reasons by the names of functions that are not archived.
    """

    def __init__(self) -> None:
        """Nothing has been compiled."""
        self.members: dict[str, tuple[dict[str, Any], str]] = {}
        self.functions: dict[str, str] = {}
        self.left_out: dict[str, str] = {}
        self._codegen = cpu_target.target_context.codegen()
        self._optimised: dict[str, str] = {}

    def watch(self, module: Any) -> Any:
        """Take down optimised code before it is generated for a processor, which changes it."""
        self._optimised[module.name] = str(module)
        return type(self._codegen)._add_module(self._codegen, module)

    def keep(self, key: str, function: FunctionType, result: Any) -> None:
        """Add a function: its key, and what Numba made of it."""
        name = f"{function.__module__}:{function.__qualname__}"
        header, module = header_of(result, LINKED), result.library._final_module
        try:
            # What is linked alone is generated for no processor.
            text = without_errors(self._alone(self._optimised.get(module.name) or str(module)))
            wrong = [symbol for symbol in undefined(text) if not OUTSIDE.match(symbol)]
        except UnifgError as error:
            self.left_out[name] = str(error)
            return
        if header is None or wrong:
            self.left_out[name] = f"expects {', '.join(wrong)}" if wrong else "its result is of no plain type"
            return
        self.members[key] = header, text
        if digest := _present(name):
            self.functions[name] = digest

    def _alone(self, text: str) -> str:
        """Code without what Python calls, which each version of it wants otherwise."""
        module = llvm.parse_assembly(text)
        for function in module.functions:
            if function.name.startswith((WRAPPER, "cfunc.")) and not function.is_declaration:
                function.linkage = llvm.Linkage.internal
        leave_out_unused(module, self._codegen._tm)
        return str(module)

    def write(self, path: Path) -> None:
        """Write the archive, and log what is left out of it."""
        for name, reason in self.left_out.items():
            logger.warning("%s is not archived: %s", name, reason)
        code, members = bytearray(), {}
        for key, (header, text) in sorted(self.members.items(), key=lambda member: member[1][0]["symbol"]):
            first = len(code)
            code += text.encode()
            digest = hashlib.sha256(code[first:]).hexdigest()
            members[key] = {"header": header, "first": first, "end": len(code), "sha256": digest}
        about = {"versions": versions(), "functions": dict(sorted(self.functions.items())), "members": members}
        content = {
            ABOUT: json.dumps(about, indent=1).encode(),
            SHAPES: json.dumps(parsed).encode(),
            CODE: lzma.compress(bytes(code), preset=9),
        }
        with replacing(path) as own, zipfile.ZipFile(own, "w") as file:
            for name, data in content.items():
                file.writestr(zipfile.ZipInfo(name), data, zipfile.ZIP_STORED if name == CODE else zipfile.ZIP_DEFLATED)


recorder: Recorder | None = None


@contextmanager
def recording() -> Iterator[Recorder]:
    """Compile everything anew meanwhile, and keep it."""
    global recorder
    recorder = Recorder()
    codegen = recorder._codegen
    codegen._add_module = recorder.watch
    try:
        yield recorder
    finally:
        del codegen._add_module
        recorder = None
