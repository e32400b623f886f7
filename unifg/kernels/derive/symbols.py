"""Numbers that remember where they come from, and arrays of them that NumPy takes for arrays.

A :class:`Symbol` stands for a number that is not known yet; what is computed with it is written on its tape. An array
of symbols (:class:`Symbols`) is an array of objects whose ufuncs and functions do what NumPy's do. A decision that
needs the number itself (``if``, ``float``, an index) cannot be traced, and says so.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NoReturn

import numpy as np

from unifg.errors import UnifgError
from unifg.kernels.derive.operations import Op
from unifg.kernels.derive.tape import NUMPY, Tape


class TraceError(UnifgError):
    """A function does something that cannot be written on a tape."""


def _both(ufunc: str) -> tuple[Any, Any]:
    """The operator that does what a ufunc does, and the same from the right."""

    def operator(self: Any, other: Any) -> Any:
        return each(self, plain(other)) if isinstance(other, np.ndarray) else UFUNCS[ufunc](self, other)

    def mirrored(self: Any, other: Any) -> Any:
        return each(plain(other), self) if isinstance(other, np.ndarray) else UFUNCS[ufunc](other, self)

    def each(a: Any, b: Any) -> Any:
        return wrapped(np.frompyfunc(UFUNCS[ufunc], 2, 1)(a, b))

    return operator, mirrored


def _alone(ufunc: str) -> Any:
    """The operator that does what a ufunc of one argument does."""
    return lambda self: UFUNCS[ufunc](self)


class Symbol:
    """A number that is not known yet.

    Attributes:
        tape: it stands on.
        node: its place there.
    """

    __slots__ = ("node", "tape")
    __array_priority__ = 100.0

    def __init__(self, tape: Tape, node: int) -> None:
        """Name a node of a tape."""
        self.tape = tape
        self.node = node

    def __repr__(self) -> str:
        """Say which."""
        return f"<number {self.node} of a trace>"

    @classmethod
    def of(cls, tape: Tape, node: int) -> Any:
        """The number of a node, where it is known, or its symbol."""
        return tape.value[node] if tape.is_constant(node) else cls(tape, node)

    def __pos__(self) -> Symbol:
        """The same."""
        return self

    __hash__ = None  # type: ignore[assignment]
    __add__, __radd__ = _both("add")
    __sub__, __rsub__ = _both("subtract")
    __mul__, __rmul__ = _both("multiply")
    __truediv__, __rtruediv__ = _both("divide")
    __floordiv__, __rfloordiv__ = _both("floor_divide")
    __mod__, __rmod__ = _both("remainder")
    __pow__, __rpow__ = _both("power")
    __neg__, __abs__, __invert__ = _alone("negative"), _alone("absolute"), _alone("logical_not")
    # Comparisons stay open.
    __lt__, __gt__ = _both("less")
    __le__, __ge__ = _both("less_equal")
    __eq__, __ne__ = _both("equal")[0], _both("not_equal")[0]
    __and__, __rand__ = _both("logical_and")
    __or__, __ror__ = _both("logical_or")

    # ---------------------------------------------------------------- what cannot be traced

    def __bool__(self) -> bool:
        """Ask who follows every way through the code; in other code nobody knows."""
        if self.tape.decide is not None:
            return self.tape.decide(self.node)
        raise TraceError("asks whether a number holds that is not known yet; write np.where(condition, a, b) for `if`")

    def __float__(self) -> NoReturn:
        """Nobody knows."""
        raise TraceError(
            "turns a number that is not known yet into a float: math.* and arrays of floats do; use np.* and np.stack"
        )

    def __int__(self) -> NoReturn:
        """Nobody knows."""
        raise TraceError("turns a number that is not known yet into an integer")

    __index__ = __int__

    def __iter__(self) -> NoReturn:
        """It is one."""
        raise TraceError("iterates over a number")


class Symbols(np.ndarray[Any, np.dtype[Any]]):
    """An array of symbols and numbers."""

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **options: Any) -> Any:
        """Do what the ufunc does, entry by entry."""
        out = options.pop("out", None)
        if ufunc is np.matmul and method == "__call__":
            result = matmul(*(plain(item) for item in inputs))
        elif (scalar := UFUNCS.get(ufunc.__name__)) is None:
            raise TraceError(f"calls np.{ufunc.__name__}, which has no derivative here")
        elif method == "__call__":
            if options.pop("where", True) is not True:
                raise TraceError(f"calls np.{ufunc.__name__} with where=; use np.where on the result")
            options.pop("dtype", None), options.pop("casting", None)
            result = np.frompyfunc(scalar, ufunc.nin, 1)(*(plain(item) for item in inputs))
        elif method in ("reduce", "accumulate") and ufunc.nin == 2:
            result = _reduced(scalar, method, plain(inputs[0]), *inputs[1:], **options)
        else:
            raise TraceError(f"calls np.{ufunc.__name__}.{method}")
        if out is not None:
            plain(out[0])[...] = result
            return out[0]
        return wrapped(result)

    def __array_function__(self, function: Any, kinds: Any, arguments: Any, options: Any) -> Any:
        """Do what NumPy's function does."""
        special = FUNCTIONS.get(function)
        if special is not None:
            return wrapped(special(*arguments, **options))
        if function.__module__.startswith("numpy.linalg"):
            raise TraceError(f"calls np.linalg.{function.__name__}; of np.linalg, norm, det, inv and solve are traced")
        return wrapped(super().__array_function__(function, kinds, arguments, options))

    def __getitem__(self, key: Any) -> Any:
        """Take entries; an index must be known."""
        for part in key if isinstance(key, tuple) else (key,):
            if isinstance(part, Symbol | Symbols):
                raise TraceError("takes entries by a number that is not known yet; write np.where(condition, a, b)")
        return super().__getitem__(key)

    def __setitem__(self, key: Any, value: Any) -> None:
        """Put entries; an index must be known."""
        for part in key if isinstance(key, tuple) else (key,):
            if isinstance(part, Symbol | Symbols):
                raise TraceError("puts entries by a number that is not known yet; write np.where(condition, a, b)")
        super().__setitem__(key, value)

    def __bool__(self) -> bool:
        """Only a single entry that is known."""
        if self.size == 1:
            return bool(self.item())
        return super().__bool__()

    def astype(self, *arguments: Any, **options: Any) -> Any:
        """Symbols stay symbols."""
        return self.copy()

    def clip(self, lower: Any = None, upper: Any = None, **options: Any) -> Any:  # type: ignore[override]
        """Limit every entry."""
        return np.clip(self, lower, upper)

    def round(self, *arguments: Any, **options: Any) -> Any:
        """Round to whole numbers."""
        return np.rint(self)


