"""Functions of NumPy on arrays of symbols: those that look at entries, or call compiled code, written again."""

from __future__ import annotations

import string
from collections import Counter
from collections.abc import Callable
from functools import reduce
from typing import Any

import numpy as np

from unifg.factors.autodiff import masks
from unifg.factors.autodiff.symbols import (
    INSTEAD,
    UFUNCS,
    Symbol,
    TraceError,
    alike,
    as_number,
    as_truth,
    choose,
    is_truth,
    node_of,
    plain,
    require_float,
    symbols,
    wrapped,
)
from unifg.factors.autodiff.tables import interp

LARGEST = 12  # rows of a linear system, whose elimination is written out
_Pick = np.frompyfunc(choose, 3, 1)


def _objects(array: Any) -> Any:
    return np.asarray(plain(array) if isinstance(array, np.ndarray) else array, dtype=object)


def matmul(a: Any, b: Any) -> Any:
    """``a @ b`` with NumPy's rules for stacks and vectors."""
    a, b = _objects(a), _objects(b)
    left, right = a[None, :] if a.ndim == 1 else a, b[:, None] if b.ndim == 1 else b
    add = np.logical_or if _truths(a) and _truths(b) else np.add
    product = add.reduce(wrapped(left[..., :, :, None] * right[..., None, :, :]), axis=-2)
    if a.ndim == 1:
        product = product[..., 0, :]
    return product[..., 0] if b.ndim == 1 else product


def _truths(array: Any) -> bool:
    """Test whether the entries of an array are truth values."""
    return array.size > 0 and is_truth(next(array.flat))


def _each(name: str, *arguments: Any) -> Any:
    scalar: Any = np.frompyfunc(UFUNCS[name], len(arguments), 1)
    return scalar(*map(_objects, arguments))


def _where(condition: Any, *parts: Any) -> Any:
    if len(parts) != 2:
        raise TraceError("asks np.where for places that are not known yet; give it what to choose from")
    return alike(_Pick(_objects(condition), _objects(parts[0]), _objects(parts[1])))


def _clip(
    array: Any, a_min: Any = None, a_max: Any = None, out: Any = None, *, min: Any = None, max: Any = None
) -> Any:
    if out is not None:
        raise TraceError("clips into another array; assign the result")
    lower, upper = (a_min if min is None else min), (a_max if max is None else max)
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
    raise TraceError(f"asks np.linalg.norm for order {ord}; 1, 2 and infinity are traced")


def _cross(a: Any, b: Any, *arguments: Any, **options: Any) -> Any:
    a, b = wrapped(_objects(a)), wrapped(_objects(b))
    if arguments or not set(options) <= {"axis"} or options.get("axis", -1) not in (-1, max(a.ndim, b.ndim) - 1):
        raise TraceError("asks np.cross for other axes than the last; move them there")
    if a.shape[-1] == 2 and b.shape[-1] == 2:
        return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return np.stack(
        [a[..., i] * b[..., j] - a[..., j] * b[..., i] for i, j in ((1, 2), (2, 0), (0, 1))],
        axis=-1,
    )


def _einsum(subscripts: str, *operands: Any, optimize: Any = False) -> Any:
    if not isinstance(subscripts, str):
        raise TraceError("calls np.einsum without a string of subscripts")
    if all(_truths(_objects(item)) for item in operands):
        raise TraceError(f"calls np.einsum on truth values; {INSTEAD}")
    if "->" not in subscripts:
        count = Counter(c for c in subscripts if c in string.ascii_letters)
        left = "".join(sorted(c for c, times in count.items() if times == 1))
        subscripts += "->" + ("..." if "..." in subscripts else "") + left
    return np.einsum(subscripts, *(_objects(item) for item in operands), optimize=False)


def _like(value: float | None) -> Callable[..., Any]:
    def fill(
        array: Any, fill_value: Any = value, dtype: Any = None, order: Any = None, subok: Any = None, shape: Any = None
    ) -> Any:
        size, number = np.shape(array) if shape is None else shape, fill_value if value is None else value
        if dtype is None:
            return symbols(size, as_truth(number) if _truths(_objects(array)) else number)
        return np.full(size, number, dtype=dtype) if np.dtype(dtype).kind in "iub" else symbols(size, number)

    def fill_like(array: Any, dtype: Any = None, order: Any = None, subok: Any = None, shape: Any = None) -> Any:
        return fill(array, value, dtype, order, subok, shape)

    return fill if value is None else fill_like


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
    return _systems(array, np.broadcast_to(np.eye(array.shape[-1]).astype(object), array.shape))


def _solve(a: Any, b: Any) -> Any:
    a, b = _objects(a), _objects(b)
    return _systems(a, b) if b.ndim != 1 else _systems(a, b[:, None])[..., 0]


def _systems(a: Any, b: Any) -> Any:
    """(..., n, k) solutions of linear systems, by nodes of the tape that pivot."""
    n = a.shape[-1]
    if a.ndim < 2 or a.shape[-2] != n:
        raise TraceError("solves a linear system whose matrix is not square")
    if n > LARGEST:
        raise TraceError(f"solves a linear system of more than {LARGEST} rows; {INSTEAD}")
    stack = np.broadcast_shapes(a.shape[:-2], b.shape[:-2])
    a, b = np.broadcast_to(a, (*stack, n, n)), np.broadcast_to(b, (*stack, *b.shape[-2:]))
    found = symbols(b.shape)
    for place in np.ndindex(stack):
        for column in range(b.shape[-1]):
            found[(*place, slice(None), column)] = _solution(a[place], b[place][:, column])
    return found


