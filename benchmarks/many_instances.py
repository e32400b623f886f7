"""A thousand instances of a plan by one call, beside a loop over single solves and the compiled share of that loop."""

from __future__ import annotations

import time
from functools import partial

import numpy as np

import unifg as fg
from benchmarks.report import table
from benchmarks.runner import Timing
from benchmarks.timing import all_cores, clocked, interleave, number, ratio
from problems.control import Problem, Quadrotor, Unicycle
from unifg.solvers import InteriorPoint

COUNT = 1000
UNICYCLES = Unicycle("straight", False, 20), Unicycle("straight", True, 20)
CASES: tuple[Problem, ...] = (*UNICYCLES, Quadrotor("goto", False, 20))


def measure(case: Problem, rounds: int, count: int = COUNT) -> tuple[str, ...]:
    """A row of the table: starts beside that of a case, cold."""
    stated, rng = case.formulation(), np.random.default_rng(0)
    steps = 0.1 * rng.standard_normal((count, case.manifold.dim))
    each = [stated.data(start, 0) for start in case.manifold.retract(np.tile(case.start, (count, 1)), steps)]
    data = {handle: np.stack([one[handle] for one in each]) for handle in each[0]}
    prepared = InteriorPoint(tolerance=1e-4).prepare(stated.graph)
    compiled = []

    def loop() -> float:
        found, spent = clocked(lambda: [prepared.solve(stated.guess, data=one) for one in each], by=time.process_time)
        compiled.append(sum(part for one in found for name, part in one.times.items() if name != "Python"))
        return spent

    def many(threads: int) -> float:
        by = time.process_time if threads == 1 else time.perf_counter
        return clocked(prepared.solve_many, stated.guess, data=data, threads=threads, by=by)[1]

    spent = interleave({"loop": loop, "many": partial(many, 1)}, rounds)
    with all_cores():
        prepared.solve_many(stated.guess, data=data, threads=2)
        alone, shared = (min(many(threads) for _ in range(rounds)) for threads in (1, 2))
    single = [fg.Status.CONVERGED is status for status in prepared.solve_many(stated.guess, data=data).statuses]
    middle = float(np.median(spent["many"]))
    relative = ratio(spent["many"], spent["loop"])[0], middle / float(np.median(compiled[-rounds:])), alone / shared
    shown = (number(found) for found in (1e6 * middle / count, *relative))
    return case.title, f"{sum(single)} of {count}", *shown


def tables(rounds: int) -> str:
    """All cases."""
    head = (
        "instances", "converged", "us each", "times a loop of solves", "times its compiled share",
        "faster by two threads",
    )  # fmt: skip
    notes = (
        f"{COUNT} starts, normal deviations of 0.1 in every tangent coordinate, cold, tolerance 1e-4; median processor "
        f"times of {rounds} interleaved rounds. The compiled share is that of the loop's solves by `solution.times`. "
        "Two threads: least wall time of as many rounds, of one over that of two. Statuses, iterations and bits are "
        "those of the loop."
    )
    return f"{table(head, [measure(case, rounds) for case in CASES], 2)}\n\n{notes}"


STUDY = Timing(tables, 7)