def holds_symbols(array: Any) -> bool:
    """Whether an array holds numbers that are not known."""
    return isinstance(array, np.ndarray) and array.dtype == object and any(isinstance(x, Symbol) for x in array.flat)


def wrapped(result: Any) -> Any:
    """An array of objects as symbols; anything else as it is."""
    if isinstance(result, np.ndarray):
        return result.view(Symbols) if result.dtype == object else result
    if isinstance(result, tuple | list):
        return type(result)(wrapped(item) for item in result)
    return result


def symbols(shape: tuple[int, ...], fill: Any = 0.0) -> Any:
    """An array that may hold symbols."""
    array = np.empty(shape, dtype=object)
    array[...] = fill
    return array.view(Symbols)


def node_of(tape: Tape, value: Any) -> int:
    """The node of a symbol or of a number."""
    return value.node if isinstance(value, Symbol) else tape.constant(float(value))


def plain(item: Any) -> Any:
    """An array of symbols as NumPy sees an array of objects."""
    return item.view(np.ndarray) if isinstance(item, Symbols) else item


def _apply(op: Op, *arguments: Any) -> Any:
    """State an operation on symbols and numbers; of numbers alone, the number."""
    tape = None
    for item in arguments:
        if isinstance(item, Symbol):
            tape = item.tape
    if tape is None:
        with np.errstate(all="ignore"):
            return NUMPY[op](*arguments)
    node = tape.apply(op, *(node_of(tape, item) for item in arguments))
    return Symbol.of(tape, node)


def _operation(op: Op) -> Callable[..., Any]:
    return lambda *arguments: _apply(op, *arguments)


def choose(condition: Any, a: Any, b: Any) -> Any:
    """Choose between single entries: the first where the condition holds."""
    if not isinstance(condition, Symbol):
        return a if condition else b
    tape = condition.tape
    return Symbol.of(tape, tape.select(condition.node, node_of(tape, a), node_of(tape, b)))


