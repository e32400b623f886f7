"""Digests of compiled functions: equal for functions that compute the same, whatever file, line and Python they have.

A digest covers the syntax of a function and of everything that it reaches: compiled functions that it calls or closes
over, what generates the instructions of its primitives, compile flags, and the constants that are compiled in.
Comments, docstrings, annotations, line numbers, names of modules and other functions of a file do not change it.
"""

from __future__ import annotations

import ast
import hashlib
import json
import os
import time
import zipfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType
from typing import Any, NamedTuple, cast

import numpy as np
from numba import types
from numba.core.dispatcher import Dispatcher

SHIPPED, SHAPES = Path(__file__).with_name("kernels.zip"), "shapes.json"
_CONSTANTS = (int, float, complex, str, tuple, np.ndarray, np.generic, np.dtype, types.Type)
_FOREIGN = ("numpy", "math", "numba", "llvmlite")
_COVERED = (*_FOREIGN, "unifg")  # packages whose functions are known by their versions, or looked into
_KNOWN = (type(None), ModuleType, BuiltinFunctionType)
_GENERATORS = "unifg.codegen."  # functions of these modules are looked at though they are not compiled
_IGNORED = {"type_params", "type_comment", "kind", "ctx", "annotation", "returns", "decorator_list"}


class Shape(NamedTuple):
    """Syntax of a function.

    Attributes:
        digest: of it.
        names: that it mentions, without its own variables, sorted.
    """

    digest: str
    names: tuple[str, ...]


began = time.time()
parsed: dict[str, dict[str, Shape]] = {}
"""Syntax of all files that were looked at, by their digests."""


def is_compiled(function: object) -> bool:
    """Test whether a function runs under Numba, whoever compiled it."""
    return isinstance(function, Dispatcher)


def source_of(function: Any) -> FunctionType:
    """The function in Python of a compiled one; any other as it is."""
    return cast(FunctionType, getattr(function, "py_func", function))


def fingerprint(function: Any) -> str:
    """Digest of a function, compiled or not, and of everything that it reaches."""
    digest = hashlib.sha256()
    for part in sorted(_parts(function, set())):
        digest.update(part.encode())
    return digest.hexdigest()


def uncovered(function: Any) -> str:
    """Name of something that a compiled function reaches and its fingerprint does not cover; empty if there is none."""
    return next(_uncovered(function, set()), "")


def _uncovered(function: Any, seen: set[int]) -> Iterator[str]:
    python = source_of(function)
    if id(python) in seen:
        return
    seen.add(id(python))
    for name, found in _reached(python, shape_of(python.__code__).names):
        parts = found if isinstance(found, tuple) else (found,)
        owner = str(getattr(found, "__module__", None) or type(found).__module__).partition(".")[0]
        if is_compiled(found):
            yield from _uncovered(found, seen)
        elif owner not in _COVERED and not all(isinstance(part, (*_KNOWN, *_CONSTANTS)) for part in parts):
            yield name


def shape_of(code: CodeType) -> Shape:
    """Syntax of the function with this code; its bytecode where there is no source."""
    found = shapes(code.co_filename).get(f"{code.co_name}:{code.co_firstlineno}")
    if found is not None:
        return found
    taken = code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags
    named = code.co_names, code.co_freevars, code.co_cellvars, code.co_exceptiontable
    constants = (c if not isinstance(c, CodeType) else shape_of(c).digest for c in code.co_consts)
    stated = repr((code.co_code, *taken, *named, *constants))
    return Shape(hashlib.sha256(stated.encode()).hexdigest(), tuple(sorted(_names(code))))


def shapes(path: str) -> dict[str, Shape]:
    """Syntax of all functions of a file by their names and first lines.

    Of none where it cannot be read, or has been changed since the process began: what runs may be what stood there.
    """
    try:
        status = os.stat(path)
        return _shapes(path, status.st_mtime_ns, status.st_size) if status.st_mtime <= began else {}
    except (OSError, SyntaxError, ValueError, TypeError):
        return {}


