"""Inputs of a solve, tick after tick: data that change or do not, and guesses that were touched."""

from __future__ import annotations

import pickle
from collections import Counter
from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.graphs import graph_with
from unifg.problem.binding import Binding
from unifg.problem.by_term import ByTerm
from unifg.problem.columns import Values
from unifg.problem.compiled_problem import compile_graph
from unifg.problem.term import Bound, CompiledTerm
from unifg.solvers import SQP, AugmentedLagrangian, InteriorPoint
from unifg.typing import Array


class Stated:
    """Two positions: the first is fixed by data, and every part of the statement of the second reads data."""

    def __init__(self) -> None:
        self.graph = graph = fg.Graph()
        self.x = graph.variables("x", fg.Rn(2), 2)
        self.start = graph.data("start", [0.0, 0.0])
        self.wanted = graph.data("wanted", [[1.0, 2.0], [3.0, 4.0]], each=True)
        self.sigma = graph.data("sigma", 1.0)
        self.limit = graph.data("limit", 10.0)
        self.on = graph.data("on", np.array([True, True]))
        self.idle = graph.data("idle", [0.0])
        graph.fix(self.x[0], self.start)
        graph.minimize(fg.prior, self.x, self.wanted, sigma=self.sigma, active=self.on, name="prior")
        graph.minimize(fg.prior, self.x[1], self.start, sigma=1.0, name="near")
        graph.bound(self.x[1], upper=self.limit, name="limit")
        self.guess = {self.x: np.zeros((2, 2))}


