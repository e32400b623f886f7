"""Numbers that remember where they come from, and arrays of them that NumPy takes for arrays.

A :class:`Symbol` stands for a number that is not known yet; what is computed with it is written on its tape. An array
of symbols (:class:`Symbols`) is an array of objects whose ufuncs and functions do what NumPy's do. A decision that
needs the number itself (``if``, ``float``, an index) cannot be traced, and says so.
"""

from __future__ import annotations

import inspect
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, ClassVar, NoReturn

import numpy as np

from unifg.errors import UnifgError
from unifg.factors.autodiff.operations import Op
from unifg.factors.autodiff.tape import NUMPY, Tape

INSTEAD = 'leave it to differences: fg.residual(f, derivatives="differences")'
DECIDES = "asks whether a number holds that is not known yet; write np.where(condition, a, b) for `if`"


_OF_TRUTHS = frozenset({Op.AND, Op.OR, Op.NOT})
_TRUTHS = _OF_TRUTHS | {Op.LESS, Op.LESS_EQUAL, Op.EQUAL}


class TraceError(UnifgError):
    """A function does something that cannot be written on a tape."""


def is_truth(item: Any) -> bool:
    """Test whether an entry is a truth value, whose sum is `or` and whose product is `and`."""
    if isinstance(item, Symbol):
        return item.tape.op[item.node] in _TRUTHS or item.node in item.tape.truths
    return isinstance(item, bool | np.bool_)


def as_number(item: Any) -> Any:
    """An entry as a floating-point number: 1.0 and 0.0 for truth values."""
    if not is_truth(item):
        return item
    if not isinstance(item, Symbol):
        return float(item)
    tape = item.tape
    return Symbol.of(tape, tape.select(item.node, tape.one, tape.zero))


def as_truth(item: Any) -> Any:
    """An entry as a truth value: whether it differs from zero."""
    return item if is_truth(item) else UFUNCS["not_equal"](item, 0.0)


def alike(array: Any) -> Any:
    """An array whose entries are of one kind: truth values beside numbers become numbers, as in an array of NumPy."""
    entries = plain(array)
    if isinstance(entries, np.ndarray) and entries.dtype.hasobject:
        truths = [is_truth(item) for item in entries.flat]
        if any(truths) and not all(truths):
            return np.frompyfunc(as_number, 1, 1)(entries)
    return array


def _both(ufunc: str) -> tuple[Any, Any]:
    """The operator that does what a ufunc does, and the same from the right."""

    def operator(self: Any, other: Any) -> Any:
        if isinstance(other, np.lib.mixins.NDArrayOperatorsMixin):  # which knows what to do
            return NotImplemented
        return each(self, plain(other)) if isinstance(other, np.ndarray) else UFUNCS[ufunc](self, other)

    def mirrored(self: Any, other: Any) -> Any:
        return each(plain(other), self) if isinstance(other, np.ndarray) else UFUNCS[ufunc](other, self)

    def each(a: Any, b: Any) -> Any:
        return wrapped(np.frompyfunc(UFUNCS[ufunc], 2, 1)(a, b))

    return operator, mirrored


def _alone(ufunc: str) -> Any:
    """The operator that does what a ufunc of one argument does."""
    return lambda self: UFUNCS[ufunc](self)


