"""The collection of small problems, the backends that are tried on it, and what is right to answer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

import unifg as fg
from judge import judge
from problems.hock_schittkowski import SMALL, Case
from problems.hock_schittkowski_later import LATER
from problems.lie import LIE, LieCase
from problems.small import DEGENERATE, INFEASIBLE, SQUARES
from unifg.solvers import SQP, InteriorPoint
from unifg.solvers.names import backends

Problem: TypeAlias = Case | LieCase

GROUPS: dict[str, list[Problem]] = {
    "Hock and Schittkowski": [*SMALL, *LATER],
    "sums of squares": [*SQUARES],
    "degenerate": [*DEGENERATE],
    "Lie groups": [case for case in LIE if case.feasible],
    "infeasible": [*INFEASIBLE, *(case for case in LIE if not case.feasible)],
}
CASES: dict[str, Problem] = {case.name: case for group in GROUPS.values() for case in group}
BACKENDS: dict[str, fg.Solver] = {
    **{solver.name: solver for solver in backends("gn", "lm", "dogleg", "kkt", "penalty", "alm", "sqp").values()},
    "SQP, exact": SQP(hessian="exact"),
    "InteriorPoint": InteriorPoint(),
}

OPTIMUM, OTHER, DEGENERATE_POINT, INFEASIBLE_POINT = "optimum", "other", "degenerate", "infeasible"
RIGHT = (OPTIMUM, OTHER, DEGENERATE_POINT, INFEASIBLE_POINT)
SAME_COST = 1e-5  # relative to max(1, |cost|)
UNQUALIFIED_COST = 1e-2


@dataclass(frozen=True)
class Outcome:
    """Result of a backend on a problem.

    Attributes:
        verdict: "optimum" (the known one), "other" (a KKT point listed with the problem), "degenerate" (said so at an
            optimum that has no multipliers), "infeasible" (said so, and there is no answer), else the status, or
            "unknown point" for a KKT point nobody has listed and "disproved" for a claim that the judge rejects.
        iterations: spent.
        cost: at the end.
    """

    verdict: str
    iterations: int
    cost: float

    @property
    def right(self) -> bool:
        """True if the backend did what can be asked of it."""
        return self.verdict in RIGHT


def attempt(name: str, backend: fg.Solver) -> Outcome | None:
    """Solve a problem by its name from its start and judge the answer; None when the backend refuses its class."""
    case = CASES[name]
    graph, guess = case.build()
    try:
        run = backend.prepare(graph)
    except fg.BackendError:
        return None
    solution = run.solve(guess)
    return Outcome(verdict(case, graph, solution), solution.iterations, solution.cost)


def verdict(case: Problem, graph: fg.Graph, solution: fg.Solution) -> str:
    """Name what a solution is."""
    if solution.status is fg.Status.LOCALLY_INFEASIBLE and not case.feasible:
        return INFEASIBLE_POINT
    degenerate = solution.status is fg.Status.DEGENERATE and not case.qualified
    if not (degenerate or solution.converged or (solution.status is fg.Status.UNDETERMINED and not case.determined)):
        return solution.status.name.lower().replace("_", " ")
    if judge(graph, solution).worst() > case.judged:
        return "disproved"
    found = _point(case, solution.cost)
    return DEGENERATE_POINT if degenerate and found == OPTIMUM else found


def _point(case: Problem, cost: float) -> str:
    accuracy = SAME_COST if case.qualified else UNQUALIFIED_COST
    for known, word in ((case.best, OPTIMUM), *((other, OTHER) for other in case.others)):
        if abs(cost - known) <= accuracy * max(1.0, abs(known)):
            return word
    return "unknown point"


def ipopt(case: Case) -> Outcome:
    """The same formulas, solved by IPOPT with exact derivatives from CasADi; not judged, only compared."""
    import casadi as ca

    ca.GlobalOptions.setNumpyMode(-1)
    x = ca.SX.sym("x", len(case.start))
    parts = ca.vertsplit(x)
    cost, rows, upper = ca.SX(0), [], []
    if case.squares is not None:
        cost += sum(row * row for row in case.squares(*parts))
    if case.cost is not None:
        cost += case.cost(*parts)
    for formula, limit in ((case.equal, 0.0), (case.least, np.inf)):
        if formula is not None:
            found = formula(*parts)
            rows += found
            upper += [limit] * len(found)
    quiet: dict[str, Any] = {
        "print_time": False,
        "show_eval_warnings": False,
        "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-8},
    }
    solver = ca.nlpsol("ipopt", "ipopt", {"x": x, "f": cost, "g": ca.vertcat(*rows) if rows else ca.SX(0, 1)}, quiet)
    size = len(case.start)
    result = solver(
        x0=case.start,
        lbx=np.broadcast_to(np.asarray(case.lower, dtype=float), size),
        ubx=np.broadcast_to(np.asarray(case.upper, dtype=float), size),
        lbg=np.zeros(len(rows)),
        ubg=np.array(upper),
    )
    stats, value = solver.stats(), float(result["f"])
    status = str(stats["return_status"])
    if status == "Infeasible_Problem_Detected" and not case.feasible:
        return Outcome(INFEASIBLE_POINT, int(stats["iter_count"]), value)
    word = _point(case, value) if stats["success"] else status.replace("_", " ").lower()
    return Outcome(word, int(stats["iter_count"]), value)
