"""Traced functions: their values, Jacobians and Hessians against CasADi's, and against the functions themselves."""

import math
from collections.abc import Callable, Sequence
from types import FunctionType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

import unifg as fg
from unifg.factors.autodiff.expression import Expression
from unifg.factors.autodiff.rows import traced
from unifg.factors.kernel import Argument, evaluate_rows
from unifg.lie import SE2, SE3, SE23, SO2, SO3, Rn
from unifg.typing import Array

Function = Callable[..., Any]
POSE = fg.Product(p=Rn(3), R=SO3, v=Rn(3))
WEIGHTS = np.arange(12.0).reshape(4, 3) / 7 - 0.6


def helper(x: Array) -> Any:
    return np.sin(x[:, 0]) * x[:, 1]


def cart_pole(x: Array, u: Array) -> Array:
    s, c = np.sin(x[:, 1]), np.cos(x[:, 1])
    push = u[:, 0] + 0.2 * s * (0.5 * x[:, 3] ** 2 + 9.81 * c)
    turn = -u[:, 0] * c - 0.1 * x[:, 3] ** 2 * c * s - 1.2 * 9.81 * s
    return np.stack([x[:, 2], x[:, 3], push / (1 + 0.2 * s**2), turn / (0.5 * (1 + 0.2 * s**2))], axis=1)


def runge_kutta(x: Array, u: Array, y: Array) -> Array:
    h = 0.05
    k1 = cart_pole(x, u)
    k2 = cart_pole(x + h / 2 * k1, u)
    k3 = cart_pole(x + h / 2 * k2, u)
    k4 = cart_pole(x + h * k3, u)
    return y - (x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4))


def filled(x: Array, y: Array) -> Array:
    r = np.zeros((len(x), 4))
    r[:, :3] = np.cross(x, y)
    r[:, 3] = np.linalg.norm(x - y, axis=1)
    r[:, 0] += x[:, 1]
    return r


def looped(x: Array) -> Array:
    total = np.zeros(len(x))
    for k in range(x.shape[1]):
        total = total + np.cos(k * x[:, k])
    return total[:, None]


def matrix_step(x: Array, u: Array) -> Any:
    A = np.array([[0.0, 1.0, 0.3], [-1.0, 0.2, 0.0], [0.1, 0.0, -0.5]])
    return x @ A.T + np.tanh(u) * 0.1


