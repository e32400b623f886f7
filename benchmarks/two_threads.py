"""What two threads gain: that solve two graphs, one each, and that share the work of one solve (`fg.use_threads`).

    python -m benchmarks.two_threads [--rounds N]

Ratios of the time of one thread to that of two, of rounds in turn. Compiled loops release the interpreter's lock, what
stands around them does not. It says nothing on a machine whose two cores have other work; a second core that has
rested needs some tenths of a second, so that solves are repeated for half a second before they count.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import partial

import numpy as np

import unifg as fg
from benchmarks.pose_graphs import cases
from benchmarks.report import command
from unifg.elimination.fronts import BLOCK, WIDE
from unifg.elimination.plan import PIVOTS, ROWS, Plan
from unifg.elimination.subtrees import PARTS
from unifg.solvers import GaussNewton

SOLVES = 8
SECONDS = 0.5  # before solves count, and for which they do
CORES = 2, 4, 8


def main(arguments: list[str] | None = None) -> int:
    """Measure, and print a line for each graph."""
    parser = command(__doc__)
    parser.add_argument("--rounds", type=int, default=7, metavar="N")
    rounds = parser.parse_args(arguments).rounds
    with ThreadPoolExecutor(2) as pool:
        for case in cases():
            graphs = [case.pose_graph.graph() for _ in range(2)]
            solves = [partial(GaussNewton().prepare(graph).solve, guess) for graph, _, guess in graphs]
            gained = np.zeros(rounds)
            for k in range(rounds):
                begin = time.perf_counter()
                for solve in solves:
                    several(solve)
                alone = time.perf_counter()
                wait([pool.submit(several, solve) for solve in solves])
                gained[k] = (alone - begin) / (time.perf_counter() - alone)
            print(f"{case.name}, two graphs: {np.median(gained):.2f} ({gained.min():.2f} .. {gained.max():.2f})")
            shared = np.array([steady(solves[0], 1) / steady(solves[0], 2) for _ in range(rounds)])
            print(f"{case.name}, one solve: {np.median(shared):.2f} ({shared.min():.2f} .. {shared.max():.2f})")
            fg.use_threads(1)
            plan = graphs[0][0].compile().systems.normal().plan
            if len(plan.part):
                told = ", ".join(f"{speedup(plan, cores):.2f} on {cores}" for cores in CORES)
                print(f"{case.name}, elimination by its multiplications: {told} cores")
    return 0


def steady(solve: Callable[[], object], threads: int) -> float:
    """Median time of a solve with so many threads, once these have been at work for a while [s]."""
    fg.use_threads(threads)
    times = list[float]()
    begin = time.perf_counter()
    while (now := time.perf_counter()) < begin + 2.0 * SECONDS:
        solve()
        if now > begin + SECONDS:
            times.append(time.perf_counter() - now)
    return float(np.median(times))


def speedup(plan: Plan, cores: int) -> float:
    """How many times faster so many cores eliminate, if multiplications were all there is."""
    alone = shared = 0.0
    load = np.zeros(cores)
    parts = np.zeros(PARTS)
    for part, pivots, rows in zip(plan.part, plan.fronts[:-1, PIVOTS], plan.fronts[:-1, ROWS], strict=True):
        size = pivots + rows
        work = 0.5 * float(np.square(size - np.arange(pivots)).sum())
        corners = work if size <= WIDE else pivots * BLOCK**2 / 6.0  # what one core does while the others wait
        alone += work
        if part < PARTS:
            parts[part] += work
        else:
            shared += corners + (work - corners) / cores
    for work in parts:  # each by the core that is free first
        load[np.argmin(load)] += work
    return float(alone / (load.max() + shared))


def several(solve: Callable[[], object]) -> None:
    """Solve a few times."""
    for _ in range(SOLVES):
        solve()


if __name__ == "__main__":
    raise SystemExit(main())
