"""The backend that docs/own-backend.md builds, on the table of problems."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unifg as fg
from fences import fences
from judge import judge
from problems.known import PROBLEMS, Problem

PAGE = Path(__file__).resolve().parent.parent / "docs" / "own-backend.md"


@pytest.fixture(scope="module")
def backend() -> fg.Solver:
    scope: dict[str, Any] = {"__name__": "own_backend"}
    code = next(block.code for block in fences(PAGE) if block.language == "python")
    exec(compile(code, str(PAGE), "exec", dont_inherit=True), scope)
    solver = scope["Newton"]()
    assert isinstance(solver, fg.Solver)
    return solver


@pytest.mark.parametrize("problem", PROBLEMS, ids=lambda p: p.name)
def test_solves_what_has_no_constraints_and_refuses_the_rest(backend: fg.Solver, problem: Problem) -> None:
    graph, guess = problem.build()
    if problem.constrained:
        with pytest.raises(fg.BackendError):
            backend.solve(graph, guess)
        return
    solution = backend.solve(graph, guess)
    assert solution.converged, solution.report()
    assert judge(graph, solution).worst() < 2e-6
    if np.isfinite(problem.cost):
        assert solution.cost == pytest.approx(problem.cost, rel=1e-6, abs=1e-7)