def is_mask(array: Any) -> bool:
    """Test whether an array holds truth values."""
    return bool(array.ndim) and bool(array.size) and is_truth(next(array.flat))


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

    @property
    def real(self) -> Symbol:
        """Itself: NumPy asks the entries of plain arrays of objects, since 2.5."""
        return self

    @property
    def imag(self) -> float:
        """None."""
        return 0.0

    __add__, __radd__ = _both("add")
    __sub__, __rsub__ = _both("subtract")
    __mul__, __rmul__ = _both("multiply")
    __truediv__, __rtruediv__ = _both("divide")
    __floordiv__, __rfloordiv__ = _both("floor_divide")
    __mod__, __rmod__ = _both("remainder")
    __pow__, __rpow__ = _both("power")
    __neg__, __abs__, __invert__ = _alone("negative"), _alone("absolute"), _alone("invert")
    # Comparisons stay open.
    __lt__, __gt__ = _both("less")
    __le__, __ge__ = _both("less_equal")
    __eq__, __ne__ = _both("equal")[0], _both("not_equal")[0]
    __and__, __rand__ = _both("bitwise_and")
    __or__, __ror__ = _both("bitwise_or")
    __xor__, __rxor__ = _both("bitwise_xor")

    # ---------------------------------------------------------------- what cannot be traced

    def __bool__(self) -> bool:
        """Ask who follows every way through the code; in other code nobody knows."""
        if self.tape.decide is not None:
            return self.tape.decide(self.node)
        raise TraceError(DECIDES)

    def __float__(self) -> NoReturn:
        """Refuse: the number is not known yet."""
        raise TraceError(
            "turns a number that is not known yet into a float, as foreign functions and arrays of floats do; write it "
            f"by np.* and np.stack, or {INSTEAD}"
        )

    def __int__(self) -> NoReturn:
        """Refuse: the number is not known yet."""
        raise TraceError("turns a number that is not known yet into an integer")

    __index__ = __int__

    def __complex__(self) -> NoReturn:
        """There are none."""
        raise TraceError("makes a complex number; write real and imaginary parts")

    def __hash__(self) -> NoReturn:
        """Refuse: the number is not known yet."""
        raise TraceError("looks up a number that is not known yet in a dictionary or a set; write np.where(...)")

    def __round__(self, digits: int = 0) -> Any:
        """Round to so many places."""
        scale = 10.0**digits
        return _apply(Op.RINT, self * scale) / scale if digits else _apply(Op.RINT, self)

    def __iter__(self) -> NoReturn:
        """It is one."""
        raise TraceError("iterates over a number")


