"""SQP's compiled step, and the graph's quadratic programs: active sides first, an interior point, or a proof."""

from __future__ import annotations

from dataclasses import replace
from typing import Any
from unittest.mock import PropertyMock, patch

import numpy as np
import pytest

from problems.control import Quadrotor, Unicycle
from problems.graphs import drawn_to
from problems.hock_schittkowski import SMALL
from unifg.problem.compiled_problem import CompiledProblem
from unifg.solution.solution import values_of
from unifg.solvers import SQP
from unifg.solvers.quadratic_programs.graph_route import GraphRoute
from unifg.solvers.quadratic_programs.piqp_route import PiqpRoute
from unifg.solvers.quadratic_programs.subproblem import QP, qp_error, subproblem

CASES = {case.name: case for case in SMALL}


def at(problem: Any, iterations: int) -> tuple[CompiledProblem, QP]:
    """The subproblem after some iterations."""
    stated = problem.formulation()
    solution = SQP(qp="graph", max_iterations=iterations).solve(stated.graph, stated.guess)
    program = stated.graph.compile()
    lin = program.linearize(program.values_from(values_of(solution)))
    return program, subproblem(program, lin, 1e-6)


@pytest.mark.parametrize("problem", [Unicycle("straight", False, 20), Quadrotor("figure8", False, 20)])
def test_one_factorisation_does_where_the_active_sides_are_known(problem: Any) -> None:
    program, qp = at(problem, 2)
    route, none = GraphRoute(program), np.zeros(program.constraints.count)
    cold = route.solve(qp, none, 1e-8)
    exact = PiqpRoute(program).solve(qp, none, 1e-8)
    assert (np.abs(cold.multipliers[~program.equality]) > 1e-3).any(), "some side is active"
    # The same subproblem, seen from its own answer: the step is zero, and limits that it reaches are where it is.
    here = replace(qp.shifted(-qp.linear(cold.step)), gradient=qp.gradient + qp.curved(cold.step))
    warm = route.solve(here, cold.multipliers, 1e-8)
    assert warm.iterations == 1 < cold.iterations
    np.testing.assert_allclose(warm.step, 0.0, atol=1e-6)
    assert cold.error <= 1e-8 and warm.error <= 1e-8
    for answer in (cold, warm):
        np.testing.assert_allclose(answer.multipliers, exact.multipliers, atol=1e-4 * np.abs(exact.multipliers).max())
    np.testing.assert_allclose(cold.step, exact.step, atol=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_any_multipliers_lead_to_the_same_answer(seed: int) -> None:
    """Sides that multipliers of the wrong sign and size point at are let go again, or an interior point takes over."""
    program, qp = at(Unicycle("behind", False, 20), 1)
    route, rng = GraphRoute(program), np.random.default_rng(seed)
    exact = route.solve(qp, np.zeros(program.constraints.count), 1e-8)
    wild = route.solve(qp, 100.0 * rng.standard_normal(program.constraints.count), 1e-8)
    assert wild.error <= 1e-8 and not wild.infeasible
    np.testing.assert_allclose(wild.step, exact.step, atol=1e-5)


def test_completing_repairs_a_rough_answer() -> None:
    """Two active sides are missing, and one too many is held."""
    program, qp = at(Unicycle("straight", False, 20), 2)
    route = GraphRoute(program)
    exact = route.solve(qp, np.zeros(program.constraints.count), 1e-9)
    active = np.flatnonzero(~program.equality & (np.abs(exact.multipliers) > 1e-3))
    idle = np.flatnonzero(~program.equality & (exact.multipliers == 0.0) & np.isfinite(qp.upper))
    step, dual = exact.step + 1e-3, exact.multipliers.copy()
    dual[active[:2]], dual[idle[0]] = 0.0, 10.0
    assert qp_error(qp, step, dual) > 1e-4
    assert route.complete(qp, step, dual, 1e-9) <= 1e-9
    np.testing.assert_allclose(step, exact.step, atol=1e-7)


@pytest.mark.parametrize(("limit", "contradicts"), [(1.0 - 1e-4, True), (1.0 + 1e-4, False)])
def test_contradicting_rows_are_proved_and_no_others(limit: float, contradicts: bool) -> None:
    """A sum that has to reach one beside limits that let it almost, or just."""
    graph, x = drawn_to([0.3, -5.0])
    graph.constrain(lambda p: p[:, :1] + p[:, 1:], x, lower=1.0, name="sum")
    graph.bound(x, lower=[-np.inf, -np.inf], upper=[0.5, limit - 0.5])
    program = graph.compile()
    qp = subproblem(program, program.linearize(program.values_from({x: np.zeros((1, 2))})), 0.0)
    answer = GraphRoute(program).solve(qp, np.zeros(program.constraints.count), 1e-8)
    assert answer.infeasible == contradicts
    assert contradicts or answer.error <= 1e-8


@pytest.mark.product(6)
@pytest.mark.parametrize("options", [{}, {"full_steps": True, "max_iterations": 5}], ids=["searched", "full steps"])
@pytest.mark.parametrize("qp", ["graph", "osqp"])
@pytest.mark.parametrize("case", ["drive", "HS26", "HS29", "HS40"])
def test_python_in_the_place_of_kernels_changes_nothing(case: str, qp: str, options: dict[str, Any]) -> None:
    """The compiled step asks Python for values and linearisations, and for corrections in both cases."""
    stated = Unicycle("behind", True, 20).formulation()
    graph, guess = CASES[case].build() if case in CASES else (stated.graph, stated.guess)
    found = SQP(qp=qp, **options).prepare(graph).solve(guess)
    with patch.object(CompiledProblem, "fully_compiled", PropertyMock(return_value=False)):
        asked = SQP(qp=qp, **options).prepare(graph).solve(guess)
    assert asked.status is found.status and asked.iterations == found.iterations
    for mine, other in zip(asked.history, found.history, strict=True):
        assert mine.step_length == other.step_length and mine.details.keys() == other.details.keys()
        assert mine.cost == pytest.approx(other.cost, rel=1e-6, abs=1e-8)
