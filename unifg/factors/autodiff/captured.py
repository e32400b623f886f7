"""Everything a function reaches beyond its arguments: a trace fixes it, so it is watched from solve to solve.

Numbers, text, tuples, arrays, lists, dictionaries and attributes of instances are values; functions and methods are
followed. A function that changes what it reaches, or reaches what cannot be watched, is traced only on request.
"""

from __future__ import annotations

import dis
import functools
import hashlib
import sys
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from enum import Enum
from types import BuiltinFunctionType, CellType, CodeType, FunctionType, MethodType, ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from unifg.codegen.fingerprint import is_compiled
from unifg.factors.autodiff.lookup import Lookup
from unifg.factors.autodiff.tables import LARGEST, fingerprint_of, kind_of, size_of
from unifg.factors.kernel import Kernel
from unifg.factors.residuals import Residual
from unifg.lie import Manifold
from unifg.typing import Array

TRUSTED = (
    "numpy", "math", "unifg", "builtins", "numba", "operator", "_operator", "itertools", "functools", "_functools"
)  # fmt: skip
"""Packages whose functions and classes stay as they are."""
OUTWARD = frozenset({"print", "open", "input", "eval", "exec", "globals", "vars", "getattr", "setattr", "id"})
"""Built-in functions that do or see more than numbers."""
_MISSING = object()
_PLAIN = (bool, int, float, complex, str, bytes, type(None), type(Ellipsis), range)


@dataclass
class _Watched:
    """Values that a function reaches, as they are when it is looked at."""

    cells: list[tuple[CellType, Any]] = field(default_factory=list)
    names: list[tuple[Mapping[str, Any], str, Any]] = field(default_factory=list)
    arrays: list[tuple[Array, bytes]] = field(default_factory=list)
    functions: list[tuple[FunctionType, tuple[Any, ...]]] = field(default_factory=list)
    containers: list[tuple[Any, tuple[Any, ...]]] = field(default_factory=list)
    interpolators: list[tuple[Any, tuple[Any, ...]]] = field(default_factory=list)

    @property
    def changed(self) -> bool:
        """True if a name means something else by now, or an array holds other numbers."""
        for cell, value in self.cells:
            if _inside(cell) is not value:
                return True
        for names, name, value in self.names:
            if names.get(name, _MISSING) is not value:
                return True
        for function, (code, defaults, options) in self.functions:  # each tick of a loop comes here
            if function.__code__ is not code or function.__defaults__ is not defaults:
                return True
            if function.__kwdefaults__ is not options:
                return True
        for container, entries in self.containers:
            present = entries_of(container)
            if len(present) != len(entries) or any(now is not kept for now, kept in zip(present, entries, strict=True)):
                return True
        for interpolator, content in self.interpolators:
            if fingerprint_of(interpolator) != content:
                return True
        return bool(self.arrays) and changed_arrays(self.arrays)


def changed_arrays(contents: Sequence[tuple[Array, bytes]]) -> bool:
    """Test whether an array holds other numbers than it did."""
    return any(array.tobytes() != content for array, content in contents)


@dataclass(frozen=True, eq=False)
class Captured:
    """Captured variables of a function.

    Attributes:
        key: equal for functions that compute the same; None where that cannot be said.
        refusal: why it is not traced unless its user asks; empty where it is.
        size: how many numbers stand in the arrays.
        named: arrays of floats that have a name of their own in the function or in one that it calls.
        attributes: what it asks modules and instances for.
    """

    key: Hashable | None
    refusal: str
    size: int
    named: tuple[Array, ...]
    attributes: frozenset[str]
    _watched: _Watched | None

    def __reduce__(self) -> tuple[Any, ...]:
        """In another process names mean what they mean there: look at everything anew."""
        return Captured, (None, self.refusal, self.size, (), self.attributes, None)

    def __deepcopy__(self, memo: dict[int, Any]) -> Captured:
        """A copy watches the same names."""
        return self

    @property
    def changed(self) -> bool:
        """True if a name means something else by now, or an array holds other numbers."""
        return self._watched is None or self._watched.changed

    @property
    def fixed(self) -> bool:
        """True if there is nothing that could change."""
        return self._watched is not None and not any(vars(self._watched).values())


