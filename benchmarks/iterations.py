"""How many iterations the backends need: on problems with known answers, among cylinders, from tick to tick.

    python -m benchmarks.iterations

The problems are those every backend is tested on (``tests/problems/known.py``), the cylinders those of
tests/problems/cylinders.py, the loops those of :mod:`benchmarks.control_loops`. Writes docs/iterations.md.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

import unifg as fg
from benchmarks import control_loops
from benchmarks.hard_guesses import CYLINDERS, Outcome, median
from benchmarks.report import command, listing, machine, publish, table, words
from problems.control import Driver, Problem
from problems.cylinders import SPEED
from problems.known import PROBLEMS, Guess
from unifg.solvers import SQP, AugmentedLagrangian, InteriorPoint, names

BACKENDS = {**names.backends(*names.LEAST_SQUARES, *names.EQUALITIES), "sqp, exact": SQP(hessian="exact")}
FLIGHTS: dict[str, fg.Solver] = {
    "`AugmentedLagrangian`": AugmentedLagrangian(),
    'the same, `hessian="gauss-newton"`': AugmentedLagrangian(hessian="gauss-newton"),
    "`InteriorPoint`": InteriorPoint(),
    "`SQP`": SQP(),
    '`SQP(hessian="exact")`': SQP(hessian="exact"),
}
CARRIED = {"values alone": (False, False), "and multipliers": (True, False), "and penalties": (True, True)}


def known_answers() -> str:
    """Every backend on the problems that all are tested on."""
    rows = [
        (problem.name, *(iterations(problem.build, solver) for solver in BACKENDS.values())) for problem in PROBLEMS
    ]
    return table(("problem", *BACKENDS), rows)


def iterations(build: Callable[[], tuple[fg.Graph, Guess]], solver: fg.Solver) -> str:
    """Of one solve; a status where it did not converge, a dash where the backend refuses the problem."""
    graph, guess = build()
    try:
        run = solver.prepare(graph)
    except fg.BackendError:
        return "-"
    solution = run.solve(guess)
    return f"{solution.iterations}" + ("" if solution.converged else f", {words(solution.status)}")


def cylinders(count: int = CYLINDERS.count) -> str:
    """Flights among cylinders: how many each backend solves."""
    found = CYLINDERS.run(range(count), FLIGHTS)
    columns: dict[str, Callable[[list[Outcome]], str]] = {
        "solved": lambda outcomes: f"{sum(one.solved for one in outcomes)} of {len(outcomes)}",
        "iterations, median of the solved": median,
    }
    return listing(["solver"], {(name.replace("ipopt", "IPOPT"),): row for name, row in found.items()}, columns)


def carried(problem: Problem, multipliers: bool, penalties: bool, steps: int = control_loops.STEPS) -> float:
    """Mean iterations of the augmented Lagrangian's warm steps in closed loop, by what a tick hands to the next."""
    driver = Driver(problem, AugmentedLagrangian(tolerance=control_loops.TOLERANCE), multipliers, penalties)
    state, counts = problem.start, []
    for index in range(steps + 1):
        tick = driver.control(state, index)
        counts.append(tick.iterations)
        state = problem.plant(state, tick.control, index)
    return float(np.mean(counts[1:]))  # the first is no step of the loop


def loops() -> str:
    """What the next tick saves by what it is given."""
    rows = [
        (problem.title, *(f"{carried(problem, *what):.1f}" for what in CARRIED.values()))
        for problem in control_loops.cases()
    ]
    return table(("closed loop", *CARRIED), rows)


def main(arguments: list[str] | None = None) -> int:
    """Measure and write the page."""
    command(__doc__).parse_args(arguments)
    text = "\n\n".join(
        [
            "### Problems with known answers",
            "Iterations to the default tolerance of 1e-6 with default options. A dash means that the backend refuses "
            "the problem.",
            known_answers(),
            "### Among cylinders",
            f"A quadrotor at {SPEED:g} m/s among ten upright cylinders, 20 layouts at random, from a "
            "straight line through the cylinders.",
            cylinders(),
            "### From tick to tick",
            f"Mean iterations of the augmented Lagrangian over {control_loops.STEPS} steps of the control cases, "
            f"tolerance {control_loops.TOLERANCE:.0e}, when the next tick begins with the shifted values, with the "
            "multipliers too, and with the penalties too.",
            loops(),
            machine("numpy", "numba", "osqp", "piqp"),
        ]
    )
    publish("iterations", text)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
