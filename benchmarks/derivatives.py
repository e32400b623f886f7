"""Sensitivities of control problems beside problems solved again, and the price of these, of verify() and explain()."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import unifg as fg
from benchmarks.report import table
from benchmarks.runner import Timing
from benchmarks.timing import clocked, number
from problems.control import Problem, problems, sixteen
from unifg.solvers import InteriorPoint
from unifg.typing import Array

CASES = list(dict.fromkeys([*problems(), *sixteen()]))
LOOSE, TIGHT, STEPS = 1e-9, 1e-11, (3e-4, 3e-5, 1e-5)
OFFSETS = 0.0, 0.01, 0.02, 0.03  # of the start, to get away from where some limit is about to act


def spent(rounds: int, call: Callable[[], Any], before: Callable[[], Any] = lambda: None) -> float:
    """Least processor time [us] of a call, which takes what ``before`` made."""
    found = []
    for _ in range(rounds):
        before()
        found.append(clocked(call)[1])
    return 1e6 * min(found)


def measure(case: Problem, rounds: int) -> tuple[float, ...]:
    """Columns of the table.

    Raises:
        GraphError: some limit is about to act at every start tried.
    """
    stated, dim = case.formulation(), case.manifold.dim
    run, start, latest = InteriorPoint(tolerance=TIGHT).prepare(stated.graph), case.start, list[fg.Solution]()
    x, u = stated.x, stated.u

    def solve(here: Any) -> fg.Solution:
        return run.solve(latest[0] if latest else stated.guess, data=stated.data(here, 0))

    probe = InteriorPoint(tolerance=LOOSE).prepare(stated.graph)
    for offset in OFFSETS:
        start = case.manifold.retract(case.start[None], np.full((1, dim), offset))[0]
        try:
            probe.solve(stated.guess, data=stated.data(start, 0), check=True).sensitivity(u[0], x[0])
            break
        except fg.GraphError:
            if offset == OFFSETS[-1]:
                raise
    solution = run.solve(stated.guess, data=stated.data(start, 0), check=True)
    found = solution.sensitivity([x, u], x[0])
    latest.append(solution)

    def differences(step: float) -> Array:
        """(K, d) central differences of fourth order of problems solved again."""
        columns = []
        for direction in np.eye(dim):
            ends = []
            for move in (step * direction[None], 2.0 * step * direction[None]):
                ahead, behind = (solve(case.manifold.retract(start[None], sign * move)[0]) for sign in (1.0, -1.0))
                ends.append(np.concatenate([f.manifold.local(behind[f], ahead[f]).ravel() for f in (x, u)]))
            columns.append((8.0 * ends[0] - ends[1]) / (12.0 * step))
        return np.stack(columns, axis=1)

    expected = [differences(step) for step in STEPS]
    error = np.min([np.linalg.norm(found - e, axis=0) / np.linalg.norm(e, axis=0) for e in expected], axis=0)

    def again() -> None:
        latest[0] = run.solve(stated.guess, data=stated.data(start, 0))

    cold = spent(rounds, again)
    per_iteration = cold / latest[0].iterations
    first = spent(rounds, lambda: latest[0].sensitivity(u[0], x[0]), again)
    latest[0].sensitivity([x, u], x[0])
    column = spent(rounds, lambda: latest[0].sensitivity([x, u], x[0])) / dim
    adjoint = spent(rounds, lambda: latest[0].gradient({x[-1]: 1.0}, x[0]))
    verify, explain = (spent(rounds, getattr(latest[0], name)) for name in ("verify", "explain"))
    return float(error.max()), 1e-3 * cold, first / per_iteration, column, adjoint, 1e-3 * verify, 1e-3 * explain


def tables(rounds: int) -> str:
    """All cases."""
    head = (
        "problem", "error", "cold solve ms", "first question, iterations", "a column us", "% of the solve",
        "an adjoint us", "% of the solve", "verify() ms", "explain() ms",
    )  # fmt: skip
    lines, rows = [], []
    for case in CASES:
        try:
            found = measure(case, rounds)
        except fg.GraphError:
            lines.append((case.title, "weakly active", *["-"] * 8))
            continue
        error, cold, first, column, adjoint, verify, explain = found
        rows.append((error, first, 0.1 * column / cold, 0.1 * adjoint / cold, verify))
        shown = (cold, first, column, 0.1 * column / cold, adjoint, 0.1 * adjoint / cold, verify, explain)
        lines.append((case.title, f"{error:.1e}", *(number(value) for value in shown)))
    middle, worst = np.median(rows, axis=0), np.max(rows, axis=0)
    notes = (
        f"Largest relative error of d(x, u) / d(start) {worst[0]:.1e}, of a column beside central differences of "
        f"fourth order of problems solved again to {TIGHT:.0e}, the best of {len(STEPS)} steps. In the median (at "
        f"worst) the first question costs {middle[1]:.1f} ({worst[1]:.1f}) iterations, a column {middle[2]:.1f} % "
        f"({worst[2]:.1f} %) of the cold solve, an adjoint {middle[3]:.1f} % ({worst[3]:.1f} %), verify() "
        f"{middle[4]:.1f} ms ({worst[4]:.1f} ms). Least processor times of {rounds}; columns are asked for "
        "together, an adjoint is a `gradient` of one sum."
    )
    return f"{table(head, lines, 2)}\n\n{notes}"


STUDY = Timing(tables, 9)
