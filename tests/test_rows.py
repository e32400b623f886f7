"""Rows of arrays and of batches, decided by the structure of a function and never by its values."""

import types
from collections.abc import Callable
from typing import Any, cast

import numpy as np
import pytest

import unifg as fg
from problems.graphs import graph_with
from unifg.errors import GraphError
from unifg.factors.autodiff.captured import captured_by
from unifg.factors.autodiff.lookup import Lookup
from unifg.factors.autodiff.rows import Common, Each, RowsError, Shared, lengths_for, traced_rows
from unifg.factors.autodiff.symbols import Length, symbols
from unifg.problem import traced
from unifg.solvers import SQP, AugmentedLagrangian, GaussNewton, InteriorPoint
from unifg.typing import Array

Function = Callable[..., Any]
N = 9
AWAY = np.array([0.0, 50.0])
RNG = np.random.default_rng(4)
NODES = np.column_stack([np.linspace(0.0, 4.0, N), 0.05 * RNG.normal(size=N)])
OBSTACLES = np.column_stack([np.linspace(0.0, 4.0, N), np.full(N, 3.0)])
OBSTACLES[7], OBSTACLES[2] = (2.05, 0.2), (1.05, 0.2)  # near a node of another row, and near that of its own


def clearance(x: Array, c: Array) -> Array:
    """Distance to the nearest obstacle, capped at a metre."""
    gap = np.linalg.norm(x[:, None] - c[None], axis=2).min(axis=1, keepdims=True)
    return np.asarray(np.minimum(gap, 1.0) - 0.5)


def own_clearance(x: Array, c: Array) -> Array:
    """Distance to the obstacle of the same row, capped at a metre."""
    return np.asarray(np.minimum(np.linalg.norm(x - c, axis=1, keepdims=True), 1.0) - 0.5)


def route(function: Function, *arguments: Any, count: int = 6, size: int = 3) -> str:
    """Route of the only term of a graph."""
    graph, x = graph_with(fg.Rn(size), count)
    graph.minimize(function, x, *arguments, name="term")
    return graph.compile().terms[0].route


@pytest.mark.product(12)
@pytest.mark.parametrize("given", ["constant", "data", "closure", "attribute", "changed"])
@pytest.mark.parametrize("function", [clearance, own_clearance])
@pytest.mark.parametrize("solver", [InteriorPoint(), SQP(), AugmentedLagrangian()], ids=lambda s: s.name)
def test_a_flat_guess_does_not_decide_how_an_array_is_read(solver: fg.Solver, function: Function, given: str) -> None:
    """Nine nodes, nine obstacles, a guess where the constraint is flat: both readings agree there and only there."""
    array = np.zeros_like(OBSTACLES) if given == "changed" else OBSTACLES.copy()
    scene = types.ModuleType("scene")
    setattr(scene, "c", array)  # noqa: B010
    graph, x = graph_with(fg.Rn(2), N)
    graph.minimize(lambda x, a: x - a, x, NODES)
    called: dict[str, tuple[Function, tuple[Any, ...]]] = {
        "data": (function, (x, graph.data("c", array))),
        "closure": (lambda x: function(x, array), (x,)),
        "attribute": (lambda x: function(x, scene.c), (x,)),
    }
    stated, arguments = called.get(given, (function, (x, array)))
    graph.constrain(stated, *arguments, lower=0.0, upper=10.0, name="clear")
    prepared = solver.prepare(graph)
    guess = {x: NODES - AWAY}
    if given == "changed":
        prepared.solve(guess)
        array[:] = OBSTACLES
    solution = prepared.solve(guess)
    assert all(term.route == "traced, its derivatives exact" for term in prepared.program.terms)
    true = float(np.maximum(-np.asarray(function(solution[x], OBSTACLES)), 0.0).max())
    assert solution.converged and solution.violation == pytest.approx(true, abs=1e-12)
    assert np.asarray(function(NODES, OBSTACLES)).min() < -0.2  # the constraint matters at the answer
    expected, y = graph_with(fg.Rn(2), N)
    expected.minimize(lambda x, a: x - a, y, NODES)
    declared = fg.shared(OBSTACLES) if function is clearance else fg.each(OBSTACLES)
    expected.constrain(function, y, declared, lower=0.0, upper=10.0)
    np.testing.assert_allclose(solution[x], solver.solve(expected, {y: NODES - AWAY})[y], atol=1e-6)


