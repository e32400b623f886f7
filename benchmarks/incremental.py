"""Smoothing pose by pose, beside GTSAM's iSAM2 and its fixed-lag smoothers.

M3500 is fed one pose at a time, with the edges that end at it; the new pose starts where the estimate and the odometry
put it. Only ``update`` is timed, on both sides, and stating the factors apart from it. Both have the same thresholds,
of relinearisation and of back-substitution (iSAM2's default, 0.001). Of each update the fastest round counts, because
a shared machine only ever makes things slower.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np

import unifg as fg
from benchmarks.comparison import Key
from benchmarks.gtsam_peer import as_array, available
from benchmarks.report import Columns, listing, shared
from benchmarks.runner import Timing
from benchmarks.timing import clock, interleave
from unifg.files.g2o import read_g2o
from unifg.pose_graphs import PoseGraph, manhattan
from unifg.pose_graphs.pose_graph import Edges
from unifg.solvers import GaussNewton
from unifg.typing import Array

POSES = 3500
WILDFIRE = 1e-3  # iSAM2's default; ours is a tenth of it
SPAN = 50  # poses over which drift is measured


class Run(NamedTuple):
    """One drive.

    Attributes:
        update: (n,) seconds of processor time of each update.
        state: (n,) the same for stating its factors, the guess of the new pose apart.
        quality: 1/2 chi2 at the end, or root mean square error of a relative pose [m].
    """

    update: Array
    state: Array
    quality: float


class Fed:
    """`Incremental` or `FixedLag`, fed one pose at a time."""

    def __init__(self, smoother: Any) -> None:
        """Begin without poses."""
        self.smoother, self.x, self.new = smoother, smoother.variables("x", fg.SE2), np.zeros(3)

    def guess(self, k: int, pose: Array) -> None:
        """Predict pose k, given its odometry (of the first its value)."""
        self.new = pose if k == 0 else fg.SE2.compose(self.smoother.estimate(self.x[-1])[0], pose)

    def state(self, k: int, edges: Edges) -> None:
        """State the edges that end at pose k."""
        if k == 0:
            self.smoother.minimize(fg.prior, self.x[0], self.new, sigma=1e-3)
        for i, j, measured, information in zip(*_fields(edges), strict=True):
            self.smoother.minimize(fg.between, self.x[i], self.x[j], measured, information=information)

    def update(self) -> None:
        """Take in what was stated."""
        self.smoother.update({self.x: self.new})

    def poses(self, first: int, last: int) -> Array:
        """(2, 3) estimates of two poses."""
        return np.asarray(self.smoother.estimate(self.x[[first, last]]))

    @property
    def cost(self) -> float:
        """1/2 chi2 of everything stated."""
        return float(self.smoother.cost)


class FedGtsam(Fed):
    """GTSAM's; its fixed-lag smoothers want a time for each pose, and do not tell the estimate of one alone."""

    def __init__(self, smoother: Any, isam: bool) -> None:
        """Begin without poses."""
        self.smoother, self.isam, self.everything = smoother, isam, list[Any]()

    def guess(self, k: int, pose: Array) -> None:
        """Predict pose k."""
        import gtsam

        self.start = gtsam.Pose2(*pose)
        if k > 0:
            find = self.smoother
            last = find.calculateEstimatePose2(k - 1) if self.isam else find.calculateEstimate().atPose2(k - 1)
            self.start = last.compose(self.start)

    def state(self, k: int, edges: Edges) -> None:
        """State the edges that end at pose k."""
        import gtsam

        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if k == 0:
            factors.add(gtsam.PriorFactorPose2(0, self.start, gtsam.noiseModel.Isotropic.Sigma(3, 1e-3)))
        for i, j, measured, information in zip(*_fields(edges), strict=True):
            noise = gtsam.noiseModel.Gaussian.Information(information)
            factors.add(gtsam.BetweenFactorPose2(i, j, gtsam.Pose2(*measured), noise))
        values.insert(k, self.start)
        self.everything.append(factors)
        self.stated = (factors, values) if self.isam else (factors, values, {k: float(k)})

    def update(self) -> None:
        """Take in what was stated."""
        self.smoother.update(*self.stated)

    def poses(self, first: int, last: int) -> Array:
        """(2, 3) estimates of two poses."""
        found = self.smoother.calculateEstimate()
        return np.array([as_array(found.atPose2(k)) for k in (first, last)])

    @property
    def cost(self) -> float:
        """1/2 chi2 of everything stated."""
        best = self.smoother.calculateBestEstimate()
        return float(sum(factors.error(best) for factors in self.everything))


def one_by_one(graph: PoseGraph, lag: float = np.inf) -> Iterator[tuple[int, Array, Edges]]:
    """For each pose its odometry (for the first its value), and the edges within the lag that end at it."""
    later = np.maximum(graph.edges.first, graph.edges.second)
    order = np.argsort(later, kind="stable")
    bounds = np.searchsorted(later[order], np.arange(len(graph.poses) + 1))
    for k in range(len(graph.poses)):
        edges = graph.edges[order[bounds[k] : bounds[k + 1]]]
        odometry = edges.measured[(edges.first == k - 1) & (edges.second == k)]
        edges = edges[np.minimum(edges.first, edges.second) > k - lag]
        yield k, graph.poses[0] if k == 0 else odometry[0], edges


