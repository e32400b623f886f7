"""The backends that docs/howto/own-backend.md builds, on the table of problems."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unifg as fg
from fences import fences
from judge import judge
from problems.known import PROBLEMS, Problem

PAGE = Path(__file__).resolve().parent.parent / "docs" / "howto" / "own-backend.md"


@pytest.fixture(scope="module")
def page() -> dict[str, Any]:
    scope: dict[str, Any] = {"__name__": "own_backend"}
    for block in fences(PAGE):
        if block.language == "python":
            exec(compile(block.code, str(PAGE), "exec", dont_inherit=True), scope)
    return scope


@pytest.fixture(scope="module")
def backend(page: dict[str, Any]) -> fg.Solver:
    solver = page["Newton"]()
    assert isinstance(solver, fg.Solver)
    return solver


@pytest.mark.parametrize("problem", PROBLEMS, ids=lambda p: p.name)
def test_solves_what_has_no_constraints_and_refuses_the_rest(backend: fg.Solver, problem: Problem) -> None:
    graph, guess = problem.build()
    if problem.constrained:
        with pytest.raises(fg.BackendError):
            backend.solve(graph, guess)
        return
    solution = backend.solve(graph, guess, check=True)
    assert judge(graph, solution).worst() < 2e-6
    if np.isfinite(problem.cost):
        assert solution.cost == pytest.approx(problem.cost, rel=1e-6, abs=1e-7)


@pytest.mark.parametrize("problem", PROBLEMS, ids=lambda p: p.name)
def test_solves_equalities_and_refuses_the_rest(page: dict[str, Any], problem: Problem) -> None:
    solver = page["Lagrange"]()
    graph, guess = problem.build()
    try:
        solution = solver.solve(graph, guess)
    except fg.BackendError:
        assert problem.scalar or not graph.compile().equality.all()
        return
    assert solution.converged, solution.report()
    assert judge(graph, solution).worst() < 2e-6
    if np.isfinite(problem.cost):
        assert solution.cost == pytest.approx(problem.cost, rel=1e-6, abs=1e-7)
    for name, expected in problem.duals.items():
        assert np.allclose(solution.dual(name), expected, atol=1e-5)


def test_page_and_example_have_the_same_backend() -> None:
    example = (PAGE.parents[2] / "examples" / "own_backend_constrained.py").read_text(encoding="utf-8")
    (own,) = (block.code for block in fences(PAGE) if "class Lagrange" in block.code)
    assert own[own.index("class Lagrange") :].strip() in example
