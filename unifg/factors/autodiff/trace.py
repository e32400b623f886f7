"""Running a function once on numbers that are not known yet.

The function is what a user writes: batched NumPy, called with one factor, or a Numba function of one factor that writes
its residual into its last argument. What it refers to is looked at before it runs: NumPy's constructors make arrays
that may hold symbols, ``math`` does what NumPy does, and functions it calls are run in the same way. Nothing outside
changes.
"""

from __future__ import annotations

import builtins
import math
import sys
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import fields, is_dataclass
from functools import partial
from types import CellType, CodeType, FunctionType, MethodType, ModuleType, SimpleNamespace
from typing import Any, cast

import numpy as np

from unifg.codegen import calls
from unifg.codegen.fingerprint import is_compiled, source_of
from unifg.factors.autodiff.array_functions import TABLE
from unifg.factors.autodiff.branches import every_way, innermost, unless_raised
from unifg.factors.autodiff.captured import classes_of, entries_of, is_operator
from unifg.factors.autodiff.groups import wrap
from unifg.factors.autodiff.manifolds import Symbolic, stated_closed
from unifg.factors.autodiff.symbols import (
    FUNCTIONS,
    UFUNCS,
    Length,
    Symbol,
    Symbols,
    TraceError,
    alike,
    as_number,
    is_truth,
    node_of,
    one_factor,
    only,
    plain,
    require_float,
    symbols,
    wrapped,
)
from unifg.factors.autodiff.tables import Interpolator, interp, kind_of
from unifg.factors.autodiff.tape import Tape
from unifg.factors.kernel import NOTHING, Argument, Kernel
from unifg.factors.residuals import Residual
from unifg.lie import ManifoldBase, Product, so2, wrap_angle

FUNCTIONS.update(TABLE)
_AS_THEY_ARE = sys.stdlib_module_names | {"numpy", "numba"}  # modules of which no function is rebound
NOWHERE = np.zeros((0, 0))  # where a kernel that is not asked for them would write derivatives


def run(function: Callable[..., Any], arguments: Sequence[Any], tape: Tape, rebound: Rebound, rows: int = 0) -> Any:
    """Call a function with symbols.

    Args:
        function: batched; it may raise an exception for some values, and what it demands of them stands in
            ``tape.required``. Or compiled for one factor; that may decide on values, and is run every way.
        arguments: arrays of symbols, as the function takes them.
        tape: of the symbols.
        rebound: makes functions that take symbols.
        rows: of a compiled function, m; it is given an array of that length to write into.

    Returns:
        (1, m) what the batched function returns, or (m,) what the compiled one writes.

    Raises:
        TraceError: the function does what cannot be traced; the message says what and in which line.
    """
    try:
        made = rebound.callable(function)
        if not is_compiled(function):
            result = unless_raised(tape, lambda: made(*arguments))
            rebound.require_untouched()
            return result

        def once() -> list[int]:
            written = symbols((rows,), math.nan)  # what is not written stays so
            made(*(argument.copy() if isinstance(argument, Symbols) else argument for argument in arguments), written)
            return [node_of(tape, entry) for entry in written]

        return [Symbol.of(tape, node) for node in every_way(tape, once)]
    except TraceError as error:
        raise TraceError(f"{_line(function)}{error}") from None
    except RecursionError:
        raise TraceError(f"{_line(function)}calls itself too often") from None
    except Exception as error:  # whatever a foreign function makes of an array of objects
        raise TraceError(f"{_line(function)}{type(error).__name__}: {error}") from error


def _line(function: Callable[..., Any]) -> str:
    """The innermost line of the user's own code that was running, or where the function begins."""
    if (running := innermost(sys.exc_info()[2])) is not None:
        return f"{running.tb_frame.f_code.co_filename}:{running.tb_lineno}: "
    code = getattr(source_of(function), "__code__", None)
    return "" if code is None else f"{code.co_filename}:{code.co_firstlineno}: "


