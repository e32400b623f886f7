"""Models written in CasADi as residuals: values and derivatives are CasADi's own."""

from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.graphs import graph_with
from test_derive import compared, curved, evaluated
from unifg.errors import ModelError
from unifg.factors.autodiff.rows import traced
from unifg.lie import SE2, Rn
from unifg.solvers import KKT
from unifg.typing import Array

ca = pytest.importorskip("casadi")


def race_car(kind: Any) -> Any:
    """One Runge-Kutta step of a car on tyres that slip: Liniger, Domahidi and Morari 2015, eq. 1 to 3, cars of 1:43."""
    x, u, y = kind.sym("x", 6), kind.sym("u", 2), kind.sym("y", 6)
    h = kind.sym("h")

    def F(x: Any) -> Any:
        psi, forwards, sideways, turning = x[2], x[3], x[4], x[5]
        duty, steer = u[0], u[1]
        front = steer - ca.atan2(sideways + 0.029 * turning, forwards)
        rear = -ca.atan2(sideways - 0.033 * turning, forwards)
        grip_front = 0.192 * ca.sin(1.2 * ca.atan(2.579 * front))
        grip_rear = 0.1737 * ca.sin(1.2691 * ca.atan(3.3852 * rear))
        drive = (0.287 - 0.0545 * forwards) * duty - 0.0518 - 0.00035 * forwards**2
        return ca.vertcat(
            forwards * ca.cos(psi) - sideways * ca.sin(psi),
            forwards * ca.sin(psi) + sideways * ca.cos(psi),
            turning,
            (drive - grip_front * ca.sin(steer)) / 0.041 + sideways * turning,
            (grip_rear + grip_front * ca.cos(steer)) / 0.041 - forwards * turning,
            (grip_front * 0.029 * ca.cos(steer) - grip_rear * 0.033) / 27.8e-6,
        )

    k1 = F(x)
    k2 = F(x + h / 2 * k1)
    k3 = F(x + h / 2 * k2)
    k4 = F(x + h * k3)
    return ca.Function("race_car", [x, u, y, h], [y - x - h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])


def everything() -> Any:
    """One row for every instruction there is."""
    a, b = ca.SX.sym("a"), ca.SX.sym("b")
    small, big = 0.3 * ca.tanh(a), 1.5 + b * b
    rows = [
        a + b, a - b, a * b, a / big, -a, ca.exp(small), ca.log(big), ca.power(big, a), a**3, big**0.7, ca.sqrt(big),
        a**2, 2 * a, ca.sin(a), ca.cos(a), ca.tan(small), ca.asin(small), ca.acos(small), ca.atan(a), ca.floor(a),
        ca.ceil(b), ca.fmod(a, 0.7), ca.remainder(b, 0.9), ca.fabs(a), ca.sign(b), ca.copysign(a, b), ca.erf(a),
        ca.fmin(a, b), ca.fmax(a * b, 0.1), 1 / big, ca.sinh(a), ca.cosh(b), ca.tanh(a), ca.asinh(a), ca.acosh(big),
        ca.atanh(small), ca.atan2(a, b), ca.log1p(a * a), ca.expm1(b), ca.hypot(a, big), ca.if_else(a < b, a * a, b),
        ca.if_else(ca.logic_and(a > 0, b <= 0.2), ca.sin(a), b), ca.if_else(ca.logic_or(a == b, a != 0), a, b),
        ca.if_else(ca.logic_not(a > 0), a * b, b), 2 * (a > 0) - (b > 0), ca.constpow(big, 1.3),
    ]  # fmt: skip
    return ca.Function("everything", [a, b], [ca.vertcat(*rows)])


def as_casadi_says(function: Any, values: list[Array], weights: Array, width: int) -> tuple[Array, Array, Array]:
    """Residuals, Jacobians and Hessians of every row of a batch by its variables, the first ``width`` numbers."""
    inputs = [ca.SX.sym(f"x{k}", *function.size_in(k)) for k in range(function.n_in())]
    v, w = ca.vertcat(*(ca.vec(x) for x in inputs))[:width], ca.SX.sym("w", max(function.size_out(0)))
    z = ca.vertcat(*(ca.vec(x) for x in inputs))
    flat = ca.SX.sym("z", z.shape[0])
    at, parts = 0, []
    for x in inputs:
        parts.append(ca.reshape(flat[at : at + x.numel()], *x.shape))
        at += x.numel()
    r = ca.vec(function(*parts))
    J, H = ca.jacobian(r, flat)[:, :width], ca.hessian(ca.dot(w, r), flat)[0][:width, :width]
    whole = ca.Function("whole", [flat, w], [r, J, H])
    found = []
    for k in range(len(weights)):
        row = np.concatenate([np.ravel(value[k], order="F") for value in values])
        found.append([np.array(part) for part in whole(row, weights[k])])
    assert v.shape[0] == width
    return np.array([f[0].ravel() for f in found]), np.array([f[1] for f in found]), np.array([f[2] for f in found])


