"""Corrections that make full steps of SQP good ones: the second-order correction, and the curvature a secant sees."""

from __future__ import annotations

import numpy as np
import pytest

import unifg as fg
from problems.hock_schittkowski import SMALL
from unifg.solvers import SQP
from unifg.solvers.quadratic_programs.scaling import Scaling
from unifg.solvers.quadratic_programs.subproblem import subproblem
from unifg.solvers.sqp import missing_curvature

CASES = {case.name: case for case in SMALL}


def maratos(angle: float) -> tuple[fg.Graph, fg.Guess]:
    """Maratos' example, as in Nocedal and Wright (2006), ex. 15.4: 2 (x^2 + y^2 - 1) - x on the unit circle.

    From any point of the circle, with the multiplier of the answer, the full Newton step converges quadratically, and
    raises both the cost and the violation.
    """
    graph = fg.Graph()
    x = graph.variables("x", fg.Rn(2), 1)
    graph.minimize_scalar(lambda p: 2.0 * ((p**2).sum(axis=1) - 1.0) - p[:, 0], x, name="cost")
    graph.constrain(lambda p: (p**2).sum(axis=1, keepdims=True), x, lower=1.0, upper=1.0, name="circle")
    return graph, fg.Guess({x: np.array([[np.cos(angle), np.sin(angle)]])}, {"circle": np.array([[-1.5]])})


@pytest.mark.parametrize("angle", [0.1, 0.3, 0.5, 0.8])
def test_full_steps_that_merits_reject_are_corrected(angle: float) -> None:
    graph, guess = maratos(angle)
    solution = SQP(hessian="exact").solve(graph, guess, check=True)
    assert [row.step_length for row in solution.history[1:]] == [1.0] * solution.iterations
    assert solution.history[1].details["correction"] == 1
    assert solution.iterations <= 4
    without = SQP(hessian="exact", second_order_correction=False).solve(graph, guess, check=True)
    assert without.history[1].step_length < 0.5
    assert without.iterations >= solution.iterations + 3


@pytest.mark.parametrize(("name", "most"), [("HS18", 25), ("HS29", 25), ("HS31", 25), ("HS40", 15), ("HS12", 15)])
def test_curvature_that_gauss_newton_lacks_is_seen_along_the_step(name: str, most: int) -> None:
    """Without the secant two of these end at the limit of 200, and the others take thrice the steps."""
    graph, guess = CASES[name].build()
    solution = SQP().solve(graph, guess)
    assert solution.converged and solution.iterations <= most, solution.report()


def test_missing_curvature_by_hand() -> None:
    """On the rim of a circle the Lagrangian's curvature is 1 + 2 lambda; Gauss-Newton knows the one."""
    graph = fg.Graph()
    x = graph.variables("x", fg.Rn(2), 1)
    graph.minimize(fg.prior, x, [1.0, 0.0])
    graph.constrain(lambda p: (p**2).sum(axis=1, keepdims=True), x, upper=1.0, name="circle")
    program = graph.compile()
    before = program.linearize(program.values_from({x: np.array([[0.6, 0.8]])}))
    step = np.array([0.3, -0.2])
    after = program.linearize(program.retract(before.values, step))
    for scaling in (Scaling.none(program), Scaling(program, np.array([4.0, 4.0]), np.ones(1))):
        unit = float(scaling.metric[0])
        for multiplier, missing in ((2.0, 4.0), (0.5, 1.0), (0.1, 0.0), (-0.4, 0.0)):  # less than half does not count
            qp = subproblem(program, before, 0.7 * scaling.metric)
            found = missing_curvature(scaling, qp, before, after, np.array([multiplier]), step)
            assert found * unit == pytest.approx(missing, abs=1e-6)
    short = program.linearize(program.retract(before.values, 1e-9 * step))
    qp = subproblem(program, before, 0.0)
    assert missing_curvature(Scaling.none(program), qp, before, short, np.array([2.0]), 1e-9 * step) == 0.0
