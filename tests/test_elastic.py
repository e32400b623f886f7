"""Behaviour of the interior point where its equalities cannot be met, or not along the way it first takes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import scipy.optimize

import unifg as fg
from out_of_reach import Stated, blocked_corridor, goal_too_far, wall_too_close
from problems import disc_fields, parkings
from unifg.solvers import InteriorPoint
from unifg.typing import Array

LINEAR: dict[str, Callable[[], Stated]] = {
    "twice as far": lambda: goal_too_far(1.0),
    "1 % too far": lambda: goal_too_far(0.01),
    "1 % too far, large costs": lambda: goal_too_far(0.01, 40, 100.0),
    "1 % too far, eight seconds": lambda: goal_too_far(0.01, 80, 1.0),
    "twice as far, huge costs": lambda: goal_too_far(1.0, 80, 100.0),
    "0.01 % too far": lambda: goal_too_far(1e-4),
    "1 % too far, in millimetres": lambda: goal_too_far(0.01, unit=1e-3),
}
BENT: dict[str, Callable[[], Stated]] = {
    "wall": lambda: wall_too_close(2.0),
    "wall, large costs": lambda: wall_too_close(2.0, 40, 100.0),
    "wall, barely too close": lambda: wall_too_close(1.5),
    "corridor": lambda: blocked_corridor(True),
    "corridor without goal": lambda: blocked_corridor(False),
}


def least_squares(graph: fg.Graph, guess: dict[fg.Family, Array]) -> float:
    """Least sum of squared violations of linear equalities within the bounds of the unknowns, found elsewhere."""
    program = graph.compile()
    lin = program.linearize(program.values_from(guess))
    matrix = program.constraints.matrix(lin.constraint_jacobian).toarray()
    equal, bounds = program.equality, program.bound_rows
    assert (equal | bounds).all()
    present = lin.constraints - program.lower
    lower, upper = np.full(program.size, -np.inf), np.full(program.size, np.inf)
    rows, columns = np.nonzero(matrix[bounds])
    lower[columns] = (program.lower - lin.constraints)[bounds][rows]
    upper[columns] = (program.upper - lin.constraints)[bounds][rows]
    found = scipy.optimize.lsq_linear(matrix[equal], -present[equal], (lower, upper), tol=1e-14, max_iter=1000)
    return 2.0 * float(found.cost)


@pytest.mark.parametrize("name", [*LINEAR, *BENT])
def test_a_goal_out_of_reach_is_told(name: str) -> None:
    """Of linear graphs, where the sum of squared violations is least; of others, where something is violated."""
    graph, guess = (LINEAR | BENT)[name]()
    solution = InteriorPoint().solve(graph, guess)
    assert solution.status is fg.Status.LOCALLY_INFEASIBLE, solution.report()
    assert solution.iterations <= 60
    if name in LINEAR:
        program = graph.compile()
        outside = program.violation(program.evaluate(solution.values).constraints)
        assert float(outside @ outside) == pytest.approx(least_squares(graph, guess), rel=1e-6)
    else:
        assert solution.violation > 1e-3


@pytest.mark.parametrize("kind", ["rest", "line"])
@pytest.mark.parametrize("cars", [False, True])
def test_parkings_from_rest(cars: bool, kind: parkings.Guess) -> None:
    """The linearised dynamics of a standing car do not reach a place beside it."""
    stated = parkings.Parking(InteriorPoint(), cars)
    for seed in range(200, 204):
        solution = stated.solve(parkings.layout(seed, cars), kind)
        assert solution.converged, solution.report()
        assert solution.iterations <= 120


def test_a_watched_solve_takes_the_same_steps_with_elastic_equalities() -> None:
    stated, drawn = parkings.Parking(InteriorPoint()), parkings.layout(0)
    alone = stated.solve(drawn, "rest")
    rows: list[fg.Iteration] = []
    watched = stated.solve(drawn, "rest", callback=rows.append)
    assert alone.converged and watched.converged
    assert abs(alone.iterations - watched.iterations) <= 2
    assert alone.cost == pytest.approx(watched.cost, rel=1e-6)
    graph, guess = goal_too_far(0.01)
    told = InteriorPoint().solve(graph, guess, callback=lambda row: None)
    assert told.status is fg.Status.LOCALLY_INFEASIBLE


def test_fields_of_discs_take_few_iterations() -> None:
    """A slice of the study, of which IPOPT and fatrop solve 21 in a median of 35 and 34 iterations."""
    stated = disc_fields.Field(InteriorPoint())
    found = [stated.solve(disc_fields.layout(seed)) for seed in range(300, 325)]
    assert sum(solution.converged for solution in found) >= 21
    assert np.median([solution.iterations for solution in found]) <= 35