def test_a_reported_cost_is_that_of_the_function() -> None:
    graph, x = graph_with(fg.Rn(2), N)
    graph.minimize(lambda x: 100.0 * np.maximum(0.5 - np.linalg.norm(x[:, None] - OBSTACLES, axis=2), 0.0).sum(
        axis=1, keepdims=True), x)  # fmt: skip
    graph.minimize(lambda x, a: x - a, x, NODES)
    solution = GaussNewton().solve(graph, {x: NODES - AWAY})
    inside = np.maximum(0.5 - np.linalg.norm(solution[x][:, None] - OBSTACLES, axis=2), 0.0).sum(axis=1)
    expected = 0.5 * (100.0 * inside) @ (100.0 * inside) + 0.5 * ((solution[x] - NODES) ** 2).sum()
    assert solution.cost == pytest.approx(expected, rel=1e-9)


WEIGHTS, ROWS = RNG.uniform(1.0, 2.0, 6), RNG.normal(size=(6, 3))
EXACT = "traced, its derivatives exact"


@pytest.mark.parametrize(
    ("function", "arguments", "expected"),
    [
        (lambda x, c: x - c, (ROWS,), EXACT),
        (lambda x, c: x - c[0], (ROWS,), EXACT),
        (lambda x, c: x - c.mean(axis=0), (ROWS,), EXACT),
        (lambda x, w: x * w[:, None], (WEIGHTS,), EXACT),
        (lambda x, w: x * w.sum(), (WEIGHTS,), EXACT),
        (lambda x, w, c: x * w.max() - c, (WEIGHTS, ROWS), EXACT),
        (lambda x: np.zeros((len(x), 3)) + np.ones((x.shape[0], 1)) * x, (), EXACT),
        (lambda x: np.stack([2.0 * row for row in x]), (), EXACT),
        (lambda x, k: x * k[:, None], (np.arange(6),), EXACT),
        (lambda x, k: x if k[0] > 1 else 2.0 * x, (np.arange(6),), EXACT),
        (lambda x, k: np.where(k[:, None], x, 2.0 * x), (WEIGHTS > 1.5,), EXACT),
        (lambda x, w: x * w[:, None] / w.sum(), (WEIGHTS,), "rows of other factors"),
        (lambda x, c: x - (c - c.mean(axis=0)), (ROWS,), "rows of other factors"),
        (lambda x: x * np.arange(len(x))[:, None], (), "which factor"),
        (lambda x, k: x[np.arange(len(x)), k][:, None], (np.arange(6) % 3,), "number that is not known"),
        (lambda x: x * len(x), (), "traced on the whole batch, its derivatives exact"),
        (lambda x: x if len(x) > 5 else 2.0 * x, (), "traced on the whole batch, its derivatives exact"),
        (lambda x: np.where(np.arange(len(x))[:, None] > 40, 2.0 * x, x), (), "traced on the whole batch, its"),
    ],
)
def test_rows_are_read_off_the_expressions(function: Function, arguments: tuple[Any, ...], expected: str) -> None:
    assert expected in route(function, *arguments)