def drive(graph: PoseGraph, make: Callable[[], Fed], lag: float, optimum: Array | None) -> Run:
    """Feed a smoother; times are the processor's: waiting for a busy machine does not count."""
    smoother, count = make(), len(graph.poses)
    update, state, errors = np.zeros(count), np.zeros(count), []
    for k, pose, edges in one_by_one(graph, lag):
        smoother.guess(k, pose)
        state[k] = clock(partial(smoother.state, k, edges))
        update[k] = clock(smoother.update)
        if optimum is not None and k % SPAN == SPAN - 1:
            first = k - int(min(SPAN, lag)) + 2  # GTSAM has dropped the one before
            errors.append(_error(optimum, first, k, *smoother.poses(first, k)))
    quality = smoother.cost if optimum is None else float(np.sqrt(np.mean(np.square(errors))))
    return Run(update, state, quality)


def _fields(edges: Edges) -> tuple[list[int], list[int], Array, Array]:
    return edges.first.tolist(), edges.second.tolist(), edges.measured, edges.information


def _error(optimum: Array, i: int, k: int, first: Array, last: Array) -> float:
    """Distance [m] of one pose seen from another to where the optimum has it."""
    truth, found = fg.SE2.between(optimum[i], optimum[k]), fg.SE2.between(first, last)
    return float(np.linalg.norm((truth - found)[:2]))


Candidates = dict[Key, Callable[[], Run]]
"""Drives to be timed, by smoother and setting."""


def incremental(graph: PoseGraph, peer: bool) -> Candidates:
    """Smoothers of the whole history."""

    def ours(threshold: float, every: int) -> Fed:
        return Fed(fg.Incremental(relinearize=threshold, every=every, wildfire=WILDFIRE))

    def theirs(threshold: float, every: int) -> Fed:
        import gtsam

        parameters = gtsam.ISAM2Params()
        parameters.setRelinearizeThreshold(threshold)
        parameters.relinearizeSkip = every
        return FedGtsam(gtsam.ISAM2(parameters), isam=True)

    makers = {"`Incremental`": ours} | ({"iSAM2": theirs} if peer else {})
    return {
        (name, f"{threshold:g}, {every}"): partial(drive, graph, partial(make, threshold, every), np.inf, None)
        for threshold, every in ((0.1, 10), (0.1, 1), (0.01, 1))
        for name, make in makers.items()
    }


def fixed_lag(graph: PoseGraph, optimum: Array, peer: bool) -> Candidates:
    """Smoothers of a window."""

    def theirs(lag: int, name: str) -> Fed:
        import gtsam

        return FedGtsam(getattr(gtsam, name)(float(lag)), isam=False)

    makers: dict[str, Callable[[int], Fed]] = {
        "`FixedLag`": lambda lag: Fed(fg.FixedLag(lag)),
        "`FixedLag`, all relinearised": lambda lag: Fed(fg.FixedLag(lag, relinearize=0.0, wildfire=0.0)),
    }
    for name in ("IncrementalFixedLagSmoother", "BatchFixedLagSmoother") if peer else ():
        makers[name] = partial(theirs, name=name)
    return {
        (name, str(lag)): partial(drive, graph, partial(make, lag), lag, optimum)
        for lag in (10, 50, 200)
        for name, make in makers.items()
    }


def told(candidates: Candidates, rounds: int, setting: str, quality: str) -> str:
    """A table: each candidate's update times, fastest of the rounds, and its quality."""
    runs: dict[Key, list[Run]] = {name: [] for name in candidates}

    def once(name: Key) -> float:
        gc.collect()
        gc.disable()
        runs[name].append(candidates[name]())
        gc.enable()
        return float(runs[name][-1].update.sum())

    interleave({", ".join(name): partial(once, name) for name in candidates}, rounds, warm=0)
    groups = {
        name: (
            1e3 * np.min([run.update for run in done], axis=0),
            1e3 * float(np.median(np.min([run.state for run in done], axis=0))),
            done[0].quality,
        )
        for name, done in runs.items()
    }
    columns: Columns[tuple[Array, float, float]] = {
        "median [ms]": lambda found: f"{np.median(found[0]):.3f}",
        "mean [ms]": lambda found: f"{np.mean(found[0]):.3f}",
        "95 % [ms]": lambda found: f"{np.percentile(found[0], 95):.3f}",
        "99 % [ms]": lambda found: f"{np.percentile(found[0], 99):.3f}",
        "largest [ms]": lambda found: f"{np.max(found[0][1:]):.3f}",
        "stating, median [ms]": lambda found: f"{found[1]:.3f}",
        quality: lambda found: f"{found[2]:.6g}",
    }
    return listing(("smoother", setting), groups, columns)


def first_poses(graph: PoseGraph, count: int) -> PoseGraph:
    """The beginning of a drive."""
    inside = np.maximum(graph.edges.first, graph.edges.second) < count
    return PoseGraph(graph.ids[:count], graph.poses[:count], graph.edges[inside])


def tables(rounds: int) -> str:
    """Smoothers of the whole history and of a window."""
    folder, peer = shared("pose_graphs"), available()
    graph = manhattan(POSES).pose_graph if folder is None else read_g2o(folder / "M3500.g2o.gz")
    little = first_poses(graph, 60)
    stated, x, guess = graph.graph()
    optimum = GaussNewton().solve(stated, guess)
    for compiles in (incremental(little, False) | fixed_lag(little, little.poses, False)).values():
        compiles()
    return "\n\n".join(
        [
            f"{'M3500' if folder else 'A generated grid'}, {len(graph.poses)} poses, {len(graph.edges)} edges; "
            f"{rounds} rounds.",
            told(incremental(graph, peer), rounds, "relinearise, every", "1/2 chi2 at the end"),
            f"The batch optimum is {optimum.cost:.6g}; GTSAM's value is that of its complete back-substitution.",
            told(fixed_lag(graph, optimum[x], peer), rounds, "lag", "error of a relative position [m]"),
        ]
    )


STUDY = Timing(tables, 3)