# Rn(4) and Rn(3) to residuals, as a user writes them.
PLAIN: dict[str, Function] = {
    "linear": lambda x, y: x[:, :3] - 2 * y,
    "product": lambda x, y: x[:, :3] * y,
    "quotient": lambda x, y: x[:, :3] / (2 + y**2),
    "powers": lambda x, y: np.stack([x[:, 0] ** 3, x[:, 1] ** -2, np.abs(y[:, 0]) ** 1.7, y[:, 1] ** 5], axis=1),
    "power of both": lambda x, y: (1.5 + np.sin(x[:, :3])) ** y,
    "sine and cosine": lambda x, y: np.sin(x[:, :3]) * np.cos(y),
    "tangent": lambda x, y: np.tan(0.3 * x[:, :3] + 0.1 * y),
    "arcsine": lambda x, y: np.arcsin(0.2 * x[:, :3]) + np.arccos(0.1 * y),
    "arctan": lambda x, y: np.arctan(x[:, :3] * y),
    "arctan2": lambda x, y: np.arctan2(x[:, :3], y),
    "hyperbolic": lambda x, y: np.sinh(x[:, :3]) - np.cosh(y) + np.tanh(x[:, 3:]),
    "exponential": lambda x, y: np.exp(0.3 * x[:, :3]) * np.expm1(y),
    "logarithm": lambda x, y: np.log(1.5 + x[:, :3] ** 2) + np.log1p(y**2),
    "root": lambda x, y: np.sqrt(1 + x[:, :3] ** 2 + y**2),
    "absolute": lambda x, y: np.abs(x[:, :3]) * np.sign(y),
    "minimum": lambda x, y: np.minimum(x[:, :3], y) + np.maximum(x[:, :3] ** 2, 0.1),
    "hinge": lambda x, y: np.maximum(0.0, 0.5 - np.hypot(x[:, 0] - y[:, 0], x[:, 1] - y[:, 1]))[:, None],
    "clip": lambda x, y: np.clip(x[:, :3], -0.5, 0.7) * y,
    "where": lambda x, y: np.where(x[:, :3] > y, x[:, :3] ** 2, np.exp(y)),
    "where of both": lambda x, y: np.where((x[:, :3] > 0) & (y <= 0.3), x[:, :3] * y, x[:, :3] - y),
    "guarded quotient": lambda x, y: np.where(
        np.abs(x[:, :3]) < 0.2, 1 - x[:, :3] ** 2 / 6, np.sin(x[:, :3]) / np.where(x[:, :3] == 0, 1.0, x[:, :3])
    ),
    "norm": lambda x, y: (np.linalg.norm(x[:, :3] - y, axis=1) - 1.0)[:, None],
    "squared norm": lambda x, y: np.sum(x**2, axis=1, keepdims=True),
    "einsum": lambda x, y: np.einsum("ni,ij->nj", x, WEIGHTS) * y,
    "einsum of both": lambda x, y: np.einsum("ni,nj->nij", x[:, :3], y).reshape(len(x), -1),
    "matmul": lambda x, y: x @ WEIGHTS - y,
    "stacked matmul": lambda x, y: (y[:, None, :] @ y[:, :, None])[:, 0],
    "cross": lambda x, y: np.cross(x[:, :3], y),
    "concatenate": lambda x, y: np.concatenate([x * x, np.flip(y, axis=1)], axis=1),
    "stack": lambda x, y: np.stack([x[:, 0] * y[:, 0], np.sum(y, axis=1)], axis=1),
    "column": lambda x, y: np.column_stack((helper(x), helper(y))),
    "mean": lambda x, y: np.mean(x, axis=1, keepdims=True) * y,
    "product of all": lambda x, y: np.prod(x, axis=1, keepdims=True) - y,
    "accumulated": lambda x, y: np.cumsum(x * x, axis=1),
    "differences": lambda x, y: np.diff(x**3, axis=1) + y,
    "roll": lambda x, y: np.roll(x, 1, axis=1) * x,
    "zeros and fill": lambda x, y: filled(x[:, :3], y),
    "loop": lambda x, y: looped(x),
    "nested": lambda x, y: np.exp(np.sin(x[:, :1] * np.cos(y) ** 2)),
    "determinant": lambda x, y: np.linalg.det(np.einsum("ni,nj->nij", x[:, :3], y) + 2 * np.eye(3))[:, None],
    "inverse": lambda x, y: (np.linalg.inv(x.reshape(-1, 2, 2) ** 2 + 3 * np.eye(2))).reshape(len(x), -1),
    "matrix constant": lambda x, y: matrix_step(x[:, :3], y),
    "runge-kutta": lambda x, y: runge_kutta(x, y[:, :1], np.concatenate([y, x[:, :1]], axis=1)),
    "remainder": lambda x, y: np.remainder(x[:, :3], 0.7) * y,
    "logaddexp": lambda x, y: np.logaddexp(x[:, :3], y),
    "reciprocal": lambda x, y: np.reciprocal(2.5 + x[:, :3]) + np.square(y),
    "degrees": lambda x, y: np.sin(np.deg2rad(x[:, :3])) + np.rad2deg(y),
    "trace of a product": lambda x, y: np.einsum("ni,ni->n", x[:, :3], y)[:, None] ** 2,
    "constant row": lambda x, y: np.stack([np.full(len(x), 2.0), x[:, 0]], axis=1),
    "greatest": lambda x, y: np.max(x, axis=1, keepdims=True) + np.min(y, axis=1, keepdims=True),
}

