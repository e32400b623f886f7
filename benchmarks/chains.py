"""The chains of control: a unicycle over fifty steps, with soft and with hard dynamics, and where its time goes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any
from unittest import mock

import numpy as np

import unifg as fg
from benchmarks.report import listing, words
from benchmarks.section import Result, goal
from benchmarks.timing import Split, interleave, milliseconds, number, shown, timed
from problems.control import Unicycle
from unifg.codegen.jit import compiled
from unifg.elimination import fronts, substitution
from unifg.models import unicycle
from unifg.problem import evaluation
from unifg.problem.compiled_problem import CompiledProblem
from unifg.solution import solver
from unifg.solvers import AugmentedLagrangian, GaussNewton, augmented_step
from unifg.typing import Array

HORIZON = 50
SOFT = 0.01  # sigma of soft dynamics [m, m, rad]
TARGET = 0.15  # [ms] per iteration
REPEATS = 20  # of a compiled pass inside one timed call
WATCHED: dict[str, tuple[Any, str]] = {
    "linearise": (evaluation, "linearize"),
    "evaluate": (evaluation, "evaluate"),
    "primal step": (augmented_step, "minimize"),
    "eliminate": (fronts, "factor"),
    "substitute": (substitution, "solve"),
    "KKT test": (solver, "optimality"),
    "retract": (CompiledProblem, "retract"),
}


def chain(kind: str, horizon: int) -> tuple[fg.Solver, fg.Graph, fg.Guess]:
    """A unicycle that is to follow a line it starts beside.

    Args:
        kind: "soft", "hard" or "bounded" (hard, with limits on the controls).
        horizon: steps.
    """
    problem = Unicycle("straight", False, horizon)
    weights = np.vstack([np.tile(problem.stage, (horizon, 1)), problem.terminal])
    reference, cruise = problem.reference()
    graph = fg.Graph()
    x = graph.variables("pose", fg.SE2, horizon + 1)
    u = graph.variables("control", fg.Rn(2), horizon)
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
    candidates: dict[str, Callable[[], float]] = {}
    splits: dict[str, Split] = {}
    rows: list[Result] = []
    for kind in CASES:
        backend, graph, guess = chain(kind, horizon)
        run = backend.prepare(graph)
        first = run.solve(guess)
        solves, count = partial(_repeat, run, guess, repeats), repeats * first.iterations
        splits[kind] = Split(WATCHED, solves, count)
        candidates |= {kind: timed(solves, count), f"{kind}, split": splits[kind]}
        rows.append(
            {
                "kind": kind,
                "horizon": horizon,
                "unknowns": run.program.size,
                "iterations": first.iterations,
                "status": words(first.status),
                "eliminations": eliminations(run, guess) / first.iterations,
                **_compiled_parts(run.program, guess, repeats, rounds),
            }
        )
    times = interleave(candidates, rounds)
    for row in rows:
        row["ms"] = milliseconds(times[row["kind"]])
        row["parts"] = splits[row["kind"]].milliseconds(rounds)
    goals = [goal(f"{CASES[row['kind']]}, N = {horizon}, iteration", "ms", row["ms"], TARGET) for row in rows]
    return {"rows": rows, "rounds": rounds, "goals": goals}


def _repeat(run: fg.Prepared, guess: fg.Guess, times: int) -> None:
    for _ in range(times):
        run.solve(guess)


def eliminations(run: fg.Prepared, guess: fg.Guess) -> float:
    """Factorisations in one solve, those inside the compiled primal step included: it runs interpreted here."""
    count = 0
    real = fronts.factor

    def counting(*arguments: Any) -> bool:
        nonlocal count
        count += 1
        return real(*arguments)

    interpreted = getattr(augmented_step.minimize, "py_func")  # noqa: B009 - an attribute of the compiled function
    with (
        mock.patch.object(augmented_step, "minimize", interpreted),
        mock.patch.object(augmented_step, "factor", counting),
        mock.patch.object(fronts, "factor", counting),
    ):
        run.solve(guess)
    return float(count)


@compiled
def _factor_often(plan: Any, data: Array, added: Array, count: int) -> None:
    for _ in range(count):
        fronts.factor(plan, data, added)


@compiled
def _assemble_often(terms: Any, jacobian: Array, weights: Array, hessian: Array, count: int) -> None:
    for _ in range(count):
        evaluation.add_constraints(terms, jacobian, weights, hessian)


def _compiled_parts(program: CompiledProblem, guess: fg.Guess, repeats: int, rounds: int) -> Result:
    """One elimination and one assembly of the constraints' normal equations, without Python around them."""
    lin = program.linearize(program.values_from(guess.values))
    factorization = program.systems.normal()
    weights = np.full(program.constraints.count, 100.0)
    hessian = program.normal_entries(lin, weights)
    spare, none = hessian.copy(), np.full(program.size, 1e-6)

    parts = {
        "one elimination": partial(_factor_often, factorization.plan, hessian, none, repeats),
        "one assembly": partial(_assemble_often, program.arrays, lin.constraint_jacobian, weights, spare, repeats),
    }
    times = interleave({name: timed(action, repeats) for name, action in parts.items()}, rounds)
    return {part: milliseconds(values) for part, values in times.items()}


COLUMNS: dict[str, Callable[[Result], str]] = {
    "unknowns": lambda row: str(row["unknowns"]),
    "iterations": lambda row: f"{row['iterations']}, {row['status']}",
    "iteration [ms]": lambda row: shown(row["ms"]),
    "target": lambda row: f"{TARGET:g}",
    "eliminations per iteration": lambda row: f"{row['eliminations']:.2f}",
    "one elimination [us]": lambda row: number(1e3 * row["one elimination"][0]),
    "one assembly of the constraints [us]": lambda row: number(1e3 * row["one assembly"][0]),
}


def render(result: Result) -> str:
    """Two tables."""
    rows = result["rows"]
    groups = {(CASES[row["kind"]],): row for row in rows}
    split = {(CASES[row["kind"]],): row["parts"] for row in rows}
    parts = {part: partial(_microseconds, part=part) for part in rows[0]["parts"]}
    notes = (
        f"Horizon {rows[0]['horizon']}, from the cold guess; an iteration is a solve over its iterations, {REPEATS} "
        "solves in a row. How many eliminations a primal step takes is counted in a run of its own."
    )
    tables = listing(("chain",), groups, COLUMNS), listing(("chain",), split, parts)
    return "\n\n".join([tables[0], "Where an iteration goes [us]:", tables[1], notes])


def _microseconds(parts: Result, part: str) -> str:
    return number(1e3 * parts[part][0])
