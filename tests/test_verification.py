"""Answers are verified by the user's functions: a trace that is another function is found out, and nothing else is."""

import logging
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

import unifg as fg
from calls import calls_of
from problems.graphs import drawn_to, graph_of, graph_with
from unifg.factors.autodiff import symbols
from unifg.factors.autodiff.calculus import jacobian
from unifg.factors.autodiff.operations import Op
from unifg.problem import term
from unifg.solution import solver as frame
from unifg.solvers import SQP, AugmentedLagrangian, GaussNewton, InteriorPoint, LevenbergMarquardt
from unifg.typing import Array

Function = Callable[..., Any]
N = 4


@pytest.fixture
def wrong_above() -> Iterator[Function]:
    """A ufunc whose trace is wrong above a limit, as a fault of the tracer would be."""
    honest = symbols.UFUNCS["tanh"]

    def faulty(limit: float, *, smooth: bool = False) -> None:
        exp = symbols.UFUNCS["exp"]
        wrong = symbols.UFUNCS["tanh"] = lambda a: (
            honest(a) + exp(50.0 * (a - limit))
            if smooth
            else symbols.choose(symbols.UFUNCS["less"](a, limit), honest(a), honest(a) + (a - limit))
        )
        symbols.Symbol.tanh = lambda self: wrong(self)  # type: ignore[attr-defined]

    yield faulty
    symbols.UFUNCS["tanh"] = honest
    symbols.Symbol.tanh = lambda self: honest(self)  # type: ignore[attr-defined]


def stated(function: Function, *, constrained: bool) -> tuple[fg.Graph, fg.Family, fg.Data]:
    """Members pulled to a target; a function of one's own is a cost or a constraint."""
    graph, x = graph_with(fg.Rn(1), N)
    target = graph.data("target", np.zeros((N, 1)))
    graph.minimize(fg.prior, x, target, name="pull")
    if constrained:
        graph.constrain(function, x, upper=0.9, name="own")
    else:
        graph.minimize(function, x, name="own")
    return graph, x, target


SOLVERS = [GaussNewton(), LevenbergMarquardt(), InteriorPoint(), SQP(), AugmentedLagrangian()]


@pytest.mark.parametrize("constrained", [False, True])
@pytest.mark.parametrize("solver", SOLVERS, ids=lambda s: s.name)
def test_a_wrong_value_at_the_answer_is_found(
    solver: fg.Solver, constrained: bool, wrong_above: Function, caplog: pytest.LogCaptureFixture
) -> None:
    """The trace is right at the guess and wrong at the answer: the solve goes on without it."""
    if constrained and solver.constraints != "all":
        pytest.skip(f"{solver.name} takes no constraints")
    wrong_above(1.2)

    def own(x: Array) -> Array:
        return np.asarray(np.tanh(x))

    graph, x, target = stated(own, constrained=constrained)
    term._told.clear()
    with caplog.at_level(logging.WARNING, "unifg"):
        solution = solver.solve(graph, {x: np.full((N, 1), 0.1)}, data={target: np.full((N, 1), 2.5)})
    assert solution.converged and solution.checked and list(solution.mistraced) == ["own"]
    assert "term 'own' is evaluated by Python" in caplog.text
    assert "Term 'own' was left to Python and the solve repeated: at factor 0 of an answer" in solution.report()
    y = solution[x]
    if constrained:
        np.testing.assert_allclose(np.tanh(y), 0.9, atol=1e-5)
    else:
        np.testing.assert_allclose(y - 2.5 + np.tanh(y) * (1.0 - np.tanh(y) ** 2), 0.0, atol=1e-5)


@pytest.mark.parametrize("solver", [GaussNewton(), SQP()], ids=lambda s: s.name)
def test_a_wrong_derivative_at_the_answer_is_found(solver: fg.Solver, monkeypatch: pytest.MonkeyPatch) -> None:
    """The values are right everywhere."""

    def doubled(tape: Any, rows: Any, width: int) -> Any:
        slopes = jacobian(tape, rows, width)
        own = any(tape.op[i] == Op.TANH for i in tape.live(rows))
        return {place: tape.apply(Op.ADD, node, node) if own else node for place, node in slopes.items()}

    monkeypatch.setattr("unifg.factors.autodiff.expression.jacobian", doubled)
    monkeypatch.setattr("unifg.factors.autodiff.expression._WRITERS", "")
    graph, x, target = stated(lambda x: np.tanh(x), constrained=False)
    solution = solver.solve(graph, {x: np.full((N, 1), 0.1)}, data={target: np.full((N, 1), 2.5)})
    assert "derivatives differ" in solution.mistraced["own"] and solution.converged
    y = solution[x]
    np.testing.assert_allclose(y - 2.5 + np.tanh(y) * (1.0 - np.tanh(y) ** 2), 0.0, atol=1e-5)


