"""Marginal covariances at the optimum: every pose's, and joint ones of pairs, beside GTSAM's.

Both hold the first pose by the same prior, and GTSAM is given our optimum and our linear factors: what differs is the
elimination alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

import unifg as fg
from benchmarks import pose_graphs
from benchmarks.gtsam_peer import ANCHOR, Peer, available, joint
from benchmarks.report import listing
from benchmarks.section import Result, goal
from benchmarks.timing import interleave, milliseconds, ratio, shown
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.linearization import Linearization
from unifg.solvers import GaussNewton
from unifg.typing import Array, IntArray

PAIRS = 10  # joint covariances of two poses
FEW = 5  # rounds at most
SLOW = 2.0  # [s]; what takes GTSAM longer is compared once
SAMPLE = 500  # poses whose covariance is compared with GTSAM's of the same linear factors
TARGET = 1e-8  # largest relative difference


def measure(rounds: int, small: bool = False) -> Result:
    """All pose graphs."""
    few = min(rounds, FEW)
    rows = [measure_case(case, few) for case in pose_graphs.cases(small)]
    goals = [
        goal(f"{row['name']}, marginal covariances", "relative difference from GTSAM",
             [max(row["difference"], row["joint difference"])] * 3, TARGET)
        for row in rows if row["difference"] is not None
    ]  # fmt: skip
    return {"rows": rows, "rounds": few, "goals": goals}


def measure_case(case: pose_graphs.Case, rounds: int) -> Result:
    """All single marginals, and some joint ones."""
    graph, x = pose_graphs.posed(case.pose_graph, ANCHOR)
    solution = GaussNewton().solve(graph, {x: case.pose_graph.poses})
    program = graph.compile()
    count, dim = len(case.pose_graph.poses), case.pose_graph.group.dim
    rng = np.random.default_rng(0)
    pairs = np.array([rng.choice(count, 2, replace=False) for _ in range(min(PAIRS, count // 2))])
    tree = Tree(program, solution)
    scalars = program.columns.unknown[program.columns.of(x[:])]
    found: dict[str, Any] = {}

    def every() -> float:
        begin = time.process_time()
        found["blocks"] = Tree(program, solution).blocks().reshape(count, dim, dim)
        return time.process_time() - begin

    def from_tree() -> float:
        begin = time.process_time()
        found["joint"] = np.array([tree.factorization.inverse_block(scalars[pair].ravel()) for pair in pairs])
        return (time.process_time() - begin) / len(pairs)

    times = interleave({"all": every, "tree": from_tree}, rounds)
    result: Result = {"name": case.name, "poses": count, "difference": None}
    result |= {what: milliseconds(values) for what, values in times.items()}
    if available():
        result |= _compared(case, tree.lin, solution[x], pairs, found, every, rounds)
    return result


def _compared(
    case: pose_graphs.Case,
    lin: Linearization,
    poses: Array,
    pairs: IntArray,
    found: dict[str, Array],
    every: Callable[[], float],
    rounds: int,
) -> Result:
    """Times of all marginals in turn, and the differences: of the elimination alone, and with GTSAM's own Jacobians."""
    peer, count, edges = Peer(case.pose_graph), len(poses), len(case.pose_graph.edges)
    dim = case.pose_graph.group.dim
    blocks: dict[str, Array] = {}

    def theirs() -> float:
        begin = time.process_time()
        marginals = peer.marginals(poses)
        blocks["own"] = np.array([marginals.marginalCovariance(k) for k in range(count)])
        return time.process_time() - begin

    times = interleave({"all": every, "gtsam": theirs}, rounds, warm=0, slow=SLOW)
    derivatives = lin.jacobian[: edges * 2 * dim * dim].reshape(edges, dim, 2 * dim)
    marginals = peer.marginals_of(derivatives, lin.jacobian[edges * 2 * dim * dim :].reshape(dim, dim))
    chosen = np.arange(0, count, max(1, count // SAMPLE))
    single = np.array([marginals.marginalCovariance(int(k)) for k in chosen])
    both = np.array([joint(marginals, first, second) for first, second in pairs.tolist()])
    return {
        "gtsam": milliseconds(times["gtsam"]),
        "ratio": ratio(times["gtsam"], times["all"]),
        "difference": _largest(found["blocks"][chosen], single),
        "joint difference": _largest(found["joint"], both),
        "with its own": _largest(found["blocks"], np.array([peer.ours(block) for block in blocks["own"]])),
    }


class Tree:
    """The normal equations at a solution, factorised.

    Attributes:
        lin: where they come from.
        factorization: what entries of the inverse are read from.
    """

    def __init__(self, program: CompiledProblem, solution: fg.Solution) -> None:
        """Linearise, order, factorise."""
        self.lin = program.linearize(solution.values)
        self.factorization = program.systems.normal()
        if not self.factorization.factor(self.lin.hessian):
            raise RuntimeError("the normal equations of this pose graph are singular")

    def blocks(self) -> Array:
        """(n, d, d) covariance of every pose."""
        return np.array(self.factorization.diagonal_blocks())


def _largest(ours: Array, reference: Array) -> float:
    """Largest difference of a block relative to the largest entry of that block."""
    size = np.abs(reference).max(axis=(1, 2))
    return float((np.abs(ours - reference).max(axis=(1, 2)) / size).max())


COLUMNS: dict[str, Callable[[Result], str]] = {
    "poses": lambda row: str(row["poses"]),
    "all poses, ours [ms]": lambda row: shown(row["all"]),
    "GTSAM [ms]": lambda row: shown(row.get("gtsam")),
    "times faster": lambda row: shown(row.get("ratio")),
    "difference": lambda row: _power(row["difference"]),
    "with GTSAM's own Jacobians": lambda row: _power(row.get("with its own")),
    "two poses, tree [ms]": lambda row: shown(row["tree"]),
    "its difference": lambda row: _power(row.get("joint difference")),
}


def render(result: Result) -> str:
    """One table."""
    notes = (
        "All poses: linearisation, ordering, factorisation and the entries of the inverse that the elimination tree "
        "holds (`Factorization.diagonal_blocks`), against `gtsam.Marginals` with one call per pose. Two poses: joint "
        f"covariance of {PAIRS} pairs anywhere in the graph, by `Factorization.inverse_block` of a factorisation "
        "there is. Differences from GTSAM are relative to the largest entry of a block. GTSAM is given our Jacobians "
        "for them, and every so many poses are compared; the column after shows all poses with its own, whose "
        "derivative of the logarithm in the plane loses figures at small angles. "
        f"{result['rounds']} rounds, one where GTSAM takes longer than {SLOW:g} s."
    )
    return "\n\n".join([listing(("graph",), {(row["name"],): row for row in result["rows"]}, COLUMNS), notes])


def _power(value: float | None) -> str:
    return "-" if value is None else f"{value:.0e}"