class Rebound:
    """Functions whose names for NumPy and ``math`` mean versions that know symbols."""

    def __init__(self) -> None:
        """Nothing is rebound yet."""
        self.given: dict[int, Any] = {}  # what stands in for arrays, by their ids
        self._seen: dict[int, Any] = {}
        self._kept: list[Any] = []  # ids stay theirs
        self._instances: dict[int, Any] = {}
        self._containers: list[tuple[Any, tuple[Any, ...]]] = []

    def callable(self, thing: Any) -> Any:
        """A callable, rebound as far as it is written in Python."""
        if isinstance(thing, FunctionType) or is_compiled(thing):
            return self.function(thing)
        if isinstance(thing, partial):
            given = [self.thing(part) for part in thing.args]
            named = {name: self.thing(part) for name, part in thing.keywords.items()}
            return partial(self.callable(thing.func), *given, **named)
        if isinstance(thing, MethodType) and isinstance(thing.__func__, FunctionType):
            return MethodType(self.function(thing.__func__), self.thing(thing.__self__))
        return self.thing(thing)

    def function(self, function: Any) -> Any:
        """A copy of a function with other names in reach."""
        python: FunctionType = source_of(function)
        found = self._seen.get(id(python))
        if found is not None:
            return found
        names = _Names(python.__globals__, self)
        cells = tuple(CellType() for _ in python.__closure__ or ())
        defaults = None if python.__defaults__ is None else tuple(map(self.thing, python.__defaults__))
        copy = FunctionType(python.__code__, names, python.__name__, defaults, cells or None)
        copy.__kwdefaults__ = {key: self.thing(value) for key, value in (python.__kwdefaults__ or {}).items()}
        self._seen[id(python)] = copy
        self._kept.append(python)
        for cell, original in zip(cells, python.__closure__ or (), strict=True):
            try:
                cell.cell_contents = self.thing(original.cell_contents)
            except ValueError:  # not assigned yet
                continue
        for name in _names_of(python.__code__):
            if name in python.__globals__:
                names[name] = self.thing(python.__globals__[name])
        return copy

    def residual(self, residual: Residual | Kernel) -> Callable[..., Any]:
        """A residual that another function calls: what its kernel is written as, row by row where that is compiled."""
        kernel = residual if isinstance(residual, Kernel) else residual.kernel
        if kernel is None:
            return cast(Callable[..., Any], self.callable(residual.function))
        called = self.callable(kernel.function)

        def batched(*arguments: Any) -> Any:
            return called(*kernel.rows_of(arguments))

        def one_by_one(*arguments: Any) -> Any:
            rows = kernel.rows_of(arguments)
            count = max(map(len, rows))
            size = kernel.size([r.shape[1:] for r, a in zip(rows, kernel.arguments, strict=True) if not _varies(a)])
            found = symbols((count, size))
            for i in range(count):
                row = [r[i if len(r) > 1 else 0] for r in rows]
                v, p = _side_by_side(kernel, row, True), _side_by_side(kernel, row, False)
                found[i] = _written(kernel, called, v, p, size)
            return found

        return one_by_one if is_compiled(kernel.function) else batched

    def record(self, record: Any) -> Any:
        """A copy of a frozen record whose fields are functions, or know some; any other one as it is."""
        if not getattr(vars(type(record)).get("__dataclass_params__"), "frozen", False):
            return record
        present = {f.name: getattr(record, f.name) for f in fields(record)}
        rebound = {name: self.thing(value) for name, value in present.items()}
        if all(rebound[name] is value for name, value in present.items()):
            return record
        copied = copy(record)
        for name, value in rebound.items():
            object.__setattr__(copied, name, value)
        return copied

    def require_untouched(self) -> None:
        """Refuse a function that changed a list or a dictionary it reaches; it changed a copy."""
        for copied, entries in self._containers:
            present = entries_of(copied)
            if len(present) != len(entries) or any(a is not b for a, b in zip(present, entries, strict=True)):
                raise TraceError(f"changes a {type(copied).__name__} that it reaches")

    def _copied(self, container: Any) -> Any:
        """A copy of a list or a dictionary, once for each."""
        if id(container) not in self._instances:
            copied: Any = type(container)()
            self._instances[id(container)] = copied
            if isinstance(container, list):
                copied.extend(map(self.thing, container))
            else:
                copied.update({key: self.thing(value) for key, value in container.items()})
            self._kept.append(container)
            self._containers.append((copied, entries_of(copied)))
        return self._instances[id(container)]

    def _instance(self, instance: Any) -> Any:
        """A stand-in for an instance, of a subclass of its class, whose attributes and methods take symbols."""
        found = self._instances.get(id(instance))
        if found is not None:
            return found
        owners, parts, rebound = classes_of(instance), dict[str, Any](), self

        def attribute(this: Any, name: str) -> Any:
            if name.startswith("__"):
                return object.__getattribute__(this, name)
            if name not in parts:
                plain = next((vars(owner)[name] for owner in owners if name in vars(owner)), None)
                if isinstance(plain, property) and name not in vars(instance):
                    return rebound.callable(plain.fget)(this)
                if isinstance(plain, FunctionType) and name not in vars(instance):
                    parts[name] = MethodType(rebound.function(plain), this)
                else:
                    parts[name] = rebound.thing(getattr(instance, name))
            return parts[name]

        def refused(this: Any, name: str, value: Any = None) -> None:
            raise TraceError(f"changes the attribute '{name}' of something that it reaches")

        names: dict[str, Any] = {"__getattribute__": attribute, "__setattr__": refused, "__delattr__": refused}
        for owner in reversed(owners):
            for name in filter(partial(is_operator, owner), vars(owner)):
                names[name] = self.function(vars(owner)[name])
        made = SimpleNamespace.__new__ if isinstance(instance, SimpleNamespace) else object.__new__
        stand_in: Any = made(type(type(instance).__name__, (type(instance),), names))
        self._instances[id(instance)] = stand_in
        self._kept.append(instance)
        return stand_in

    def thing(self, thing: Any) -> Any:
        """Stand-in of a value while a function is traced."""
        if id(thing) in self.given:
            return self.given[id(thing)]
        if thing is np:
            return NUMPY
        if thing is math:
            return MATH
        if id(thing) in BORROWED:
            return BORROWED[id(thing)]
        if kind_of(thing):
            return Interpolator(thing)
        if isinstance(thing, ManifoldBase | Product):
            return Symbolic(thing, self.callable)
        if isinstance(thing, Residual | Kernel):
            return self.residual(thing)
        if thing is so2.wrap or thing is wrap_angle:
            return _wrapped
        if is_compiled(thing):
            return self.function(thing)
        if isinstance(thing, ModuleType) and thing.__name__.partition(".")[0] not in _AS_THEY_ARE:
            return _Module(thing, self)
        if type(thing) is tuple:
            return tuple(map(self.thing, thing))
        if type(thing) in (list, dict):
            return self._copied(thing)
        if isinstance(thing, FunctionType):
            module = str(thing.__module__ or "")
            return thing if module.partition(".")[0] == "numpy" else self.function(thing)
        if isinstance(thing, partial | MethodType):
            return self.callable(thing)
        if is_dataclass(thing) and not isinstance(thing, type) and not classes_of(thing):
            return self.record(thing)
        if classes_of(thing):
            return self._instance(thing)
        return CONSTRUCTORS.get(id(thing), thing) if callable(thing) else thing