def _remainder(a: Any, b: Any) -> Any:
    """With the sign of the divisor."""
    rest = _apply(Op.FMOD, a, b)
    other = _apply(Op.LESS, rest * b, 0.0)
    return choose(other, rest + b, rest)


def _floor_divide(a: Any, b: Any) -> Any:
    return _apply(Op.RINT, _apply(Op.DIVIDE, a - _remainder(a, b), b))


def _hypot(a: Any, b: Any) -> Any:
    return _apply(Op.SQRT, a * a + b * b)


def _not_equal(a: Any, b: Any) -> Any:
    return _apply(Op.NOT, _apply(Op.EQUAL, a, b))


UFUNCS: dict[str, Callable[..., Any]] = {
    "add": _operation(Op.ADD),
    "subtract": _operation(Op.SUBTRACT),
    "multiply": _operation(Op.MULTIPLY),
    "divide": _operation(Op.DIVIDE),
    "true_divide": _operation(Op.DIVIDE),
    "power": _operation(Op.POWER),
    "float_power": _operation(Op.POWER),
    "negative": _operation(Op.NEGATE),
    "positive": lambda a: a,
    "conjugate": lambda a: a,
    "absolute": _operation(Op.ABSOLUTE),
    "fabs": _operation(Op.ABSOLUTE),
    "sign": _operation(Op.SIGN),
    "sqrt": _operation(Op.SQRT),
    "cbrt": lambda a: _apply(Op.SIGN, a) * _apply(Op.POWER, _apply(Op.ABSOLUTE, a), 1.0 / 3.0),
    "square": lambda a: a * a,
    "reciprocal": lambda a: _apply(Op.DIVIDE, 1.0, a),
    "sin": _operation(Op.SIN),
    "cos": _operation(Op.COS),
    "tan": _operation(Op.TAN),
    "arcsin": _operation(Op.ARCSIN),
    "arccos": _operation(Op.ARCCOS),
    "arctan": _operation(Op.ARCTAN),
    "arctan2": _operation(Op.ARCTAN2),
    "sinh": _operation(Op.SINH),
    "cosh": _operation(Op.COSH),
    "tanh": _operation(Op.TANH),
    "arcsinh": _operation(Op.ARCSINH),
    "arccosh": _operation(Op.ARCCOSH),
    "arctanh": _operation(Op.ARCTANH),
    "erf": _operation(Op.ERF),
    "exp": _operation(Op.EXP),
    "exp2": lambda a: _apply(Op.EXP, a * math.log(2.0)),
    "expm1": _operation(Op.EXPM1),
    "log": _operation(Op.LOG),
    "log2": lambda a: _apply(Op.LOG, a) / math.log(2.0),
    "log10": lambda a: _apply(Op.LOG, a) / math.log(10.0),
    "log1p": _operation(Op.LOG1P),
    "logaddexp": lambda a, b: _apply(Op.MAXIMUM, a, b) + _apply(Op.LOG1P, _apply(Op.EXP, -_apply(Op.ABSOLUTE, a - b))),
    "hypot": _hypot,
    "deg2rad": lambda a: a * (math.pi / 180.0),
    "radians": lambda a: a * (math.pi / 180.0),
    "rad2deg": lambda a: a * (180.0 / math.pi),
    "degrees": lambda a: a * (180.0 / math.pi),
    "floor": _operation(Op.FLOOR),
    "ceil": lambda a: -_apply(Op.FLOOR, -a),
    "trunc": lambda a: _apply(Op.SIGN, a) * _apply(Op.FLOOR, _apply(Op.ABSOLUTE, a)),
    "rint": _operation(Op.RINT),
    "floor_divide": _floor_divide,
    "remainder": _remainder,
    "fmod": _operation(Op.FMOD),
    "minimum": _operation(Op.MINIMUM),
    "maximum": _operation(Op.MAXIMUM),
    "fmin": _operation(Op.MINIMUM),
    "fmax": _operation(Op.MAXIMUM),
    "copysign": lambda a, b: choose(_apply(Op.LESS, b, 0.0), -abs(a), abs(a)),
    "heaviside": lambda a, b: choose(_apply(Op.EQUAL, a, 0.0), b, choose(_apply(Op.LESS, a, 0.0), 0.0, 1.0)),
    "less": _operation(Op.LESS),
    "less_equal": _operation(Op.LESS_EQUAL),
    "greater": lambda a, b: _apply(Op.LESS, b, a),
    "greater_equal": lambda a, b: _apply(Op.LESS_EQUAL, b, a),
    "equal": _operation(Op.EQUAL),
    "not_equal": _not_equal,
    "logical_and": _operation(Op.AND),
    "logical_or": _operation(Op.OR),
    "logical_not": _operation(Op.NOT),
    "bitwise_and": _operation(Op.AND),
    "bitwise_or": _operation(Op.OR),
    "invert": _operation(Op.NOT),
}
"""What the ufuncs of NumPy do with single entries, by name."""
for _name, _scalar in UFUNCS.items():  # NumPy asks the entries of plain arrays of objects for methods of these names
    setattr(Symbol, _name, (lambda scalar: lambda *arguments: scalar(*arguments))(_scalar))


