"""Generated planar graphs of growing size: time per iteration, symbolic work and memory, and how they grow.

    python -m benchmarks.growth POSES

prints the memory one size takes; every size is measured by itself in a new process.
"""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.gtsam_peer import ORDERINGS, Peer, available
from benchmarks.report import CHECKOUT, table
from benchmarks.section import Result, goal
from benchmarks.timing import clock, interleave, milliseconds, number, shown, spread, timed
from unifg.elimination.factorization import Factorization
from unifg.pose_graphs import PoseGraph, manhattan
from unifg.solvers import GaussNewton

SIZES = (1000, 3000, 10000, 30000, 100000)
PEER_UP_TO = 10000  # poses
ITERATIONS = 3
FEW = 5  # rounds of symbolic work on the largest graphs
LINEAR = 1.15  # growth exponent that still counts as near-linear


def walk(poses: int) -> PoseGraph:
    """A drive through a square city, starting at the truth so that every size takes the same full steps."""
    made = manhattan(poses, seed=1)
    return made.pose_graph.with_poses(made.truth)


def measure(rounds: int, small: bool = False) -> Result:
    """All sizes."""
    sizes = (40, 80) if small else SIZES
    rows = [measure_size(size, rounds, small) for size in sizes]
    poses, what = [row["poses"] for row in rows], ("ours", "compile", "analyse", "factor")
    exponents = {name: growth(poses, [np.ravel(row[name])[0] for row in rows]) for name in what}
    name = f"{sizes[0]} to {sizes[-1]} poses, iteration"
    goals = [goal(name, "growth exponent", [exponents["ours"]] * 3, LINEAR)]
    return {"rows": rows, "exponents": exponents, "rounds": rounds, "goals": goals}


def growth(sizes: list[int], values: list[float]) -> float:
    """Exponent of the power of the size that fits best."""
    return float(np.polyfit(np.log(sizes), np.log(values), 1)[0])


def measure_size(poses: int, rounds: int, small: bool) -> Result:
    """One size: iterations beside GTSAM, structure from scratch, and memory."""
    pose_graph = walk(poses)
    graph, _, guess = pose_graph.graph()
    run = GaussNewton(max_iterations=ITERATIONS, tolerance=1e-300).prepare(graph)
    count = max(run.solve(guess).iterations, 1)
    compiling: list[float] = []

    def symbolic() -> float:
        fresh = pose_graph.graph()[0]
        compiling.append(clock(fresh.compile))
        program = fresh.compile()  # the one just made
        return clock(lambda: Factorization(program.normal, program.blocks).plan)

    candidates: dict[str, Callable[[], float]] = {"ours": timed(partial(run.solve, guess), count)}
    if available() and poses <= PEER_UP_TO:
        peer = Peer(pose_graph)
        pilot = {ordering: peer.iterate(ordering, 1)[0] for ordering in ORDERINGS}
        best = min(pilot, key=lambda ordering: pilot[ordering])
        candidates["gtsam"] = lambda: peer.iterate(best, ITERATIONS)[0]
    times = interleave(candidates, rounds)
    few = min(rounds, FEW) if poses > PEER_UP_TO else rounds
    times |= interleave({"analyse": symbolic}, few)
    result: Result = {
        "poses": poses,
        "edges": len(pose_graph.edges),
        "ours": milliseconds(times["ours"]),
        "analyse": milliseconds(times["analyse"]),
        "compile": milliseconds(np.array(compiling[-few:])),
        "factor": int(graph.compile().systems.normal().plan.numbers.nbytes),
        "gtsam": None,
    }
    if "gtsam" in times:
        result |= {
            "gtsam": milliseconds(times["gtsam"]),
            "ordering": best,
            "ratio": spread(times["gtsam"] / times["ours"]),
        }
    gc.collect()
    return result | (memory(poses) if small else _elsewhere(poses))


def memory(poses: int) -> Result:
    """Bytes of one graph and one solve: what NumPy and Python hold at their peak, and the growth of the process."""
    warm = walk(40).graph()
    GaussNewton(max_iterations=1).solve(warm[0], warm[2])
    pose_graph = walk(poses)
    gc.collect()
    before = _resident()
    graph, _, guess = pose_graph.graph()
    run = GaussNewton(max_iterations=1).prepare(graph)
    solution = run.solve(guess)
    grown = _resident() - before
    del run, solution, graph, guess
    gc.collect()
    tracemalloc.start()
    graph, _, guess = pose_graph.graph()
    run = GaussNewton(max_iterations=1).prepare(graph)
    run.solve(guess)
    traced = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return {"resident": grown if grown > 0 else None, "traced": traced}


def _resident() -> int:
    """Bytes of the process in memory, 0 where the system does not tell."""
    if sys.platform != "linux":
        return 0
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE")


def _elsewhere(poses: int) -> Result:
    """The same in a process that has seen no other graph."""
    command = [sys.executable, "-m", "benchmarks.growth", str(poses)]
    done = subprocess.run(command, cwd=CHECKOUT, check=True, capture_output=True, text=True)
    found: Result = json.loads(done.stdout)
    return found


COLUMNS: dict[str, Callable[[Result], str]] = {
    "poses": lambda row: str(row["poses"]),
    "edges": lambda row: str(row["edges"]),
    "iteration [ms]": lambda row: shown(row["ours"]),
    "us per pose": lambda row: number(1e3 * row["ours"][0] / row["poses"]),
    "GTSAM [ms]": lambda row: f"{shown(row['gtsam'])}, {row['ordering']}" if row["gtsam"] else "-",
    "times faster": lambda row: shown(row.get("ratio")),
    "compiling [ms]": lambda row: number(row["compile"][0]),
    "ordering and symbolic [ms]": lambda row: number(row["analyse"][0]),
    "factor [MB]": lambda row: number(row["factor"] / 1e6),
    "peak, NumPy [MB]": lambda row: number(row["traced"] / 1e6),
    "growth of the process [MB]": lambda row: number(row["resident"] / 1e6) if row["resident"] else "-",
}


def render(result: Result) -> str:
    """A table and the exponents."""
    lines = [[tell(row) for tell in COLUMNS.values()] for row in result["rows"]]
    powers = result["exponents"]
    text = (
        f"Growth exponents, fitted over all sizes: iteration {powers['ours']:.2f}, compiling {powers['compile']:.2f}, "
        f"ordering and symbolic work {powers['analyse']:.2f}, factor {powers['factor']:.2f}. An iteration is a third "
        f"of a solve of {ITERATIONS} from the truth. Memory is that of compiling and one iteration, in a process of "
        "its own: the peak of NumPy's arrays and Python's objects (tracemalloc), and what the resident set has grown "
        f"by when graph, solver and solution are kept. Structure of more than {PEER_UP_TO} poses: {FEW} rounds."
    )
    return "\n\n".join([table(list(COLUMNS), lines, text=0), text])


if __name__ == "__main__":
    print(json.dumps(memory(int(sys.argv[1]))))