@cache
def _shapes(path: str, date: int, size: int) -> dict[str, Shape]:
    """Syntax of a file as it was at a date."""
    content = Path(path).read_bytes()
    digest = hashlib.sha256(content).hexdigest()
    found = archived().get(digest)
    if found is None:
        parsed[digest] = _parsed(content)
    else:
        parsed[digest] = {name: Shape(shape, tuple(mentioned)) for name, (shape, mentioned) in found.items()}
    return parsed[digest]


@cache
def archived() -> dict[str, Any]:
    """Syntax of files as they come with the library, by their digests: what has not been edited is not parsed."""
    try:
        with zipfile.ZipFile(SHIPPED) as file:
            return dict(json.loads(file.read(SHAPES)))
    except (OSError, KeyError, ValueError, zipfile.BadZipFile):
        return {}


def _parsed(content: bytes) -> dict[str, Shape]:
    """Syntax of the functions of a source."""
    found = {}
    for node in ast.walk(ast.parse(content)):
        if isinstance(node, ast.FunctionDef):
            first = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)])
            digest = hashlib.sha256(_spelled(node).encode()).hexdigest()
            found[f"{node.name}:{first}"] = Shape(digest, tuple(sorted(_mentioned(node))))
    return found


def _mentioned(function: ast.FunctionDef) -> set[str]:
    """Names and attributes in a function, without its own variables; those of comprehensions may be others' as well."""
    nodes = list(ast.walk(function))
    attributes = {node.attr for node in nodes if isinstance(node, ast.Attribute)}
    names = [node for node in nodes if isinstance(node, ast.Name)]
    counted = {
        name.id
        for node in nodes
        if isinstance(node, ast.comprehension)
        for name in ast.walk(node.target)
        if isinstance(name, ast.Name)
    }
    stored = {name.id for name in names if isinstance(name.ctx, ast.Store)} - counted
    given = {node.arg for node in nodes if isinstance(node, ast.arg)}
    return attributes | {name.id for name in names} - stored - given


def _spelled(node: Any) -> str:
    """Syntax in full, without what differs between versions of Python and what computes nothing."""
    if isinstance(node, list):
        return f"[{', '.join(map(_spelled, node))}]"
    if not isinstance(node, ast.AST):
        return repr(node)
    fields = {name: value for name, value in ast.iter_fields(node) if name not in _IGNORED and value not in (None, [])}
    if isinstance(node, ast.FunctionDef) and ast.get_docstring(node, clean=False) is not None:
        fields["body"] = node.body[1:]
    return f"{type(node).__name__}({', '.join(f'{name}={_spelled(value)}' for name, value in fields.items())})"


def _parts(function: Any, seen: set[int]) -> Iterator[str]:
    """Digests of syntax, compile flags and constants of a function and of what it reaches."""
    python = source_of(function)
    if id(python) in seen:
        return
    seen.add(id(python))
    shape = shape_of(python.__code__)
    flags = sorted(f"{name} {_constant(value)}" for name, value in getattr(function, "targetoptions", {}).items())
    yield f"{python.__name__} {shape.digest} {_constant(python.__defaults__)} {flags}"
    for name, found in _reached(python, shape.names):
        inner = found if is_compiled(found) else getattr(found, "__wrapped__", found)  # primitives wrap generators
        if is_compiled(inner) or _generates(inner):
            yield from _parts(inner, seen)
        elif isinstance(found, type) and issubclass(found, tuple):
            yield f"{name} = {getattr(found, '_fields', ())}"
        elif isinstance(found, _CONSTANTS) or name in python.__code__.co_freevars:
            yield f"{name} = {_constant(found)}"


def _generates(found: Any) -> bool:
    """Test for a function that helps to write instructions."""
    return isinstance(found, FunctionType) and found.__module__.startswith(_GENERATORS)


def _reached(function: FunctionType, names: tuple[str, ...]) -> Iterator[tuple[str, Any]]:
    """Names that a function refers to, and what they stand for: in its closure, its module and modules it names."""
    own, known = function.__code__.co_freevars, function.__globals__
    yield from zip(own, (c.cell_contents for c in function.__closure__ or ()), strict=True)
    for name in names:
        if name in known and name not in own:
            yield name, known[name]
            if isinstance(known[name], ModuleType) and known[name].__name__.partition(".")[0] not in _FOREIGN:
                yield from ((f"{name}.{n}", vars(known[name])[n]) for n in names if n in vars(known[name]))


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