GROUPS: dict[str, tuple[Function, tuple[Argument, ...]]] = {
    "between on SE2": (lambda x, y, z: SE2.local(z, SE2.between(x, y)), (SE2, SE2, (3,))),
    "prior on SE2": (lambda x, z: SE2.log(SE2.compose(SE2.inverse(z), x)), (SE2, (3,))),
    "act on SE2": (lambda x, p: SE2.act(x, p), (SE2, Rn(2))),
    "retract on SE2": (lambda x, d: SE2.log(SE2.retract(x, 0.3 * d)), (SE2, Rn(3))),
    "heading": (lambda x, p: fg.wrap_angle(np.arctan2(p[:, 1], p[:, 0]) - x[:, 0])[:, None], (SO2, Rn(2))),
    "between on SO2": (lambda x, y: SO2.local(x, y), (SO2, SO2)),
    "local on SO3": (lambda x, y: SO3.local(x, y), (SO3, SO3)),
    "act on SO3": (lambda x, p: SO3.act(x, p), (SO3, Rn(3))),
    "exp on SO3": (lambda x, d: SO3.local(x, SO3.exp(d)), (SO3, Rn(3))),
    "matrix of SO3": (lambda x: SO3.matrix(x).reshape(len(x), 9), (SO3,)),
    "between on SE3": (lambda x, y, z: SE3.local(z, SE3.between(x, y)), (SE3, SE3, (7,))),
    "act on SE3": (lambda x, p: SE3.act(SE3.inverse(x), p), (SE3, Rn(3))),
    "exp on SE3": (lambda x, d: SE3.local(x, SE3.exp(d)), (SE3, Rn(6))),
    "between on SE23": (lambda x, y, z: SE23.local(z, SE23.between(x, y)), (SE23, SE23, (10,))),
    "act on SE23": (lambda x, p: SE23.act(SE23.inverse(x), p), (SE23, Rn(3))),
    "exp on SE23": (lambda x, d: SE23.local(x, SE23.exp(d)), (SE23, Rn(9))),
    "matrix of SE23": (lambda x: SE23.matrix(x).reshape(len(x), 25), (SE23,)),
    "Jacobian on SE23": (lambda d: SE23.right_jacobian_inverse(d).reshape(len(d), 81), (Rn(9),)),
    "product": (lambda x, y: POSE.local(x, y), (POSE, POSE)),
    "bearing": (lambda x, p: SE3.act(SE3.inverse(x), p)[:, :2] / 3.0, (SE3, Rn(3))),
}


def points(arguments: Sequence[Argument], count: int, seed: int = 0) -> list[Array]:
    """One batch per argument; parameters on manifolds of the same size are points of them."""
    rng = np.random.default_rng(seed)
    like: dict[Any, Any] = {(3,): SE2, (7,): SE3, (10,): SE23}
    drawn = []
    for argument in arguments:
        manifold: Any = like.get(argument, argument) if isinstance(argument, tuple) else argument
        drawn.append(manifold.random(rng, (count,)))
    return drawn


def packed(arguments: Sequence[Argument], values: Sequence[Array]) -> tuple[Array, Array]:
    """Variables and parameters side by side."""
    count = len(values[0])
    variables = [v for a, v in zip(arguments, values, strict=True) if not isinstance(a, tuple)]
    shared = [v.reshape(count, -1) for a, v in zip(arguments, values, strict=True) if isinstance(a, tuple)]
    parameters = np.concatenate(shared, axis=1) if shared else np.zeros((1, 0))
    return np.ascontiguousarray(np.concatenate(variables, axis=1)), np.ascontiguousarray(parameters)


def evaluated(expression: Expression, variables: Array, parameters: Array) -> tuple[Array, Array]:
    """Residuals and Jacobians by the machine code."""
    code = expression.residual()
    r = np.full((len(variables), len(expression.rows)), np.nan)
    J = np.full((*r.shape, expression.width), np.nan)
    evaluate_rows(code.address, variables, parameters, expression.table, r, J)
    return r, J


