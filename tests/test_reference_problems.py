"""The sixteen unicycle problems with verified answers, from their cold guesses, judged by :mod:`judge`."""

from __future__ import annotations

import numpy as np
import pytest

from judge import judge
from problems.control import Unicycle, sixteen
from unifg.solvers.names import backends

# Minima that are not listed, at which IPOPT stays when it is started there.
CONFIRMED = {("ahead", True, 20): (586.14768,), ("ahead", True, 50): (580.25905,)}
SOLVERS = backends("alm", "sqp", "ipm", tolerance=1e-5)


@pytest.mark.parametrize("problem", sixteen(), ids=lambda p: p.name)
@pytest.mark.parametrize("solver", SOLVERS)
def test_reference_problem(solver: str, problem: Unicycle) -> None:
    stated = problem.formulation()
    solution = SOLVERS[solver].solve(stated.graph, stated.guess)
    assert solution.converged, solution.report()
    known = np.array([*problem.optima, *CONFIRMED.get((problem.instance, problem.blocked, problem.horizon), ())])
    assert np.abs(solution.cost / known - 1.0).min() < 1e-4
    if problem.horizon == 20:  # the judge differentiates densely: two evaluations of everything per coordinate
        assert judge(stated.graph, solution).worst() < 1e-4
