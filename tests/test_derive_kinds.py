"""Differential tests of the tracer: whatever it does not refuse computes what NumPy computes.

Kinds of numbers, keywords, branches on types, and points that are special: zeros, ties, negative numbers, NaN.
"""

import itertools
import math
import time
from collections.abc import Callable, Iterator
from datetime import datetime
from functools import partial
from typing import Any

import numpy as np
import pytest

from problems.graphs import graph_with
from unifg.factors.autodiff.captured import captured_by
from unifg.factors.autodiff.rows import traced
from unifg.factors.autodiff.symbols import TraceError
from unifg.lie import Rn
from unifg.typing import Array

Function = Callable[..., Any]
NAN = math.nan
POINTS = np.array(
    [
        [0.3, -1.2, 2.4, 0.7], [0.0, 0.0, 0.0, 0.0], [1.0, 1.0, 2.0, 2.0], [-0.5, -2.5, 0.5, 1.5],
        [NAN, 1.0, -1.0, 0.0], [3.0, -3.0, 0.0, NAN], [-0.0, 0.0, 1e100, -1e-100], [4.0, 9.0, 16.0, 25.0],
    ]
)  # fmt: skip


FINITE = POINTS[np.isfinite(POINTS).all(axis=1)]


def differs(function: Function, points: Array = POINTS) -> str:
    """Reason for which a trace is not the function at some point; empty where it is the function or is refused."""
    try:
        expression = traced(function, (Rn(4),))
        tape, rows = expression.tape.at_rest(expression.rows)
    except TraceError:
        return ""
    for point in points:
        with np.errstate(all="ignore"):
            try:
                expected = np.asarray(function(point[None].copy()))
            except Exception as error:
                return f"traced, and the function raises {type(error).__name__}: {error}"
        if expected.ndim != 2:
            return f"traced, and the function returns shape {expected.shape}"
        found = np.array(tape.evaluate(rows, point, []))
        if not np.allclose(found, expected[0].astype(float), rtol=1e-12, atol=1e-14, equal_nan=True):
            return f"at {point}: {found}, NumPy {expected[0]}"
    return ""


def column(a: Any) -> Any:
    """(1, 1) of a number for each factor."""
    return np.asarray(a).reshape(len(a), -1) if np.ndim(a) else a


def reshaped(x: Array) -> Any:
    y = x * 1.0
    y.shape = (2, 2)
    return y.reshape(1, 4) if y.shape[0] == 2 else 2.0 * y.reshape(1, 4)


def assigned(x: Array) -> Any:
    r = np.zeros_like(x)
    r[:, :2] = x[:, :2] > 0.5
    return r[:, :2] + r[:, :2]


def masked(x: Array) -> Any:
    m = x > 0.0
    m[:, 0] = x[:, 1]
    return (m + m) * 1.0


def outed(x: Array) -> Any:
    r = np.zeros((1, 4))
    np.greater(x, 0.5, out=r)
    return r + r


def summed_builtin(x: Array) -> Any:
    return sum([x[:, :1] > 0.0, x[:, 1:2] > 0.0]) * 1.0