class Symbols(np.ndarray[Any, np.dtype[Any]]):
    """An array of symbols and numbers."""

    @property
    def shape(self) -> Any:
        """Shape; a first axis as long as the traced batch is a :class:`Length`."""
        shape = np.ndarray.shape.__get__(self)
        return (Length(shape[0]), *shape[1:]) if shape and Length.batch == shape[0] > 0 else shape

    @shape.setter
    def shape(self, shape: Any) -> None:
        """Refuse a change in place."""
        raise TraceError("changes the shape of an array in place; write reshape")

    @property
    def dtype(self) -> Any:
        """Type of the numbers that the symbols stand for: float64 or bool; to NumPy, objects."""
        if sys._getframe(1).f_globals.get("__name__", "").startswith("numpy"):
            return np.ndarray.dtype.__get__(self)
        return np.dtype(bool if self.size and is_truth(next(self.flat)) else float)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **options: Any) -> Any:
        """Do what the ufunc does, entry by entry."""
        if any(isinstance(item, np.lib.mixins.NDArrayOperatorsMixin) for item in inputs):
            return NotImplemented
        out = options.pop("out", None)
        if method == "__call__":
            only(f"np.{ufunc.__name__}", options, "where", "dtype", "casting", "order", "subok")
            if options.pop("where", True) is not True:
                raise TraceError(f"calls np.{ufunc.__name__} with where=; write np.where(condition, a, b)")
            dtype = options.pop("dtype", None)
            require_float(f"np.{ufunc.__name__}", dtype)
            if dtype is not None and ufunc.__name__.startswith("logical"):
                raise TraceError(f"calls np.{ufunc.__name__} with dtype=, which is not traced; {INSTEAD}")
            if dtype is not None:
                inputs = tuple(np.frompyfunc(as_number, 1, 1)(plain(item)) for item in inputs)
        if ufunc in FUNCTIONS and method == "__call__":
            result = FUNCTIONS[ufunc](*(plain(item) for item in inputs))
        elif (scalar := UFUNCS.get(ufunc.__name__)) is None:
            raise TraceError(f"calls {ufunc.__name__}, which has no derivative here; {INSTEAD}")
        elif method == "__call__":
            result = np.frompyfunc(scalar, ufunc.nin, 1)(*(plain(item) for item in inputs))
        elif method in ("reduce", "accumulate") and ufunc.nin == 2:
            result = _reduced(ufunc, scalar, method, plain(inputs[0]), *inputs[1:], **options)
        elif method == "outer":
            first, second = (np.asarray(plain(item), dtype=object) for item in inputs)
            result = np.frompyfunc(scalar, 2, 1)(first.reshape(first.shape + (1,) * second.ndim), second)
        else:
            raise TraceError(f"calls np.{ufunc.__name__}.{method}, which is not traced; {INSTEAD}")
        if out is not None:
            out[0][...] = wrapped(result)
            return out[0]
        return wrapped(result)

    def __array_function__(self, function: Any, kinds: Any, arguments: Any, options: Any) -> Any:
        """Do what NumPy's function does."""
        special = FUNCTIONS.get(function)
        if special is not None:
            try:
                inspect.signature(special).bind(*arguments, **options)
            except TypeError as error:
                raise TraceError(
                    f"calls np.{function.__name__} in a way that is not traced ({error}); {INSTEAD}"
                ) from None
            return wrapped(special(*arguments, **options))
        if function.__module__.startswith(("numpy.linalg", "numpy.fft")):
            module = function.__module__.removeprefix("numpy")
            raise TraceError(
                f"calls np{module}.{function.__name__}; of np.linalg, norm, det, inv, solve and cholesky of "
                f"small matrices are traced; {INSTEAD}"
            )
        result = super().__array_function__(function, kinds, arguments, options)
        return wrapped([alike(item) for item in result] if isinstance(result, list) else alike(result))

    def __getitem__(self, key: Any) -> Any:
        """Take entries; an index must be known."""
        parts = key if isinstance(key, tuple) else (key,)
        if parts and isinstance(parts[0], Symbols) and is_mask(parts[0]):
            return FUNCTIONS[np.ndarray.__getitem__](self, parts)
        for part in parts:
            if isinstance(part, Symbol | Symbols):
                raise TraceError("takes entries by a number that is not known yet; write np.where(condition, a, b)")
        first = key[0] if isinstance(key, tuple) and key else key
        if isinstance(first, slice) and first != slice(None) and self.shape and type(self.shape[0]) is Length:
            Length.used = True
        return super().__getitem__(key)

    def __setitem__(self, key: Any, value: Any) -> None:
        """Put entries; an index must be known."""
        parts = key if isinstance(key, tuple) else (key,)
        if parts and isinstance(parts[0], Symbols) and is_mask(parts[0]):
            FUNCTIONS[np.ndarray.__setitem__](self, parts, value)
            return
        for part in parts:
            if isinstance(part, Symbol | Symbols):
                raise TraceError("puts entries by a number that is not known yet; write np.where(condition, a, b)")
        if self.size:  # what is put takes the kind of the array
            cast = as_truth if is_truth(next(self.flat)) else as_number
            many = isinstance(value, np.ndarray | list | tuple)
            value = np.frompyfunc(cast, 1, 1)(plain(np.asarray(value, dtype=object))) if many else cast(value)
        super().__setitem__(key, value)

    @property  # type: ignore[misc]
    def real(self) -> Any:
        """The same; since NumPy 2.5 a ufunc, which asks the entries."""
        return self

    @property  # type: ignore[misc]
    def imag(self) -> Any:
        """Zeros."""
        return symbols(self.shape)

    def __bool__(self) -> bool:
        """Only a single entry that is known."""
        if self.size == 1:
            return bool(self.item())
        return super().__bool__()

    def astype(self, dtype: Any, **options: Any) -> Any:  # type: ignore[override]
        """Floats, truth values, or 64-bit integers: what is left without the fraction."""
        only("astype", options, "order", "casting", "subok", "copy")
        kind = np.dtype(dtype)
        if kind not in (np.float64, np.int64, np.bool_):
            raise TraceError(f"turns numbers into {kind.name}, which is not traced; {INSTEAD}")
        cast = wrapped(np.frompyfunc(as_truth if kind == np.bool_ else as_number, 1, 1)(plain(self)))
        return np.trunc(cast) if kind == np.int64 else cast

    def sort(self, *arguments: Any, **options: Any) -> Any:
        """Refuse: the order is not known yet."""
        raise TraceError(f"sorts by numbers that are not known yet; write np.minimum and np.maximum, or {INSTEAD}")

    argsort = argmax = argmin = argpartition = partition = searchsorted = nonzero = sort

    def clip(self, lower: Any = None, upper: Any = None, **options: Any) -> Any:  # type: ignore[override]
        """Limit every entry."""
        only("clip", options, "min", "max")
        return np.clip(self, options.get("min", lower), options.get("max", upper))

    def round(self, decimals: int = 0, out: Any = None) -> Any:  # type: ignore[override]
        """Round to so many places."""
        if out is not None:
            raise TraceError("rounds into another array; assign the result")
        return np.rint(self * 10.0**decimals) / 10.0**decimals if decimals else np.rint(self)