def test_one_wrong_factor_is_named_and_a_factor_that_is_switched_off_is_not(wrong_above: Function) -> None:
    wrong_above(1.2)
    graph, x = graph_with(fg.Rn(1), N)
    active = graph.data("active", np.ones(N, dtype=bool), each=True)
    graph.minimize(lambda x: np.tanh(x) + 0.0, x, active=active, name="own")
    program = graph.compile()
    values = program.values_from({x: np.zeros((N, 1))})
    values[x][2] = 2.5
    program.bind({active: np.arange(N) != 2})
    assert not program.mistraced(values, True, 0)
    program.bind({})
    assert "at factor 2 of an answer" in program.mistraced(values, True, 0)["own"]


def test_derivatives_are_compared_when_asked_and_along_another_direction_each_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def doubled(tape: Any, rows: Any, width: int) -> Any:
        return {place: tape.apply(Op.ADD, node, node) for place, node in jacobian(tape, rows, width).items()}

    monkeypatch.setattr("unifg.factors.autodiff.expression.jacobian", doubled)
    monkeypatch.setattr("unifg.factors.autodiff.expression._WRITERS", "")
    graph, x = graph_with(fg.Rn(1), N)
    graph.minimize(lambda x: np.sinh(x) * 0.5, x, name="own")
    program = graph.compile()
    values = program.values_from({x: np.full((N, 1), 0.3)})
    assert not program.mistraced(values, False, 0)
    assert "derivatives differ" in program.mistraced(values, True, 0)["own"]


def test_insisting_on_the_trace_is_an_error_then(wrong_above: Function) -> None:
    wrong_above(1.2)
    graph, x, target = stated(fg.residual(lambda x: np.tanh(x), derivatives="trace"), constrained=False)
    with pytest.raises(fg.GraphError, match="term 'own': cannot be traced: at factor 0 of an answer"):
        GaussNewton().solve(graph, {x: np.full((N, 1), 0.1)}, data={target: np.full((N, 1), 2.5)})


def test_a_loop_is_verified_on_a_schedule(monkeypatch: pytest.MonkeyPatch) -> None:
    graph, x, _ = stated(lambda x: np.tanh(x), constrained=False)
    prepared = GaussNewton().prepare(graph)
    asked = calls_of(monkeypatch, prepared.program, "mistraced")
    checked = [prepared.solve({x: np.zeros((N, 1))}).checked for _ in range(frame.EVERY + 1)]
    assert [given[1:] for given in asked] == [(True, n) for n in (1, 2, 4, 8, 16, 32, 64)] + [(False, frame.EVERY)]
    assert [n for n, yes in enumerate(checked, 1) if yes] == [n for _, _, n in asked]


def test_a_solve_without_time_left_is_verified_after_the_next() -> None:
    graph, x, target = stated(lambda x: np.cosh(x), constrained=False)
    prepared = LevenbergMarquardt(max_iterations=50).prepare(graph)
    guess = {x: np.full((N, 1), 3.0)}
    found = [prepared.solve(guess).checked for _ in range(6)]
    assert found == [True, True, False, True, False, False]
    prepared.solver.time_limit = 0.0
    assert not any(prepared.solve(guess).checked for _ in range(2))  # the eighth would have been
    prepared.solver.time_limit = np.inf
    assert [prepared.solve(guess).checked for _ in range(2)] == [True, False]
    assert prepared.solve(guess, data={target: np.ones((N, 1))}).converged


def test_a_verification_that_would_take_longer_than_is_left_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    """The functions as written may take fifty times as long as a tick."""
    graph, x, _ = stated(lambda x: np.cosh(x), constrained=False)
    prepared = LevenbergMarquardt(max_iterations=50).prepare(graph)
    guess, look = {x: np.full((N, 1), 3.0)}, prepared.program.mistraced
    prepared.solve(guess)

    def slowly(*given: Any) -> dict[str, str]:
        time.sleep(0.3)
        return look(*given)

    monkeypatch.setattr(prepared.program, "mistraced", slowly)
    assert prepared.solve(guess).checked
    prepared.solver.time_limit = 0.25
    assert not any(prepared.solve(guess).checked for _ in range(6))  # the fourth and the eighth would have been
    prepared.solver.time_limit = 5.0
    assert prepared.solve(guess).checked


