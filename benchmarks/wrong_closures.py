"""Wrong loop closures on published pose graphs: graduated non-convexity, dynamic covariance scaling, and GTSAM's.

    python -m benchmarks.wrong_closures [--graphs M3500:0.3 ...] [--seeds FIRST:END] [--methods unifg DCS GTSAM]

Prints a Markdown table; it takes about an hour, most of it for M3500 with 30 %, and goes on where it stopped. Settings
were chosen on the seeds 0 to 2, the table is of seeds from 10 on. Errors are distances from the answer without wrong
closures. A wrong closure within the threshold of that answer cannot be told from a right one by the loss, whoever
minimises it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

import unifg as fg
from benchmarks import runs
from benchmarks.gtsam_peer import Peer, as_array, available
from benchmarks.report import command, listing, publish, shared
from problems.closures import Claim, with_wrong_closures
from unifg.files.g2o import read_g2o
from unifg.lie import SE2
from unifg.pose_graphs import PoseGraph
from unifg.scenarios.campaigns.comparison import Row
from unifg.solvers import GaussNewton, GraduatedNonConvexity
from unifg.typing import Array

THRESHOLD = {3: 3.37, 6: 4.10}  # by numbers in a measurement: 99 % of right ones
CLAIMS: tuple[Claim, ...] = ("same place", "anywhere")
CASES = (
    ("intel", 0.3, 3),
    ("intel", 0.5, 3),
    ("M3500", 0.1, 6),
    ("M3500", 0.3, 3),
    ("smallGrid3D", 0.1, 3),
    ("smallGrid3D", 0.3, 3),
)  # graph, share, seeds
FIRST = 10  # seed


class Found(NamedTuple):
    """An answer.

    Attributes:
        poses: (n, storage).
        remark: its status, where it has one.
    """

    poses: Array
    remark: str = ""


def by_gtsam(pose_graph: PoseGraph) -> Found:
    """GTSAM's GNC with Gauss-Newton inside, odometry known to be right, truncated least squares."""
    import gtsam

    peer, dim = Peer(pose_graph), pose_graph.group.dim
    edges = pose_graph.edges
    options = gtsam.GncGaussNewtonParams(gtsam.GaussNewtonParams())
    options.setKnownInliers([*np.flatnonzero(edges.odometry).tolist(), len(edges)])
    options.setLossType(gtsam.GncLossType.TLS)
    optimizer = gtsam.GncGaussNewtonOptimizer(peer.graph, peer.start, options)
    optimizer.setInlierCostThresholds(0.5 * THRESHOLD[dim] ** 2)
    found = optimizer.optimize()
    pose = found.atPose2 if pose_graph.group is SE2 else found.atPose3
    return Found(np.array([as_array(pose(k)) for k in range(len(pose_graph.poses))]))


def by_graduation(pose_graph: PoseGraph) -> Found:
    """Ours."""
    graph, x, guess = pose_graph.graph(robust=fg.TruncatedLeastSquares(THRESHOLD[pose_graph.group.dim]))
    solution = GraduatedNonConvexity().solve(graph, guess)
    return Found(solution[x], solution.status.name)


def by_scaling(pose_graph: PoseGraph) -> Found:
    """Dynamic covariance scaling with the same bound, Gauss-Newton from the guess."""
    graph, x, guess = pose_graph.graph(robust=fg.DCS(THRESHOLD[pose_graph.group.dim] ** 2 / 3.0))
    return Found(GaussNewton().solve(graph, guess)[x])


METHODS = {"unifg": by_graduation, "DCS": by_scaling, "GTSAM": by_gtsam}


@dataclass(frozen=True)
class Job:
    """A method, and the wrong closures it is to find; see :func:`problems.closures.with_wrong_closures`."""

    graph: str
    share: float
    claim: Claim
    seed: int
    method: str


def attempt(clean: PoseGraph, job: Job) -> Row:
    """What a method makes of a graph with wrong closures."""
    graph, x, guess = clean.graph()
    right = GaussNewton().solve(graph, guess, check=True)[x]
    dirty, wrong = with_wrong_closures(clean, job.share, job.seed, job.claim)
    closures, place = ~dirty.edges.odometry, 2 if clean.group is SE2 else 3
    begin = time.process_time()
    found = METHODS[job.method](dirty)
    seconds = time.process_time() - begin
    kept = dirty.with_poses(found.poses).squared_errors() <= THRESHOLD[clean.group.dim] ** 2
    good, bad = kept[closures & ~wrong], kept[wrong]
    return {
        "remark": found.remark,
        "distance": float(np.linalg.norm(found.poses[:, :place] - right[:, :place], axis=1).max()),
        "right kept": float(good.mean()),
        "wrong kept": int(bad.sum()),
        "wrong": len(bad),
        "precision": float(good.sum() / max(good.sum() + bad.sum(), 1)),
        "seconds": seconds,
    }


def attempted(job: Job) -> Row:
    """The same on the published graph."""
    return attempt(published(job.graph), job)


@cache
def published(name: str) -> PoseGraph:
    """A graph of the shared data."""
    folder = shared("pose_graphs")
    if folder is None:
        raise SystemExit("there is no folder of pose graphs: set UNIFG_DATA")
    path = folder / f"{name}.g2o.gz"
    return read_g2o(path if path.is_file() else folder / f"{name}.g2o")


COLUMNS: dict[str, Callable[[Row], str]] = {
    "error [m]": lambda row: f"{row['distance']:.3f}",
    "right kept": lambda row: f"{row['right kept']:.4f}",
    "wrong kept": lambda row: f"{row['wrong kept']} of {row['wrong']}",
    "precision": lambda row: f"{row['precision']:.4f}",
    "CPU [s]": lambda row: f"{row['seconds']:.1f}",
}


def named(row: Row) -> tuple[str, ...]:
    """The words a line begins with."""
    called = f"{row['method']} ({row['remark']})" if row["remark"] else row["method"]
    return row["graph"], f"{row['share']:.0%}", row["claim"], str(row["seed"]), called


def main(arguments: list[str] | None = None) -> int:
    """Print one row per graph, share, claim, seed and method."""
    parser = command(__doc__)
    runs.options(parser)
    parser.add_argument("--seeds", type=runs.seeds, metavar="FIRST:END", help="instead of three or six from 10 on")
    parser.add_argument("--graphs", nargs="+", help="only these, as NAME or NAME:SHARE")
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS))
    options = parser.parse_args(arguments)
    jobs = [
        # Half of the seeds with either claim: what the wrong closures measure.
        Job(name, share, CLAIMS[seed % 2], seed, method)
        for name, share, count in CASES
        if not options.graphs or {name, f"{name}:{share}"} & set(options.graphs)
        for seed in options.seeds or range(FIRST, FIRST + count)
        for method in options.methods
        if method != "GTSAM" or available()
    ]
    rows = {row["key"]: row for row in runs.episodes("wrong_closures", attempted, jobs, options)}
    asked = [rows[key] for job in jobs if (key := tuple(vars(job).values())) in rows]
    head = ("graph", "wrong", "claim", "seed", "method")
    publish("wrong-closures", listing(head, {named(row): row for row in asked}, COLUMNS))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