def _varies(argument: Argument) -> bool:
    """Test whether an argument of a kernel is a variable."""
    return not isinstance(argument, int | tuple)


def _side_by_side(kernel: Kernel, row: Sequence[Any], varying: bool) -> Any:
    """Variables of one factor, or its parameters, flat."""
    parts = [part.ravel() for part, a in zip(row, kernel.arguments, strict=True) if _varies(a) == varying]
    return wrapped(np.concatenate([NOTHING, *parts]))


def _written(kernel: Kernel, called: Callable[..., Any], v: Any, p: Any, size: int) -> list[Any]:
    """Output of a compiled kernel for one factor, on both branches."""
    tape = next((entry.tape for entry in (*v, *p) if isinstance(entry, Symbol)), None)

    def once() -> Any:
        r = symbols((size,), math.nan)
        with one_factor():
            called(v.copy(), p.copy(), kernel.table, r, NOWHERE)
        return r

    if tape is None:
        return list(once())
    return [Symbol.of(tape, node) for node in every_way(tape, lambda: [node_of(tape, entry) for entry in once()])]


def _names_of(code: CodeType) -> set[str]:
    """Names that a function looks up, and that functions and comprehensions inside it do."""
    inner = (_names_of(part) for part in code.co_consts if isinstance(part, CodeType))
    return set(code.co_names).union(*inner)


