"""Digests of compiled functions: equal for functions that compute the same, whatever file and line they stand in.

A digest covers the bytecode of a function and of everything compiled that it calls or closes over, and the constants
that are compiled in. Comments, docstrings, line numbers and other functions of a file do not change it.
"""

from __future__ import annotations

import dis
import hashlib
from collections.abc import Iterator
from functools import cache, lru_cache
from importlib.util import find_spec
from inspect import CO_NEWLOCALS, CO_OPTIMIZED
from types import CodeType, FunctionType, ModuleType
from typing import Any, cast

import numpy as np
from numba.core.dispatcher import Dispatcher

GENERATORS = ("calls", "function_pointers", "jit", "vectors", "views", "work_queue")
"""Modules of this package that say what is generated for primitives and types of their own."""
_FUNCTION = CO_OPTIMIZED | CO_NEWLOCALS
_CONSTANTS = (int, float, complex, str, tuple, np.ndarray, np.generic)
_LOADS = {number for name, number in dis.opmap.items() if "CONST" in name}
_FOREIGN = ("numpy", "math", "numba", "llvmlite")
_FLAGS = 0xFFFF  # those of later versions say whether there is a docstring


def is_compiled(function: object) -> bool:
    """Test whether a function runs under Numba, whoever compiled it."""
    return isinstance(function, Dispatcher)


def source_of(function: Any) -> FunctionType:
    """The function in Python of a compiled one; any other as it is."""
    return cast(FunctionType, getattr(function, "py_func", function))


def fingerprint(function: Any) -> str:
    """Digest of a function, compiled or not, and of every compiled function it calls or closes over."""
    digest = hashlib.sha256()
    for part in sorted(_parts(function, set())):
        digest.update(part.encode())
    return digest.hexdigest()


@cache
def generators() -> str:
    """Digest of the modules that generate instructions."""
    digest = hashlib.sha256()
    for name in GENERATORS:
        spec: Any = find_spec(f"{__package__}.{name}")
        digest.update(code_digest(spec.loader.get_code(spec.name)).encode())
    return digest.hexdigest()


@lru_cache(maxsize=4096)
def code_digest(code: CodeType) -> str:
    """Digest of bytecode without positions and docstrings."""
    constants = list(code.co_consts)
    if code.co_flags & _FUNCTION == _FUNCTION:
        if constants and isinstance(constants[0], str) and not _loads_first(code):
            constants[0] = None
    elif "__doc__" in code.co_names:
        constants[constants.index(next(c for c in constants if isinstance(c, str) and c != code.co_qualname))] = None
    parts = (
        code.co_code.hex(), code.co_exceptiontable.hex(), code.co_flags & _FLAGS, code.co_names, code.co_varnames,
        code.co_freevars, code.co_cellvars, code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount,
        *(code_digest(c) if isinstance(c, CodeType) else _constant(c) for c in constants),
    )  # fmt: skip
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def _loads_first(code: CodeType) -> bool:
    """Test whether an instruction loads the first constant, which then is more than a docstring."""
    return any(k in _LOADS and place == 0 for k, place in zip(code.co_code[::2], code.co_code[1::2], strict=True))


def _parts(function: Any, seen: set[int]) -> Iterator[str]:
    """Digests of code, compile flags and constants of a function and its callees."""
    python = source_of(function)
    if id(python) in seen:
        return
    seen.add(id(python))
    flags = sorted(f"{name} {_constant(value)}" for name, value in getattr(function, "targetoptions", {}).items())
    yield f"{python.__qualname__} {code_digest(python.__code__)} {_constant(python.__defaults__)} {flags}"
    for name, found in _reached(python):
        if is_compiled(found):
            yield from _parts(found, seen)
        elif isinstance(found, _CONSTANTS) or name in python.__code__.co_freevars:
            yield f"{name} = {_constant(found)}"


def _reached(function: FunctionType) -> Iterator[tuple[str, Any]]:
    """Names that a function refers to, and what they stand for: in its closure, its module and modules it names."""
    yield from zip(function.__code__.co_freevars, (c.cell_contents for c in function.__closure__ or ()), strict=True)
    names, known = set(_names(function.__code__)), function.__globals__
    for name in sorted(names & known.keys()):
        yield name, known[name]
        if isinstance(known[name], ModuleType) and known[name].__name__.partition(".")[0] not in _FOREIGN:
            yield from ((f"{name}.{n}", vars(known[name])[n]) for n in sorted(names & vars(known[name]).keys()))


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _constant(value: Any) -> str:
    """A value in full: printed arrays leave out digits, and large ones their middle."""
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {value.shape} {value.tobytes().hex()}"
    if isinstance(value, set | frozenset):
        return f"{type(value).__name__} {sorted(map(_constant, value))}"
    if isinstance(value, tuple):
        return f"({', '.join(map(_constant, value))})"
    return f"{type(value).__name__} {value!r}"
