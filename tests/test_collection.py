"""Every backend on the collection of small problems, judged by :mod:`judge`, and what it says without an answer."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import unifg as fg
from judge import judge
from problems.collection import BACKENDS, CASES, GROUPS, OPTIMUM, RIGHT, attempt, ipopt, verdict
from problems.graphs import graph_with
from problems.hock_schittkowski import Case
from problems.known import short_drive
from problems.lie import LieCase
from unifg.modeling.terms import Constraint
from unifg.typing import Array

# Constraints, costs that are no squares.
CLASSES = {
    "GaussNewton": (False, False),
    "LevenbergMarquardt": (False, False),
    "DogLeg": (False, False),
    "KKT": (True, False),
    "Penalty": (True, False),
    "AugmentedLagrangian": (True, True),
    "SQP": (True, True),
    "SQP, exact": (True, True),
    "InteriorPoint": (True, True),
}
# What is known not to be solved; a problem that begins to fail or to pass fails here.
UNSOLVED: dict[str, set[str]] = {
    # No damping: the valley of Freudenstein and Roth is flat at a KKT point, Beale's Jacobian is singular on the way.
    "GaussNewton": {"Freudenstein and Roth", "Beale", "Jennrich and Sampson"},
    # Damping that is relative to what vanishes with the residuals makes steps ever shorter; SQP's is absolute, and ends
    # at 1e-12 of the residuals.
    "LevenbergMarquardt": {"Powell's singular function"},
    "DogLeg": {"Freudenstein and Roth", "Beale", "Jennrich and Sampson"},
    "KKT": {"HS27", "Powell's singular function"},
    # A largest penalty leaves violations; and large penalties are hard least-squares problems.
    "Penalty": {
        *("HS13", "HS15", "HS17", "HS20", "HS27", "HS58", "discs that touch"),
    },
    "AugmentedLagrangian": {"HS13"},  # no multipliers
    # Convexified costs without curvature send the first steps far away; where they land decides, to the last digit.
    "SQP": {"HS93", "Powell's singular function"},
    "SQP, exact": {"HS25", "HS93", "Powell's singular function"},
    "InteriorPoint": set(),
}
# Solved or not, by the version of the QP solver: with PIQP 0.7 the first ends 4e-5 short of stationarity, with 0.6 it
# converges. What is claimed must be true all the same.
# HS93 is found in 46 iterations with PIQP 0.6; with 0.7, all else the same, a first step lands where products of six
# unknowns have no slope, and it stalls after 6. It counts as unsolved.
# Where the first steps of SQP in HS56 land depends on the rounding of its derivatives.
UNDECIDED: dict[str, set[str]] = {"SQP, exact": {"HS72", "HS93"}, "SQP": {"HS56", "HS93"}}
AIMS = {"InteriorPoint": 0.95, "SQP": 0.95, "AugmentedLagrangian": 0.90}


def takes(name: str, graph: fg.Graph) -> bool:
    """Test whether a backend claims the class of a graph."""
    constraints, scalars = CLASSES[name]
    program = graph.compile()
    return (scalars or not program.scalar_terms) and (constraints or not len(program.equality))


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.product(24)
def test_backend_solves_what_its_class_allows(name: str, case: str) -> None:
    graph, guess = CASES[case].build()
    backend = BACKENDS[name]
    if not takes(name, graph):
        with pytest.raises(fg.BackendError):
            backend.prepare(graph)
        return
    solution = backend.solve(graph, guess)
    found = verdict(CASES[case], graph, solution)
    assert found not in ("disproved", "unknown point"), solution.report()
    if case in UNDECIDED.get(name, set()):
        return
    if case in UNSOLVED[name]:
        assert found not in RIGHT, f"solved now ({found}): take it off the list"
        return
    assert found in RIGHT, solution.report()
    known = CASES[case]
    if found == OPTIMUM and isinstance(known, LieCase):
        for family, expected in known.answer.items():
            handle = graph.families[family]
            distance = handle.manifold.local(np.asarray(expected, dtype=np.float64), solution[handle])
            assert np.abs(distance).max() < 1e-5


@pytest.mark.parametrize("case", ["HS24", "HS45", "HS61", "HS104"])
def test_penalties_hold_what_curved_scalar_costs_run_down(case: str) -> None:
    """Slopes at the guess are small, those farther on are not."""
    outcome = attempt(case, BACKENDS["AugmentedLagrangian"])
    assert outcome is not None and outcome.verdict == OPTIMUM and outcome.iterations <= 40


@pytest.mark.product(1, of="studies")
def test_the_aims_are_met() -> None:
    """Shares of what a backend takes; the test above holds the lists to the truth."""
    assert sum(len(GROUPS[name]) for name in ("Hock and Schittkowski",)) >= 60
    assert sum(isinstance(case, LieCase) for case in CASES.values()) >= 10
    graphs = {name: case.build()[0] for name, case in CASES.items()}
    for name, aim in AIMS.items():
        taken = [case for case, graph in graphs.items() if takes(name, graph)]
        assert 1.0 - len(UNSOLVED[name]) / len(taken) >= aim


@pytest.mark.product(1, of="studies")
def test_ipopt_confirms_the_formulas() -> None:
    """The same expressions, differentiated and solved by others, lead to the published optima."""
    pytest.importorskip("casadi")
    wrong = {
        name: outcome.verdict
        for name, case in CASES.items()
        if isinstance(case, Case) and not (outcome := ipopt(case)).right
    }
    # One has more equalities than unknowns, which IPOPT refuses; in the other multipliers grow without end.
    assert set(wrong) <= {"three lines through a point", "HS13"}, wrong


# ------------------------------------------------------------------- the files of quadratic programs


def quadratic_program(text: str) -> tuple[Array, Array, Array, Array, float]:
    """Hessian, linear cost, rows, right-hand sides and constant of a small QPS file."""
    sections: dict[str, list[list[str]]] = {}
    for line in text.splitlines():
        if line.strip() and not line.startswith(" "):
            entries = sections.setdefault(line.split()[0], [])
        elif line.strip():
            entries.append(line.split())
    rows = [name for _, name in sections["ROWS"]]
    columns = list(dict.fromkeys(entry[0] for entry in sections["COLUMNS"]))
    matrix, right, hessian = np.zeros((len(rows), len(columns))), np.zeros(len(rows)), np.zeros((len(columns),) * 2)
    for column, *pairs in sections["COLUMNS"]:
        for row, value in zip(pairs[::2], pairs[1::2], strict=True):
            matrix[rows.index(row), columns.index(column)] = float(value)
    for _, *pairs in sections["RHS"]:
        for row, value in zip(pairs[::2], pairs[1::2], strict=True):
            right[rows.index(row)] = float(value)
    for first, second, value in sections["QUADOBJ"]:
        i, j = columns.index(first), columns.index(second)
        hessian[i, j] = hessian[j, i] = float(value)
    return hessian, matrix[0], matrix[1:], right[1:], -float(right[0])


@pytest.mark.data
@pytest.mark.parametrize("name", ["HS21", "HS35", "HS51", "HS52", "HS268"])
def test_formulas_agree_with_the_files(shared_data: Path, name: str, rng: np.random.Generator) -> None:
    """Costs agree up to a constant of the file, and rows up to their order and sign."""
    hessian, linear, rows, right, constant = quadratic_program((shared_data / "qp" / f"{name}.QPS").read_text())
    case = CASES[name]
    program = case.build()[0].compile()
    family = program.families[0]
    differences = []
    for _ in range(4):
        x = rng.standard_normal(len(linear))
        point = program.evaluate(program.values_from({family: x[None]}))
        differences.append(point.cost - (0.5 * x @ hessian @ x + linear @ x + constant))
        file = np.sort(np.abs(rows @ x - right))
        own = np.abs(point.constraints[~program.bound_rows])
        np.testing.assert_allclose(np.sort(own), file, rtol=1e-9, atol=1e-9)
    scale = max(1.0, float(np.abs(hessian).max()))
    np.testing.assert_allclose(differences, differences[0], atol=1e-9 * scale)


# ------------------------------------------------------------------- honest endings

CONSTRAINED = [name for name, (constraints, _) in CLASSES.items() if constraints]


@pytest.mark.product(12)
@pytest.mark.parametrize("case", [case.name for case in GROUPS["infeasible"]])
@pytest.mark.parametrize("name", CONSTRAINED)
def test_least_violation_is_claimed_where_it_is(name: str, case: str, rng: np.random.Generator) -> None:
    """The worst term is named, and no nearby point that keeps the bounds violates less."""
    if case in UNDECIDED.get(name, set()):
        return
    if case in UNSOLVED[name]:
        pytest.skip("not found by this backend")
    graph, guess = CASES[case].build()
    solution = BACKENDS[name].solve(graph, guess)
    assert solution.status is fg.Status.LOCALLY_INFEASIBLE, solution.report()
    assert solution.worst is not None
    assert solution.worst[0] in {term.name for term in graph.terms if isinstance(term, Constraint)}
    assert solution.worst[0] in solution.report()
    program = graph.compile()
    values = program.values_from(solution.values)
    kept = not (program.violation(program.evaluate(values).constraints) * program.bound_rows).any()
    here = program.violation(program.evaluate(values).constraints)
    for _ in range(50):
        moved = program.retract(values, 1e-3 * rng.standard_normal(program.size))
        there = program.violation(program.evaluate(program.within_bounds(moved) if kept else moved).constraints)
        assert there @ there >= here @ here - 1e-6


def staged(name: str) -> tuple[fg.Graph, dict[fg.Family, Array]]:
    """A problem of the backend's class that takes it several iterations."""
    return short_drive() if CLASSES[name][0] else CASES["Bard"].build()


