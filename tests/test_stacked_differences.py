"""Derivatives by differences of a user's batched function: few calls, and right numbers whatever the function knows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.graphs import graph_of, graph_with, program_of
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.hessian import lagrangian_hessian
from unifg.problem.linearization import Linearization
from unifg.solvers import SQP, AugmentedLagrangian, InteriorPoint
from unifg.typing import Array

N, STATES, CONTROLS = 9, 12, 3
RNG = np.random.default_rng(3)
X, U, PULL = RNG.standard_normal((N + 1, STATES)), RNG.standard_normal((N, CONTROLS)), RNG.standard_normal((N, STATES))
SLOPE, ROWS = RNG.standard_normal((STATES, STATES + CONTROLS)), RNG.standard_normal((N, STATES))


def straight(x: Array, u: Array, after: Array) -> Array:
    """A linear system of 27 columns."""
    return np.asarray(after - np.einsum("ab,nb->na", SLOPE, np.hstack([x, u])))


def bent(x: Array, u: Array, after: Array) -> Array:
    """The same with products and a sine in some of its rows."""
    found = straight(x, u, after)
    found[:, 0] += x[:, 3] * u[:, 0]
    found[:, 5] += np.sin(x[:, 4]) * after[:, 1]
    return found


def bent_hessian(x: Array, after: Array, pull: Array) -> Array:
    """(N, 27, 27) of ``bent``: columns of x, u, after."""
    expected = np.zeros((N, 2 * STATES + CONTROLS, 2 * STATES + CONTROLS))
    product, sine = STATES, STATES + CONTROLS + 1
    expected[:, 3, product] = expected[:, product, 3] = pull[:, 0]
    expected[:, 4, sine] = expected[:, sine, 4] = pull[:, 5] * np.cos(x[:, 4])
    expected[:, 4, 4] = -pull[:, 5] * np.sin(x[:, 4]) * after[:, 1]
    return expected


class Counted:
    """A function that counts its calls."""

    def __init__(self, function: Callable[..., Array]) -> None:
        self.function, self.calls = function, 0

    def __call__(self, *arguments: Array) -> Array:
        self.calls += 1
        return self.function(*arguments)


def chain(function: Callable[..., Array], *more: Any) -> tuple[CompiledProblem, Linearization]:
    """A graph of one dynamics term evaluated by NumPy, at the points above."""
    graph = fg.Graph()
    function = fg.residual(function, derivatives="differences")
    x, u = graph.variables("x", fg.Rn(STATES), N + 1), graph.variables("u", fg.Rn(CONTROLS), N)
    graph.constrain(function, x[:-1], u, x[1:], *more, lower=0.0, upper=0.0, name="motion")
    program = program_of(graph)
    return program, program.linearize(program.values_from({x: X, u: U}))


def second(program: CompiledProblem, lin: Linearization, pull: Array = PULL) -> Array:
    """(N, 27, 27) second derivatives of the one term."""
    return program.terms[0].second_derivatives(lin.values, pull)


@pytest.mark.parametrize("function", [straight, bent])
def test_derivatives_take_few_calls(function: Callable[..., Array]) -> None:
    """One call for each perturbation made 54 of a Jacobian, and 1567 of second derivatives."""
    counted = Counted(function)
    program, lin = chain(counted)
    counted.calls = 0
    program.linearize(lin.values)
    assert counted.calls == 2, "one for the residual, one for the Jacobian"
    counted.calls = 0
    lagrangian_hessian(program, lin, PULL.ravel())
    assert counted.calls <= 2, "one to see what bends, one for pairs of what does"


def test_long_batches_are_cut() -> None:
    """Memory does not grow with the number of columns."""
    longest = 0

    def wide(x: Array) -> Array:
        nonlocal longest
        longest = max(longest, x.size)
        return np.asarray((x**2).sum(axis=1, keepdims=True))

    graph, x = graph_with(fg.Rn(40), 200)
    graph.minimize(wide, x, name="wide")
    program = program_of(graph)
    program.linearize(program.values_from({x: RNG.standard_normal((200, 40))}))
    assert 200 * 40 < longest <= 1 << 15


def test_second_derivatives_are_exact() -> None:
    program, lin = chain(bent)
    np.testing.assert_allclose(second(program, lin), bent_hessian(X[:-1], X[1:], PULL), atol=1e-6)
    assert not second(*chain(straight)).any(), "what is straight has none, not even rounding"


def test_rows_without_weight_have_no_second_derivatives() -> None:
    program, lin = chain(bent)
    pull = PULL.copy()
    pull[:, 5] = 0.0
    pull[4] = 0.0
    np.testing.assert_allclose(second(program, lin, pull), bent_hessian(X[:-1], X[1:], pull), atol=1e-6)


ALIKE = ("knows its rows", "knows the index", "counts", "one by one", "given rows", "given each", "shared by chance")


@pytest.mark.parametrize("derivatives", ["differences", None])
@pytest.mark.parametrize("which", ALIKE)
def test_functions_that_know_their_batch(which: str, derivatives: Any) -> None:
    """Long batches are for functions of one factor after the other; all others get what they were written for.

    So are traces, of which the last three are.
    """
    index = np.arange(N)
    more: tuple[Any, ...] = ()
    weight = ROWS
    if which == "knows its rows":
        function: Callable[..., Array] = lambda x, u, after: bent(x, u, after) + ROWS * x**2  # noqa: E731
    elif which == "knows the index":
        weight = np.repeat(index[:, None] * 0.1, STATES, axis=1)
        function = lambda x, u, after: bent(x, u, after) + 0.1 * np.arange(len(x))[:, None] * x**2  # noqa: E731
    elif which == "counts":
        weight = np.full((N, STATES), 1.0 / N)
        function = lambda x, u, after: bent(x, u, after) + x**2 / len(x)  # noqa: E731
    elif which == "one by one":

        def function(x: Array, u: Array, after: Array) -> Array:
            found = [bent(x[i : i + 1], u[i : i + 1], after[i : i + 1])[0] + ROWS[i] * x[i] ** 2 for i in index]
            return np.stack(found)

    else:
        function = lambda x, u, after, own: bent(x, u, after) + own * x**2  # noqa: E731
        more = (ROWS,)
        if which == "shared by chance":  # as long as the batch, and no row for each factor
            weight = np.tile(ROWS.sum(axis=0), (N, 1))
            function = lambda x, u, after, own: bent(x, u, after) + own.sum(axis=0) * x**2  # noqa: E731
    graph, x, u = graph_of(("x", fg.Rn(STATES), N + 1), ("u", fg.Rn(CONTROLS), N))
    if which == "given each":
        more = (graph.data("rows", ROWS, each=True),)
    stated = fg.residual(function, derivatives=derivatives)
    graph.constrain(stated, x[:-1], u, x[1:], *more, lower=0.0, upper=0.0, name="motion")
    program = program_of(graph)
    lin = program.linearize(program.values_from({x: X, u: U}))
    expected = bent_hessian(X[:-1], X[1:], PULL)
    diagonal = np.arange(STATES)
    expected[:, diagonal, diagonal] += 2.0 * PULL * weight
    np.testing.assert_allclose(second(program, lin), expected, atol=1e-5)
    slope = program.terms[0].jacobians(lin.values)[1]
    gain = np.tile(-SLOPE[:, STATES:], (N, 1, 1))
    gain[:, 0, 0] += X[:-1, 3]
    np.testing.assert_allclose(slope, gain, atol=1e-8)


def test_a_function_may_refuse_points_that_only_the_trial_asks_for() -> None:
    """Residuals raise outside their domain; differences at the guess stay within it."""

    def edge(x: Array) -> Array:
        if (np.abs(x) > 1e-4).any():
            raise ValueError("outside")
        return x + x**2

    graph, x = graph_with(fg.Rn(2), 3)
    graph.minimize(edge, x, name="edge")
    program = program_of(graph)
    lin = program.linearize(program.values_from({x: np.zeros((3, 2))}))
    np.testing.assert_allclose(lin.jacobian.reshape(3, 2, 2), np.tile(np.eye(2), (3, 1, 1)), atol=1e-9)


@pytest.mark.parametrize("derivatives", ["differences", "trace"])
def test_rows_for_each_factor_may_change(derivatives: Any) -> None:
    graph, x = graph_with(fg.Rn(2), 5)
    own = graph.data("own", np.ones((5, 2)), each=True)
    graph.minimize(fg.residual(lambda x, own: own * x**2, derivatives=derivatives), x, own, name="term")
    program = graph.compile()
    for scale in (1.0, 3.0):
        program.bind({own: np.full((5, 2), scale)})
        values = program.values_from({x: np.ones((5, 2))})
        found = program.terms[0].second_derivatives(values, np.ones((5, 2)))
        np.testing.assert_allclose(found, np.tile(2.0 * scale * np.eye(2), (5, 1, 1)), atol=1e-6)


@pytest.mark.parametrize("derivatives", ["differences", "trace"])
def test_a_term_may_be_straight_at_one_point_and_bent_at_another(derivatives: Any) -> None:
    """Straight terms are examined again: a hinge that is inactive at the guess bends later."""
    graph, x = graph_with(fg.Rn(3), 4)
    hinge = fg.residual(lambda x: np.maximum(x[:, :1] - 1.0, 0.0) * x[:, 1:2], derivatives=derivatives)
    graph.constrain(hinge, x, upper=0.0, name="hinge")
    program = program_of(graph)
    at = np.zeros((4, 3))
    term, pull = program.terms[0], np.ones((4, 1))
    assert not term.second_derivatives(program.values_from({x: at}), pull).any()
    at[2] = 2.0, 5.0, 0.0
    expected = np.zeros((4, 3, 3))
    expected[2, 0, 1] = expected[2, 1, 0] = 1.0
    np.testing.assert_allclose(term.second_derivatives(program.values_from({x: at}), pull), expected, atol=1e-6)


@pytest.mark.parametrize("solver", [AugmentedLagrangian(), InteriorPoint(), SQP(hessian="exact")])
def test_solves_do_not_depend_on_how_a_function_is_called(solver: fg.Solver) -> None:
    """The same problem by a function that takes long batches and by one that refuses them."""

    def long(x: Array, u: Array, after: Array) -> Array:
        return after - x - 0.2 * np.column_stack([u[:, 0] * np.cos(x[:, 2]), u[:, 0] * np.sin(x[:, 2]), u[:, 1]])

    def short(x: Array, u: Array, after: Array) -> Array:
        assert len(x) == 10
        return long(x, u, after)

    found = []
    for function in (long, short):
        graph, x, u = graph_of(("x", fg.Rn(3), 11), ("u", fg.Rn(2), 10))
        graph.fix(x[0], np.zeros(3))
        graph.minimize(lambda u: u, u, name="effort")
        graph.constrain(function, x[:-1], u, x[1:], lower=0.0, upper=0.0, name="motion")
        graph.constrain(lambda x: x - np.array([1.0, 0.4, 0.0]), x[-1], lower=0.0, upper=0.0, name="goal")
        graph.constrain(
            lambda x: ((x[:, :2] - np.array([0.5, 0.1])) ** 2).sum(axis=1, keepdims=True),
            x[1:-1],
            lower=0.04,
            name="disc",
        )
        found.append(solver.solve(graph, {x: np.linspace([0, 0, 0], [1.0, 0.4, 0.0], 11), u: np.ones((10, 2))}))
    assert found[0].converged
    assert found[0].iterations == found[1].iterations
    assert found[0].cost == pytest.approx(found[1].cost, rel=1e-9)