class Length(int):
    """Length of a batch whose trace is to hold for batches of any length.

    It may be the length of other arrays. Any other use is noted, because it may tell one batch from another: a
    comparison, a division, a position along the batch. No batch has fewer than two rows.

    Attributes:
        batch: length of the batch that is traced; 0 where a trace holds for that one length only.
        used: another use was made of it.
    """

    batch: ClassVar[int] = 0
    used: ClassVar[bool] = False

    def __hash__(self) -> int:
        """Hash of the number."""
        return super().__hash__()


@contextmanager
def one_factor() -> Iterator[None]:
    """Run a function of one factor, whose arrays have no axis along the batch."""
    batch, Length.batch = Length.batch, 0
    try:
        yield
    finally:
        Length.batch = batch


def _carried(name: str) -> Callable[..., Any]:
    """Arithmetic whose result is again a length."""
    plain = getattr(int, name)
    return lambda self, other: Length(found) if isinstance(found := plain(self, other), int) else found


def _distinguishes(other: float) -> bool:
    """Test whether a comparison with a number may differ between batches of two rows and more."""
    return type(other) is not Length and other > 1


def _noted(name: str) -> Callable[..., Any]:
    """An operation on a length whose result may differ between batches."""
    plain, compared = getattr(int, name), name.strip("_") in ("lt", "le", "gt", "ge", "eq", "ne")

    def operation(self: Length, *others: Any) -> Any:
        if not compared or any(isinstance(other, int | float) and _distinguishes(other) for other in others):
            Length.used = True
        return plain(self, *others)

    return operation


for _name in ("add", "radd", "sub", "rsub", "mul", "rmul"):
    setattr(Length, f"__{_name}__", _carried(f"__{_name}__"))
for _name in (
    "lt", "le", "gt", "ge", "eq", "ne", "floordiv", "rfloordiv", "mod", "rmod", "truediv", "rtruediv", "pow", "rpow",
    "divmod", "rdivmod", "float", "and", "rand", "or", "ror", "xor", "rxor", "lshift", "rshift",
):  # fmt: skip
    setattr(Length, f"__{_name}__", _noted(f"__{_name}__"))


def holds_symbols(array: Any) -> bool:
    """Test whether an array holds numbers that are not known."""
    array = plain(array)
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


def only(name: str, options: dict[str, Any], *known: str) -> None:
    """Refuse keywords that have no rule here."""
    if unknown := sorted(set(options) - set(known)):
        raise TraceError(f"calls {name} with {unknown[0]}=, which is not traced; {INSTEAD}")


def require_float(name: str, dtype: Any) -> None:
    """Refuse another type than that of floats."""
    if dtype is not None and np.dtype(dtype) not in (np.float64, np.object_):
        raise TraceError(f"calls {name} with dtype={np.dtype(dtype).name}, which is not traced; {INSTEAD}")


def node_of(tape: Tape, value: Any) -> int:
    """The node of a symbol or of a number."""
    if isinstance(value, complex):
        raise TraceError("makes a complex number; write real and imaginary parts")
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
    if op not in _OF_TRUTHS:
        arguments = tuple(map(as_number, arguments))  # simplified to one of them, a number stays one
    node = tape.apply(op, *(node_of(tape, item) for item in arguments))
    known = Symbol.of(tape, node)
    return bool(known) if op in _TRUTHS and not isinstance(known, Symbol) else known


def _operation(op: Op) -> Callable[..., Any]:
    return lambda *arguments: _apply(op, *arguments)


def choose(condition: Any, a: Any, b: Any) -> Any:
    """Choose between single entries: the first where the condition holds."""
    if not isinstance(condition, Symbol):
        return a if condition else b
    if is_truth(a) and is_truth(b):
        return _apply(Op.OR, _apply(Op.AND, condition, a), _apply(Op.AND, _apply(Op.NOT, condition), b))
    tape, a, b = condition.tape, as_number(a), as_number(b)
    return Symbol.of(tape, tape.select(condition.node, node_of(tape, a), node_of(tape, b)))


