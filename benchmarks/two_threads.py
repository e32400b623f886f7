"""What two threads gain that solve two graphs, one each: the time of one after the other over that of both at once.

    python -m benchmarks.two_threads [--rounds N]

Compiled loops release the interpreter's lock, what stands around them does not. It says nothing on a machine whose two
cores have other work.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import partial

import numpy as np

from benchmarks.pose_graphs import cases
from benchmarks.report import command
from unifg.solvers import GaussNewton

SOLVES = 8


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
            print(f"{case.name}: {np.median(gained):.2f} ({gained.min():.2f} .. {gained.max():.2f})")
    return 0


def several(solve: Callable[[], object]) -> None:
    """Solve a few times."""
    for _ in range(SOLVES):
        solve()


if __name__ == "__main__":
    raise SystemExit(main())