def test_where_nothing_is_traced_nothing_is_left_unchecked() -> None:
    graph, x = drawn_to([1.0])
    prepared = GaussNewton().prepare(graph)
    assert all(prepared.solve({x: np.zeros((1, 1))}).checked for _ in range(4))


@pytest.mark.parametrize("prepared_by", ["prepare", "bound"])
def test_a_fault_that_begins_to_matter_late_is_found(wrong_above: Function, prepared_by: str) -> None:
    """Answers are verified at once where a comparison comes out otherwise; else within a hundred solves."""
    wrong_above(1.2)
    graph, x, target = stated(lambda x: np.tanh(x), constrained=False)
    solver = GaussNewton()
    prepared = solver.prepare(graph) if prepared_by == "prepare" else solver.bound(graph)
    late = 137
    for tick in range(late):
        assert not prepared.solve({x: np.zeros((N, 1))}, data={target: np.full((N, 1), 0.1 + 1e-4 * tick)}).mistraced
    after = 0
    while not (solution := prepared.solve({x: np.zeros((N, 1))}, data={target: np.full((N, 1), 2.5)})).mistraced:
        after += 1
    assert after == (0 if prepared_by == "prepare" else 2 * frame.EVERY - late - 1)
    y = solution[x]
    np.testing.assert_allclose(y - 2.5 + np.tanh(y) * (1.0 - np.tanh(y) ** 2), 0.0, atol=1e-5)


def test_branches_are_verified_once_and_within_a_ration() -> None:
    """In a noisy loop comparisons come out otherwise at every tick: most answers would be verified."""
    graph, x = graph_with(fg.Rn(8))
    target = graph.data("target", np.zeros(8))
    graph.minimize(lambda x, target: np.where(x > 0.0, x, 2.0 * x) - target, x, target, name="own")
    prepared = GaussNewton().prepare(graph)
    signs = np.sign(np.random.default_rng(1).uniform(-1.0, 1.0, (60, 8)))

    def checked(number: int) -> bool:
        return prepared.solve({x: signs[:1]}, data={target: signs[number]}).checked

    extra = [n for n in range(1, 60) if checked(n) and n.bit_count() > 1]
    assert extra == [3, 5, 6, 7]  # AT_ONCE
    prepared._of_branches = 0
    assert not any(checked(number) for number in extra), "verified before"
    assert checked(9)


RNG = np.random.default_rng(0)


@pytest.mark.parametrize(
    ("function", "at"),
    [
        (lambda x: np.abs(x), 0.0),
        (lambda x: np.maximum(x, 0.0) + np.maximum(0.0, x[:, ::-1]), 0.0),
        (lambda x: np.linalg.norm(x, axis=1, keepdims=True), 0.0),
        (lambda x: np.sign(x) + np.floor(x), 0.0),
        (lambda x: np.where(x < 1.0, x, 2.0 * x - 1.0), 1.0),
        (lambda x: np.where(x < 1.0, x, x + 5.0), 1.0),
        (lambda x: np.rint(3.0 * x), 0.5),
        (lambda x: np.sin(1e4 * x) / 1e4, 0.3),
        (lambda x: (1.0 - np.cos(x)) / x**2, 1e-5),
        (lambda x: (x - 1e8) ** 2, 1e8),
        (lambda x: np.exp(50.0 * x), 1.0),
        (lambda x: 1e-9 * x, 1.0),
        (lambda x: 1e9 * x, 1e6),
        (lambda x: np.arctan2(x, x[:, ::-1] - 1.0), 0.5),
        (lambda x: fg.wrap_angle(x), np.pi),
    ],
)
def test_kinks_jumps_and_noise_are_no_differences(function: Function, at: float) -> None:
    graph, x = graph_with(fg.Rn(2), 40)
    graph.minimize(function, x, name="own")
    program = graph.compile()
    values = program.values_from({x: np.full((40, 2), at)})
    assert len(program.verifications) == 1
    for seed in range(20):
        assert not program.mistraced(values, True, seed)