def bindings(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Counts how often terms are worked out anew."""
    counted: Counter[str] = Counter()
    bind = CompiledTerm.bind

    def counting(term: CompiledTerm, data: Bound) -> None:
        counted[term.name] += 1
        bind(term, data)

    monkeypatch.setattr(CompiledTerm, "bind", counting)
    return counted


def expected(start: Array, wanted: Array, sigma: float, limit: float, on: bool = True) -> Array:
    """Solution by hand: a weighted mean, cut off at the limit (diagonal Hessian)."""
    weight = on / sigma**2
    return np.asarray(np.minimum((weight * wanted[1] + start) / (weight + 1.0), limit))


def test_every_datum_reaches_what_reads_it_and_comes_back_to_its_default() -> None:
    stated = Stated()
    run = InteriorPoint(tolerance=1e-9).prepare(stated.graph)
    start, wanted = np.zeros(2), np.array([[1.0, 2.0], [3.0, 4.0]])
    given: list[tuple[dict[fg.Data, Any], Array]] = [
        ({}, expected(start, wanted, 1.0, 10.0)),
        ({stated.wanted: wanted + 1.0}, expected(start, wanted + 1.0, 1.0, 10.0)),
        ({stated.start: [1.0, -1.0]}, expected(np.array([1.0, -1.0]), wanted, 1.0, 10.0)),
        ({stated.sigma: 0.5}, expected(start, wanted, 0.5, 10.0)),
        ({stated.limit: 1.0}, expected(start, wanted, 1.0, 1.0)),
        ({stated.on: np.array([True, False])}, expected(start, wanted, 1.0, 10.0, on=False)),
        ({stated.idle: [5.0]}, expected(start, wanted, 1.0, 10.0)),
        ({stated.wanted: np.asfortranarray(wanted)[::-1]}, expected(start, wanted[::-1], 1.0, 10.0)),
        ({stated.wanted: wanted.astype(np.float32)}, expected(start, wanted, 1.0, 10.0)),
    ]
    for data, answer in given + given[::-1]:
        solution = run.solve(stated.guess, data=data, check=True)
        np.testing.assert_allclose(solution[stated.x[1]][0], answer, atol=1e-6, err_msg=str(data))
        np.testing.assert_array_equal(solution[stated.x[0]][0], data.get(stated.start, start))


def test_what_has_not_changed_is_not_worked_out_again(monkeypatch: pytest.MonkeyPatch) -> None:
    stated = Stated()
    run = InteriorPoint().prepare(stated.graph)
    counted = bindings(monkeypatch)
    wanted = np.array([[1.0, 2.0], [3.0, 5.0]])
    for _ in range(3):  # given anew, and the same
        run.solve(stated.guess, data={stated.wanted: wanted.copy(), stated.start: [1.0, 0.0]})
    assert not counted, "parameters of kernels are copied, never worked out"
    run.solve(stated.guess, data={stated.sigma: 2.0})
    run.solve(stated.guess, data={stated.sigma: 2.0})
    assert counted == {"prior": 1}
    run.solve(stated.guess, data={stated.limit: 2.0})
    assert counted == {"prior": 2, "limit": 1}, "the other one returned to its default"


def test_a_default_may_be_changed_in_place_or_replaced() -> None:
    stated = Stated()
    run = InteriorPoint(tolerance=1e-9).prepare(stated.graph)
    run.solve(stated.guess)
    stated.wanted.value[1] = 7.0, 8.0
    np.testing.assert_allclose(run.solve(stated.guess)[stated.x[1]][0], [3.5, 4.0], atol=1e-6)
    stated.wanted.value = np.full((2, 2), 2.0)
    np.testing.assert_allclose(run.solve(stated.guess)[stated.x[1]][0], [1.0, 1.0], atol=1e-6)


def test_a_default_of_another_shape_is_refused() -> None:
    stated = Stated()
    run = InteriorPoint().prepare(stated.graph)
    stated.wanted.value = np.zeros(2)  # would fit by broadcasting
    with pytest.raises(fg.GraphError, match="'wanted' has a default of shape"):
        run.solve(stated.guess)


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (
            lambda stated: {stated.start: [9.0, 9.0], stated.wanted: [[1.0, 2.0], [5.0, np.nan]]},
            r"'wanted' contains NaN at \(1, 1\)",
        ),
        (lambda stated: {stated.idle: [np.nan]}, "'idle' contains NaN"),
        (lambda stated: {stated.idle: [0.0, 1.0]}, "'idle' has shape"),
        (lambda stated: {Stated().wanted: np.zeros((2, 2))}, "does not belong to this graph"),
        (lambda stated: {stated.sigma: -1.0}, "sigma"),
    ],
)
def test_a_refused_datum_changes_nothing_and_is_named(bad: Any, words: str) -> None:
    stated = Stated()
    run = InteriorPoint(tolerance=1e-9).prepare(stated.graph)
    with pytest.raises(fg.GraphError, match=words):
        run.solve(stated.guess, data=bad(stated))
    np.testing.assert_array_equal(run.program.arrays.parameters[:4], [1.0, 2.0, 3.0, 4.0])
    np.testing.assert_allclose(run.solve(stated.guess)[stated.x[1]][0], [1.5, 2.0], atol=1e-6)


def test_infinite_limits_are_no_nan() -> None:
    stated = Stated()
    solution = InteriorPoint(tolerance=1e-9).solve(stated.graph, stated.guess, data={stated.limit: np.inf})
    np.testing.assert_allclose(solution[stated.x[1]][0], [1.5, 2.0], atol=1e-6)


def test_scalars_and_nothing_can_be_bound() -> None:
    graph = fg.Graph()
    one, none = graph.data("one", 1.0), graph.data("none", np.zeros((0, 3)))
    binding = Binding(graph._data, [one, none])
    assert set(binding.take({})) == {one, none}
    assert binding.take({one: 1.0}) == []
    assert binding.take({one: 2.0}) == [one]
    assert binding.present[one] == 2.0
    assert binding.place(one).shape == ()


def test_a_prepared_solver_that_was_pickled_takes_data() -> None:
    stated = Stated()
    stated.sigma.value = np.asarray(1.0)
    run = InteriorPoint(tolerance=1e-9).prepare(stated.graph)
    solution = run.solve(stated.guess)
    again = pickle.loads(pickle.dumps(run))
    graph = again.program.graph
    x, wanted = graph.families["x"], graph._data["wanted"]
    moved = again.solve({x: np.zeros((2, 2))}, data={wanted: np.full((2, 2), 4.0)})
    np.testing.assert_allclose(moved[x[1]][0], [2.0, 2.0], atol=1e-6)
    copy = pickle.loads(pickle.dumps(solution))
    assert copy.multipliers.keys() == solution.multipliers.keys()
    guess = pickle.loads(pickle.dumps(solution.shifted(stated.x)))
    (values,) = guess.values.values()
    values[1] = 5.0
    np.testing.assert_array_equal(guess.values.flat[2:], 5.0)


# ---------------------------------------------------------------- guesses


@pytest.mark.parametrize("how", ["in place", "another array", "plain dictionary"])
def test_a_shifted_guess_may_be_changed_before_it_is_used(how: str) -> None:
    stated = Stated()
    run = SQP(max_iterations=0).prepare(stated.graph)
    first = InteriorPoint().solve(stated.graph, stated.guess)
    guess = first.shifted(stated.x)
    assert type(guess.values) is Values and type(guess.multipliers) is ByTerm
    if how == "in place":
        guess.values[stated.x][1] = 0.25
        guess.multipliers["limit"][:] = 0.5
    else:
        if how == "plain dictionary":
            guess = fg.Guess(dict(guess.values), dict(guess.multipliers))
        guess.values[stated.x] = np.full((2, 2), 0.25)  # type: ignore[index]
        guess.multipliers["limit"] = np.full((1, 2), 0.5)  # type: ignore[index]
    solution = run.solve(guess)
    np.testing.assert_array_equal(solution[stated.x], [[0.0, 0.0], [0.25, 0.25]])
    np.testing.assert_array_equal(solution.dual("limit"), [[0.5, 0.5]])
    guess.values[stated.x][:] = 9.0
    np.testing.assert_array_equal(solution[stated.x[1]], [[0.25, 0.25]])


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda guess, x: np.put(guess.values[x], 2, np.nan), r"x\[1\]"),
        (lambda guess, x: np.put(guess.multipliers["limit"], 1, np.inf), "'limit' are not finite"),
        (lambda guess, x: guess.values.pop(x), "no values for family 'x'"),
    ],
)
def test_guesses_are_looked_at_wherever_they_come_from(spoil: Any, words: str) -> None:
    stated, other = Stated(), Stated()
    run = InteriorPoint().prepare(stated.graph)
    guess = run.solve(stated.guess).shifted(stated.x)
    spoil(guess, stated.x)
    with pytest.raises(fg.GraphError, match=words):
        run.solve(guess)
    with pytest.raises(fg.GraphError, match="no family of this graph"):
        run.solve(InteriorPoint().solve(other.graph, other.guess).shifted(other.x))


def test_values_that_were_replaced_are_not_read_from_the_flat_array() -> None:
    stated = Stated()
    columns = compile_graph(stated.graph).columns
    values = columns.view(np.zeros(4))
    assert columns.values(values) is values
    values[stated.x] = np.ones((2, 2))
    assert not values.intact
    np.testing.assert_array_equal(columns.values(values).flat, 1.0)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(values)).flat, 1.0)


def test_penalties_move_with_the_stages_too() -> None:
    graph, x = graph_with(fg.Rn(1), 4)
    graph.minimize(fg.prior, x, np.arange(4.0)[:, None], sigma=1.0)
    graph.constrain(fg.prior, x, [0.5], upper=0.0, name="below")
    solution = AugmentedLagrangian().solve(graph, {x: np.zeros((4, 1))})
    guess = solution.shifted(x, by=2)
    for moved, own in ((guess.multipliers, solution.multipliers), (guess.penalties, solution.penalties)):
        np.testing.assert_array_equal(moved["below"], own["below"][[2, 3, 3, 3]])
    np.testing.assert_array_equal(guess.values[x], solution[x][[2, 3, 3, 3]])
    with pytest.raises(fg.GraphError, match="must not be negative"):
        solution.shifted(x, by=-1)
    for by in range(200):  # what is remembered has an end
        solution.shifted(x, by=by)
    other = fg.Graph().variables("y", fg.Rn(1), 4)
    with pytest.raises(fg.GraphError, match="'y' is not part"):
        solution.shifted(other)