class _Names(dict[str, Any]):
    """Globals of a rebound function."""

    def __init__(self, names: dict[str, Any], rebound: Rebound) -> None:
        super().__init__(names)
        self["__builtins__"] = {
            **vars(builtins),
            "abs": abs,
            "enumerate": _along(enumerate),
            "isinstance": _is_instance,
            "len": _length,
            "max": partial(_fold, "maximum", builtins.max),
            "min": partial(_fold, "minimum", builtins.min),
            "range": _along(range),
            "sum": _sum,
            "type": _type,
        }


def _length(thing: Any) -> int:
    return thing.shape[0] if isinstance(thing, Symbols) and thing.ndim else len(thing)


def _stand_in(thing: Any) -> Any:
    """A number or an array of the type that a symbol stands for."""
    if isinstance(thing, Symbols):
        return np.empty(0, dtype=thing.dtype)
    return (np.bool_ if is_truth(thing) else np.float64)(0) if isinstance(thing, Symbol) else thing


def _is_instance(thing: Any, kind: Any) -> bool:
    return isinstance(_stand_in(thing), builtins.type if kind is _type else kind)


def _type(*arguments: Any) -> Any:
    return builtins.type(_stand_in(arguments[0])) if len(arguments) == 1 else builtins.type(*arguments)