def agrees(function: Any, arguments: tuple[Any, ...], values: list[Array]) -> None:
    f = fg.from_casadi(function)
    assert f.name == function.name()
    expression = traced(f.function, arguments)
    width = sum(a.dim for a in arguments if not isinstance(a, tuple))
    count = len(values[0])
    weights = np.random.default_rng(1).normal(size=(count, max(function.size_out(0))))
    r, J, H = as_casadi_says(function, values, weights, width)
    split = [k for k, a in enumerate(arguments) if isinstance(a, tuple)]
    variables = np.concatenate([v for k, v in enumerate(values) if k not in split], axis=1)
    parameters = [values[k].reshape(count, -1) for k in split]
    shared = np.ascontiguousarray(np.concatenate(parameters, axis=1)) if parameters else np.zeros((1, 0))
    found, slopes = evaluated(expression, variables, shared)
    compared(found, r)
    compared(slopes, J)
    compared(curved(expression, variables, shared, weights), H)
    compared(np.asarray(f(*values)), r)  # called with arrays


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
def test_a_race_car(kind: Any) -> None:
    rng = np.random.default_rng(0)
    x = rng.normal([0, 0, 0, 1.5, 0, 0], [1, 1, 2, 0.3, 0.2, 2.0], (8, 6))
    u, y = rng.normal(0.2, 0.2, (8, 2)), x + 0.1 * rng.normal(size=(8, 6))
    agrees(race_car(kind), (Rn(6), Rn(2), Rn(6), ()), [x, u, y, np.full(8, 0.02)])


def test_every_instruction() -> None:
    a, b = np.random.default_rng(3).normal(size=(2, 40, 1))
    agrees(everything(), (Rn(1), Rn(1)), [a, b])


def test_matrices_and_what_is_not_stored() -> None:
    """A sparse input and a sparse, lying output; parameters in CasADi's order of columns."""
    A, x = ca.SX.sym("A", ca.Sparsity.lower(3)), ca.SX.sym("x", 3)
    B = ca.SX.sym("B", 2, 3)
    out = ca.SX(1, 4)
    out[0, 1], out[0, 3] = ca.dot(x, A @ x), ca.sum1(ca.sin(B @ x))
    rng = np.random.default_rng(5)
    values = [rng.normal(size=(5, 3)), np.tril(rng.normal(size=(5, 3, 3))), rng.normal(size=(5, 2, 3))]
    f = fg.from_casadi(ca.Function("mixed", [x, A, B], [out]))
    quadratic = np.einsum("ni,nij,nj->n", values[0], values[1], values[0])
    wave = np.sin(np.einsum("nij,nj->ni", values[2], values[0])).sum(axis=1)
    expected = np.stack([0 * wave, quadratic, 0 * wave, wave], axis=1)
    np.testing.assert_allclose(f(*values), expected, rtol=0, atol=1e-13)
    np.testing.assert_allclose(f(values[0], values[1][0], values[2][0])[0], expected[0], rtol=0, atol=1e-13)
    expression = traced(f.function, (Rn(3), (3, 3), (2, 3)))
    shared = np.ascontiguousarray(np.concatenate([values[1].reshape(5, 9), values[2].reshape(5, 6)], axis=1))
    r, J = evaluated(expression, values[0], shared)
    np.testing.assert_allclose(r, expected, rtol=0, atol=1e-13)
    symmetric = values[1] + np.swapaxes(values[1], 1, 2)
    np.testing.assert_allclose(J[:, 1], np.einsum("nij,nj->ni", symmetric, values[0]), rtol=0, atol=1e-13)


def test_in_a_graph_on_a_manifold() -> None:
    x = ca.SX.sym("x", 3)
    wall = fg.from_casadi(ca.Function("wall", [x], [x[0] * ca.cos(0.3) + x[1] * ca.sin(0.3) - 2.0]))
    graph, pose = graph_with(SE2, 2, "pose")
    graph.minimize(fg.prior, pose, np.array([[3.0, 1.0, 0.5], [0.0, 0.0, 0.0]]))
    graph.constrain(wall, pose[0], lower=0.0, upper=0.0)
    solution = KKT().solve(graph, {pose: np.zeros((2, 3))}, check=True)
    assert float(wall(solution[pose])[0, 0]) == pytest.approx(0.0, abs=1e-6)


X = ca.SX.sym("x", 2)
M = ca.MX.sym("m", 2)
TABLE = ca.interpolant("g", "bspline", [[0, 1, 2, 3.0]], [0, 1, 4, 9.0])


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (lambda x: x, "takes a casadi.Function, found function"),
        (ca.Function("f", [X], [X, X]), r"'f' has 1 inputs and returns \[\(2, 1\), \(2, 1\)\]"),
        (ca.Function("f", [X], [X @ X.T]), r"returns \[\(2, 2\)\], not a vector"),
        (ca.Function("f", [], [ca.SX(2, 1)]), "has 0 inputs"),
        (
            ca.Function("f", [M], [TABLE(M[0])]),
            "contains the instruction CALL",
        ),
        (ca.Function("inverse_erf", [X], [ca.erfinv(X)]), "'inverse_erf' contains the instruction ERFINV"),
    ],
)
def test_what_is_no_residual_is_refused(function: Any, words: str) -> None:
    with pytest.raises(ModelError, match=words):
        fg.from_casadi(function)


@pytest.mark.parametrize("wrong", [np.zeros(3), np.zeros((4, 3)), np.zeros((2, 2, 2)), 1.0])
def test_arguments_of_another_size_are_refused(wrong: Any) -> None:
    with pytest.raises(ModelError, match="takes 2 by 1 numbers here"):
        fg.from_casadi(ca.Function("f", [X], [X]))(wrong)