def curved(expression: Expression, variables: Array, parameters: Array, weights: Array) -> Array:
    """Hessians of w' r by the machine code."""
    code = expression.second()
    S = np.full((len(variables), expression.width, expression.width), np.nan)
    for k in range(len(variables)):
        shared = parameters[min(k, len(parameters) - 1)][None]
        evaluate_rows(code.address, variables[k][None], shared, expression.table, weights[k][None].copy(), S[k][None])
    return S


# ---------------------------------------------------------------- the oracle


class Open(np.ndarray[Any, np.dtype[Any]]):
    """An array of objects whose comparisons stay open."""

    def __lt__(self, other: Any) -> Any:
        return np.frompyfunc(lambda a, b: a < b, 2, 1)(self, other)

    def __le__(self, other: Any) -> Any:
        return np.frompyfunc(lambda a, b: a <= b, 2, 1)(self, other)

    def __gt__(self, other: Any) -> Any:
        return np.frompyfunc(lambda a, b: a > b, 2, 1)(self, other)

    def __ge__(self, other: Any) -> Any:
        return np.frompyfunc(lambda a, b: a >= b, 2, 1)(self, other)

    def __eq__(self, other: object) -> Any:
        return np.frompyfunc(lambda a, b: a == b, 2, 1)(self, other)

    def __and__(self, other: Any) -> Any:
        return np.frompyfunc(lambda a, b: a * b, 2, 1)(self, other)


def numpy_of_casadi() -> Any:
    """NumPy for CasADi's numbers."""
    ca = pytest.importorskip("casadi")
    ca.GlobalOptions.setNumpyMode(-1)

    def each(scalar: Function, count: int) -> Function:
        batch = np.frompyfunc(scalar, count, 1)
        return lambda *a: batch(*a) if any(isinstance(part, np.ndarray) for part in a) else scalar(*a)

    def norm(a: Any, axis: int) -> Any:
        return each(ca.sqrt, 1)(np.sum(a * a, axis=axis))

    def like_numpy(shape: Any) -> Any:
        array = np.empty(shape, dtype=object)
        array[...] = ca.SX(0)
        return array

    def array(values: Any) -> Any:  # NumPy's own would look into them
        if not isinstance(values, list | tuple | np.ndarray):
            return values
        parts = [array(value) for value in values]
        whole = np.empty((len(parts), *np.shape(parts[0] if isinstance(parts[0], np.ndarray) else 0)), dtype=object)
        for k, part in enumerate(parts):
            whole[k] = part
        return whole.view(Open)

    def inverse(a: Any) -> Any:
        found = ca.inv(ca.vertcat(*(ca.horzcat(*row) for row in a[0])))
        return np.array([[[found[i, j] for j in range(len(a[0]))] for i in range(len(a[0]))]], dtype=object)

    def determinant(a: Any) -> Any:
        return np.array([ca.det(ca.vertcat(*(ca.horzcat(*row) for row in a[0])))], dtype=object)

    names = {
        "arctan2": each(ca.atan2, 2), "hypot": each(lambda a, b: ca.sqrt(a * a + b * b), 2),
        "maximum": each(ca.fmax, 2), "minimum": each(ca.fmin, 2), "abs": each(ca.fabs, 1), "sign": each(ca.sign, 1),
        "clip": lambda a, low, high: each(lambda x: ca.fmin(ca.fmax(x, low), high), 1)(a),
        "where": lambda c, a, b: each(ca.if_else, 3)(c, a, b),
        "remainder": each(lambda a, b: a - ca.floor(a / b) * b, 2),
        "logaddexp": each(lambda a, b: ca.log(ca.exp(a) + ca.exp(b)), 2), "reciprocal": lambda a: 1 / a,
        "square": lambda a: a * a, "deg2rad": lambda a: a * (math.pi / 180), "rad2deg": lambda a: a * (180 / math.pi),
        "array": array, "zeros": like_numpy, "full": lambda shape, x: like_numpy(shape) + x,
        "max": lambda a, axis, keepdims: np.array([[ca.mmax(ca.vertcat(*a[0]))]], dtype=object),
        "min": lambda a, axis, keepdims: np.array([[ca.mmin(ca.vertcat(*a[0]))]], dtype=object),
        "linalg": SimpleNamespace(norm=norm, inv=inverse, det=determinant),
    }  # fmt: skip

    class Namespace:  # of NumPy
        def __getattr__(self, name: str) -> Any:
            return names.get(name, getattr(np, name))

    return Namespace()