def _along(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function whose result depends on positions along the batch, where it is given the batch or its length."""

    def positions(*arguments: Any, **options: Any) -> Any:
        for part in (*arguments, *options.values()):
            first = part.shape[0] if isinstance(part, Symbols) and part.ndim else part
            Length.used = Length.used or type(first) is Length
        return function(*arguments, **options)

    return positions


def _wrapped(angle: Any) -> Any:
    return wrap(angle) if isinstance(angle, Symbol | float) else wrapped(np.frompyfunc(wrap, 1, 1)(plain(angle)))


def _fold(name: str, plain: Callable[..., Any], *values: Any, **options: Any) -> Any:
    items = list(values[0]) if len(values) == 1 else list(values)
    if options or not any(isinstance(item, Symbol | Symbols) for item in items):
        return plain(items, **options)
    total = items[0]
    for item in items[1:]:
        total = getattr(np, name)(total, item) if isinstance(item, Symbols) else UFUNCS[name](total, item)
    return total


def _sum(values: Any, start: Any = 0) -> Any:
    total = start
    for item in values:
        total = total + item
    return total


# ---------------------------------------------------------------- NumPy and math, as far as they look at entries


def _array(values: Any, dtype: Any = None, **options: Any) -> Any:
    if isinstance(values, Symbols | Symbol):
        array = values.copy() if isinstance(values, Symbols) else symbols((), values)
    else:
        plain = np.array(values, dtype=object)
        if not any(isinstance(item, Symbol) for item in plain.flat):
            return np.array(values, dtype, **options)
        array = wrapped(alike(plain))
    only("np.array", options, "copy", "order", "subok")
    return array if dtype is None else array.astype(dtype)


def _as_array(values: Any, dtype: Any = None, **options: Any) -> Any:
    if isinstance(values, Symbols) and (dtype is None or np.dtype(dtype) == values.dtype):
        return values
    return _array(values, dtype, **options)


def _filled(value: float) -> Callable[..., Any]:
    return lambda shape, dtype=None, order=None: _full(shape, value, dtype)


def _full(shape: Any, fill_value: Any, dtype: Any = None, order: Any = None) -> Any:
    kind = np.dtype(float if dtype is None else dtype)
    if kind.kind in "iub":  # for indices and masks that are known
        return np.full(shape, fill_value, dtype=kind)
    require_float("np.full", kind)
    value = as_number(fill_value) if np.ndim(fill_value) == 0 else fill_value
    return symbols(tuple(shape) if isinstance(shape, list | tuple) else (int(shape),), value)


def _eye(*arguments: Any, **options: Any) -> Any:
    return wrapped(_along(np.eye)(*arguments, **options).astype(object))


class _Proxy(ModuleType):
    """A module some of whose names mean something else."""

    def __init__(self, module: ModuleType, names: dict[str, Any]) -> None:
        super().__init__(module.__name__)
        self._module, self._names = module, names

    def __getattr__(self, name: str) -> Any:
        names = self.__dict__["_names"]
        return names[name] if name in names else getattr(self.__dict__["_module"], name)


class _Refused:
    """A part of a module that no trace may use."""

    def __init__(self, what: str) -> None:
        self._what = what

    def __getattr__(self, name: str) -> Any:
        raise TraceError(f"calls {self._what}.{name}, which returns other numbers each time")


class _Module(_Proxy):
    """A module whose functions and groups take symbols, and whose arrays may be parameters."""

    def __init__(self, module: ModuleType, rebound: Rebound) -> None:
        super().__init__(module, {})
        self._rebound = rebound

    def __getattr__(self, name: str) -> Any:
        return self.__dict__["_rebound"].thing(getattr(self.__dict__["_module"], name))


_MAKERS = {
    "array": _array, "asarray": _as_array, "asanyarray": _as_array, "ascontiguousarray": _as_array,
    "zeros": _filled(0.0), "empty": _filled(0.0), "ones": _filled(1.0), "full": _full, "eye": _eye, "identity": _eye,
    "atleast_1d": lambda a: _as_array(a) if np.ndim(a) else _as_array(a).reshape(1),
    "random": _Refused("np.random"), "interp": interp,
    **{name: _along(getattr(np, name)) for name in ("arange", "linspace", "indices", "tri", "ndindex", "ndenumerate")},
}  # fmt: skip
# The functions of groups, views, and arrays on the stack, as compiled functions of this library call them.
BORROWED: dict[int, Callable[..., Any]] = {
    **stated_closed(),
    id(calls.local_vector): lambda length: symbols((length,)),
    id(calls.local_matrix): lambda rows, columns: symbols((rows, columns)),
    id(calls.vector): lambda array, start, length: array[start : start + length],
    id(calls.matrix): lambda array, start, rows, columns: array[start : start + rows * columns].reshape(rows, columns),
}
NUMPY = _Proxy(np, _MAKERS)
CONSTRUCTORS = {id(getattr(np, name)): made for name, made in _MAKERS.items()}
_MATH = {
    "fabs": "absolute", "pow": "power", "asin": "arcsin", "acos": "arccos", "atan": "arctan", "atan2": "arctan2",
    "asinh": "arcsinh", "acosh": "arccosh", "atanh": "arctanh",
}  # fmt: skip


def _mathematical(name: str) -> Callable[..., Any]:
    scalar, plain = UFUNCS[_MATH.get(name, name)], getattr(math, name)

    def function(*arguments: Any) -> Any:
        return scalar(*arguments) if any(isinstance(a, Symbol) for a in arguments) else plain(*arguments)

    return function


MATH = _Proxy(
    math,
    {name: _mathematical(name) for name in dir(math) if _MATH.get(name, name) in UFUNCS and name not in ("remainder",)},
)
