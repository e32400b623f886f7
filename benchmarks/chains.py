"""Chains of control: a unicycle over fifty steps, with soft and with hard dynamics."""

from __future__ import annotations

from functools import partial

import numpy as np

import unifg as fg
from benchmarks.report import Columns, listing, told, words
from benchmarks.section import Result, goal
from benchmarks.timing import Contestants, interleave, milliseconds, shown, timed
from problems.control import Unicycle
from problems.graphs import graph_of
from unifg.models import unicycle
from unifg.solvers import AugmentedLagrangian, GaussNewton

HORIZON = 50
SOFT = 0.01  # sigma of soft dynamics [m, m, rad]
TARGET = 0.15  # [ms] per iteration
REPEATS = 20  # solves inside one timed call


def chain(kind: str, horizon: int) -> tuple[fg.Solver, fg.Graph, fg.Guess]:
    """A unicycle that is to follow a line it starts beside.

    Args:
        kind: "soft", "hard" or "bounded" (hard, with limits on the controls).
        horizon: steps.
    """
    problem = Unicycle("straight", False, horizon)
    weights = np.vstack([np.tile(problem.stage, (horizon, 1)), problem.terminal])
    reference, cruise = problem.reference()
    graph, x, u = graph_of(("pose", fg.SE2, horizon + 1), ("control", fg.Rn(2), horizon))
    graph.fix(x[0], problem.start)
    graph.minimize(unicycle.tracking, x, reference, sigma=weights**-0.5, name="tracking")
    graph.minimize(fg.prior, u, cruise, sigma=problem.effort**-0.5, name="effort")
    if kind == "soft":
        graph.minimize(unicycle.dynamics, x[:-1], u, x[1:], problem.dt, sigma=SOFT, name="dynamics")
    else:
        graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], problem.dt, lower=0.0, upper=0.0, name="dynamics")
    if kind == "bounded":
        graph.bound(u, lower=problem.lower, upper=problem.upper, name="limits")
    states, controls = problem.guess()
    backend = GaussNewton() if kind == "soft" else AugmentedLagrangian()
    return backend, graph, fg.Guess({x: states, u: controls})


CASES = {
    "soft": "Gauss-Newton, soft dynamics",
    "hard": "augmented Lagrangian, hard dynamics",
    "bounded": "augmented Lagrangian, hard dynamics, bounded controls",
}


def measure(rounds: int, small: bool = False) -> Result:
    """All chains in one set of rounds; a round repeats each solve, the chains being short."""
    horizon, repeats = (4, 1) if small else (HORIZON, REPEATS)
    contestants: Contestants = {}
    rows: list[Result] = []
    for kind in CASES:
        backend, graph, guess = chain(kind, horizon)
        run = backend.prepare(graph)
        first = run.solve(guess)
        contestants[kind] = timed(partial(_repeat, run, guess, repeats), repeats * first.iterations)
        rows.append(
            {
                "kind": kind, "horizon": horizon, "unknowns": run.program.size, "iterations": first.iterations,
                "status": words(first.status),
            }
        )  # fmt: skip
    times = interleave(contestants, rounds)
    for row in rows:
        row["ms"] = milliseconds(times[row["kind"]])
    goals = [goal(f"{CASES[row['kind']]}, N = {horizon}, iteration", "ms", row["ms"], TARGET) for row in rows]
    return {"rows": rows, "rounds": rounds, "goals": goals}


def _repeat(run: fg.Prepared, guess: fg.Guess, times: int) -> None:
    for _ in range(times):
        run.solve(guess)


COLUMNS: Columns[Result] = {
    "unknowns": told("unknowns"),
    "iterations": lambda row: f"{row['iterations']}, {row['status']}",
    "iteration [ms]": told("ms", shown),
    "target": lambda row: f"{TARGET:g}",
}


def render(result: Result) -> str:
    """One table."""
    rows = result["rows"]
    notes = (
        f"Horizon {rows[0]['horizon']}, from the cold guess; an iteration is a solve over its iterations, {REPEATS} "
        "solves in a row."
    )
    return "\n\n".join([listing(("chain",), {(CASES[row["kind"]],): row for row in rows}, COLUMNS), notes])