def _reduced(scalar: Callable[..., Any], method: str, array: Any, axis: Any = 0, **options: Any) -> Any:
    """``ufunc.reduce`` and ``ufunc.accumulate``."""
    keep, initial = options.pop("keepdims", False), options.pop("initial", None)
    array = np.asarray(array, dtype=object)
    if axis is None:
        axes = tuple(range(array.ndim))
    else:
        axes = tuple(k % array.ndim for k in (axis if isinstance(axis, tuple) else (axis,)))
    if method == "accumulate":
        moved = np.moveaxis(array, axes[0], 0)
        rows = [moved[0]]
        for row in moved[1:]:
            rows.append(np.frompyfunc(scalar, 2, 1)(rows[-1], row))
        return np.moveaxis(np.array(rows, dtype=object), 0, axes[0])
    rest = [k for k in range(array.ndim) if k not in axes]
    moved = array.transpose([*axes, *rest]).reshape(-1, *(array.shape[k] for k in rest))
    combine = np.frompyfunc(scalar, 2, 1)
    starts = [] if initial is None or not isinstance(initial, int | float | Symbol) else [initial]
    rows = [np.broadcast_to(np.array(item, dtype=object), moved.shape[1:]) for item in starts] + list(moved)
    if not rows:
        neutral = {"add": 0.0, "multiply": 1.0}
        total: Any = np.full(moved.shape[1:], neutral["multiply" if scalar is UFUNCS["multiply"] else "add"], object)
    else:
        total = np.array(rows[0], dtype=object)  # the caller may write into it
        for row in rows[1:]:
            total = combine(total, row)
    if keep:
        total = np.asarray(total, dtype=object).reshape([1 if k in axes else n for k, n in enumerate(array.shape)])
    return total


# ---------------------------------------------------------------- functions of NumPy that must be done again here

_Pick = np.frompyfunc(choose, 3, 1)


def _objects(array: Any) -> Any:
    return np.asarray(plain(array) if isinstance(array, np.ndarray) else array, dtype=object)


def matmul(a: Any, b: Any) -> Any:
    """``a @ b`` with NumPy's rules for stacks and vectors."""
    a, b = _objects(a), _objects(b)
    left, right = a[None, :] if a.ndim == 1 else a, b[:, None] if b.ndim == 1 else b
    product = np.sum(left[..., :, :, None] * right[..., None, :, :], axis=-2)
    if a.ndim == 1:
        product = product[..., 0, :]
    return product[..., 0] if b.ndim == 1 else product


def _where(condition: Any, *parts: Any) -> Any:
    if len(parts) != 2:
        raise TraceError("asks np.where for places that are not known yet; give it what to choose from")
    return _Pick(_objects(condition), _objects(parts[0]), _objects(parts[1]))


def _clip(array: Any, lower: Any = None, upper: Any = None, **options: Any) -> Any:
    lower, upper = options.get("min", lower), options.get("max", upper)
    limited = wrapped(_objects(array))
    if lower is not None:
        limited = np.maximum(limited, lower)
    return limited if upper is None else np.minimum(limited, upper)


