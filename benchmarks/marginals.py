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
from benchmarks.report import Columns, listing, told
from benchmarks.section import Result, goal
from benchmarks.timing import clocked, interleave, milliseconds, ratio, shown
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
    count = len(case.pose_graph.poses)
    rng = np.random.default_rng(0)
    pairs = np.array([rng.choice(count, 2, replace=False) for _ in range(min(PAIRS, count // 2))])
    tree = Tree(program, solution)
    scalars = program.columns.unknown[program.columns.of(x[:])]
    found: dict[str, Any] = {}

    def every() -> float:
        found["blocks"], seconds = clocked(lambda: Tree(program, solution).blocks(), by=time.process_time)
        return seconds

    def from_tree() -> float:
        blocks = [scalars[pair].ravel() for pair in pairs]
        found["joint"], seconds = clocked(
            lambda: [*map(tree.factorization.inverse_block, blocks)], by=time.process_time
        )
        return seconds / len(pairs)

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
        "joint difference": _largest(np.array(found["joint"]), both),
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


COLUMNS: Columns[Result] = {
    "poses": told("poses"),
    "all poses, ours [ms]": told("all", shown),
    "GTSAM [ms]": told("gtsam", shown),
    "times faster": told("ratio", shown),
    "difference": told("difference", "{:.0e}".format),
    "with GTSAM's own Jacobians": told("with its own", "{:.0e}".format),
    "two poses, tree [ms]": told("tree", shown),
    "its difference": told("joint difference", "{:.0e}".format),
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
