"""Traced functions: their values and derivatives against the functions themselves and their differences."""

from collections.abc import Callable, Sequence
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


# Rn(4) and Rn(3) to residuals, as a user writes them; what else NumPy has stands in test_derive_numpy.py.
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
    "minimum": lambda x, y: np.minimum(x[:, :3], y) + np.maximum(x[:, :3] ** 2, 0.12),
    "hinge": lambda x, y: np.maximum(0.0, 0.5 - np.hypot(x[:, 0] - y[:, 0], x[:, 1] - y[:, 1]))[:, None],
    "where": lambda x, y: np.where(x[:, :3] > y, x[:, :3] ** 2, np.exp(y)),
    "where of both": lambda x, y: np.where((x[:, :3] > 0) & (y <= 0.3), x[:, :3] * y, x[:, :3] - y),
    "guarded quotient": lambda x, y: np.where(
        np.abs(x[:, :3]) < 0.2, 1 - x[:, :3] ** 2 / 6, np.sin(x[:, :3]) / np.where(x[:, :3] == 0, 1.0, x[:, :3])
    ),
    "stacked matmul": lambda x, y: (y[:, None, :] @ y[:, :, None])[:, 0],
    "concatenate": lambda x, y: np.concatenate([x * x, np.flip(y, axis=1)], axis=1),
    "nested": lambda x, y: np.exp(np.sin(x[:, :1] * np.cos(y) ** 2)),
    "reciprocal": lambda x, y: np.reciprocal(2.5 + x[:, :3]) + np.square(y),
    "degrees": lambda x, y: np.sin(np.deg2rad(x[:, :3])) + np.rad2deg(y),
    "constant row": lambda x, y: np.stack([np.full(len(x), 2.0), x[:, 0]], axis=1),
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


# ---------------------------------------------------------------- differences


def compared(found: Array, expected: Array) -> None:
    """Equal to 1e-12 of the largest."""
    assert found.shape == expected.shape
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * max(1.0, float(np.abs(expected).max())))


def differences(function: Function, arguments: Sequence[Argument], values: Sequence[Array]) -> Array:
    """(n, ..., D) fourth-order differences of a function along the retractions of its variables."""
    h, slopes = 2e-4, []
    for i, manifold in enumerate(arguments):
        if isinstance(manifold, int | tuple):
            continue
        for step in h * np.eye(manifold.dim):
            moved = [[*values[:i], manifold.retract(values[i], k * step), *values[i + 1 :]] for k in (1, -1, 2, -2)]
            ahead, behind, far_ahead, far_behind = (np.asarray(function(*points)) for points in moved)
            slopes.append((8.0 * (ahead - behind) - (far_ahead - far_behind)) / (12.0 * h))
    return np.stack(slopes, axis=-1)


def bends(
    expression: Expression, arguments: Sequence[Argument], values: Sequence[Array], weights: Array
) -> tuple[Array, Array]:
    """Hessians of w' r by the machine code, and by differences of its Jacobians.

    Along an exponential a second derivative is the symmetric part of the first derivatives' derivative.
    """

    def pull(*moved: Array) -> Array:
        return np.asarray(np.einsum("nm,nmd->nd", weights, evaluated(expression, *packed(arguments, moved))[1]))

    differenced = differences(pull, arguments, values)
    found = curved(expression, *packed(arguments, values), weights)
    np.testing.assert_array_equal(found, np.swapaxes(found, 1, 2))
    return found, 0.5 * (differenced + np.swapaxes(differenced, 1, 2))


def compared_with_differences(
    expression: Expression, function: Function, arguments: Sequence[Argument], values: Sequence[Array]
) -> None:
    """Value as the function's own, Jacobian as its differences, Hessian as those of the Jacobian."""
    r, J = evaluated(expression, *packed(arguments, values))
    np.testing.assert_allclose(r, function(*values), rtol=0, atol=1e-13 * max(1.0, float(np.abs(r).max())))
    slopes = differences(function, arguments, values)
    np.testing.assert_allclose(J, slopes, rtol=0, atol=1e-8 * (1.0 + np.abs(slopes).max()))
    found, expected = bends(expression, arguments, values, np.random.default_rng(1).normal(size=r.shape))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8 * (1.0 + np.abs(expected).max()))


CASES = {**{name: (function, (Rn(4), Rn(3))) for name, function in PLAIN.items()}, **GROUPS}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.product(30)
def test_derivatives_are_those_of_the_function(name: str) -> None:
    function, arguments = CASES[name]
    compared_with_differences(traced(function, arguments, name=name), function, arguments, points(arguments, 6))


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
    function = random_function(seed)
    compared_with_differences(traced(function, (Rn(3),)), function, (Rn(3),), points((Rn(3),), 4, seed))


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
