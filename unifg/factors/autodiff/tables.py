"""Look-ups in tables, traced: ``np.interp`` and the interpolators of SciPy, by bisection of their points.

A table is compiled in, or a run of parameters. Its length sets the number of steps of the bisection and nothing else,
so code and compile time do not grow with it. Between its points a look-up is a polynomial whose derivatives are exact;
at a point it has those of the interval that begins there, at the last point those of the last interval.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from unifg.factors.autodiff.operations import Op
from unifg.factors.autodiff.symbols import (
    INSTEAD,
    UFUNCS,
    Symbol,
    TraceError,
    as_number,
    choose,
    node_of,
    plain,
    wrapped,
)
from unifg.factors.autodiff.tape import Tape
from unifg.typing import Array

SCIPY = ("RegularGridInterpolator", "PPoly", "BSpline")
"""Classes whose instances are traced, and those of their subclasses in SciPy."""
LARGEST = 1 << 17  # numbers of an interpolator, which are compared before each solve
DEGREE = 5  # of a spline, at most

_less, _less_equal, _either = UFUNCS["less"], UFUNCS["less_equal"], UFUNCS["logical_or"]


def kind_of(value: Any) -> str:
    """Class of SciPy that an interpolator is of; empty for anything else."""
    owner = type(value)
    if not owner.__module__.startswith("scipy.interpolate"):
        return ""
    names = {base.__name__ for base in owner.__mro__}
    return next((name for name in SCIPY if name in names), "")


def content_of(value: Any) -> tuple[Any, ...]:
    """Numbers and options that an interpolator computes with: arrays, and what can be compared."""
    kind = kind_of(value)
    if kind == "PPoly":
        return kind, value.x, value.c, value.extrapolate, value.axis
    if kind == "BSpline":
        return kind, value.t, value.c, value.k, value.extrapolate, value.axis
    spline = value._spline
    parts = () if spline is None else (*spline.t, spline.c, *map(int, spline.k))
    options = value.method, value.bounds_error, None if value.fill_value is None else complex(value.fill_value)
    return kind, *value.grid, np.asarray(value.values), *options, *parts


def fingerprint_of(value: Any) -> tuple[Any, ...]:
    """Content of an interpolator, with the bytes of its arrays."""
    return tuple(
        (part.dtype.str, part.shape, part.tobytes()) if isinstance(part, np.ndarray) else part
        for part in content_of(value)
    )


def size_of(value: Any) -> int:
    """Numbers that an interpolator holds."""
    return sum(part.size for part in content_of(value) if isinstance(part, np.ndarray))


# ---------------------------------------------------------------- runs of numbers


class Run:
    """Numbers that stand one after the other where machine code reads: in the tables, or among the parameters.

    Attributes:
        tape: of the symbols.
        begin: node of the first: its place in the tables, or the first parameter.
        count: how many.
        known: the numbers, where they are compiled in.
    """

    def __init__(self, tape: Tape, numbers: Any) -> None:
        """Take numbers that are all known, or a whole array of parameters.

        Raises:
            TraceError: the function computes them.
        """
        entries = list(np.asarray(plain(numbers), dtype=object).ravel())
        self.tape, self.count, self.known = tape, len(entries), None
        if not any(isinstance(entry, Symbol) for entry in entries):
            self.known = _real(entries)
            self.begin = tape.constant(float(tape.table(self.known)))
            return
        nodes = [entry.node if isinstance(entry, Symbol) else -1 for entry in entries]
        first = tape.a[nodes[0]]
        if any(i < 0 or tape.op[i] != Op.PARAMETER or tape.a[i] != first + k for k, i in enumerate(nodes)):
            raise TraceError(
                "looks up in a table that it computes; compute it outside, and pass it as an argument or as data"
            )
        self.begin = nodes[0]

    def interval(self, x: Any) -> Any:
        """Number of the interval of x, from 0 to the count less 2."""
        count = self.tape.constant(float(self.count))
        return self._symbol(Op.SEARCH, node_of(self.tape, x), self.begin, count)

    def take(self, place: Any) -> Any:
        """The number at a place."""
        node = node_of(self.tape, place)
        if self.known is not None:
            return self._symbol(Op.GATHER, self.tape.add(node, self.begin))
        return self._symbol(Op.TAKE, node, self.begin, self.tape.constant(float(self.count)))

    def _symbol(self, op: Op, *taken: int) -> Any:
        return Symbol.of(self.tape, self.tape.apply(op, *taken))


def _real(entries: Sequence[Any]) -> Array:
    found = np.array(entries)
    if found.dtype.kind not in "fiub":
        raise TraceError(f"looks up in a table of {found.dtype.name}; {INSTEAD}")
    return found.astype(np.float64)


def _increasing(points: Array, name: str) -> None:
    if len(points) > 1 and not (np.diff(points) > 0.0).all():
        raise TraceError(f"calls {name} with points that do not increase; sort them, each once")


def _tape_of(*parts: Any) -> Tape | None:
    for part in parts:
        for entry in np.asarray(plain(part), dtype=object).flat:
            if isinstance(entry, Symbol):
                return entry.tape
    return None


def _each(function: Callable[[Any], Any], x: Any) -> Any:
    """The values of a function of one number, in the shape of x."""
    entries = np.asarray(plain(x), dtype=object)
    found = np.empty(entries.shape, dtype=object)
    for place in np.ndindex(entries.shape):
        found[place] = function(as_number(entries[place]))
    return wrapped(found) if found.ndim else found.item()


# ---------------------------------------------------------------- np.interp


def interp(x: Any, xp: Any, fp: Any, left: Any = None, right: Any = None, period: Any = None) -> Any:
    """``np.interp``: straight lines between points, constant beyond them."""
    tape = _tape_of(x, xp, fp, left, right, period)
    if tape is None:
        return np.interp(x, xp, fp, left, right, period)
    points, values = (np.asarray(plain(part), dtype=object) for part in (xp, fp))
    if points.ndim != 1 or points.shape != values.shape or not len(points):
        raise TraceError(f"calls np.interp with points of shape {points.shape} and values of shape {values.shape}")
    if period is not None:
        if _tape_of(points, values, period) is not None:
            raise TraceError("calls np.interp with period= and points that may change; wrap them yourself")
        points, values = _once_around(_real(list(points)), _real(list(values)), float(period))
        x, left, right = np.remainder(wrapped(np.asarray(plain(x), dtype=object)), abs(float(period))), None, None
    if len(points) == 1:
        points, values = np.append(points, points + 1.0), np.append(values, values)  # of one point, all is its value
        right = values[0] if right is None else right
        below, above = points[0], points[0]
    else:
        below, above = points[0], points[-1]
    places, heights = Run(tape, points), Run(tape, values)
    rises = None
    if places.known is not None:
        _increasing(places.known, "np.interp")
        if heights.known is not None:
            rises = Run(tape, np.diff(heights.known) / np.diff(places.known))
    first, last = (values[0] if left is None else left), (values[-1] if right is None else right)

    def at(x: Any) -> Any:
        place = places.interval(x)
        begin, height = places.take(place), heights.take(place)
        if rises is None:
            rise = (heights.take(place + 1.0) - height) / (places.take(place + 1.0) - begin)
        else:
            rise = rises.take(place)
        between = height + rise * (x - begin)
        return choose(_less(x, below), first, choose(_less(above, x), last, between))

    return _each(at, x)


def _once_around(points: Array, values: Array, period: float) -> tuple[Array, Array]:
    """Points of one period, with a neighbour on each side."""
    if period == 0.0:
        raise TraceError("calls np.interp with a period of zero")
    period = abs(period)
    points = points % period
    order = np.argsort(points)
    points, values = points[order], values[order]
    return (
        np.concatenate([points[-1:] - period, points, points[:1] + period]),
        np.concatenate([values[-1:], values, values[:1]]),
    )


# ---------------------------------------------------------------- interpolators of SciPy


class Interpolator:
    """Stand-in for an interpolator of SciPy while a function is traced."""

    def __init__(self, original: Any) -> None:
        """Keep the original."""
        self._original = original

    def __getattr__(self, name: str) -> Any:
        """Attribute of the original; its derivatives are stand-ins, too."""
        found = getattr(self._original, name)
        if name in ("derivative", "antiderivative"):
            return lambda nu=1: Interpolator(found(nu))
        return found

    def __call__(self, x: Any, *arguments: Any, **options: Any) -> Any:
        """Values at points."""
        parts = x if isinstance(x, tuple | list) else (x,)
        tape = _tape_of(*parts)
        if tape is None:
            return self._original(x, *arguments, **options)
        kind = kind_of(self._original)
        try:
            return _CALLS[kind](tape, self._original, x, *arguments, **options)
        except TypeError as error:
            raise TraceError(f"calls a {kind} in a way that is not traced ({error}); {INSTEAD}") from None


def _polynomials(tape: Tape, original: Any, x: Any, nu: int = 0, extrapolate: Any = None) -> Any:
    """Piecewise polynomials: coefficients c[k, interval], of the highest power first."""
    extrapolate = original.extrapolate if extrapolate is None else extrapolate
    if nu:
        original = original.derivative(nu)
    points, c = np.asarray(original.x), np.asarray(original.c)
    _increasing(points, "a piecewise polynomial")
    powers, tail = len(c), c.shape[2:]
    flat = c.reshape(powers, len(points) - 1, -1).transpose(1, 2, 0)
    places, numbers, components = Run(tape, points), Run(tape, flat), flat.shape[1]

    def at(x: Any) -> list[Any]:
        place = places.interval(x)
        beside, first = x - places.take(place), place * float(powers * components)
        found = []
        for component in range(components):
            total = numbers.take(first + float(component * powers))
            for power in range(1, powers):
                total = total * beside + numbers.take(first + float(component * powers + power))
            found.append(total)
        return found

    return _along_axis(_within(at, points[0], points[-1], extrapolate), x, tail, original.axis)


def _spline(tape: Tape, original: Any, x: Any, nu: int = 0, extrapolate: Any = None) -> Any:
    """A sum of B-splines."""
    extrapolate = original.extrapolate if extrapolate is None else extrapolate
    if nu:
        original = original.derivative(nu)
    knots, degree = np.asarray(original.t), int(original.k)
    count = len(knots) - degree - 1
    at = _tensor(tape, [knots], np.asarray(original.c)[:count], [degree])
    ends = knots[degree], knots[count]
    return _along_axis(_within(lambda x: at([x]), *ends, extrapolate), x, original.c.shape[1:], original.axis)


def _within(at: Callable[[Any], list[Any]], first: float, last: float, extrapolate: Any) -> Callable[[Any], list[Any]]:
    """Values continued beyond the ends as the option says."""
    if extrapolate == "periodic":
        return lambda x: at(first + UFUNCS["remainder"](x - first, last - first))
    if extrapolate:
        return at

    def inside(x: Any) -> list[Any]:
        beyond = _either(_less(x, first), _less(last, x))
        return [choose(beyond, math.nan, value) for value in at(x)]

    return inside


def _along_axis(at: Callable[[Any], list[Any]], x: Any, tail: tuple[int, ...], axis: int) -> Any:
    """Values of several components, which SciPy puts around the axis of the points."""
    entries = np.asarray(plain(x), dtype=object)
    found = np.empty((*entries.shape, math.prod(tail)), dtype=object)
    for place in np.ndindex(entries.shape):
        found[place] = at(as_number(entries[place]))
    found = found.reshape(entries.shape + tail)
    if axis:
        order, n = list(range(found.ndim)), entries.ndim
        found = found.transpose(order[n : n + axis] + order[:n] + order[n + axis :])
    return wrapped(found) if found.ndim else found.item()


def _grid(tape: Tape, original: Any, xi: Any, method: str | None = None, *, nu: Any = None) -> Any:
    """A table over a regular grid of any number of dimensions, linear between its points or a tensor spline."""
    grid, values, count = [np.asarray(axis) for axis in original.grid], np.asarray(original.values), len(original.grid)
    method = original.method if method is None else method
    if method not in ("linear", original.method) or method in ("nearest", "pchip") or nu is not None:
        raise TraceError(f"calls a RegularGridInterpolator with {'nu=' if nu is not None else method}; {INSTEAD}")
    if isinstance(xi, tuple):
        entries = np.stack(np.broadcast_arrays(*(np.asarray(plain(part), dtype=object) for part in xi)), axis=-1)
    else:
        entries = np.asarray(plain(np.asarray(xi, dtype=object) if isinstance(xi, list) else xi), dtype=object)
        entries = entries.reshape(-1, count) if entries.ndim == 1 else entries
    if entries.ndim == 1:  # of single numbers
        entries = entries.reshape(1, -1)
    if entries.shape[-1] != count:
        raise TraceError(f"calls a RegularGridInterpolator of {count} dimensions with points of {entries.shape[-1]}")
    for axis in grid:
        _increasing(axis, "a RegularGridInterpolator")
    if method == "linear":
        at = _multilinear(tape, grid, values)
    else:
        spline = original._spline
        at = _tensor(tape, [np.asarray(t) for t in spline.t], np.asarray(spline.c), [int(k) for k in spline.k])
    ends, fill, tail = [(axis[0], axis[-1]) for axis in grid], original.fill_value, values.shape[count:]
    found = np.empty((*entries.shape[:-1], math.prod(tail)), dtype=object)
    for place in np.ndindex(entries.shape[:-1]):
        point = [as_number(x) for x in entries[place]]
        number = at(point)
        for x, (first, last) in zip(point, ends, strict=True):
            if original.bounds_error:
                tape.required += [node_of(tape, _less_equal(first, x)), node_of(tape, _less_equal(x, last))]
            elif fill is not None:
                beyond = _either(_less(x, first), _less(last, x))
                number = [choose(beyond, float(fill), value) for value in number]
        found[place] = number
    return wrapped(found.reshape(entries.shape[:-1] + tail))


def _multilinear(tape: Tape, grid: Sequence[Array], values: Array) -> Callable[[Sequence[Any]], list[Any]]:
    """Values linear in each variable between the points of a grid."""
    axes, sizes, components = [Run(tape, axis) for axis in grid], values.shape[: len(grid)], _components(values, grid)
    numbers, strides = Run(tape, values), _strides(sizes, components)
    if min(sizes) < 2:
        raise TraceError(f"calls a RegularGridInterpolator whose values, {values.shape}, have one point along an axis")

    def at(point: Sequence[Any]) -> list[Any]:
        first: Any = 0.0
        weights = []
        for axis, stride, x in zip(axes, strides, point, strict=True):
            place = axis.interval(x)
            begin = axis.take(place)
            weights.append((x - begin) / (axis.take(place + 1.0) - begin))
            first = first + place * float(stride)
        found = []
        for component in range(components):
            corners = [
                numbers.take(first + float(component + sum(map(int.__mul__, corner, strides))))
                for corner in itertools.product((0, 1), repeat=len(axes))
            ]
            for weight in reversed(weights):
                corners = [a + weight * (b - a) for a, b in zip(corners[::2], corners[1::2], strict=True)]
            found.append(corners[0])
        return found

    return at


def _tensor(
    tape: Tape, knots: Sequence[Array], c: Array, degrees: Sequence[int]
) -> Callable[[Sequence[Any]], list[Any]]:
    """Sum of products of B-splines (de Boor, *A Practical Guide to Splines*, chapter X, algorithm BSPLVB)."""
    if max(degrees) > DEGREE:
        raise TraceError(f"calls a spline of degree {max(degrees)}; up to {DEGREE} are traced")
    sizes, components = c.shape[: len(knots)], _components(c, knots)
    inner = [Run(tape, t[k : n + 1]) for t, k, n in zip(knots, degrees, sizes, strict=True)]
    whole, numbers, strides = [Run(tape, t) for t in knots], Run(tape, c), _strides(sizes, components)
    for run in inner:
        assert run.known is not None
        _increasing(run.known, "a spline")

    def at(point: Sequence[Any]) -> list[Any]:
        first: Any = 0.0
        weights = []
        for run, knot, degree, stride, x in zip(inner, whole, degrees, strides, point, strict=True):
            place = run.interval(x)
            weights.append(_basis(knot, place, degree, x))
            first = first + place * float(stride)
        found = []
        for component in range(components):
            total: Any = 0.0
            for chosen in itertools.product(*(range(k + 1) for k in degrees)):
                weight = math.prod((w[m] for w, m in zip(weights, chosen, strict=True)), start=1.0)
                offset = component + sum(map(int.__mul__, chosen, strides))
                total = total + weight * numbers.take(first + float(offset))
            found.append(total)
        return found

    return at


def _basis(knots: Run, place: Any, degree: int, x: Any) -> list[Any]:
    """B-splines that do not vanish on the interval of knots that begins at ``place + degree``."""
    near = [knots.take(place + float(r)) for r in range(1, 2 * degree + 1)]
    found: list[Any] = [1.0]
    for j in range(1, degree + 1):
        saved: Any = 0.0
        for r in range(j):
            right, left = near[degree + r], near[degree - j + r]
            part = found[r] / (right - left)
            found[r] = saved + (right - x) * part
            saved = (x - left) * part
        found.append(saved)
    return found


def _components(numbers: Array, axes: Sequence[Any]) -> int:
    return math.prod(numbers.shape[len(axes) :])


def _strides(sizes: Sequence[int], components: int) -> list[int]:
    """Distances of neighbours along each axis, in a flat table."""
    return [components * math.prod(sizes[d + 1 :]) for d in range(len(sizes))]


_CALLS: dict[str, Callable[..., Any]] = {"PPoly": _polynomials, "BSpline": _spline, "RegularGridInterpolator": _grid}