def captured_by(
    function: Callable[..., Any], given: Sequence[Array] = (), attributes: frozenset[str] = frozenset()
) -> Captured:
    """Look at a function, and at everything it refers to.

    Args:
        function: in Python, or compiled by Numba.
        given: named arrays whose content does not matter, because a kernel is given it each time.
        attributes: what others ask for that take what it returns.
    """
    while True:  # what a module or an instance is asked for, functions say that are met after it
        walk = _Walk(given, attributes)
        key = walk.value(function, "it")
        if walk.complete:
            break
        attributes = walk.attributes
    return Captured(
        None if walk.refusal else key,
        walk.refusal,
        walk.size,
        tuple(walk.named.values()),
        walk.attributes,
        walk.watched,
    )


class _Walk:
    """Follows references, each once."""

    def __init__(self, given: Sequence[Array], attributes: frozenset[str]) -> None:
        self._given = {id(array): k for k, array in enumerate(given)}
        self.named: dict[int, Array] = {}
        self.refusal = ""
        self.size = 0
        self.watched = _Watched()
        self._seen: dict[int, int] = {}
        self._attributes = set(attributes)
        self._asked = len(attributes)

    @property
    def attributes(self) -> frozenset[str]:
        """Names that functions ask modules and instances for."""
        return frozenset(self._attributes)

    @property
    def complete(self) -> bool:
        """True if all of them were known from the beginning."""
        return len(self._attributes) == self._asked

    def named_value(self, value: Any, where: str) -> Hashable:
        """Key of the value of a name."""
        if type(value) is np.ndarray and value.dtype == np.float64 and value.ndim:
            self.named[id(value)] = value
            if id(value) in self._given:
                return "given", self._given[id(value)], value.shape
        return self.value(value, where)

    def refuse(self, why: str) -> None:
        self.refusal = self.refusal or why

    def value(self, value: Any, where: str) -> Hashable:
        """Key of a value."""
        if isinstance(value, _PLAIN) and type(value) in _PLAIN:
            return type(value).__name__, repr(value)
        if isinstance(value, np.generic):
            return "number", value.dtype.str, value.tobytes()
        if isinstance(value, np.ndarray):
            return self._array(value, where)
        if isinstance(value, tuple | frozenset):
            if type(value) not in (tuple, frozenset) and not hasattr(value, "_fields"):
                self.refuse(f"{where} is {_kind(value)}, which may change")
            if hasattr(value, "_fields"):
                self._named_tuple(value, where)
            return type(value), tuple(self.value(item, f"an entry of {where}") for item in value)
        if type(value) in (list, dict):
            return self._container(value, where)
        if isinstance(value, MethodType):
            return "method", self.value(value.__func__, where), self.value(value.__self__, where)
        if isinstance(value, slice):
            return "slice", tuple(self.value(part, where) for part in (value.start, value.stop, value.step))
        if isinstance(value, ModuleType):
            return self._module(value)
        if isinstance(value, FunctionType) or is_compiled(value):
            return self._function(value)
        if type(value) is functools.partial:
            options = tuple((name, self.value(item, f"'{name}'")) for name, item in sorted(value.keywords.items()))
            given = tuple(self.value(item, "a given argument") for item in value.args)
            return "partial", self.value(value.func, "its function"), given, options
        return self._other(value, where)

    def _other(self, value: Any, where: str) -> Hashable:
        if isinstance(value, np.ufunc | Manifold | Enum):
            return type(value), value
        if isinstance(value, Residual):  # of which only what it computes is called
            return "residual", self.value(value.function, where)
        if isinstance(value, Lookup) and _trusted(type(value).__module__):
            return type(value), value.digest
        if kind_of(value):
            return self._interpolator(value, where)
        if isinstance(value, BuiltinFunctionType) and isinstance(value.__self__, ModuleType | type | None):
            module = str(value.__module__)
            if value.__name__ in OUTWARD or not _trusted(module):
                self.refuse(f"it calls {'' if module == 'builtins' else module + '.'}{value.__name__}()")
            return value
        if isinstance(value, type):
            if not _trusted(value.__module__):
                self.refuse(f"{where} is the class {value.__name__}, which may change")
            return value
        if type(value).__module__.partition(".")[0] == "numpy" and callable(value) and hasattr(value, "__name__"):
            return "numpy", value.__name__, id(value)  # functions of NumPy that are not written in Python
        if isinstance(value, Kernel) and is_dataclass(value):  # whose methods nobody changes
            return type(value), tuple(self.value(getattr(value, f.name), f"{where}.{f.name}") for f in fields(value))
        return self._instance(value, where)

    def _named_tuple(self, value: Any, where: str) -> None:
        """Refuse a named tuple whose methods are used: no stand-in can be made of it."""
        for owner in type(value).__mro__:
            for name in self._attributes & set(vars(owner)):
                if isinstance(vars(owner)[name], FunctionType | property) and not name.startswith("__"):
                    self.refuse(f"{where} is {_kind(value)}, whose method {name} it uses")

    def _container(self, value: Any, where: str) -> Hashable:
        """A list or dictionary: its entries, and what tells them from others."""
        if id(value) in self._seen:
            return "seen", self._seen[id(value)]
        self._seen[id(value)] = len(self._seen)
        entries = entries_of(value)
        self.watched.containers.append((value, entries))
        return type(value).__name__, tuple(self.named_value(entry, f"an entry of {where}") for entry in entries)

    def _instance(self, value: Any, where: str) -> Hashable:
        """An instance of a class written in Python: the attributes that functions ask for, and its operators."""
        if id(value) in self._seen:
            return "seen", self._seen[id(value)]
        self._seen[id(value)] = len(self._seen)
        owners = classes_of(value)
        if not owners:
            self.refuse(f"{where} is {_kind(value)}, which may change")
            return id(value)
        own: dict[str, Any] = vars(value)
        parts: list[Any] = [type(value)]
        asked = {name for name in self._attributes if not name.startswith("__")}
        for name in sorted(asked | {name for owner in owners for name in vars(owner) if is_operator(owner, name)}):
            if name in own:
                parts.append(self._named(own, name, f"{_kind(value)}."))
                continue
            for owner in owners:  # also those further up, which super() calls
                if name in vars(owner):
                    self.watched.names += [(own, name, _MISSING), (vars(owner), name, vars(owner)[name])]
                    parts.append((owner, name, self._of_class(vars(owner)[name], f"{where}.{name}")))
        return tuple(parts)

    def _of_class(self, value: Any, where: str) -> Hashable:
        """An attribute of a class as its instances see it."""
        if isinstance(value, staticmethod | classmethod):
            return self.value(value.__func__, where)
        if isinstance(value, property):
            return "property", self.value(value.fget, where)
        if hasattr(type(value), "__get__") and not isinstance(value, FunctionType) and not is_compiled(value):
            self.refuse(f"{where} is a {type(value).__name__}, which may return anything")
            return id(value)
        return self.named_value(value, where)

    def _array(self, array: Array, where: str) -> Hashable:
        if array.dtype.hasobject or type(array) is not np.ndarray:
            self.refuse(f"{where} is {_kind(array)}")
            return id(array)
        content = array.tobytes()
        self.watched.arrays.append((array, content))
        self.size += array.size
        return array.dtype.str, array.shape, hashlib.blake2b(content, digest_size=16).digest()

    def _interpolator(self, value: Any, where: str) -> Hashable:
        """An interpolator of SciPy: its numbers, however many, are compared before each solve."""
        if (size := size_of(value)) > LARGEST:
            self.refuse(
                f"{where} has {size} numbers, which would be compared before each solve; unifg.models.spline has "
                "tables that never change"
            )
        content = fingerprint_of(value)
        self.watched.interpolators.append((value, content))
        return type(value), hashlib.blake2b(repr(content).encode(), digest_size=16).digest()

    def _module(self, module: ModuleType) -> Hashable:
        if module is np.random:
            self.refuse("it calls functions of np.random")
        if _trusted(module.__name__):
            return module.__name__
        if id(module) in self._seen:
            return "seen", self._seen[id(module)]
        self._seen[id(module)] = len(self._seen)
        names = [name for name in sorted(self._attributes) if name in vars(module)]
        return module.__name__, tuple(self._named(vars(module), name, module.__name__ + ".") for name in names)

    def _named(self, names: dict[str, Any], name: str, prefix: str = "") -> Hashable:
        value = names[name]
        if not (isinstance(value, ModuleType) and _trusted(value.__name__)):
            self.watched.names.append((names, name, value))
        return name, self.named_value(value, f"'{prefix}{name}'")

    def _function(self, function: Any) -> Hashable:
        python: FunctionType = getattr(function, "py_func", function)
        if id(python) in self._seen:
            return "seen", self._seen[id(python)]
        self._seen[id(python)] = len(self._seen)
        code, own = python.__code__, not _trusted(str(python.__module__))
        seen = _scanned(code)
        parts: list[Hashable] = [code]
        if own:
            written = python.__code__, python.__defaults__, python.__kwdefaults__  # notebooks replace them
            self.watched.functions.append((python, written))
            if seen.trouble:
                self.refuse(f"{seen.trouble}")
            self._attributes |= seen.attributes
        for name, cell in zip(code.co_freevars, python.__closure__ or (), strict=True):
            value = _inside(cell)
            self.watched.cells.append((cell, value))
            if name == "__class__":  # for super()
                parts.append(value)
                continue
            parts.append((name, "unassigned" if value is _MISSING else self.named_value(value, f"'{name}'")))
        for default in (*(python.__defaults__ or ()), *(v for _, v in sorted((python.__kwdefaults__ or {}).items()))):
            parts.append(self.named_value(default, "a default"))
        if own:
            known = python.__globals__
            for name in sorted(seen.names):
                if name in known:
                    parts.append(self._named(known, name))
                elif name in OUTWARD:
                    self.refuse(f"it calls {name}()")
        return tuple(parts)