@pytest.mark.parametrize("name", BACKENDS)
def test_limits_and_interruptions_are_told_apart(name: str) -> None:
    graph, guess = staged(name)
    backend = BACKENDS[name]
    late = replace(backend, time_limit=0.0).solve(graph, guess)
    assert late.status is fg.Status.TIME_LIMIT
    short = replace(backend, max_iterations=1).solve(graph, guess)
    assert short.status is fg.Status.ITERATION_LIMIT
    assert short.iterations == 1
    stopped = backend.solve(graph, guess, callback=lambda row: row.number == 2)
    assert stopped.status is fg.Status.INTERRUPTED
    assert [row.number for row in stopped.history] == [0, 1, 2]

    def pressed(row: fg.Iteration) -> bool:
        if row.number == 1:
            raise KeyboardInterrupt
        return False

    assert backend.solve(graph, guess, callback=pressed).status is fg.Status.INTERRUPTED
    for solution in (late, short, stopped):
        assert not solution.converged
        assert re.match(re.escape(f"{solution.solver}: {solution.status.value}"), solution.report())


@pytest.mark.parametrize("name", [name for name, (_, scalars) in CLASSES.items() if scalars])
@pytest.mark.parametrize("bounded", [True, False], ids=["bounded", "free"])
def test_an_objective_without_minimum_is_unbounded(name: str, bounded: bool) -> None:
    graph, x = graph_with(fg.Rn(2))
    graph.minimize_scalar(lambda p: p[:, 1] ** 2 - np.exp(p[:, 0]), x, name="downhill")
    if bounded:
        graph.bound(x, lower=0.0, name="half plane")
    solution = replace(BACKENDS[name], max_iterations=1000).solve(graph, {x: np.array([[1.0, 1.0]])})
    assert solution.status is fg.Status.UNBOUNDED, solution.report()


@pytest.mark.parametrize("name", BACKENDS)
def test_a_claim_without_multipliers_is_still_a_kkt_point(name: str) -> None:
    """Claims hold to the tolerance where the constraints are not qualified, though a backend may fail there."""
    for case in CASES.values():
        if case.qualified:
            continue
        graph, guess = case.build()
        if takes(name, graph):
            solution = BACKENDS[name].solve(graph, guess)
            assert not solution.converged or judge(graph, solution).worst() < case.judged
