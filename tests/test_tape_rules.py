"""Every rule of the tape, in value, first and second derivative, by mpmath with ninety digits."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.special

from test_derive import curved, evaluated
from unifg.factors.autodiff import symbols
from unifg.factors.autodiff.expression import Expression
from unifg.factors.autodiff.operations import GROUPED, STEADY, UNARY, Op
from unifg.factors.autodiff.rows import traced
from unifg.factors.autodiff.tape import Tape
from unifg.lie import Rn

mp = pytest.importorskip("mpmath")
Rule = Callable[..., Any]


def fmod(a: Any, b: Any) -> Any:
    quotient = a / b
    return a - b * (mp.floor(quotient) if quotient >= 0 else mp.ceil(quotient))


GENERIC, POSITIVE, INNER, BEYOND = (
    (-1.3, -0.2, 0.4, 1.9, 30.0),
    (0.3, 1.0, 7.0, 1e-8),
    (-0.9, 0.0, 0.3),
    (1.1, 2.0, 40.0),
)
ONE: dict[Op, tuple[Rule, tuple[float, ...]]] = {
    Op.NEGATE: (lambda a: -a, (*GENERIC, 0.0)), Op.SQRT: (mp.sqrt, POSITIVE),
    Op.SIN: (mp.sin, (*GENERIC, 0.0, math.pi)),
    Op.COS: (mp.cos, (*GENERIC, 0.0, math.pi)), Op.TAN: (mp.tan, (*GENERIC[:4], 0.0)), Op.ARCSIN: (mp.asin, INNER),
    Op.ARCCOS: (mp.acos, INNER), Op.ARCTAN: (mp.atan, (*GENERIC, 0.0)), Op.SINH: (mp.sinh, (*GENERIC, 0.0)),
    Op.COSH: (mp.cosh, (*GENERIC, 0.0)), Op.TANH: (mp.tanh, (*GENERIC[:4], 0.0)),
    Op.ARCSINH: (mp.asinh, (*GENERIC, 0.0)),
    Op.ARCCOSH: (mp.acosh, BEYOND), Op.ARCTANH: (mp.atanh, INNER), Op.ERF: (mp.erf, (*GENERIC[:4], 0.0)),
    Op.EXP: (mp.exp, (*GENERIC, 0.0)), Op.EXPM1: (mp.expm1, (*GENERIC, 0.0, 1e-9)), Op.LOG: (mp.log, POSITIVE),
    Op.LOG1P: (mp.log1p, (0.0, 1e-9, -0.5, 3.0)), Op.ABSOLUTE: (abs, GENERIC),
}  # fmt: skip
PAIRS = ((0.7, 1.9), (-1.3, 0.4), (2.5, -0.6), (-3.1, -1.2), (30.0, 7.0))
TWO: dict[Op, tuple[Rule, tuple[tuple[float, float], ...]]] = {
    Op.ADD: (lambda a, b: a + b, PAIRS), Op.SUBTRACT: (lambda a, b: a - b, PAIRS),
    Op.MULTIPLY: (lambda a, b: a * b, PAIRS), Op.DIVIDE: (lambda a, b: a / b, PAIRS),
    Op.ARCTAN2: (mp.atan2, (*PAIRS, (0.0, 1.0), (1.0, 0.0), (0.5, -1e-3))),
    Op.POWER: (lambda a, b: a**b, ((0.7, 1.9), (2.5, -0.6), (1.0, 0.0), (3.0, 2.0), (1e-3, 0.5))),
    Op.FMOD: (fmod, (*PAIRS, (7.3, 2.0), (-7.3, 2.0), (7.3, -2.0))),
    Op.MINIMUM: (min, PAIRS), Op.MAXIMUM: (max, PAIRS),
}  # fmt: skip


def stated(op: Op, count: int) -> Expression:
    """One operation on the coordinates of a vector."""
    tape = Tape()
    moved = [tape.add(tape.leaf(Op.VARIABLE, k), tape.leaf(Op.TANGENT, k)) for k in range(count)]
    return Expression(tape, (tape.apply(op, *moved),), Rn(count).dim, op.name)


def test_every_operation_with_derivatives_has_a_rule_here() -> None:
    leaves = {Op.CONSTANT, Op.VARIABLE, Op.PARAMETER, Op.WEIGHT, Op.TANGENT}
    others = {Op.SELECT, Op.ENTRY} | GROUPED | STEADY | leaves
    assert set(ONE) == (UNARY - STEADY) and set(ONE) | set(TWO) | others == set(Op)


JUDGEMENTS = (
    "equal", "not_equal", "less", "less_equal", "greater", "greater_equal", "isfinite", "isinf", "isnan",
)  # fmt: skip


@pytest.mark.parametrize("name", sorted(symbols.UFUNCS))
def test_every_ufunc_is_that_of_numpy_or_scipy(name: str) -> None:
    """At three points at least where it is finite; operators of one, two and truth values."""
    ufunc = getattr(np, name, None) or getattr(scipy.special, name)
    truth = name.startswith(("logical", "bitwise", "invert"))
    near = np.array([-2.0, -0.75, -0.1, 0.0, 0.3, 0.5, 1.0, 1.6, 3.0])
    places = np.array(np.meshgrid(*[near] * ufunc.nin)).reshape(ufunc.nin, -1).T

    def rows(x: Any) -> Any:
        given = [x[:, k : k + 1] > 0.4 if truth else x[:, k : k + 1] for k in range(ufunc.nin)]
        found = ufunc(*given)
        return np.where(found, 1.0, 0.0) if truth or name in JUDGEMENTS else found

    expression = traced(rows, [Rn(ufunc.nin)])
    with np.errstate(all="ignore"):
        expected = rows(places)
        found, _ = evaluated(expression, places, np.zeros((len(places), 0)))
    finite = np.isfinite(expected)
    assert finite.sum() >= 3
    np.testing.assert_allclose(found[finite], expected[finite], rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize("op", [*ONE, *TWO], ids=lambda op: op.name)
def test_values_and_derivatives(op: Op) -> None:
    rule, points = ONE.get(op) or TWO[op]
    count = 1 if op in ONE else 2
    expression = stated(op, count)
    for point in points:
        v = np.atleast_2d(np.array(point, dtype=float))
        nothing = np.zeros((1, 0))
        r, J = evaluated(expression, v, nothing)
        S = curved(expression, v, nothing, np.ones((1, 1)))[0]
        with mp.workdps(90):
            at = tuple(map(mp.mpf, v[0].tolist()))
            value = rule(*at)
            orders = np.eye(count, dtype=int)
            slope = [float(mp.diff(rule, at, tuple(n.tolist()))) for n in orders]
            bend = [[float(mp.diff(rule, at, tuple((n + m).tolist()))) for m in orders] for n in orders]
        np.testing.assert_allclose(r[0, 0], float(value), rtol=4e-15, atol=1e-300)
        np.testing.assert_allclose(J[0, 0], slope, rtol=1e-13, atol=1e-14)
        np.testing.assert_allclose(S, bend, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("op", sorted(STEADY - {Op.GATHER, Op.SEARCH, Op.TAKE}), ids=lambda op: Op(op).name)
def test_what_jumps_has_no_slope(op: Op) -> None:
    expression = stated(op, 1 if op in UNARY else 2)
    v = np.array([[0.7, 1.9][: expression.width]])
    nothing = np.zeros((1, 0))
    r, J = evaluated(expression, v, nothing)
    expected = {Op.SIGN: 1.0, Op.FLOOR: 0.0, Op.RINT: 1.0, Op.NOT: 0.0, Op.EQUAL: 0.0}
    assert r[0, 0] == expected.get(Op(op), 1.0) and not J.any() and not expression.slopes


@pytest.mark.parametrize(
    ("point", "value", "slope", "bend"),
    [
        ((2.0, 3.0), 4.0, [4.0, 0.0], [[2.0, 0.0], [0.0, 0.0]]),
        ((3.0, 2.0), 6.0, [2.0, 3.0], [[0.0, 1.0], [1.0, 0.0]]),
        ((2.0, 2.0), 4.0, [2.0, 2.0], [[0.0, 1.0], [1.0, 0.0]]),
    ],
)
def test_a_choice_has_the_slope_of_what_is_chosen(point: Any, value: float, slope: Any, bend: Any) -> None:
    tape = Tape()
    x, y = (tape.add(tape.leaf(Op.VARIABLE, k), tape.leaf(Op.TANGENT, k)) for k in range(2))
    chosen = tape.select(tape.apply(Op.LESS, x, y), tape.multiply(x, x), tape.multiply(x, y))
    expression, nothing = Expression(tape, (chosen,), 2, "choice"), np.zeros((1, 0))
    r, J = evaluated(expression, np.array([point]), nothing)
    S = curved(expression, np.array([point]), nothing, np.ones((1, 1)))[0]
    assert r[0, 0] == value and J[0, 0].tolist() == slope and S.tolist() == bend


@pytest.mark.parametrize("condition", [1.0, 1e5, 1e10])
@pytest.mark.parametrize("size", [1, 2, 3, 4, 6])
@pytest.mark.product(6)
def test_linear_systems_are_solved_as_well_as_their_condition_allows(size: int, condition: float) -> None:
    """Value and both derivatives by A and b, within 100 roundings times the condition number."""
    rng = np.random.default_rng(size)
    left, right = (np.linalg.qr(rng.normal(size=(size, size)))[0] for _ in range(2))
    matrix = left @ np.diag(np.geomspace(1.0, 1.0 / condition if size > 1 else 1.0, size)) @ right
    v = np.concatenate([matrix.ravel(), rng.normal(size=size)])[None]
    n = v.shape[1]

    def function(x: Any) -> Any:
        a, b = x[:, : size * size].reshape(-1, size, size), x[:, size * size :]
        return np.linalg.solve(a, b[..., None])[..., 0]

    expression, nothing, w = traced(function, (Rn(n),)), np.zeros((1, 0)), rng.normal(size=(1, size))
    r, J = evaluated(expression, v, nothing)
    S = curved(expression, v, nothing, w)[0]
    with mp.workdps(60):
        inverse = mp.matrix(matrix.tolist()) ** -1
        Y = np.array(inverse.tolist(), dtype=object)
        x = Y @ np.array([mp.mpf(float(b)) for b in v[0, size * size :]], dtype=object)
        slope = np.zeros((size, n), dtype=object)
        bend = np.zeros((n, n), dtype=object)
        z = np.array([mp.mpf(float(weight)) for weight in w[0]], dtype=object) @ Y
        for i in range(size):
            slope[:, size * size + i] = Y[:, i]
            for j in range(size):
                slope[:, i * size + j] = -Y[:, i] * x[j]
                for k in range(size):  # by an entry of A and one of b, and by two entries of A
                    bend[i * size + j, size * size + k] = bend[size * size + k, i * size + j] = -z[i] * Y[j, k]
                    for m in range(size):
                        bend[i * size + j, k * size + m] = z[i] * Y[j, k] * x[m] + z[k] * Y[m, i] * x[j]
        expected = [np.array(part, dtype=float) for part in (x, slope, bend)]
    for found, true in zip((r[0], J[0], S), expected, strict=True):
        error = np.abs(found - true).max() / np.abs(true).max()
        assert error <= 100.0 * np.finfo(float).eps * condition


def test_a_system_that_needs_pivots_is_solved() -> None:
    function: Rule = lambda x: np.linalg.inv(np.stack([x[:, :2] - 1.0, x[:, 2:]], axis=1))[:, 0]  # noqa: E731
    expression = traced(function, (Rn(4),))
    v = np.array([[1.0, 3.0, 2.0, 5.0]])  # the first pivot is zero
    np.testing.assert_allclose(evaluated(expression, v, np.zeros((1, 0)))[0], function(v), rtol=1e-15)
    assert np.isfinite(curved(expression, v, np.zeros((1, 0)), np.ones((1, 2)))).all()
