"""Many instances of one graph by one compiled call, and by single solves where it cannot be."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.control import Quadrotor, Stated, Unicycle
from problems.graphs import graph_with
from unifg.solution.batch import Batch
from unifg.solvers import SQP, GaussNewton, InteriorPoint
from unifg.typing import Array

COUNT = 130


def instances(case: Unicycle | Quadrotor, count: int, far: float = 0.1) -> tuple[Stated, list[dict[fg.Data, Array]]]:
    """A stated case, and the data of it from starts beside its own."""
    stated, rng = case.formulation(), np.random.default_rng(0)
    spread = far * np.ones(case.manifold.dim)
    starts = case.manifold.retract(np.tile(case.start, (count, 1)), spread * rng.standard_normal((count, len(spread))))
    return stated, [stated.data(start, 0) for start in starts]


def stacked(each: list[dict[fg.Data, Array]]) -> dict[fg.Data, Array]:
    """One array for all instances of every datum."""
    return {handle: np.stack([data[handle] for data in each]) for handle in each[0]}


def assert_same(batch: Batch, singles: list[fg.Solution], family: fg.Family) -> None:
    assert batch.statuses == [found.status for found in singles]
    assert batch.iterations.tolist() == [found.iterations for found in singles]
    np.testing.assert_array_equal(batch.cost, [found.cost for found in singles])
    np.testing.assert_array_equal(batch[family], [found[family] for found in singles])
    np.testing.assert_array_equal(batch.violation, [found.violation for found in singles])
    np.testing.assert_array_equal(batch.stationarity, [found.stationarity for found in singles])


@pytest.mark.parametrize("case", [Unicycle("straight", True, 20), Quadrotor("goto", False, 20)], ids=str)
@pytest.mark.parametrize("options", [{}, {"step_tolerance": np.inf}, {"max_iterations": 9}], ids=str)
@pytest.mark.product(1)
def test_instances_are_solved_as_one_by_one(case: Unicycle | Quadrotor, options: dict[str, Any]) -> None:
    stated, each = instances(case, COUNT if case.robot == "unicycle" else 20)
    prepared = InteriorPoint(tolerance=1e-4, **options).prepare(stated.graph)
    first = prepared.solve(stated.guess)
    for guess in (stated.guess, first.shifted(stated.x, stated.u)):
        singles = [prepared.solve(guess, data=data) for data in each]
        assert_same(prepared.solve_many(guess, data=stacked(each)), singles, stated.x)
        assert_same(prepared.solve_many([guess] * len(each), data=stacked(each), threads=2), singles, stated.u)
    again = prepared.solve(stated.guess)  # with its own data again
    assert again.cost == first.cost and again.iterations == first.iterations


def test_one_instance_as_a_solution() -> None:
    stated, each = instances(Unicycle("straight", False, 20), 12)
    prepared = InteriorPoint().prepare(stated.graph)
    batch = prepared.solve_many(stated.guess, data=stacked(each))
    assert batch.converged and len(batch) == 12
    found = batch.solution(7)
    assert found.converged and found.iterations <= 1
    np.testing.assert_allclose(found[stated.x], batch[stated.x][7], atol=1e-6)
    assert found.multipliers.keys() == {"dynamics", "limits"}


def test_a_batch_keeps_its_data_when_the_caller_changes_them() -> None:
    graph = fg.Graph()
    x, goal = graph.variables("x", fg.Rn(2), 1), graph.data("goal", [0.0, 0.0])
    graph.minimize(fg.difference, x, goal)
    graph.constrain(lambda x: (x**2).sum(axis=1, keepdims=True), x, upper=1.0)
    goals = np.array([[2.0, 0.0], [0.0, 2.0]])
    batch = InteriorPoint().prepare(graph).solve_many({x: [[0.1, 0.0]]}, data={goal: goals})
    goals[:] = 0.0
    np.testing.assert_allclose(batch.solution(1)[x], [[0.0, 1.0]], atol=1e-6)


@pytest.mark.product(1, of="studies")
def test_what_compiled_code_leaves_is_solved_as_usual() -> None:
    """Other backends, a time limit, and data that single solves refuse."""
    stated, each = instances(Quadrotor("goto", False, 20), 6)
    for solver in (InteriorPoint(), SQP(qp="graph"), InteriorPoint(time_limit=10.0)):
        prepared = solver.prepare(stated.graph)
        batch = prepared.solve_many(stated.guess, data=stacked(each))
        singles = [prepared.solve(stated.guess, data=data) for data in each]
        assert_same(batch, singles, stated.x)
    start = next(handle for handle in each[3] if handle.name == "start")
    prepared = InteriorPoint().prepare(stated.graph)
    for place, number, why in ((0, np.nan, "data 'start' contains NaN"), (4, 0.9, r"state\[0\] is not on Product")):
        wrong = stacked(each)
        wrong[start][3, place] = number
        with pytest.raises(fg.GraphError, match=why):
            prepared.solve_many(stated.guess, data=wrong)


def test_limits_as_data_are_solved_as_usual() -> None:
    graph = fg.Graph()
    x, top = graph.variables("x", fg.Rn(1), 1), graph.data("top", [1.0])
    graph.minimize(fg.prior, x, [3.0], sigma=1.0)
    graph.bound(x, upper=top, name="top")
    prepared = InteriorPoint().prepare(graph)
    batch = prepared.solve_many({x: [[0.0]]}, data={top: [[0.5], [1.5], [9.0]]})
    np.testing.assert_allclose(batch[x].ravel(), [0.5, 1.5, 3.0], atol=1e-6)


def test_an_infeasible_instance_has_its_own_status() -> None:
    graph = fg.Graph()
    x, place = graph.variables("x", fg.Rn(2), 1), graph.data("place", [0.0, 0.0])
    graph.minimize(lambda x, p: x - p, x, place, sigma=1.0)
    graph.constrain(lambda x, p: ((x - p) ** 2).sum(axis=1, keepdims=True), x, place, upper=1.0, name="near")
    graph.bound(x, lower=0.0, name="quadrant")
    prepared = InteriorPoint().prepare(graph)
    batch = prepared.solve_many({x: [[0.5, 0.5]]}, data={place: [[1.0, 1.0], [-3.0, 0.0], [0.2, 0.1]]})
    assert [status.name for status in batch.statuses] == ["CONVERGED", "LOCALLY_INFEASIBLE", "CONVERGED"]
    assert not batch.converged


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (
            lambda run, guess, data, start: run.solve_many(guess, data={start: data[start][0]}),
            r"data 'start' of many instances has shape \(3,\), expected \(K, 3\)",
        ),
        (
            lambda run, guess, data, start: run.solve_many(guess, data={**data, start: data[start][:2]}),
            r"is given for \d instances, others for \d",
        ),
        (
            lambda run, guess, data, start: run.solve_many([guess] * 2, data=data),
            "2 guesses are given for 3 instances",
        ),
        (lambda run, guess, data, start: run.solve_many(guess), "solve_many of what"),
        (
            lambda run, guess, data, start: run.solve_many(guess, data={start: [[1.0, 2.0, 3.0], [1.0]]}),
            "data 'start' of many instances cannot be read as an array",
        ),
        (
            lambda run, guess, data, start: run.solve_many(guess, data={start: "here"}),
            "data 'start' of many instances must be real numbers, found 'here'",
        ),
        (
            lambda run, guess, data, start: run.solve_many([guess, guess, {}], data=data),
            "instance 2: .*guess",
        ),
    ],
)
def test_what_does_not_fit_is_refused(ask: Any, message: str) -> None:
    stated, each = instances(Unicycle("straight", False, 20), 3)
    prepared, data = InteriorPoint().prepare(stated.graph), stacked(each)
    start = next(handle for handle in data if handle.name == "start")
    with pytest.raises(fg.GraphError, match=message):
        ask(prepared, stated.guess, data, start)
    assert len(prepared.solve_many([])) == 0


def test_a_single_number_is_no_datum_of_many_instances() -> None:
    graph, x = graph_with(fg.Rn(1), 1)
    number = graph.data("number", 1.0)
    graph.minimize(lambda p, at: p - at, x, number, name="there")
    with pytest.raises(fg.GraphError, match=r"data 'number' of many instances has shape \(\)"):
        GaussNewton().prepare(graph).solve_many({x: [[0.0]]}, data={number: 3.0})


def test_huge_multipliers_are_no_success() -> None:
    """A row without a slope at its answer: its KKT numbers hold in proportion to its multiplier alone."""
    graph = fg.Graph()
    x, value = graph.variables("x", fg.Rn(1), 1), graph.data("value", [1.0])
    graph.minimize(fg.prior, x, [3.0], sigma=1.0)
    graph.constrain(lambda x, p: np.exp(x) - p, x, value, lower=0.0, upper=0.0, name="power")
    prepared = InteriorPoint().prepare(graph)
    batch = prepared.solve_many({x: [[0.5]]}, data={value: [[1.0], [0.0], [2.0]]})
    singles = [prepared.solve({x: [[0.5]]}, data={value: [number]}) for number in (1.0, 0.0, 2.0)]
    assert_same(batch, singles, x)
    assert [status.name for status in batch.statuses] == ["CONVERGED", "DEGENERATE", "CONVERGED"]


def test_data_off_their_manifold_are_refused_as_by_single_solves() -> None:
    graph = fg.Graph()
    x, seen = graph.variables("x", fg.SO3, 1), graph.data("seen", [1.0, 0.0, 0.0, 0.0])
    graph.minimize(fg.prior, x, seen, sigma=1.0)
    graph.constrain(lambda x: x[:, 3:], x, lower=-0.5, upper=0.5, name="tilt")
    given = np.tile([1.0, 0.0, 0.0, 0.0], (3, 1))
    prepared = InteriorPoint().prepare(graph)
    assert prepared.solve_many({x: given[:1]}, data={seen: given}).converged
    given[2, 1] = 0.5
    with pytest.raises(fg.GraphError, match="is not on SO3"):
        prepared.solve_many({x: given[:1]}, data={seen: given})


def test_answers_are_asked_for_by_name_and_by_numbers_there_are() -> None:
    graph = fg.Graph()
    x, seen = graph.variables("x", fg.Rn(1), 1), graph.data("seen", [1.0])
    graph.minimize(fg.prior, x, seen, sigma=1.0)
    batch = InteriorPoint().prepare(graph).solve_many({x: [[0.0]]}, data={seen: [[1.0], [2.0]]})
    assert np.array_equal(batch["x"], batch[x]) and batch.solution(-1)[x][0, 0] == pytest.approx(2.0)
    for ask, message in (
        (lambda: batch["y"], r"'y' is no family of these instances \(there are: x\)"),
        (lambda: batch[fg.Graph().variables("x", fg.Rn(1), 1)], "is no family of these instances"),
        (lambda: batch.solution(2), "there is no instance 2: 2 were solved, 0 to 1"),
        (lambda: batch.solution(0.5), "there is no instance 0.5"),  # type: ignore[arg-type]
        (lambda: batch.data_of(-3), "there is no instance -3"),
    ):
        with pytest.raises(fg.GraphError, match=message):
            ask()


def test_a_cost_beyond_numbers_is_no_success() -> None:
    """The gradient of a robust loss is zero where its cost has overflowed; a single solve refuses such data."""
    graph, x = graph_with(fg.Rn(1), 1)
    seen, slope = graph.data("seen", [1.0]), graph.data("slope", 1.0)
    graph.minimize(lambda p, at: p - at, x, seen, robust=fg.Cauchy(1.0), name="seen")
    graph.minimize_scalar(lambda p, times: times * p[:, 0], x, slope, name="slope")
    graph.bound(x, lower=-1.0, upper=1.0, name="box")
    prepared, guess = InteriorPoint().prepare(graph), {x: np.zeros((1, 1))}
    with pytest.raises(fg.GraphError, match="instance 1: a Jacobian is not finite at the guess"):
        prepared.solve_many(guess, data={seen: [[1.0], [1e200]], slope: [1.0, 0.0]})
    batch = prepared.solve_many(guess, data={slope: [1.0, 1e30]})
    assert batch.statuses == [prepared.solve(guess, data=batch.data_of(k)).status for k in range(2)]
    assert batch.statuses[1] is fg.Status.UNBOUNDED


@pytest.mark.parametrize("threads", [1, 2])
def test_numbers_that_a_function_captures_change_for_all_threads(threads: int) -> None:
    graph, x = graph_with(fg.Rn(1), 1)
    goal, most = graph.data("goal", [5.0]), np.array([1.0])
    graph.minimize(lambda p, to: p - to, x, goal, name="to")
    graph.constrain(lambda p: p - most, x, upper=0.0, name="most")
    run, goals = InteriorPoint().prepare(graph), np.full((6, 1), 5.0)
    for limit in (1.0, 2.0):
        most[0] = limit
        found = run.solve_many({x: [[0.0]]}, data={goal: goals}, threads=threads)
        np.testing.assert_allclose(found[x].ravel(), limit, atol=1e-5)