def _by_kind(number: Op, truth: Op) -> Callable[..., Any]:
    """An operation on numbers that is another one on truth values."""
    return lambda a, b: _apply(truth if is_truth(a) and is_truth(b) else number, a, b)


def _all_truths(arguments: tuple[Any, ...]) -> bool:
    return all(map(is_truth, arguments))


def _unless(refused: Callable[[tuple[Any, ...]], bool], why: str, operation: Callable[..., Any]) -> Callable[..., Any]:
    """An operation that refuses some arguments."""

    def guarded(*arguments: Any) -> Any:
        if refused(arguments):
            raise TraceError(why)
        return operation(*arguments)

    return guarded


def _of_truths(name: str, operation: Callable[..., Any]) -> Callable[..., Any]:
    """An operation on the bits of integers, which is traced for truth values only."""
    why = f"calls np.{name} on numbers, which takes their bits; {INSTEAD}"
    return _unless(lambda arguments: not _all_truths(arguments), why, operation)


def _of_numbers(name: str, op: Op) -> Callable[..., Any]:
    """An operation that NumPy refuses for truth values."""
    return _unless(_all_truths, f"calls np.{name} on truth values, which NumPy refuses", _operation(op))


def _beside_nan(op: Op, truth: Op) -> Callable[..., Any]:
    """The smaller or the larger number; where one is NaN, the other."""

    def operation(a: Any, b: Any) -> Any:
        if is_truth(a) and is_truth(b):
            return _apply(truth, a, b)
        known = choose(_apply(Op.EQUAL, b, b), _apply(op, a, b), a)
        return choose(_apply(Op.EQUAL, a, a), known, b)

    return operation


def _remainder(a: Any, b: Any) -> Any:
    """With the sign of the divisor."""
    rest = _apply(Op.FMOD, a, b)
    other = _apply(Op.LESS, rest * b, 0.0)
    return choose(other, rest + b, rest)


def _signed(a: Any) -> Any:
    """Test whether a number has a minus sign, as -0.0 has."""
    zero = _apply(Op.AND, _apply(Op.EQUAL, a, 0.0), _apply(Op.LESS, _apply(Op.DIVIDE, 1.0, a), 0.0))
    return _apply(Op.OR, _apply(Op.LESS, a, 0.0), zero)


def _floor_divide(a: Any, b: Any) -> Any:
    return _apply(Op.RINT, _apply(Op.DIVIDE, a - _remainder(a, b), b))


def _hypot(a: Any, b: Any) -> Any:
    return _apply(Op.SQRT, a * a + b * b)


def _not_equal(a: Any, b: Any) -> Any:
    return _apply(Op.NOT, _apply(Op.EQUAL, a, b))


def _exclusive_or(a: Any, b: Any) -> Any:
    return _apply(Op.AND, _apply(Op.OR, a, b), _apply(Op.NOT, _apply(Op.AND, a, b)))


UFUNCS: dict[str, Callable[..., Any]] = {
    "add": _by_kind(Op.ADD, Op.OR),
    "subtract": _of_numbers("subtract", Op.SUBTRACT),
    "multiply": _by_kind(Op.MULTIPLY, Op.AND),
    "divide": _operation(Op.DIVIDE),
    "true_divide": _operation(Op.DIVIDE),
    "power": _operation(Op.POWER),
    "float_power": _operation(Op.POWER),
    "negative": _of_numbers("negative", Op.NEGATE),
    "positive": lambda a: a,
    "conjugate": lambda a: a,
    "absolute": lambda a: a if is_truth(a) else _apply(Op.ABSOLUTE, a),
    "fabs": _operation(Op.ABSOLUTE),
    "sign": _operation(Op.SIGN),
    "sqrt": _operation(Op.SQRT),
    "cbrt": lambda a: _apply(Op.SIGN, a) * _apply(Op.POWER, _apply(Op.ABSOLUTE, a), 1.0 / 3.0),
    "square": lambda a: _apply(Op.MULTIPLY, a, a),
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
    "logaddexp2": lambda a, b: (
        _apply(Op.MAXIMUM, a, b)
        + _apply(Op.LOG1P, _apply(Op.EXP, -_apply(Op.ABSOLUTE, a - b) * math.log(2.0))) / math.log(2.0)
    ),
    "erfc": lambda a: 1.0 - _apply(Op.ERF, a),
    "expit": lambda a: 0.5 + 0.5 * _apply(Op.TANH, 0.5 * a),
    "isnan": lambda a: _apply(Op.NOT, _apply(Op.EQUAL, a, a)),
    "isfinite": lambda a: _apply(Op.LESS, _apply(Op.ABSOLUTE, a), math.inf),
    "isinf": lambda a: _apply(Op.EQUAL, _apply(Op.ABSOLUTE, a), math.inf),
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
    "minimum": _by_kind(Op.MINIMUM, Op.AND),
    "maximum": _by_kind(Op.MAXIMUM, Op.OR),
    "fmin": _beside_nan(Op.MINIMUM, Op.AND),
    "fmax": _beside_nan(Op.MAXIMUM, Op.OR),
    "copysign": lambda a, b: choose(_signed(b), -abs(a), abs(a)),
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
    "logical_xor": _exclusive_or,
    "bitwise_and": _of_truths("bitwise_and", _operation(Op.AND)),
    "bitwise_or": _of_truths("bitwise_or", _operation(Op.OR)),
    "bitwise_xor": _of_truths("bitwise_xor", _exclusive_or),
    "invert": _of_truths("invert", _operation(Op.NOT)),
}
"""Meaning of the ufuncs of NumPy for single entries, by name."""


