"""Decisions of SQP between subproblems: when violation alone counts, what a price is, which answers it takes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.control import Unicycle
from problems.graphs import drawn_to
from problems.known import short_drive
from unifg.solvers import KKT, SQP, kkt, sqp
from unifg.solvers.globalize.feasibility_restoration import FALLING, PATIENCE, RestorationTrigger
from unifg.solvers.globalize.slow_convergence import converges_slowly, iterations_left
from unifg.solvers.quadratic_programs.attempt import highest_price, next_damping, raise_prices
from unifg.solvers.quadratic_programs.routes import RESTING
from unifg.solvers.quadratic_programs.subproblem import LEFT, QPAnswer, subproblem
from unifg.typing import Array

TOLERANCE = 1e-6


def test_a_violation_that_does_not_fall_is_looked_at_ever_more_seldom() -> None:
    watch = RestorationTrigger()
    assert not watch.calls(1.0, TOLERANCE)
    calls = [watch.calls(1.0, TOLERANCE) for _ in range(7 * PATIENCE)]
    assert [k + 1 for k, called in enumerate(calls) if called] == [PATIENCE, 3 * PATIENCE, 7 * PATIENCE]


@pytest.mark.parametrize("violation", [0.9 * FALLING, 1e-7])
def test_a_violation_that_falls_or_is_none_begins_the_wait_anew(violation: float) -> None:
    watch = RestorationTrigger()
    watch.calls(1.0, TOLERANCE)
    assert not any(watch.calls(1.0, TOLERANCE) for _ in range(PATIENCE - 1))
    assert not watch.calls(violation, TOLERANCE)
    assert not any(watch.calls(1.0, TOLERANCE) for _ in range(PATIENCE - 1))
    assert watch.calls(1.0, TOLERANCE)


def test_falling_by_little_at_a_time_is_not_falling() -> None:
    watch, violation = RestorationTrigger(), 1.0
    watch.calls(violation, TOLERANCE)
    shrinking = violation * 0.999 ** np.arange(PATIENCE)
    assert [watch.calls(float(value), TOLERANCE) for value in shrinking][-1]


def line(limit: float = -1.0) -> tuple[fg.Graph, fg.Family]:
    """One number, to be at most ``limit``."""
    graph, x = drawn_to([3.0])
    graph.constrain(lambda p: p, x, upper=limit, name="limit")
    return graph, x


@pytest.mark.parametrize(("penalty", "row", "price"), [(6.0, 2.0, 3.0), (6.0, 0.5, 12.0), (0.1, 1.0, 1.0)])
def test_the_highest_price_is_that_of_scaled_rows_and_at_least_one(penalty: float, row: float, price: float) -> None:
    assert highest_price(np.array([penalty]), np.array([row])) == pytest.approx(price)


def test_prices_stay_above_their_multipliers_and_come_down_slowly() -> None:
    penalties = np.array([2.0])
    raise_prices(penalties, np.array([-4.0]))
    np.testing.assert_allclose(penalties, [4.4])
    raise_prices(penalties, np.array([1.0]))
    np.testing.assert_allclose(penalties, [2.7])


@pytest.mark.parametrize(
    ("limit", "left", "contradicts"),
    [(-1.0, 0.5 * LEFT, False), (-1.0, min(1.5 * LEFT, 1.0), True), (-1e-3, 1e-3 * 0.5 * LEFT, False)],
)
def test_an_answer_contradicts_when_it_leaves_most_of_the_violation(
    limit: float, left: float, contradicts: bool
) -> None:
    graph, _ = line(limit)
    work = SQP().workspace(graph.compile())
    qp: Any = SimpleNamespace(lower=np.array([-np.inf]), upper=np.array([limit]), linear=lambda step: step)
    step: Array = np.array([limit + left])
    assert work._contradicts(qp, QPAnswer(step, np.zeros(1), "by hand", 1, 1e-3)) == contradicts
    assert not work._contradicts(qp, QPAnswer(step, np.zeros(1), "by hand", 1, 1e-8)), "as exact as the test asks"


def test_the_first_route_rests_after_a_step_that_led_nowhere() -> None:
    """It is asked, not asked for a while when its step was distrusted, and asked again."""
    graph, guess = short_drive()
    program = graph.compile()
    work, lin = SQP().workspace(program), program.linearize(program.values_from(guess))
    work.start(lin)
    assert not work.distrust(), "it has given no step yet"
    qp = subproblem(program, lin, np.full(program.size, 1e-6), work.pattern)
    none = np.zeros(program.constraints.count)
    routes = [work.solve(qp, none, 1e-4).route]
    assert work.distrust()
    routes += [work.solve(qp, none, 1e-4).route for _ in range(RESTING + 1)]
    assert work.fallback is not None
    assert routes == [work.first.name, *[work.fallback.name] * RESTING, work.first.name]


def row(missing: float, length: float = 1.0) -> Any:
    """Row of a history."""
    parts = {"stationarity": missing, "violation": 0.1 * missing, "complementarity": 0.01 * missing}
    return SimpleNamespace(**parts, step_length=length)


def test_the_last_two_full_steps_tell_how_many_are_left() -> None:
    history = [row(0.01 * 0.5**k) for k in range(5)]
    assert iterations_left(history, 1e-6) == pytest.approx(np.log(1e-6 / (0.01 / 16.0)) / np.log(0.5))
    assert iterations_left(history[:3], 1e-6) == 0.0, "two steps of a start tell nothing"
    for shortened in (-1, -2):
        other = [*history]
        other[shortened] = row(0.01 * 0.5 ** (5 + shortened), 0.5)
        assert iterations_left(other, 1e-6) == 0.0
    assert iterations_left(history[::-1], 1e-6) == 0.0, "they diverge"
    assert iterations_left([row(20.0 * 0.5**k) for k in range(5)], 1e-6) == 0.0, "far from an answer"
    assert iterations_left(history, 0.01 / 16.0) == 0.0, "none is left"


@pytest.mark.parametrize("backend", [SQP, KKT])
def test_second_derivatives_take_over_where_gauss_newton_has_far_to_go(
    backend: type[SQP | KKT], monkeypatch: pytest.MonkeyPatch
) -> None:
    stated = Unicycle("straight", True, 20).formulation()

    def solved(graph: fg.Graph, **options: Any) -> fg.Solution:
        return backend(**options).solve(graph, stated.guess, check=True)

    found = solved(stated.graph)
    assert found.iterations <= 8, "for twenty"
    if backend is SQP:
        assert "exact" in str(found.history[-1].details.get("hessian"))
        assert solved(stated.graph, time_limit=60.0).iterations == found.iterations
        watched = SQP(qp="graph").solve(stated.graph, stated.guess, check=True, callback=lambda row: None)
        assert watched.iterations >= 15, "which are cheap there"
    monkeypatch.setattr(sqp, "WORTH", np.inf)
    monkeypatch.setattr(kkt, "WORTH", np.inf)
    other = solved(stated.graph)
    assert other.iterations >= 15 and other.cost == pytest.approx(found.cost, rel=1e-7)
    monkeypatch.undo()
    x = stated.x
    stated.graph.minimize(fg.residual(lambda p: 1e-3 * p[:, :1], derivatives="differences"), x[-1], name="own")
    assert solved(stated.graph).iterations >= 15, "second derivatives of Python's terms cost more"


@pytest.mark.parametrize(("pace", "slow"), [(0.75, False), (0.9, True), (1.1, True)])
def test_a_solve_creeps_where_ten_iterations_leave_a_tenth_after_twenty(pace: float, slow: bool) -> None:
    history = [row(pace**k) for k in range(40)]
    assert not any(converges_slowly(history[:k]) for k in range(21))
    assert [converges_slowly(history[:k]) for k in range(21, 40)] == [slow] * 19
    for part in ("stationarity", "violation", "complementarity"):  # each of them keeps a solve from its end
        held = [row(0.5**k) for k in range(30)]
        for made in held:
            setattr(made, part, 1.0)
        assert converges_slowly(held)


def test_damping_grows_with_shortened_steps_and_fades_with_full_ones() -> None:
    first = next_damping(False, 1e-12, 0.5)
    assert next_damping(False, first, 0.25) > 2.0 * first
    fading = next_damping(False, first, 1.0)
    assert 0.05 * first < fading < first
    assert next_damping(True, first, 1.0) < fading, "or convergence would be linear"
    assert next_damping(True, next_damping(True, first, 0.25), 1.0) > first, "or it swings to and fro"
    assert next_damping(True, 1e12, 0.5) == 1e12, "an elastic problem does without, however often steps are short"