def oracle(function: Function) -> Function:
    """The same function, where NumPy's names mean CasADi's."""

    def rebound(f: FunctionType) -> FunctionType:
        inside = {k: rebound(v) if isinstance(v, FunctionType) and v is not f and v.__module__ == f.__module__ else v
                  for k, v in f.__globals__.items() if k in f.__code__.co_names}  # fmt: skip
        return FunctionType(f.__code__, {**f.__globals__, **inside, "np": numpy_of_casadi()}, f.__name__)

    return rebound(function)  # type: ignore[arg-type]


def compared(found: Array, expected: Array) -> None:
    """Equal to 1e-12 of the largest."""
    assert found.shape == expected.shape
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * max(1.0, float(np.abs(expected).max())))


def compared_with_casadi(function: Function, *values: Array) -> None:
    """Value as the function's own, value, Jacobian and Hessian as CasADi's."""
    ca = pytest.importorskip("casadi")
    spaces = [Rn(value.shape[1]) for value in values]
    expression, (variables, parameters) = traced(function, spaces), packed(spaces, values)
    r, J = evaluated(expression, variables, parameters)
    np.testing.assert_allclose(r, function(*values), rtol=1e-14, atol=1e-14)
    symbols = ca.SX.sym("v", variables.shape[1])
    entries = np.array([symbols[k] for k in range(symbols.shape[0])], dtype=object)[None].view(Open)
    splits = np.cumsum([space.dim for space in spaces])[:-1]
    rows = ca.vertcat(*oracle(function)(*np.split(entries, splits, axis=1)).ravel())
    w = ca.SX.sym("w", rows.shape[0])
    theirs = ca.Function("f", [symbols, w], [rows, ca.jacobian(rows, symbols), ca.hessian(ca.dot(w, rows), symbols)[0]])
    weights = np.random.default_rng(1).normal(size=r.shape)
    answers = [[np.asarray(part) for part in theirs(v, q)] for v, q in zip(variables, weights, strict=True)]
    compared(r, np.array([a[0].ravel() for a in answers]))
    compared(J, np.array([a[1] for a in answers]))
    compared(curved(expression, variables, parameters, weights), np.array([a[2] for a in answers]))


@pytest.mark.parametrize("name", PLAIN)
@pytest.mark.product(25)
def test_values_jacobians_and_hessians_are_casadis(name: str) -> None:
    compared_with_casadi(PLAIN[name], *points((Rn(4), Rn(3)), 6))


@pytest.mark.parametrize("name", GROUPS)
@pytest.mark.product(8)
def test_derivatives_on_groups_are_those_of_the_function(name: str) -> None:
    """Fourth-order differences of what the function itself computes along the retraction."""
    function, arguments = GROUPS[name]
    values = points(arguments, 8)
    expression = traced(function, arguments, name=name)
    variables, parameters = packed(arguments, values)
    r, J = evaluated(expression, variables, parameters)
    np.testing.assert_allclose(r, function(*values), rtol=0, atol=1e-13)

    slots = [(i, d) for i, a in enumerate(arguments) if not isinstance(a, tuple) for d in range(a.dim)]  # type: ignore[union-attr]

    def along(steps: dict[int, float]) -> Array:
        moved = list(values)
        for i, manifold in enumerate(arguments):
            own = {d: steps[k] for k, (j, d) in enumerate(slots) if j == i and k in steps}
            if own:
                assert not isinstance(manifold, int | tuple)
                step = np.zeros(manifold.dim)
                step[list(own)] = list(own.values())
                moved[i] = manifold.retract(values[i], step)
        return np.asarray(function(*moved))

    h = 1e-3
    for k in range(len(slots)):
        wide, near = along({k: 2 * h}) - along({k: -2 * h}), along({k: h}) - along({k: -h})
        np.testing.assert_allclose(J[:, :, k], (8 * near - wide) / (12 * h), rtol=0, atol=3e-9)

    weights = np.random.default_rng(1).normal(size=r.shape)
    S = curved(expression, variables, parameters, weights)
    np.testing.assert_array_equal(S, np.swapaxes(S, 1, 2))
    for k in range(len(slots)):
        for j in range(k, len(slots)):

            def corner(a: float, b: float, k: int = k, j: int = j) -> Any:
                steps = {k: a * h} if k != j else {k: (a + b) * h / 2}
                if k != j:
                    steps[j] = b * h
                return np.sum(weights * along(steps), axis=1)

            both = corner(1, 1) - corner(1, -1) - corner(-1, 1) + corner(-1, -1)
            expected = both / (4 * h * h) if k != j else both / (h * h)
            np.testing.assert_allclose(S[:, k, j], expected, rtol=0, atol=3e-5)


