"""A backend for whoever names none: what a graph states decides, and a second one tries where the first ends without.

The order is the measured one (docs/guide/solvers.md): from cold guesses the damped Gauss-Newton method solves sums of
squares, the interior point takes the fewest iterations as soon as there is a constraint or a scalar cost, and the
augmented Lagrangian gets there from guesses that lead the interior point into a corner.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from unifg.errors import GraphError, NotFiniteError, require_kinds
from unifg.modeling.model import Model
from unifg.modeling.variables import Data
from unifg.problem.compiled_problem import CompiledProblem, idle_problem
from unifg.solution.solution import AnyGuess, NotConverged, Solution
from unifg.solution.solve_state import Callback
from unifg.solution.solver import Solver
from unifg.solution.starts import spread
from unifg.solution.status import Found, Status
from unifg.solvers.augmented_lagrangian import AugmentedLagrangian
from unifg.solvers.interior_point.method import InteriorPoint
from unifg.solvers.least_squares import LevenbergMarquardt
from unifg.typing import Numbers

logger = logging.getLogger("unifg")

ELSEWHERE = {
    Status.ITERATION_LIMIT,
    Status.STALLED,
    Status.LOCALLY_INFEASIBLE,
    Status.DEGENERATE,
    Status.SINGULAR,
    Status.NOT_FINITE,
}
"""Endings after which another method may get further from the same guess."""


@dataclass(frozen=True)
class Choice:
    """Backend chosen for a graph, with the reason.

    Attributes:
        first: is tried.
        second: is tried where the first ends without a solution.
        reason: what about the graph decided, as it follows "picked for".
    """

    first: Solver
    second: Solver
    reason: str


def choose(
    graph: Model,
    data: Mapping[Data, Numbers] | None = None,
    *,
    tolerance: float = 1e-6,
    time_limit: float = np.inf,
    verbose: bool = False,
) -> Choice:
    """Pick backends by what a graph states with these data; arguments as for :func:`solve`.

    Raises:
        GraphError: when the graph or data is malformed.
    """
    program = idle_problem(graph)
    with program.lock:
        program.bind(data or {})
        reason = _kind(program)
    options = {"tolerance": tolerance, "time_limit": time_limit, "verbose": verbose}
    point = InteriorPoint(**options)  # type: ignore[arg-type]  # each goes to the field of its name
    if not (program.constraint_terms or program.scalar_terms):
        return Choice(LevenbergMarquardt(**options), point, reason)  # type: ignore[arg-type]
    return Choice(point, AugmentedLagrangian(**options), reason)  # type: ignore[arg-type]


def _kind(program: CompiledProblem) -> str:
    """Deciding property in words."""
    if program.scalar_terms:
        return f"the scalar cost '{program.scalar_terms[0].name}'"
    if not program.constraint_terms:
        return "least squares without constraints"
    rows = np.flatnonzero(program.inequalities)
    if len(rows):
        return f"the inequality '{program.row_name(int(rows[0]))[0]}'"
    equal = np.flatnonzero(program.equality)
    if len(equal):
        return f"the equality '{program.row_name(int(equal[0]))[0]}'"
    return f"the constraint '{program.constraint_terms[0].name}', without limits now"


def solve(
    graph: Model,
    guess: AnyGuess,
    *,
    data: Mapping[Data, Numbers] | None = None,
    check: bool = False,
    callback: Callback | None = None,
    tolerance: float = 1e-6,
    time_limit: float = np.inf,
    verbose: bool = False,
    starts: int = 1,
) -> Solution:
    """Do as ``fg.solve`` says."""
    require_kinds("solve", GraphError, solve.__annotations__, {"starts": starts})
    if starts < 1:
        raise GraphError(f"solve: starts must be 1, the guess alone, or more, found {starts}")
    choice = choose(graph, data, tolerance=tolerance, time_limit=time_limit, verbose=verbose)
    logger.info("picked %s for %s", choice.first.name, choice.reason)
    solution = choice.first.solve(graph, guess, data=data, callback=callback)
    left = time_limit - solution.seconds
    if starts > 1:
        solution, left = _best_start(choice.first, graph, guess, data or {}, callback, starts, solution, left)
    others, solution.picked = solution.others, f"picked for {choice.reason}"
    if solution.status in ELSEWHERE and left > 0.0:
        how = solution.status.name.lower().replace("_", " ")
        logger.info("picked %s: %s ended as %s", choice.second.name, choice.first.name, how)
        other = replace(choice.second, time_limit=left).solve(graph, guess, data=data, callback=callback)
        if other.converged or _reached(other, tolerance) < _reached(solution, tolerance):
            other.picked = f"{solution.picked}, after {choice.first.name} ended as {how}"
            solution, other.others = other, others
        else:
            solution.picked += f"; {other.solver} ended as {other.status.name.lower().replace('_', ' ')}"
    if check and not solution.converged:
        raise NotConverged(solution)
    return solution


def _reached(solution: Solution, tolerance: float) -> tuple[float, float]:
    """Violation, or the tolerance of it, and cost, by which endings without an answer are compared."""
    return max(solution.violation, tolerance), solution.cost


def _best_start(
    solver: Solver,
    graph: Model,
    guess: AnyGuess,
    data: Mapping[Data, Numbers],
    callback: Callback | None,
    count: int,
    best: Solution,
    left: float,
) -> tuple[Solution, float]:
    """The cheapest answer from the guess, ``best``, and from other starts, and what is ``left`` of the time [s].

    Starts at which a term is not finite are left out.
    """
    prepared, others, last = solver.bound(graph), list[Found](), best
    with prepared.program.lock:
        prepared.program.bind(data)
        starts = spread(prepared.program, prepared.read(guess), count - 1)
    while left > 0.0 and last.status is not Status.INTERRUPTED:
        with prepared.program.lock:
            prepared.program.bind(data)
            if (start := next(starts, None)) is None:
                break
        with suppress(NotFiniteError):
            last = replace(solver, time_limit=left).solve(graph, start, data=data, callback=callback)
            left -= last.seconds
            cheaper = last.converged and not (best.converged and best.cost <= last.cost)
            best, worse = (last, best) if cheaper else (best, last)
            values = {family.name: array.copy() for family, array in worse.values.items()}
            others.append(Found(worse.status, worse.cost, worse.violation, values))
    best.others = tuple(others)
    return best, left