@pytest.mark.parametrize(
    "function",
    [
        lambda x: np.where(np.arange(len(x))[:, None] > 40, 2.0 * x, x),
        lambda x: np.concatenate([x[:50], 2.0 * x[50:]]),
        lambda x: x if len(x) > 7 else 2.0 * x,
        lambda x: x * (1.0 if x.shape[0] // 10 else 2.0),
        lambda x: np.stack([row if k < 40 else 2.0 * row for k, row in enumerate(x)]),
        lambda x: np.stack([x[k] if k < 40 else 2.0 * x[k] for k in range(len(x))]),
        lambda x: x * np.linspace(1.0, 2.0, len(x))[:, None],
    ],
)
def test_long_batches_that_two_short_ones_do_not_decide_stay_in_python(function: Function) -> None:
    """At two short lengths their rows look alike: only the use of the length tells."""
    count = traced.WHOLE + 1
    assert "which factor they belong to" in route(function, count=count)
    graph, x = graph_with(fg.Rn(3), count)
    graph.minimize(function, x, name="term")
    program = graph.compile()
    values = program.values_from({x: np.ones((count, 3))})
    np.testing.assert_array_equal(program.terms[0].residual(values), function(np.ones((count, 3))))


def test_a_batch_of_one_is_asked_nothing() -> None:
    assert route(lambda x, c: x - c[0] * len(x), ROWS[:1], count=1) == EXACT


@pytest.mark.parametrize("derivatives", [None, "trace", "differences"])
@pytest.mark.parametrize(
    "function",
    [
        lambda x, c: x - 0.5 * x.mean(axis=0) - c,
        lambda x, c: 2.0 * x - x[0] - c,
        lambda x, c: 2.0 * x - np.roll(x, 1, axis=0) - c,
        lambda x, c: np.minimum(np.abs(x[:, None] - x[None]).sum(axis=1), 1e-9) - c,
    ],
)
def test_rows_that_depend_on_other_variables_are_an_error(function: Function, derivatives: Any) -> None:
    with pytest.raises(GraphError, match=r"term 'term': the rows of factor \d change when") as raised:
        route(fg.residual(function, derivatives=derivatives), ROWS)
    assert raised.value.term == "term"


@pytest.mark.parametrize("make", ["data", "constant"])
def test_what_is_declared_is_obeyed(make: str) -> None:
    """A function in Python may read an array in both ways; a declaration leaves only one."""

    def declared(graph: fg.Graph, value: Array, each: bool) -> Any:
        if make == "data":
            return graph.data("c", value, each=each)
        return fg.each(value) if each else fg.shared(value)

    for each, expected in ((True, ROWS), (False, ROWS[0])):
        graph, x = graph_with(fg.Rn(3), 6)
        function: Function = (lambda x, c: x - c) if each else (lambda x, c: x - c[0])
        graph.minimize(function, x, declared(graph, ROWS, each), name="term")
        assert graph.compile().terms[0].route == EXACT
        found = GaussNewton().solve(graph, {x: np.zeros((6, 3))})[x]
        np.testing.assert_allclose(found, expected + np.zeros((6, 3)), atol=1e-9)
        wrong, y = graph_with(fg.Rn(3), 6)
        wrong.minimize(function, y, declared(wrong, ROWS, not each), name="term")
        assert wrong.compile().terms[0].route.startswith("evaluated by Python")


def test_declarations_are_checked() -> None:
    graph, x = graph_with(fg.Rn(3), 6)
    with pytest.raises(GraphError, match=r"argument 1, by fg\.each, has 5"):
        graph.minimize(lambda x, c: x - c, x, fg.each(ROWS[:5]))


def test_unclear_arrays_of_functions_in_python_get_a_call_for_each_move() -> None:
    """Tiled as rows, an array that all share would be another one."""
    lengths = set[int]()

    def seen(x: Array, c: Array) -> Array:
        lengths.add(len(x))
        return np.asarray(x - float(np.max(c)))

    for argument in (WEIGHTS, fg.shared(WEIGHTS), fg.each(WEIGHTS)):
        graph, x = graph_with(fg.Rn(3), 6)
        graph.minimize(seen, x, argument, name="term")
        program = graph.compile()
        values = program.values_from({x: np.zeros((6, 3))})
        lengths.clear()
        program.terms[0].jacobians(values)
        assert (lengths == {6}) == (argument is WEIGHTS)


def test_lengths_avoid_the_dimensions_of_arguments() -> None:
    assert lengths_for([fg.Rn(7)]) == (2, 3)
    assert lengths_for([fg.Rn(2), Each((3, 5)), Shared((9, 2)), Common(fg.SE2)]) == (4, 6)


def test_uses_of_a_length_are_noted() -> None:
    def used(use: Function) -> bool:
        Length.used = False
        use(Length(4))
        found, Length.used = Length.used, False
        return found

    makers: list[Function] = [lambda n: n == 1, lambda n: n < 0, lambda n: n == Length(4), lambda n: n + 1, np.zeros]
    others: list[Function] = [lambda n: n > 2, lambda n: n // 2, lambda n: n / 2, float, lambda n: n * 2 > 5]
    assert not any(used(use) for use in makers) and all(used(use) for use in others)
    assert type(symbols((4, 2)).shape[0]) is int


def test_mixed_inputs_are_named() -> None:
    function = lambda x, c: x + c[:1]  # noqa: E731
    with pytest.raises(RowsError) as raised:
        traced_rows(function, [fg.Rn(2), Each((2,))], [], (3, 4))
    assert raised.value.mixed == {1} and raised.value.row == 1
    assert captured_by(function).key is not None


class Stairs(Lookup):
    """A table that is read at whole numbers."""

    def __call__(self, x: Array) -> Array:
        return cast(Array, self.take(np.clip(np.floor(x), 0.0, 2.0)) * x)


def test_tables_are_read_in_batches() -> None:
    """Two tables, of which the second stands behind the first."""
    first, second = Stairs([1.0, 2.0, 4.0]), Stairs([10.0, 20.0, 40.0, 80.0])
    graph, x = graph_with(fg.Rn(1), 3)
    graph.minimize(fg.residual(lambda x: first(x) + second(x), derivatives="trace"), x)
    program = graph.compile()
    assert program.terms[0].route.startswith("traced")
    lin = program.linearize({x: np.array([[0.5], [1.5], [2.5]])})
    np.testing.assert_allclose(lin.residual, [5.5, 33.0, 110.0])
    np.testing.assert_allclose(lin.jacobian, [11.0, 22.0, 44.0])