@dataclass(frozen=True)
class _Scan:
    """Names of globals and attributes in the instructions of a function, and what prevents a trace."""

    names: frozenset[str]
    attributes: frozenset[str]
    trouble: str


@functools.lru_cache(maxsize=1024)
def _scanned(code: CodeType) -> _Scan:
    names, attributes, trouble = set[str](), set[str](), ""
    for inner in _codes(code):
        steps = list(dis.get_instructions(inner))
        for step, after in zip(steps, [*steps[1:], steps[-1]], strict=True):
            operation = step.opname
            if operation in ("LOAD_GLOBAL", "LOAD_NAME"):
                names.add(str(step.argval))
            elif operation in ("LOAD_ATTR", "LOAD_METHOD"):
                attributes.add(str(step.argval))
            elif operation in ("STORE_GLOBAL", "DELETE_GLOBAL"):
                trouble = trouble or f"it changes the global name '{step.argval}'"
            elif operation in ("STORE_ATTR", "DELETE_ATTR"):
                trouble = trouble or f"it changes the attribute '{step.argval}'"
            elif operation == "STORE_DEREF" and step.argval in code.co_freevars:
                trouble = trouble or f"it changes '{step.argval}' outside itself"
            elif operation == "IMPORT_NAME" and not _trusted(str(step.argval)):
                trouble = trouble or f"it imports {step.argval}"
            elif operation == "PUSH_EXC_INFO" and after.opname != "WITH_EXCEPT_START":
                trouble = trouble or "it handles exceptions, so what it computes may depend on the numbers"
    return _Scan(frozenset(names), frozenset(attributes), trouble)