def test_verification_costs_little(monkeypatch: pytest.MonkeyPatch) -> None:
    """Within a loop it is a small share of the time; the figure is on docs/howto/own-functions.md."""
    graph, x, target = stated(lambda x: np.where(x < 0.5, np.tanh(x), np.sin(x)), constrained=True)
    prepared = InteriorPoint().prepare(graph)
    spent, honest = 0.0, prepared._verified

    def timed(*arguments: Any) -> Any:
        nonlocal spent
        began = time.thread_time()
        found = honest(*arguments)
        spent += time.thread_time() - began
        return found

    monkeypatch.setattr(prepared, "_verified", timed)
    for tick in range(300):
        assert prepared.solve({x: np.zeros((N, 1))}, data={target: np.full((N, 1), 0.001 * tick)}).converged
    assert spent < 10.0


@pytest.mark.parametrize("seed", range(4))
def test_fields_of_discs_and_costs_with_kinks_raise_no_alarm(seed: int) -> None:
    """Two hundred such fields were run once; none was wrong."""
    rng = np.random.default_rng(seed)
    centre, radius, steps = rng.uniform([0.8, -1.0], [4.2, 1.0], (6, 2)), rng.uniform(0.1, 0.35, 6), 15

    def moved(x: Array, u: Array, after: Array) -> Array:
        heading = 0.5 * (x + after)[:, 2]
        rate = np.stack([u[:, 0] * np.cos(heading), u[:, 0] * np.sin(heading), u[:, 1]], axis=1)
        return np.asarray(after - x - 0.3 * rate)

    graph, x, u = graph_of(("x", fg.Rn(3), steps + 1), ("u", fg.Rn(2), steps))
    graph.fix(x[0], np.zeros(3))
    graph.constrain(moved, x[:-1], u, x[1:], lower=0.0, upper=0.0)
    gap: Function = lambda x: np.linalg.norm(x[:, None, :2] - centre, axis=2) - radius  # noqa: E731
    graph.constrain((lambda x: gap(x).min(axis=1, keepdims=True)) if seed % 2 else gap, x[1:], lower=0.1)
    graph.minimize(lambda x: x - np.array([4.5, 0.0, 0.0]), x[-1], sigma=0.05)
    graph.bound(u, lower=-2.0, upper=2.0)
    graph.minimize(lambda u: 0.1 * u, u)
    if seed % 3:
        graph.minimize_scalar(lambda u: np.abs(u).sum(axis=1), u)
    else:
        graph.minimize(lambda u: np.maximum(np.abs(u) - 0.5, 0.0), u)
    line = np.linspace(np.zeros(3), [4.5, 0.0, 0.0], steps + 1)
    solution = InteriorPoint(max_iterations=80).solve(graph, {x: line, u: np.full((steps, 2), 0.5)})
    assert solution.checked and not solution.mistraced


def test_an_answer_is_not_verified_with_the_data_of_another_solve() -> None:
    graph, x, target = stated(lambda x: 0.1 * np.tanh(x), constrained=False)
    prepared, start = GaussNewton().prepare(graph), {x: np.zeros((N, 1))}
    solution = prepared.solve(start, data={target: np.full((N, 1), 2.0)})
    GaussNewton().solve(graph, start)
    with pytest.raises(fg.UnifgError, match="the data of others are not kept"):
        prepared.verify(solution)
    assert prepared.verify(prepared.solve(start)) == {}


def test_the_last_answer_is_verified_in_idle_time(wrong_above: Function) -> None:
    """Between the solves that are verified by themselves, and for the last solution alone."""
    wrong_above(2.0, smooth=True)  # no comparison that would come out otherwise
    graph, x, target = stated(lambda x: 0.1 * np.tanh(x), constrained=False)
    prepared = GaussNewton().prepare(graph)
    first = prepared.solve({x: np.zeros((N, 1))})
    for _ in range(5):
        solution = prepared.solve({x: np.zeros((N, 1))})
    late = prepared.solve({x: np.zeros((N, 1))}, data={target: np.full((N, 1), 2.0)})
    assert first.checked and not solution.checked and not late.checked
    with pytest.raises(fg.UnifgError, match="only the last solution"):
        prepared.verify(solution)
    found = prepared.verify(late)
    assert found.keys() == {"own"} == late.mistraced.keys() and not late.checked
    again = prepared.solve({x: np.zeros((N, 1))}, data={target: np.full((N, 1), 2.0)})
    assert np.abs(again[x] - late[x]).max() > 1e-3 and prepared.verify(again) == {} and again.checked
    with pytest.raises(fg.UnifgError, match="from within a solve"):
        prepared.solve({x: np.ones((N, 1))}, callback=lambda row: bool(prepared.verify(again)))
