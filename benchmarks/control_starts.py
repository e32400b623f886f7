"""Random starts: every control case with obstacles from thirty perturbed guesses."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from benchmarks.report import table, words
from problems.control import Problem
from unifg.solvers.names import backends

STARTS = 30
SOLVERS = backends("ipm", "sqp", "alm", tolerance=1e-4)


@dataclass
class Tally:
    """What one solver made of the starts of one case.

    Attributes:
        statuses: how often each.
        iterations: of every start.
        costs: of the converged ones, relative to the listed optimum.
    """

    statuses: Counter[str] = field(default_factory=Counter)
    iterations: list[int] = field(default_factory=list)
    costs: list[float] = field(default_factory=list)


def measure(problem: Problem, count: int = STARTS) -> dict[str, Tally]:
    """Solve from every start with every solver."""
    stated = problem.formulation()
    runs = {name: solver.prepare(stated.graph) for name, solver in SOLVERS.items()}
    tallies = {name: Tally() for name in runs}
    for states, controls in problem.starts(count):
        for name, run in runs.items():
            solution = run.solve({stated.x: states, stated.u: controls})
            tally = tallies[name]
            tally.statuses[words(solution.status)] += 1
            tally.iterations.append(solution.iterations)
            if solution.converged:
                tally.costs.append(solution.cost / problem.optima[0])
    return tallies


def render(results: dict[Problem, dict[str, Tally]], count: int) -> str:
    """A table and what it means."""
    lines = []
    for name in SOLVERS:
        mine = {problem: tallies[name] for problem, tallies in results.items()}
        solved = sum(tally.statuses["converged"] for tally in mine.values())
        lines.append((name, "all", f"{solved} / {count * len(mine)}", "---", "---", "---"))
        for problem, tally in mine.items():
            others = ", ".join(f"{n} {status}" for status, n in tally.statuses.items() if status != "converged")
            best = f"{min(tally.costs):.3f} to {max(tally.costs):.3f}" if tally.costs else "-"
            lines.append(
                (
                    name, problem.title, f"{tally.statuses['converged']} / {count}", others or "-",
                    f"{np.median(tally.iterations):.0f}, {max(tally.iterations)}", best,
                )
            )  # fmt: skip
    head = ("solver", "case", "converged", "other endings", "iterations, median and most", "cost / listed optimum")
    notes = (
        f"{count} guesses for each case: the cold guess with every state moved by a normal tangent step (unicycle "
        f"0.3 m, 0.5 rad; quadrotor 0.3 m, 0.3 rad, 0.5 m/s) and every control by 0.3, or 0.5 rad/s and 1 m/s^2. "
        "Tolerance 1e-4. A cost above the listed optimum is another local optimum: it passes some obstacle on "
        "the other side."
    )
    return "\n\n".join([table(head, lines, text=2), notes])