def _norm(array: Any, ord: Any = None, axis: Any = None, keepdims: bool = False) -> Any:
    array = wrapped(_objects(array))
    if ord in (None, 2, "fro") and not (ord == 2 and axis is None and array.ndim == 2):
        return np.sqrt(np.sum(array * array, axis=axis, keepdims=keepdims))
    if ord == 1:
        return np.sum(np.abs(array), axis=axis, keepdims=keepdims)
    if ord == np.inf:
        return np.max(np.abs(array), axis=axis, keepdims=keepdims)
    raise TraceError(f"asks np.linalg.norm for order {ord}")


def _cross(a: Any, b: Any, *arguments: Any, **options: Any) -> Any:
    if arguments or options.get("axis", -1) != -1:
        raise TraceError("asks np.cross for other axes than the last")
    a, b = wrapped(_objects(a)), wrapped(_objects(b))
    if a.shape[-1] == 2 and b.shape[-1] == 2:
        return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return np.stack(
        [a[..., i] * b[..., j] - a[..., j] * b[..., i] for i, j in ((1, 2), (2, 0), (0, 1))],
        axis=-1,
    )


def _einsum(subscripts: str, *operands: Any, **options: Any) -> Any:
    if "->" not in subscripts:
        raise TraceError("calls np.einsum without '->': say which axes are left")
    return np.einsum(subscripts, *(_objects(item) for item in operands), optimize=False)


def _like(value: float | None) -> Callable[..., Any]:
    def fill(array: Any, *arguments: Any, **options: Any) -> Any:
        shape = options.get("shape")
        number = arguments[0] if value is None else value
        return symbols(np.shape(array) if shape is None else shape, number)

    return fill


def _determinant(array: Any) -> Any:
    array = _objects(array)
    n = array.shape[-1]
    if n == 1:
        return array[..., 0, 0]
    total: Any = 0.0
    for k in range(n):
        minor = _determinant(np.delete(array[..., 1:, :], k, axis=-1))
        total = total + (1.0 if k % 2 == 0 else -1.0) * array[..., 0, k] * minor
    return total


def _inverse(array: Any) -> Any:
    array = _objects(array)
    n = array.shape[-1]
    if n > 4:
        raise TraceError("inverts a matrix of more than four rows")
    if n == 1:
        return np.frompyfunc(UFUNCS["reciprocal"], 1, 1)(array)
    determinant = np.asarray(_determinant(array), dtype=object)
    rows = [
        [
            (1.0 if (i + j) % 2 == 0 else -1.0) * _determinant(np.delete(np.delete(array, j, -2), i, -1)) / determinant
            for j in range(n)
        ]
        for i in range(n)
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _solve(a: Any, b: Any) -> Any:
    inverse = _inverse(a)
    b = _objects(b)
    return matmul(inverse, b) if b.ndim != 1 else matmul(inverse, b[:, None])[..., 0]


def _every(array: Any, *arguments: Any, **options: Any) -> Any:
    return np.logical_and.reduce(wrapped(_objects(array)), *arguments, **options)


def _some(array: Any, *arguments: Any, **options: Any) -> Any:
    return np.logical_or.reduce(wrapped(_objects(array)), *arguments, **options)


def _mean(array: Any, axis: Any = None, keepdims: bool = False, **options: Any) -> Any:
    array = wrapped(_objects(array))
    total = np.sum(array, axis=axis, keepdims=keepdims)
    return total / (array.size / np.size(total))


FUNCTIONS: dict[Any, Callable[..., Any]] = {
    np.where: _where,
    np.clip: _clip,
    np.cross: _cross,
    np.einsum: _einsum,
    np.dot: lambda a, b: (
        _objects(a) * _objects(b) if min(np.ndim(a), np.ndim(b)) == 0 else _dot(_objects(a), _objects(b))
    ),
    np.linalg.norm: _norm,
    np.linalg.det: _determinant,
    np.linalg.inv: _inverse,
    np.linalg.solve: _solve,
    np.zeros_like: _like(0.0),
    np.empty_like: _like(0.0),
    np.ones_like: _like(1.0),
    np.full_like: _like(None),
    np.all: _every,
    np.any: _some,
    np.mean: _mean,
}
"""Functions of NumPy that look at what entries are, or call compiled code."""


def _dot(a: Any, b: Any) -> Any:
    if b.ndim > 2:
        raise TraceError("calls np.dot with a stack of matrices; use @")
    return matmul(a, b)
