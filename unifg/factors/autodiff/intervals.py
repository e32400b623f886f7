"""Bounds of the rows of an expression over boxes of its arguments, by interval arithmetic on its tape.

Each operation is given the bounds of what it takes and rounds outwards (R. E. Moore, R. B. Kearfott, M. J. Cloud,
"Introduction to Interval Analysis", 2009). What appears twice counts as independent, so bounds are wider than the range
and approach it as boxes get small. Where an operation has no rule here, its bounds are infinite.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from unifg.factors.autodiff.expression import Expression
from unifg.factors.autodiff.operations import Op
from unifg.factors.autodiff.tape import NUMPY
from unifg.typing import Array, BoolArray

Interval = tuple[Array, Array]
RISING = frozenset(
    {Op.SQRT, Op.ARCSIN, Op.ARCTAN, Op.SINH, Op.TANH, Op.ARCSINH, Op.ERF, Op.EXP, Op.EXPM1, Op.LOG, Op.LOG1P}
)
STEPS = frozenset({Op.FLOOR, Op.RINT, Op.SIGN, Op.MINIMUM, Op.MAXIMUM})  # rise in every argument, without rounding
ULPS = 2.0 * np.finfo(float).eps  # error of an operation, relative


def bounds(expression: Expression, variables: Interval, parameters: Interval) -> Interval:
    """(n, m) least and greatest values of the rows over n boxes.

    Args:
        expression: traced.
        variables: (n, storage) least and greatest numbers that store its variables.
        parameters: (n, p) the same of its parameters.
    """
    tape, count = expression.tape, len(variables[0])
    known: dict[int, Interval] = {}
    with np.errstate(all="ignore"):
        for i in tape.live(expression.rows):
            op, a, b, c = Op(tape.op[i]), tape.a[i], tape.b[i], tape.c[i]
            if op in (Op.VARIABLE, Op.PARAMETER):
                low, high = variables if op == Op.VARIABLE else parameters
                known[i] = low[:, a], high[:, a]
            elif op in (Op.CONSTANT, Op.TANGENT):
                number = np.full(count, tape.value[i] if op == Op.CONSTANT else 0.0)
                known[i] = number, number
            else:
                low, high = _applied(op, [known[k] for k in (a, b, c) if k >= 0 and k in known], a == b)
                sound = ~(np.isnan(low) | np.isnan(high))
                known[i] = np.where(sound, low, -np.inf), np.where(sound, high, np.inf)
    low, high = (np.stack([known[row][side] for row in expression.rows], axis=1) for side in (0, 1))
    return low, high


def _applied(op: Op, given: list[Interval], twice: bool) -> Interval:
    """Bounds of one operation; of ``twice`` the same argument."""
    first = given[0]
    if op in STEPS:
        return NUMPY[op](*(low for low, _ in given)), NUMPY[op](*(high for _, high in given))
    if op in RISING:
        return _wider(NUMPY[op](first[0]), NUMPY[op](first[1]))
    if op == Op.NEGATE:
        return -first[1], -first[0]
    if op == Op.ABSOLUTE:
        return _absolute(first)
    if op in (Op.SIN, Op.COS):
        return _wave(first, 0.5 if op == Op.SIN else 0.0)
    rule = RULES.get(op)
    if op == Op.MULTIPLY and twice:
        low, high = _absolute(first)
        low, high = _wider(low * low, high * high)
        return np.maximum(low, 0.0), high
    return rule(*given) if rule else (np.full_like(first[0], -np.inf), np.full_like(first[0], np.inf))


def _wider(low: Array, high: Array) -> Interval:
    """Bounds with the rounding of an operation."""
    return low - ULPS * np.abs(low) - 5e-324, high + ULPS * np.abs(high) + 5e-324


def _absolute(x: Interval) -> Interval:
    low = np.where((x[0] <= 0.0) & (x[1] >= 0.0), 0.0, np.minimum(np.abs(x[0]), np.abs(x[1])))
    return low, np.maximum(np.abs(x[0]), np.abs(x[1]))


def _wave(x: Interval, quarter: float) -> Interval:
    """Bounds of cos(x - quarter pi): its crests lie at even multiples of pi, its troughs at odd ones."""
    low, high = x[0] / np.pi - quarter, x[1] / np.pi - quarter
    ends = np.cos(np.pi * low), np.cos(np.pi * high)

    def within(first: float) -> BoolArray:
        margin = ULPS * (2.0 + np.abs(low) + np.abs(high))
        return 2.0 * np.ceil((low - margin - first) / 2.0) + first <= high + margin

    error = ULPS * (2.0 + np.pi * (np.abs(low) + np.abs(high)))
    least = np.where(within(1.0), -1.0, np.minimum(*ends) - error)
    return np.maximum(least, -1.0), np.minimum(np.where(within(0.0), 1.0, np.maximum(*ends) + error), 1.0)


def _products(x: Interval, y: Interval) -> Interval:
    ends = np.stack([a * b for a in x for b in y])
    return _wider(ends.min(axis=0), ends.max(axis=0))


def _quotients(x: Interval, y: Interval) -> Interval:
    """Infinite where the divisor may be zero."""
    through = (y[0] <= 0.0) & (y[1] >= 0.0)
    low, high = _products(x, _wider(1.0 / y[1], 1.0 / y[0]))
    return np.where(through, -np.inf, low), np.where(through, np.inf, high)


def _compared(certain: BoolArray, possible: BoolArray) -> Interval:
    return certain.astype(float), possible.astype(float)


def _chosen(condition: Interval, x: Interval, y: Interval) -> Interval:
    """The hull of what may be chosen."""
    always, never = condition[0] > 0.0, condition[1] <= 0.0
    low = np.where(always, x[0], np.where(never, y[0], np.minimum(x[0], y[0])))
    return low, np.where(always, x[1], np.where(never, y[1], np.maximum(x[1], y[1])))


RULES: dict[Op, Callable[..., Interval]] = {
    Op.ADD: lambda x, y: _wider(x[0] + y[0], x[1] + y[1]),
    Op.SUBTRACT: lambda x, y: _wider(x[0] - y[1], x[1] - y[0]),
    Op.MULTIPLY: _products,
    Op.DIVIDE: _quotients,
    Op.LESS: lambda x, y: _compared(x[1] < y[0], x[0] < y[1]),
    Op.LESS_EQUAL: lambda x, y: _compared(x[1] <= y[0], x[0] <= y[1]),
    Op.AND: lambda x, y: (np.minimum(x[0], y[0]), np.minimum(x[1], y[1])),
    Op.OR: lambda x, y: (np.maximum(x[0], y[0]), np.maximum(x[1], y[1])),
    Op.NOT: lambda x: (1.0 - x[1], 1.0 - x[0]),
    Op.SELECT: _chosen,
}