# ---------------------------------------------------------------- random expressions


def random_function(seed: int) -> Function:
    """An expression of three variables, drawn."""
    rng = np.random.default_rng(seed)
    text = [f"x[:, {k}]" for k in range(3)] + ["(0.7 + 0 * x[:, 0])"]
    for _ in range(25):
        a, b = (text[int(k)] for k in rng.integers(len(text), size=2))
        shape = int(rng.integers(9))
        text.append(
            [
                f"np.sin({a} + {b})", f"({a} * {b})", f"({a} - {b})", f"np.tanh({a})", f"np.sqrt(1 + {a} ** 2)",
                f"np.exp(-(({a}) ** 2))", f"({a} / (1.5 + np.cos({b})))", f"np.where({a} < {b}, {a}, {b} ** 2)",
                f"np.arctan2({a}, 1.1 + np.abs({b}))",
            ][shape]
        )  # fmt: skip
        text = [t for t in text if len(t) < 700]
    source = f"lambda x: np.stack([{', '.join(text[-4:])}], axis=1) + 0 * x[:, :1]"
    function: Function = eval(source, {"np": np, "__name__": __name__})
    return function


@pytest.mark.parametrize("seed", range(40))
@pytest.mark.product(20)
def test_random_expressions(seed: int) -> None:
    compared_with_casadi(random_function(seed), np.random.default_rng(seed).normal(size=(4, 3)))


def test_a_function_that_closes_over_numbers() -> None:
    mass, gains = 2.0, np.array([1.0, -3.0])
    expression = traced(lambda x: mass * x @ gains[:, None], (Rn(2),))
    r, J = evaluated(expression, np.array([[1.0, 2.0]]), np.zeros((1, 0)))
    np.testing.assert_array_equal(r, [[-10.0]])
    np.testing.assert_array_equal(J, [[[2.0, -6.0]]])


def test_second_derivatives_of_products_that_share_their_slopes() -> None:
    """The slope of x cos(y) is a node that the other row has: it stands for what it depends on, once."""

    def turned(x: Array) -> Array:
        s, c = np.sin(x[:, 1] + 2.0 * x[:, 2]), np.cos(x[:, 1] + 2.0 * x[:, 2])
        return np.stack([x[:, 0] * c, x[:, 0] * s, x[:, 0] * s / c], axis=1)

    x, w = np.array([[0.7, 0.3, -0.4]]), np.array([[0.6, -1.1, 0.9]])
    S = curved(traced(turned, (Rn(3),)), x, np.zeros((1, 0)), w)[0]
    angle, along = x[0, 1] + 2.0 * x[0, 2], np.array([1.0, 2.0])
    s, c = np.sin(angle), np.cos(angle)
    slope = w[0] @ [-s, c, 1.0 / c**2]
    bend = x[0, 0] * (w[0] @ [-c, -s, 2.0 * s / c**3])
    np.testing.assert_allclose(S[0], [0.0, *(slope * along)], atol=1e-14)
    np.testing.assert_allclose(S[1:, 1:], bend * np.outer(along, along), atol=1e-14)