DIRECTED: list[Function] = [
    lambda x: 1.0 * ((x > 0.5) + (x > 0.0)),
    lambda x: 1.0 * ((x > 0.5) * (x > 0.0)) + 2.0 * ((x > 0.5) | (x < 0.0)),
    lambda x: 1.0 * ((x > 0.5) ^ (x > 0.0)),
    lambda x: (x > 0.5) - (x > 0.0),
    lambda x: -(x > 0.5) * 1.0,
    lambda x: ~(x > 0.5) * 1.0,
    lambda x: ~np.floor(x) * 1.0,
    lambda x: (np.floor(x).astype(int) & 1) * 1.0,
    lambda x: 1.0 * ((x > 0.5) @ np.ones((4, 2), dtype=bool)),
    lambda x: 1.0 * ((x > 0.5) @ (x > 0.0).T),
    lambda x: 1.0 * np.einsum("ni,ni->n", x > 0.5, x > 0.0)[:, None],
    lambda x: 1.0 * np.dot(x > 0.5, np.ones(4, dtype=bool))[:, None],
    lambda x: np.sum(x > 0.5, axis=1, keepdims=True) * 0.5,
    lambda x: np.mean(x > 0.5, axis=1, keepdims=True),
    lambda x: np.cumsum(x > 0.5, axis=1) * 1.0,
    lambda x: np.prod((x > 0.5) + 0.5, axis=1, keepdims=True),
    lambda x: 1.0 * (np.where(x > 0.0, x > 0.5, x > -1.0) + (x > 0.0)),
    lambda x: 1.0 * (np.where(x > 0.0, True, False) + np.where(x > 0.5, True, False)),
    lambda x: 1.0 * (np.where(x > 0.0, True, x) + np.where(x > 0.5, 1.0, False)),
    lambda x: 1.0 * (np.stack([x > 0.5, x])[0] + np.stack([x > 0.5, x])[0]),
    lambda x: 1.0 * (np.concatenate([x > 0.5, x > 0.0], axis=1) + True),
    lambda x: (np.array([x[0] > 0.5, x[0] > 0.0]) + 0)[:1] * 1.0,
    lambda x: np.array([x[0] > 0.5], dtype=float) + np.array([x[0] > 0.0], dtype=float),
    lambda x: (x > 0.5).astype(float) + (x > 0.0).astype(float),
    lambda x: (x > 0.5).astype(int) + (x > 0.0).astype(int) + 0.5,
    lambda x: 1.0 * (x.astype(bool) + x.astype(bool)),
    lambda x: np.nan_to_num(x).astype(np.int8) * 1.0,
    lambda x: (x * 1.1).astype(np.float32).astype(float),
    lambda x: np.asarray(x, dtype=np.float32) * 1.0,
    lambda x: np.array(x, dtype=np.float32) * 1.0,
    lambda x: np.zeros_like(x, dtype=np.float32) + x,
    lambda x: np.full_like(x > 0.0, 3.0) * 1.0,
    lambda x: np.ones_like(x > 0.0) + np.ones_like(x > 0.5) + 0.0,
    lambda x: np.add(x, 1.0, dtype=np.float32) * 1.0,
    lambda x: np.sum(x, axis=1, keepdims=True, where=x > 0.0),
    lambda x: np.sum(x, axis=1, keepdims=True, where=np.array([True, False, True, True])),
    lambda x: np.mean(x, axis=1, keepdims=True, where=np.array([True, False, True, True])),
    lambda x: np.max(x, axis=1, keepdims=True, where=np.array([True, False, True, True]), initial=-9.0),
    lambda x: np.max(x, axis=1, keepdims=True, initial=np.int64(1)),
    lambda x: np.min(x, axis=1, keepdims=True, initial=np.float32(0.5)),
    lambda x: np.sum(x, axis=1, keepdims=True, initial=np.int64(3)),
    lambda x: x.sum(axis=1, keepdims=True, initial=np.array(2.0)),
    lambda x: np.multiply(x, 2.0, where=x > 0.0),
    lambda x: np.any(x > 0.5, axis=1, keepdims=True, where=np.array([True, False, True, True])) * 1.0,
    lambda x: np.fmin(x, 1.0) + np.fmax(x, x[:, ::-1]),
    lambda x: np.minimum(x, 1.0) + np.maximum(x, x[:, ::-1]),
    lambda x: np.sqrt(x) ** 2,
    lambda x: np.sqrt(x) * np.sqrt(x),
    lambda x: np.sqrt(x) * x * np.sqrt(x),
    lambda x: np.sqrt(x**2) ** 2 + np.sqrt(np.abs(x)) ** 2,
    lambda x: np.square(x > 0.5) + np.square(x > 0.0) + 0.0,
    lambda x: x if x.dtype == float else 2.0 * x,
    lambda x: x if np.issubdtype(x.dtype, np.floating) else 2.0 * x,
    lambda x: x * 1.0 if (x > 0.0).dtype == bool else 2.0 * x,
    lambda x: x if isinstance(x, np.ndarray) else 2.0 * x,
    lambda x: x if type(x) is np.ndarray else 2.0 * x,
    lambda x: x if isinstance(x[0, 0], float) else 2.0 * x,
    lambda x: x if type(x[0, 0]) is np.float64 else 2.0 * x,
    lambda x: x if isinstance(x.dtype, np.dtype) and isinstance(float, type) else 2.0 * x,
    lambda x: np.zeros(x.shape, dtype=x.dtype) + x,
    lambda x: np.zeros((len(x), 4), dtype=bool) + x,
    lambda x: np.full((1, 4), 2, dtype=int) * x,
    lambda x: np.full((1, 4), 2.7, dtype=int) * x,
    lambda x: np.clip(x, -1.0, None) + np.clip(x, a_min=None, a_max=1.0),
    lambda x: x.clip(max=0.5) + np.round(x, 1) + x.round(decimals=2),
    lambda x: np.linalg.norm(x, axis=1, keepdims=True, ord=1),
    lambda x: np.linalg.norm(x.reshape(2, 2), ord=2) * x,
    lambda x: np.std(x, axis=1, keepdims=True, ddof=1) + np.var(x, axis=1, keepdims=True),
    lambda x: np.std(x, axis=1, keepdims=True, where=np.array([True, False, True, True])),
    lambda x: np.diff(x, axis=1, prepend=0.0) + np.diff(x, axis=1, append=1.0),
    lambda x: np.isclose(x, x[:, ::-1], atol=0.1) * 1.0,
    lambda x: np.heaviside(x, 0.5) + np.sign(x) + np.copysign(1.0, x) + np.fmod(x, 0.7) + np.mod(x, 0.7),
    lambda x: x // 0.3 + np.floor_divide(x, -0.7) + np.trunc(x) + np.rint(x) + np.ceil(x),
    lambda x: np.float_power(np.abs(x), 0.3) + np.cbrt(x) + np.exp2(x),
    lambda x: np.logaddexp(x, x[:, ::-1]),
    lambda x: np.sinc(x),
    lambda x: np.logical_xor(x, x > 0.5) + 1.0 * ((x > 0.0) ^ (x < 0.5)),
    reshaped, assigned, masked, outed, summed_builtin,
]  # fmt: skip


