"""Twenty-four optimal control problems, cold, in closed loop and from random starts, beside IPOPT and fatrop.

The problems are stated in tests/problems/control.py. With casadi installed, its IPOPT (MUMPS) and fatrop solve them in
turn with ours, both with exact Hessians and the same tolerance.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd
from tqdm import tqdm

from benchmarks import cold, compiled_peers, control_loops
from benchmarks.cold import SAME, SLOW, TOLERANCE, Outcome, Results
from benchmarks.report import table
from benchmarks.runner import Timing
from problems.control import blocked, problems
from unifg.solution.status import Status
from unifg.solvers.names import backends

STARTS = 30
SOLVERS = backends("ipm", "sqp", "alm", tolerance=TOLERANCE)


def render(results: Results, rounds: int) -> str:
    """The cold solves as Markdown."""
    counted: dict[str, Callable[[Outcome], bool]] = {
        "converged": lambda outcome: outcome.status == "converged",
        "degenerate": lambda outcome: outcome.status == "degenerate",
        "listed optimum or lower": lambda outcome: outcome.verdict.startswith(("listed", "lower")),
    }
    notes = (
        f"Cold: from the listed guess, tolerance {TOLERANCE:.0e} of every solver, median processor time of "
        f"{rounds} interleaved solves (one where it took more than {1e3 * SLOW:.0f} ms). The cost of an interior point "
        "is above the optimum by about the tolerance times the number of active limits; listed optima were found at "
        f"1e-9. Same optimum: within {SAME:.0e}. Our residuals are those that ship; "
        "fatrop runs in casadi's virtual machine and compiled "
        f"({compiled_peers.described()}), IPOPT in the virtual machine."
    )
    return "\n\n".join([cold.summary(results, counted), cold.every(results), notes])


def starts(count: int) -> str:
    """Convergence and cost from perturbed guesses, by solver and case with obstacles."""
    rows = []
    for problem in tqdm(blocked(), unit="case"):
        stated = problem.formulation()
        runs = {name: solver.prepare(stated.graph) for name, solver in SOLVERS.items()}
        for states, controls in problem.starts(count):
            for name, run in runs.items():
                solution = run.solve({stated.x: states, stated.u: controls})
                cost = solution.cost / problem.optima[0] if solution.converged else np.nan
                rows.append((name, problem.title, solution.status, solution.iterations, cost))
    frame = pd.DataFrame(rows, columns=["solver", "case", "status", "iterations", "cost"])
    lines = [
        (
            name, case,
            *(f"{(found['status'] == status).sum()} / {count}" for status in (Status.CONVERGED, Status.DEGENERATE)),
            f"{found['iterations'].median():.0f}, {found['iterations'].max()}",
            f"{found['cost'].min():.3f} to {found['cost'].max():.3f}",
        )
        for (name, case), found in frame.groupby(["solver", "case"], sort=False)
    ]  # fmt: skip
    head = ("solver", "case", "converged", "degenerate", "iterations, median and most", "cost / listed optimum")
    notes = (
        f"{count} guesses for each case: the cold guess with every state moved by a normal tangent step (unicycle "
        f"0.3 m, 0.5 rad; quadrotor 0.3 m, 0.3 rad, 0.5 m/s) and every control by 0.3, or 0.5 rad/s and 1 m/s^2. "
        "Tolerance 1e-4. A cost above the listed optimum is another local optimum: it passes some obstacle on "
        "the other side."
    )
    return "\n\n".join([table(head, lines, text=2), notes])


def tables(rounds: int) -> str:
    """Cold solves, closed loops and random starts."""
    results = {problem: cold.measure(problem, SOLVERS, rounds) for problem in tqdm(problems(), unit="case")}
    loops = {problem: control_loops.drive(problem) for problem in tqdm(control_loops.cases(), unit="loop")}
    return "\n\n".join([render(results, rounds), control_loops.render(loops), starts(STARTS)])


STUDY = Timing(tables, 20)