def _solution(matrix: Any, right: Any) -> list[Any]:
    """Solution of one linear system."""
    numbers = [as_number(entry) for entry in (*matrix.flat, *right)]
    tape = next((entry.tape for entry in numbers if isinstance(entry, Symbol)), None)
    n = len(right)
    if tape is None:
        return list(np.linalg.solve(np.array(numbers[: n * n], dtype=float).reshape(n, n), np.array(numbers[n * n :])))
    nodes = [node_of(tape, entry) for entry in numbers]
    rows = [nodes[k * n : (k + 1) * n] for k in range(n)]
    return [Symbol.of(tape, node) for node in tape.solve(rows, nodes[n * n :])]


def _every(array: Any, axis: Any = None, *, keepdims: Any = False) -> Any:
    return np.logical_and.reduce(wrapped(_objects(array)), axis, keepdims=keepdims)


def _some(array: Any, axis: Any = None, *, keepdims: Any = False) -> Any:
    return np.logical_or.reduce(wrapped(_objects(array)), axis, keepdims=keepdims)


def _mean(array: Any, axis: Any = None, dtype: Any = None, *, keepdims: bool = False) -> Any:
    require_float("np.mean", dtype)
    array = wrapped(_objects(array))
    total = np.sum(array, axis=axis, keepdims=keepdims)
    return total / (array.size / np.size(total))


def _cholesky(array: Any) -> Any:
    array = _objects(array)
    n = array.shape[-1]
    root = symbols(array.shape)
    for j in range(n):
        rest = array[..., j, j] - sum((root[..., j, k] ** 2 for k in range(j)), 0.0)
        root[..., j, j] = _each("sqrt", rest)
        for i in range(j + 1, n):
            known = sum((root[..., i, k] * root[..., j, k] for k in range(j)), 0.0)
            root[..., i, j] = (array[..., i, j] - known) / root[..., j, j]
    return root


def _select(conditions: Any, choices: Any, default: Any = 0.0) -> Any:
    found = default
    for condition, choice in zip(reversed(conditions), reversed(choices), strict=True):
        found = _where(condition, choice, found)
    return found


def _piecewise(array: Any, conditions: Any, functions: Any, *arguments: Any, **options: Any) -> Any:
    values = [f(wrapped(_objects(array)), *arguments, **options) if callable(f) else f for f in functions]
    if len(values) == len(conditions):
        values.append(0.0)
    found = values[-1]
    for condition, value in zip(conditions, values, strict=False):  # the last that holds
        found = _where(condition, value, found)
    return found


def _finite(array: Any, copy: bool = True, nan: float = 0.0, posinf: Any = None, neginf: Any = None) -> Any:
    array, big = wrapped(_objects(array)), np.finfo(float).max
    found = _where(np.isnan(array), nan, array)
    found = _where(wrapped(_objects(array)) == np.inf, big if posinf is None else posinf, found)
    return _where(wrapped(_objects(array)) == -np.inf, -big if neginf is None else neginf, found)


def _product_of_sums(a: Any, b: Any, axis: int = -1) -> Any:
    return np.sum(wrapped(_objects(a)) * wrapped(_objects(b)), axis=axis)


def _unknown(function: Callable[..., Any], advice: str) -> Callable[..., Any]:
    def refuse(*arguments: Any, **options: Any) -> Any:
        raise TraceError(
            f"calls np.{function.__name__}, which depends on the order of numbers that are not known; write {advice}, "
            f"or {INSTEAD}"
        )

    return refuse


def _dot(a: Any, b: Any) -> Any:
    if b.ndim > 2:
        raise TraceError("calls np.dot with a stack of matrices; use @")
    return matmul(a, b)


TABLE: dict[Any, Callable[..., Any]] = {
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
    np.linalg.cholesky: _cholesky,
    np.linalg.multi_dot: lambda arrays: reduce(matmul, arrays),
    np.linalg.matrix_power: lambda array, n: reduce(matmul, [array] * n if n > 0 else [_inverse(array)] * -n),
    np.matmul: matmul,
    np.divmod: lambda a, b: (_each("floor_divide", a, b), _each("remainder", a, b)),
    np.modf: lambda a: (_each("fmod", a, 1.0), _each("trunc", a)),
    np.select: _select,
    np.piecewise: _piecewise,
    np.nan_to_num: _finite,
    np.round: lambda array, decimals=0: wrapped(_objects(array)).round(decimals),
    np.interp: interp,
    np.ndarray.__getitem__: masks.taken,
    np.ndarray.__setitem__: masks.put,
    np.all: _every,
    np.any: _some,
    np.mean: _mean,
}
"""Functions of NumPy, and what takes their place."""
TABLE |= {
    function: _unknown(function, advice)
    for advice, functions in {
        "np.minimum and np.maximum": (
            np.sort, np.argsort, np.argmax, np.argmin, np.median, np.percentile, np.quantile, np.partition, np.unique,
        ),
        "np.where(condition, a, b)": (np.nonzero, np.flatnonzero, np.argwhere, np.extract, np.count_nonzero),
        "np.interp or a spline (unifg.models.spline)": (np.searchsorted, np.digitize),
        "fg.wrap_angle": (np.unwrap,),
    }.items()
    for function in functions
}  # fmt: skip
TABLE |= {  # not in every NumPy: of 2, and what 2.5 calls deprecated
    getattr(module, name): made
    for module, name, made in (
        (np, "fix", lambda x: np.trunc(wrapped(_objects(x)))),
        (np, "vecdot", _product_of_sums),
        (np.linalg, "vecdot", lambda a, b, *, axis=-1: _product_of_sums(a, b, axis)),
        (np.linalg, "vector_norm", lambda x, *, axis=None, keepdims=False, ord=2: _norm(x, ord, axis, keepdims)),
    )
    if hasattr(module, name)
}