@pytest.mark.parametrize("place", range(len(DIRECTED)))
def test_what_is_traced_is_what_numpy_computes(place: int) -> None:
    assert not differs(DIRECTED[place])


REDUCTIONS = ("sum", "prod", "mean", "max", "min", "all", "any", "std", "var", "cumsum", "cumprod", "ptp", "nansum")
KEYWORDS: dict[str, tuple[Any, ...]] = {
    "axis": (None, 0, 1, (0, 1)),
    "keepdims": (True, False),
    "initial": (0.5, np.int64(2), np.float32(0.25), np.array(1.5), True),
    "where": (True, np.array([True, False, True, True]), np.array([[False] * 4])),
    "dtype": (float, np.float32, int, bool, object),
    "ddof": (0, 1),
    "out": (None,),
}
ELEMENTWISE = ("add", "multiply", "subtract", "maximum", "fmin", "fmax", "logical_or", "power", "greater", "hypot")


def drawn(count: int, seed: int) -> Iterator[tuple[str, Function]]:
    """Calls of NumPy's functions with keywords of their signatures, on numbers and on truth values."""
    rng = np.random.default_rng(seed)

    def pick(things: Any) -> Any:
        return things[int(rng.integers(len(things)))]

    for _ in range(count):
        before: Function = pick([lambda x: x, lambda x: x > 0.5, lambda x: np.floor(x), lambda x: x[:, ::-1] * 2.0])
        chosen = {name: pick(KEYWORDS[name]) for name in rng.permutation(list(KEYWORDS))[: int(rng.integers(4))]}
        if rng.random() < 0.5:
            name = pick(REDUCTIONS)
            method = bool(rng.random() < 0.3) and hasattr(np.ndarray, name)
            called: Function = (
                (lambda x, n=name, k=chosen, b=before: getattr(b(x), n)(**k)) if method
                else (lambda x, n=name, k=chosen, b=before: getattr(np, n)(b(x), **k))
            )  # fmt: skip
        else:
            name, other = pick(ELEMENTWISE), pick([lambda x: x, lambda x: x > 0.0, lambda x: 1.5, lambda x: True])
            kept = {k: v for k, v in chosen.items() if k in ("where", "dtype")}
            called = partial(lambda n, k, b, o, x: getattr(np, n)(b(x), o(x), **k), name, kept, before, other)
        after: Function = pick(
            [lambda r: r * 1.0, lambda r: r + r, lambda r: np.where(r, 1.0, 2.0), lambda r: r + True]
        )
        yield f"{name} {chosen}", lambda x, c=called, a=after: 1.0 * np.reshape(a(c(x)), (1, -1))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("seed", range(8))
def test_drawn_calls_with_keywords_are_traced_rightly_or_refused(seed: int) -> None:
    wrong, kept = [], 0
    for name, function in drawn(60, seed):
        try:
            function(POINTS[:1].copy())
        except Exception:  # NumPy itself refuses the combination
            continue
        kept += 1
        if why := differs(function, FINITE):  # simplifications hold for finite numbers
            wrong.append(f"{name}: {why}")
    assert not wrong and kept > 15, wrong


DRAW = np.random.default_rng(0)


@pytest.mark.parametrize(
    ("function", "why"),
    [
        (lambda x: x * time.monotonic(), "time.monotonic()"),
        (lambda x: x * time.perf_counter(), "time.perf_counter()"),
        (lambda x: x * datetime.now().microsecond, "datetime"),
        (lambda x: x * np.random.rand(), "np.random"),  # noqa: NPY002
        (lambda x: x * DRAW.normal(), "Generator"),
    ],
)
def test_clocks_and_random_numbers_are_refused_by_name(function: Function, why: str) -> None:
    graph, x = graph_with(Rn(2), 3)
    graph.minimize(function, x, name="own")
    route = graph.compile().terms[0].route
    assert route.startswith("evaluated by Python") and why in route


def test_functions_of_itertools_and_functools_are_no_foreign_ones() -> None:
    assert not captured_by(lambda x: sum(itertools.accumulate([1.0, 2.0])) * x).refusal