def _not_in_half_precision(name: str, scalar: Callable[..., Any]) -> Callable[..., Any]:
    """Refuse truth values where NumPy computes functions of them with half precision."""
    types = getattr(getattr(np, name, None), "types", ())
    if not types or any(kinds[0] in "?b" for kinds in types) or not any(kinds[0] == "e" for kinds in types):
        return scalar
    why = f"calls np.{name} on truth values, which NumPy does with half precision; convert them"
    return _unless(_all_truths, why, scalar)


UFUNCS |= {name: _not_in_half_precision(name, scalar) for name, scalar in UFUNCS.items()}
for _name, _scalar in UFUNCS.items():  # NumPy asks the entries of plain arrays of objects for methods of these names
    setattr(Symbol, _name, (lambda scalar: lambda *arguments: scalar(*arguments))(_scalar))


def _reduced(
    ufunc: np.ufunc, scalar: Callable[..., Any], method: str, array: Any, axis: Any = 0, **options: Any
) -> Any:
    """``ufunc.reduce`` and ``ufunc.accumulate``."""
    only(f"np.{ufunc.__name__}.{method}", options, "keepdims", "initial", "where", "dtype")
    if options.pop("where", True) is not True:
        raise TraceError(f"calls np.{ufunc.__name__}.{method} with where=; write np.where(condition, a, b)")
    dtype = options.pop("dtype", None)
    if ufunc in (np.logical_and, np.logical_or) and dtype in (bool, np.bool_):
        dtype = None
    require_float(f"np.{ufunc.__name__}.{method}", dtype)
    keep, initial = options.pop("keepdims", False), options.pop("initial", None)
    if ufunc in (np.add, np.multiply) or dtype is not None:  # which count truth values
        array = np.frompyfunc(as_number, 1, 1)(array)
    elif initial is not None and initial is not np._NoValue and any(map(is_truth, array.flat)):
        raise TraceError(f"calls np.{ufunc.__name__}.{method} on truth values with initial=; {INSTEAD}")
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
    kept = [array.shape[k] for k in rest]
    moved = array.transpose([*axes, *rest]).reshape(math.prod(array.shape[k] for k in axes), *kept)
    combine = np.frompyfunc(scalar, 2, 1)
    starts = [] if initial is None or initial is np._NoValue else [initial]
    rows = [np.broadcast_to(np.array(item, dtype=object), moved.shape[1:]) for item in starts] + list(moved)
    if not rows:
        if ufunc.identity is None:
            raise TraceError(f"calls np.{ufunc.__name__}.{method} on nothing")
        total: Any = np.full(moved.shape[1:], ufunc.identity, object)
    else:
        total = np.array(rows[0], dtype=object)  # the caller may write into it
        for row in rows[1:]:
            total = combine(total, row)
    if keep:
        total = np.asarray(total, dtype=object).reshape([1 if k in axes else n for k, n in enumerate(array.shape)])
    return total


FUNCTIONS: dict[Any, Callable[..., Any]] = {}
"""Replacements of functions of NumPy for arrays of symbols, where NumPy itself would look at entries."""
