"""Which backend for which graph: every kind of problem from cold, and the ticks of one control loop.

    python -m benchmarks.choosing [--seeds S] [--parkings P] [--quick]

Least squares are those of the collection (tests/problems/small.py) and of the problems that all backends are tested on;
the others are control problems stated twice (tests/problems/twins), with and without their inequalities, and parkings,
from a user's guesses. ``fg.solve`` takes part as a user calls it. The loops are control cases. Needs casadi. Writes
docs/choosing.md.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

import unifg as fg
from benchmarks import control_loops
from benchmarks.report import command, listing, machine, publish
from problems.control import Quadrotor, Unicycle
from problems.known import PROBLEMS
from problems.small import SQUARES
from problems.twins import KINDS
from unifg.solvers.names import backends
from unifg.typing import Array

Stated: TypeAlias = tuple[fg.Graph, Mapping[fg.Family, Array]]
Solve: TypeAlias = Callable[[fg.Graph, Mapping[fg.Family, Array]], fg.Solution]

PICKED = "fg.solve"
SQUARED = ("gn", "lm", "dogleg", "ipm")
EQUAL = ("kkt", "ipm", "alm", "sqp")
LIMITED = ("ipm", "alm", "sqp", "penalty")
LOOPS = (Unicycle("straight", False, 50), Unicycle("straight", True, 50), Quadrotor("figure8", True, 20))
OURS = ("ipm, 1 iteration", "ipm, safe", "ipm", "alm", "sqp, 1 iteration", "sqp")


@dataclass(frozen=True)
class Attempt:
    """One solve from cold.

    Attributes:
        solved: whether it converged.
        iterations: spent.
        seconds: processor time of the same solve, repeated.
    """

    solved: bool
    iterations: int
    seconds: float


def least_squares() -> Iterable[Stated]:
    """Sums of squares without constraints."""
    for problem in PROBLEMS:
        if not (problem.constrained or problem.scalar):
            yield problem.build()
    for case in SQUARES:
        yield case.build()


def controlled(seeds: int, equalities_only: bool) -> Iterable[Stated]:
    """Every kind of control problem but parking."""
    for kind, build in KINDS.items():
        for seed in range(seeds if kind != "parking" else 0):
            twin = build(seed, equalities_only)
            yield twin.graph, twin.guess


def parked(count: int) -> Iterable[Stated]:
    """Parallel parkings of a kinematic bicycle."""
    for seed in range(count):
        twin = KINDS["parking"](seed, False)
        yield twin.graph, twin.guess


def attempts(problems: Iterable[Stated], names: Iterable[str]) -> dict[str, list[Attempt]]:
    """What backends by their short names, and who picks one, make of problems."""
    solves: dict[str, Solve] = {PICKED: fg.solve} | {name: one.solve for name, one in backends(*names).items()}
    found: dict[str, list[Attempt]] = {name: [] for name in solves}
    for graph, guess in problems:
        for name, solve in solves.items():
            solve(graph, guess)  # compiles, and reads what is compiled
            began = time.process_time()
            solution = solve(graph, guess)
            spent = time.process_time() - began
            found[name].append(Attempt(solution.converged, solution.iterations, spent))
    return found


def cold(results: Mapping[str, Mapping[str, list[Attempt]]]) -> str:
    """One row for every kind and backend."""

    def of_solved(tell: Callable[[Attempt], float], spelled: str) -> Callable[[list[Attempt]], str]:
        def told(row: list[Attempt]) -> str:
            values = [tell(one) for one in row if one.solved]
            return format(float(np.median(values)), spelled) if values else "-"

        return told

    columns: dict[str, Callable[[list[Attempt]], str]] = {
        "solved": lambda row: f"{sum(one.solved for one in row)} of {len(row)}",
        "iterations": of_solved(lambda one: float(one.iterations), ".0f"),
        "median [ms]": of_solved(lambda one: 1e3 * one.seconds, ".2f"),
        "longest of all [ms]": lambda row: f"{1e3 * max(one.seconds for one in row):.0f}",
    }
    groups = {
        (kind, f"`{name}`"): row for kind, found in results.items() for name, row in found.items()
    }  # fmt: skip
    return listing(["problems", "solver"], groups, columns)


def loops(steps: Mapping[str, Mapping[str, control_loops.Drive]]) -> str:
    """The ticks of every loop."""
    columns: dict[str, Callable[[control_loops.Drive], str]] = {
        "median [ms]": lambda drive: f"{np.median(drive.times):.3f}",
        "p99 [ms]": lambda drive: f"{np.percentile(drive.times, 99):.2f}",
        "iterations, mean": lambda drive: f"{np.mean(drive.iterations):.1f}",
        "not converged": lambda drive: ", ".join(f"{n} {how}" for how, n in drive.failures.items()) or "0",
        "cost": lambda drive: f"{drive.cost:.4f}",
    }
    groups = {(loop, f"`{name}`"): drive for loop, drives in steps.items() for name, drive in drives.items()}
    return listing(["closed loop", "solver"], groups, columns)


def main(arguments: list[str] | None = None) -> int:
    """Measure and write the page."""
    parser = command(__doc__)
    parser.add_argument("--seeds", type=int, default=3, help="of every kind of control problem")
    parser.add_argument("--parkings", type=int, default=30)
    parser.add_argument("--quick", action="store_true", help="one loop; write no page")
    chosen = parser.parse_args(arguments)
    results = {
        "least squares": attempts(least_squares(), SQUARED),
        "equalities only": attempts(controlled(chosen.seeds, True), EQUAL),
        "inequalities": attempts(controlled(chosen.seeds, False), LIMITED),
        "parking": attempts(parked(chosen.parkings), LIMITED),
    }
    driven = {problem.title: control_loops.drive(problem, OURS, ()) for problem in LOOPS[: 1 if chosen.quick else None]}
    text = "\n\n".join(
        [
            "### From cold",
            "Default options, tolerance 1e-6. Iterations and times are medians of the converged solves, processor time "
            "of the second of two equal calls, which compiles nothing.",
            cold(results),
            "### In a loop",
            f"{control_loops.STEPS} ticks, tolerance {control_loops.TOLERANCE:.0e}, interleaved, warm start by values "
            "and multipliers. `1 iteration`: `max_iterations=1`. `safe`: `step_tolerance=np.inf, "
            f"violation_tolerance={control_loops.CONTACT:g}`. Cost: sum of the stage costs of what happened.",
            loops(driven),
            machine("numpy", "numba", "osqp", "piqp"),
        ]
    )
    publish("choosing", text, docs=not chosen.quick)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
