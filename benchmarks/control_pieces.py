"""Where the time of an interior-point iteration goes, piece by piece."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

import numpy as np

from benchmarks.report import table
from problems.control import Problem, Quadrotor, Unicycle
from unifg.codegen.function_pointers import run
from unifg.codegen.jit import compiled
from unifg.elimination.fronts import factor
from unifg.elimination.substitution import solve
from unifg.problem import evaluation
from unifg.problem.hessian import add_curvature
from unifg.solvers import InteriorPoint

REPEATS, ROUNDS = 500, 7


@compiled
def _many(function: int, address: int, count: int) -> None:
    """Run a linked function again and again."""
    for _ in range(count):
        run(function, (address,))


def measure(problem: Problem) -> dict[str, float]:
    """Microseconds of every piece, the least of several rounds of processor time."""
    stated = problem.formulation()
    prepared = InteriorPoint(tolerance=1e-4).prepare(stated.graph)
    solution = prepared.solve(stated.guess)
    workspace, program = prepared._workspace, prepared.program
    links, work = workspace.problem.links, workspace.work
    pieces: dict[str, float] = {}
    for name, function in (("assemble, factorise, solve", "direct"), ("solve again", "steer"),
                           ("trial: move and evaluate", "advance"), ("KKT numbers", "measure")):  # fmt: skip
        _many(links[0][function], workspace._address, 3)
        pieces[name] = _least(partial(_many, links[0][function], workspace._address, REPEATS)) / REPEATS
    lin = program.linearize(solution.values)
    entries, norms = lin.hessian.copy(), np.empty(len(program.arrays.fields))
    squares, weights, gradient = lin.squares.copy(), lin.weights.copy(), lin.gradient.copy()
    calls: dict[str, Callable[[], object]] = {
        "linearise *": lambda: evaluation.linearize(
            program.arrays, lin.values.flat, False,
            evaluation.LinearArrays(
                lin.residual, lin.jacobian, lin.constraints, lin.constraint_jacobian, squares, weights, norms, gradient,
                entries,
            ),
            program.scratch,
        ),
        "second derivatives *": lambda: add_curvature(
            program.arrays, lin.values.flat, lin.residual, lin.weights, work.multipliers, entries
        ),
        "factorise *": lambda: factor(workspace.problem.plan, work.data, work.shift),
        "solve *": lambda: solve(workspace.problem.plan, work.right, work.step),
    }  # fmt: skip
    for name, call in calls.items():
        call()
        pieces[name] = _least(partial(_repeat, call, 100)) / 100
    cold = _least(lambda: [prepared.solve(stated.guess) for _ in range(10)]) / 10
    pieces["cold solve, all"], pieces["cold solve, iterations"] = cold, float(solution.iterations)
    still = _least(lambda: [prepared.solve(solution) for _ in range(20)]) / 20
    pieces["solve that needs no iteration"] = still
    return pieces


def _repeat(call: Callable[[], object], times: int) -> None:
    for _ in range(times):
        call()


def _least(call: Callable[[], object]) -> float:
    """Processor time in microseconds, the least of several rounds."""
    least = np.inf
    for _ in range(ROUNDS):
        begin = time.thread_time()
        call()
        least = min(least, time.thread_time() - begin)
    return 1e6 * least


def render() -> str:
    """A table and what it means."""
    cases: list[Problem] = [Unicycle("straight", False, 50), Unicycle("straight", True, 50)]
    cases += [Quadrotor("figure8", False, 20), Quadrotor("figure8", True, 20)]
    found = {problem.title: measure(problem) for problem in cases}
    rows = [[name, *(f"{pieces[name]:.1f}" for pieces in found.values())] for name in next(iter(found.values()))]
    notes = (
        "Microseconds of processor time, least of several rounds. Pieces marked * are called from Python here, which "
        "adds 2 to 4 to each; inside the loop they are not. A solve that needs no iteration is what data, checks, the "
        "final judgement and the answer cost."
    )
    return "\n\n".join([table(["piece", *found], rows), notes])
