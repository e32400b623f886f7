"""What writing a residual oneself costs: the relative pose of SE(2) in a chain, shipped and written by hand.

The shipped `fg.between`, the same as a compiled function of one factor with and without derivatives of its own, the
same in batched NumPy, and GTSAM's factor in C++ and as a Python callback.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numba
import numpy as np

import unifg as fg
from benchmarks.gtsam_peer import Peer, available
from benchmarks.report import table
from benchmarks.section import Result, goal
from benchmarks.timing import interleave, milliseconds, shown, spread, timed
from unifg.pose_graphs import Edges, PoseGraph
from unifg.solvers import GaussNewton
from unifg.typing import Array

LENGTHS = (200, 2000)  # poses; the targets are for the longer chain
ITERATIONS = 3
FEW = 3  # rounds of GTSAM's callbacks on the long chain
SIGMA = np.array([0.05, 0.05, 0.02])  # of odometry [m, m, rad]
FIX, EVERY = 0.1, 20  # sigma of the poses measured absolutely [m, rad], one in so many
NAMES = {
    "between": "`fg.between`",
    "compiled": "compiled function of one factor, numerical derivatives",
    "derived": "compiled function of one factor, own derivatives",
    "batched": "batched NumPy function, numerical derivatives",
    "gtsam": "GTSAM, BetweenFactorPose2",
    "callback": "GTSAM, CustomFactor in Python",
}
TARGETS = {"compiled": 3.0, "derived": 3.0, "batched": 30.0}


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def relative(x: Array, y: Array, measured: Array, r: Array) -> None:
    """Log(Z^-1 X^-1 Y) of one factor."""
    c, s = math.cos(x[2]), math.sin(x[2])
    dx, dy = y[0] - x[0], y[1] - x[1]
    ahead, left = c * dx + s * dy - measured[0], c * dy - s * dx - measured[1]
    c, s = math.cos(measured[2]), math.sin(measured[2])
    turn = y[2] - x[2] - measured[2]
    turn = math.atan2(math.sin(turn), math.cos(turn))
    half = 0.5 * turn
    a = 1.0 - half * half / 3.0 if abs(turn) < 1e-4 else half / math.tan(half)
    ahead, left = c * ahead + s * left, c * left - s * ahead
    r[0] = a * ahead + half * left
    r[1] = a * left - half * ahead
    r[2] = turn


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def relative_jacobian(x: Array, y: Array, measured: Array, by_x: Array, by_y: Array) -> None:
    """Derivatives of `relative`: J = Jr^-1(r) by y, and -J Ad(Y^-1 X) by x."""
    r = np.empty(3)
    relative(x, y, measured, r)
    turn, half = r[2], 0.5 * r[2]
    if abs(turn) < 1e-4:
        a, b = 1.0 - half * half / 3.0, turn / 12.0
    else:
        a = half / math.tan(half)
        b = (1.0 - a) / turn
    by_y[0, 0] = by_y[1, 1] = a
    by_y[0, 1], by_y[1, 0] = -half, half
    by_y[0, 2], by_y[1, 2] = b * r[0] + 0.5 * r[1], b * r[1] - 0.5 * r[0]
    by_y[2, 0] = by_y[2, 1] = 0.0
    by_y[2, 2] = 1.0
    c, s = math.cos(y[2]), math.sin(y[2])
    px, py = c * (x[0] - y[0]) + s * (x[1] - y[1]), c * (x[1] - y[1]) - s * (x[0] - y[0])
    c, s = math.cos(x[2] - y[2]), math.sin(x[2] - y[2])
    for row in range(3):
        u, v, w = by_y[row, 0], by_y[row, 1], by_y[row, 2]
        by_x[row, 0] = -(u * c + v * s)
        by_x[row, 1] = u * s - v * c
        by_x[row, 2] = -(u * py - v * px + w)


def batched(x: Array, y: Array, measured: Array) -> Array:
    """The same for a batch, (n, 3)."""
    c, s = np.cos(x[:, 2]), np.sin(x[:, 2])
    d = y[:, :2] - x[:, :2]
    ahead, left = c * d[:, 0] + s * d[:, 1] - measured[:, 0], c * d[:, 1] - s * d[:, 0] - measured[:, 1]
    c, s = np.cos(measured[:, 2]), np.sin(measured[:, 2])
    turn = y[:, 2] - x[:, 2] - measured[:, 2]
    turn = np.arctan2(np.sin(turn), np.cos(turn))
    half = 0.5 * turn
    little = np.abs(turn) < 1e-4
    a = np.where(little, 1.0 - half**2 / 3.0, half / np.tan(np.where(little, 1.0, half)))
    ahead, left = c * ahead + s * left, c * left - s * ahead
    return np.stack([a * ahead + half * left, a * left - half * ahead, turn], axis=1)


RESIDUALS: dict[str, Any] = {
    "between": fg.between,
    "compiled": fg.residual(relative, rows=3),
    "derived": fg.residual(relative, relative_jacobian, rows=3),
    "batched": batched,
}


def drive(poses: int) -> tuple[PoseGraph, Array]:
    """Noisy odometry along a winding road with a noisy start, and the pose at every place that is measured absolutely.

    Without those the answer would be the odometry itself, with nothing left to iterate on.
    """
    rng = np.random.default_rng(2)
    steps = np.column_stack([np.ones(poses - 1), np.zeros(poses - 1), 0.1 * np.sin(0.05 * np.arange(poses - 1))])
    first = np.arange(poses - 1)
    measured = fg.SE2.retract(steps, SIGMA * rng.standard_normal(steps.shape))
    truth = np.zeros((poses, 3))
    for k in range(poses - 1):
        truth[k + 1] = fg.SE2.compose(truth[k], steps[k])
    start = fg.SE2.retract(truth, SIGMA * rng.standard_normal((poses, 3)))
    known = fg.SE2.retract(truth[::EVERY], FIX * rng.standard_normal((len(truth[::EVERY]), 3)))
    information = np.tile(np.diag(SIGMA**-2.0), (poses - 1, 1, 1))
    return PoseGraph(np.arange(poses, dtype=np.int64), start, Edges(first, first + 1, measured, information)), known


def stated(pose_graph: PoseGraph, known: Array, residual: Any) -> tuple[fg.Graph, fg.Family]:
    """The chain as a factor graph."""
    graph = fg.Graph()
    x = graph.variables("poses", fg.SE2, len(pose_graph.poses))
    graph.minimize(residual, x[:-1], x[1:], pose_graph.edges.measured, sigma=SIGMA, name="odometry")
    graph.minimize(fg.prior, x[::EVERY], known, sigma=FIX, name="known poses")
    return graph, x


def measure(rounds: int, small: bool = False) -> Result:
    """Both chains."""
    lengths = (9,) if small else LENGTHS
    rows = [measure_length(length, rounds) for length in lengths]
    goals = [
        goal(f"own residual, {NAMES[name]}", "times the time of `fg.between`", rows[-1]["ratios"][name], target)
        for name, target in TARGETS.items()
    ]
    return {"rows": rows, "rounds": rounds, "goals": goals}


def measure_length(poses: int, rounds: int) -> Result:
    """One chain, everything in turn; callbacks on the long chain take seconds and have rounds of their own."""
    pose_graph, known = drive(poses)
    candidates: dict[str, Callable[[], float]] = {}
    costs: dict[str, float] = {}
    for name, residual in RESIDUALS.items():
        graph, x = stated(pose_graph, known, residual)
        run = GaussNewton(max_iterations=ITERATIONS, tolerance=1e-300).prepare(graph)
        first = run.solve({x: pose_graph.poses})
        costs[name] = first.cost
        candidates[name] = timed(partial(run.solve, {x: pose_graph.poses}), max(first.iterations, 1))
    slow: dict[str, Callable[[], float]] = {}
    if available():
        peer, other = _peers(pose_graph, known)
        candidates["gtsam"] = slow["gtsam again"] = lambda: peer.iterate("COLAMD", ITERATIONS)[0]
        slow["callback"] = lambda: other.iterate("COLAMD", 1)[0]
    times = interleave(candidates, rounds)
    ratios = {name: spread(times[name] / times["between"]) for name in candidates}
    if slow:
        few = interleave(slow, min(rounds, FEW), warm=0)
        times["callback"] = few["callback"]
        ratios["callback"] = spread(few["callback"] / few["gtsam again"])
    milli = {name: milliseconds(values) for name, values in times.items()}
    return {"poses": poses, "ms": milli, "ratios": ratios, "costs": costs}


def _peers(pose_graph: PoseGraph, known: Array) -> tuple[Peer, Peer]:
    """The chain in GTSAM with its own relative poses, and with relative poses evaluated in Python."""
    import gtsam

    peers = Peer(pose_graph), Peer(pose_graph)
    noise, fix = gtsam.noiseModel.Diagonal.Sigmas(SIGMA), gtsam.noiseModel.Isotropic.Sigma(3, FIX)
    absolute = [gtsam.PriorFactorPose2(EVERY * k, gtsam.Pose2(*pose), fix) for k, pose in enumerate(known)]
    own = [peers[0].graph.at(k) for k in range(len(pose_graph.edges))]
    measured = [gtsam.Pose2(*pose) for pose in pose_graph.edges.measured]
    python = [gtsam.CustomFactor(noise, [k, k + 1], _callback(pose, k)) for k, pose in enumerate(measured)]
    for peer, odometry in zip(peers, (own, python), strict=True):
        peer.graph = gtsam.NonlinearFactorGraph()
        for factor in (*odometry, *absolute):
            peer.graph.add(factor)
    return peers


def _callback(measured: Any, first: int) -> Callable[[Any, Any, Any], Array]:
    def error(factor: Any, values: Any, jacobians: Any) -> Array:
        relative = values.atPose2(first).between(values.atPose2(first + 1))
        if jacobians is None:
            return np.asarray(measured.localCoordinates(relative))
        by_relative = np.zeros((3, 3), order="F")
        result = np.asarray(measured.localCoordinates(relative, np.zeros((3, 3), order="F"), by_relative))
        jacobians[0] = -by_relative @ relative.inverse().AdjointMap()
        jacobians[1] = by_relative
        return result

    return error


def render(result: Result) -> str:
    """One table."""
    rows = result["rows"]
    head = ("residual", *(f"{row['poses']} poses [ms]" for row in rows), "times", "target")
    lines = []
    for name, words in NAMES.items():
        if name not in rows[-1]["ms"]:
            continue
        of = "GTSAM's own" if name == "callback" else "`fg.between`"
        ratio = rows[-1]["ratios"][name]
        target = f"{TARGETS[name]:g}" if name in TARGETS else "-"
        lines.append((words, *(shown(row["ms"][name]) for row in rows), f"{shown(ratio)} of {of}", target))
    notes = (
        f"Per Gauss-Newton iteration of {ITERATIONS}, on {rows[-1]['poses']} poses for the ratios. GTSAM's callback is "
        f"timed over {FEW} rounds of one iteration and compared with its own factor in C++: it copies all values "
        "into Python for each factor, so that it grows with the square of the length."
    )
    return "\n\n".join([table(head, lines), notes])