def entries_of(container: Any) -> tuple[Any, ...]:
    """Entries of a list; keys and values of a dictionary."""
    return tuple(container) if isinstance(container, list) else (*container, *container.values())


def classes_of(value: Any) -> list[type]:
    """Classes of an instance that is nothing but attributes, written in Python; none of any other."""
    owners = [owner for owner in type(value).__mro__ if owner is not object]
    if type(value) is SimpleNamespace:
        return [SimpleNamespace]
    if isinstance(value, Lookup):  # a table that never changes: its own methods take symbols
        return []
    strange = any(
        owner.__module__.partition(".")[0] in sys.stdlib_module_names - {"__main__", "abc", "typing"}
        or "__getattribute__" in vars(owner)
        or "__getattr__" in vars(owner)
        or "__slots__" in vars(owner)
        for owner in owners
    )
    python = type(value).__basicsize__ == _Plain.__basicsize__
    return owners if python and hasattr(value, "__dict__") and not strange and not isinstance(value, type) else []


def is_operator(owner: type, name: str) -> bool:
    """Test whether an attribute of a class is a method that an operator calls, or a call."""
    hidden = ("__init__", "__new__", "__repr__", "__init_subclass__", "__post_init__", "__setattr__", "__delattr__")
    return name.startswith("__") and name not in hidden and isinstance(vars(owner)[name], FunctionType)


class _Plain:
    """An instance with a dictionary and nothing else."""


def _codes(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


def _inside(cell: CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # not assigned yet
        return _MISSING


def _trusted(module: str) -> bool:
    return module.partition(".")[0] in TRUSTED


def _kind(value: Any) -> str:
    name = type(value).__name__
    return f"an instance of {name}" if not isinstance(value, list | dict | set) else f"a {name}"
