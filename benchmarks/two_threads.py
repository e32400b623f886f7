"""Gain of two threads that share one solve (`fg.use_threads`), or that solve two graphs, one each.

Wall time of one thread over that of two. Nothing is gained on a machine whose two cores have other work, and a second
core that has rested needs some tenths of a second, so that everything is repeated for a while before it counts. Of each
turn the fastest repetition counts, on both sides: other work of a shared machine only makes things slower.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np

import unifg as fg
from benchmarks.pose_graphs import Case, cases
from benchmarks.report import Columns, listing, told
from benchmarks.section import Result, goal
from benchmarks.timing import all_cores, interleave, milliseconds, ratio, shown
from unifg.elimination.factorization import Factorization
from unifg.elimination.subtrees import WORTH
from unifg.lie import SE3
from unifg.pose_graphs import sphere
from unifg.solvers import GaussNewton

ROUNDS = 7  # at most
BEFORE, WHILE = 0.3, 0.2  # how long something is repeated before it counts, and while it does [s]
WANTED = 1.6  # times, of graphs in space
PIECES = {"linearise": "linearise", "eliminate": "eliminate", "substitute": "substitute", "solve": "whole solve"}


def measure(rounds: int, small: bool = False) -> Result:
    """All graphs."""
    rounds = min(rounds, ROUNDS)
    before, during = (0.0, 0.01) if small else (BEFORE, WHILE)
    with all_cores():
        chosen = cases(small) if small else [*cases(), large()]
        rows = [measure_case(case, rounds, before, during) for case in chosen]
    goals = [
        goal(f"{row['graph']}, one solve by two threads", "times faster than by one", row["ratio"]["solve"], WANTED)
        for row in rows
        if row["space"]
    ]
    return {"rows": rows, "rounds": rounds, "goals": goals}


def large() -> Case:
    """Pose graph large enough for threads."""
    ball = sphere(100, 100, seed=0)
    return Case("sphere 10000", ball.pose_graph.with_poses(ball.truth), np.nan, 2.0, 1.5)


def measure_case(case: Case, rounds: int, before: float, during: float) -> Result:
    """One graph."""
    graphs = [case.pose_graph.graph() for _ in range(2)]
    solves = [partial(GaussNewton().prepare(graph).solve, guess) for graph, _, guess in graphs]
    graph, _, guess = graphs[0]
    program = graph.compile()
    factorization = Factorization(program.normal, program.blocks)
    hessian = program.linearize(guess).hessian.copy()
    factorization.factor(hessian)
    right = np.random.default_rng(0).normal(size=program.size)
    pieces: dict[str, Callable[[], object]] = {
        "linearise": partial(program.linearize, guess),
        "eliminate": partial(factorization.factor, hessian),
        "substitute": partial(factorization.solve, right),
        "solve": solves[0],
    }

    def shared(piece: Callable[[], object], count: int) -> float:
        fg.use_threads(count)
        try:
            return steady(piece, before, during)
        finally:
            fg.use_threads(1)

    def apart(solve: Callable[[], object], other: Callable[[], object]) -> float:
        with ThreadPoolExecutor(2) as pool:
            told = [pool.submit(steady, each, before, during) for each in (solve, other)]
            return max(future.result() for future in told)

    times = interleave(
        {
            f"{name} {count}": partial(shared, piece, count) for name, piece in pieces.items() for count in (1, 2)
        } | {"apart": partial(apart, solves[0], solves[1])},
        rounds,
        warm=0,
    )  # fmt: skip
    return {
        "graph": case.name,
        "space": case.pose_graph.group is SE3,
        "alone": {name: milliseconds(times[f"{name} 1"]) for name in pieces},
        "ratio": {name: ratio(times[f"{name} 1"], times[f"{name} 2"]) for name in pieces},
        "apart": ratio(2.0 * times["solve 1"], times["apart"]),
    }


def steady(action: Callable[[], object], before: float, during: float) -> float:
    """Least time of an action once it has been repeated for a while [s]."""
    times = list[float]()
    begin = time.perf_counter()
    while (now := time.perf_counter()) < begin + before + during or not times:
        action()
        if now >= begin + before:
            times.append(time.perf_counter() - now)
    return min(times)


def _gain(name: str) -> Callable[[Result], str]:
    return lambda row: shown(row["ratio"][name])


COLUMNS: Columns[Result] = {
    "whole solve by one thread [ms]": lambda row: shown(row["alone"]["solve"]),
    **{f"{title}, times faster": _gain(name) for name, title in PIECES.items()},
    "two graphs in two threads, times faster": told("apart", shown),
}


def render(result: Result) -> str:
    """A table, and what its columns are."""
    text = (
        "Wall time of one thread over that of two on two cores, `fg.use_threads(2)`, of the fastest repetition of each "
        "turn. An elimination of fewer than "
        f"{WORTH / 1e6:.0f} million multiplications is not shared out. The last column: two graphs stated apart, each "
        f"solved by a thread of its own, against one after the other. {result['rounds']} rounds."
    )
    return "\n\n".join([listing(("graph",), {(row["graph"],): row for row in result["rows"]}, COLUMNS), text])
