"""Smoothing pose by pose, beside GTSAM's iSAM2 and its fixed-lag smoothers: `python -m benchmarks.incremental`.

M3500 (or the graph named) is fed one pose at a time, with the edges that end at it; the new pose starts where the
estimate and the odometry put it. Only ``update`` is timed, on both sides, and stating the factors apart from it.
Candidates run in turn, for several rounds; of each update the fastest round counts, because a shared machine only ever
makes things slower.
"""

from __future__ import annotations

import argparse
import gc
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import unifg as fg
from benchmarks.gtsam_peer import available
from benchmarks.pose_graphs import data_folder
from benchmarks.report import CHECKOUT, machine, put_results, table
from benchmarks.timing import pin
from unifg.files.g2o import read_g2o
from unifg.pose_graphs import PoseGraph, manhattan
from unifg.pose_graphs.pose_graph import Edges
from unifg.solvers import GaussNewton
from unifg.typing import Array

PAGE = CHECKOUT / "docs" / "smoothing.md"
SPAN = 50  # poses over which drift is measured


class Run(NamedTuple):
    """One drive.

    Attributes:
        update: (n,) seconds of processor time of each update.
        state: (n,) the same for stating its factors.
        quality: 1/2 chi2 at the end, or root mean square error of a relative pose [m].
    """

    update: Array
    state: Array
    quality: float


class Candidate(NamedTuple):
    """A smoother to drive: what it is, and the drive itself."""

    name: str
    setting: str
    drive: Callable[[], Run]


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


def clock() -> float:
    """Processor time of this process [s]: waiting for a busy machine does not count."""
    return time.process_time()


def drive(graph: PoseGraph, smoother: Any, lag: float, optimum: Array | None) -> Run:
    """Feed our smoother."""
    x = smoother.variables("x", fg.SE2)
    count = len(graph.poses)
    update, state, errors = np.zeros(count), np.zeros(count), []
    for k, pose, edges in one_by_one(graph, lag):
        start = clock()
        if k == 0:
            smoother.minimize(fg.prior, x[0], pose, sigma=1e-3)
        for i, j, measured, information in zip(*_fields(edges), strict=True):
            smoother.minimize(fg.between, x[i], x[j], measured, information=information)
        guess = pose if k == 0 else fg.SE2.compose(smoother.estimate(x[-1])[0], pose)
        begin = clock()
        smoother.update({x: guess})
        end = clock()
        update[k], state[k] = end - begin, begin - start
        if optimum is not None and k % SPAN == SPAN - 1:
            first = k - int(min(SPAN, lag)) + 2  # GTSAM has dropped the one before
            errors.append(_error(optimum, first, k, *smoother.estimate(x[[first, k]])))
    quality = smoother.cost if optimum is None else float(np.sqrt(np.mean(np.square(errors))))
    return Run(update, state, quality)


def drive_gtsam(graph: PoseGraph, make: Callable[[], Any], lag: float, optimum: Array | None) -> Run:
    """Feed GTSAM's."""
    import gtsam

    smoother, everything = make(), gtsam.NonlinearFactorGraph()
    count = len(graph.poses)
    update, state, errors = np.zeros(count), np.zeros(count), []
    last, isam = gtsam.Pose2(), np.isinf(lag)
    for k, pose, edges in one_by_one(graph, lag):
        start = clock()
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if k == 0:
            factors.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*pose), gtsam.noiseModel.Isotropic.Sigma(3, 1e-3)))
        for i, j, measured, information in zip(*_fields(edges), strict=True):
            noise = gtsam.noiseModel.Gaussian.Information(information)
            factors.add(gtsam.BetweenFactorPose2(i, j, gtsam.Pose2(*measured), noise))
        if k > 0:
            estimate = smoother.calculateEstimatePose2(k - 1) if isam else smoother.calculateEstimate().atPose2(k - 1)
            last = estimate.compose(gtsam.Pose2(*pose))
        values.insert(k, last if k else gtsam.Pose2(*pose))
        arguments = (factors, values) if isam else (factors, values, {k: float(k)})
        begin = clock()
        smoother.update(*arguments)
        end = clock()
        update[k], state[k] = end - begin, begin - start
        everything.push_back(factors)
        if optimum is not None and k % SPAN == SPAN - 1:
            first, estimates = k - int(min(SPAN, lag)) + 2, smoother.calculateEstimate()
            ends = [estimates.atPose2(i) for i in (first, k)]
            errors.append(_error(optimum, first, k, *(np.array([p.x(), p.y(), p.theta()]) for p in ends)))
    if optimum is None:
        return Run(update, state, everything.error(smoother.calculateBestEstimate()))
    return Run(update, state, float(np.sqrt(np.mean(np.square(errors)))))


def _fields(edges: Edges) -> tuple[list[int], list[int], Array, Array]:
    return edges.first.tolist(), edges.second.tolist(), edges.measured, edges.information


def _error(optimum: Array, i: int, k: int, first: Array, last: Array) -> float:
    """Distance [m] of one pose seen from another to where the optimum has it."""
    truth, found = fg.SE2.between(optimum[i], optimum[k]), fg.SE2.between(first, last)
    return float(np.linalg.norm((truth - found)[:2]))


def first_poses(graph: PoseGraph, count: int) -> PoseGraph:
    """The beginning of a drive."""
    inside = np.maximum(graph.edges.first, graph.edges.second) < count
    return PoseGraph(graph.ids[:count], graph.poses[:count], graph.edges[inside])


def incremental(graph: PoseGraph, peer: bool) -> list[Candidate]:
    """Smoothers of the whole history."""
    result = []
    for threshold, every in ((0.1, 10), (0.1, 1), (0.01, 1)):
        setting = f"{threshold:g}, {every}"

        def ours(threshold: float = threshold, every: int = every) -> Run:
            return drive(graph, fg.Incremental(relinearize=threshold, every=every), np.inf, None)

        def theirs(threshold: float = threshold, every: int = every) -> Run:
            import gtsam

            parameters = gtsam.ISAM2Params()
            parameters.setRelinearizeThreshold(threshold)
            parameters.relinearizeSkip = every
            return drive_gtsam(graph, lambda: gtsam.ISAM2(parameters), np.inf, None)

        result.append(Candidate("`Incremental`", setting, ours))
        if peer:
            result.append(Candidate("iSAM2", setting, theirs))
    return result


def fixed_lag(graph: PoseGraph, optimum: Array, peer: bool) -> list[Candidate]:
    """Smoothers of a window."""
    result = []
    for lag in (10, 50, 200):

        def ours(lag: int = lag) -> Run:
            return drive(graph, fg.FixedLag(lag), lag, optimum)

        def always(lag: int = lag) -> Run:
            return drive(graph, fg.FixedLag(lag, relinearize=0.0, wildfire=0.0), lag, optimum)

        result.append(Candidate("`FixedLag`", str(lag), ours))
        result.append(Candidate("`FixedLag`, all relinearised", str(lag), always))
        for name in ("IncrementalFixedLagSmoother", "BatchFixedLagSmoother") if peer else ():

            def theirs(name: str = name, lag: int = lag) -> Run:
                import gtsam

                return drive_gtsam(graph, lambda: getattr(gtsam, name)(float(lag)), lag, optimum)

            result.append(Candidate(name, str(lag), theirs))
    return result


def measured(candidates: list[Candidate], rounds: int) -> list[list[str]]:
    """Rows of a table: each candidate's update times, fastest of the rounds, and its quality."""
    runs: list[list[Run]] = [[] for _ in candidates]
    for _ in range(rounds):
        for candidate, done in zip(candidates, runs, strict=True):
            gc.collect()
            gc.disable()
            done.append(candidate.drive())
            gc.enable()
    rows = []
    for candidate, done in zip(candidates, runs, strict=True):
        update = 1e3 * np.min([run.update for run in done], axis=0)
        state = 1e3 * np.min([run.state for run in done], axis=0)
        numbers = [np.median(update), np.mean(update), *np.percentile(update, [95, 99]), np.max(update[1:])]
        rows.append(
            [
                candidate.name,
                candidate.setting,
                *(f"{number:.3f}" for number in numbers),
                f"{np.median(state):.3f}",
                f"{done[0].quality:.6g}",
            ]
        )
    return rows


def main() -> None:
    """Drive all, and put the tables into the documentation."""
    parser = argparse.ArgumentParser(description="Smoothing pose by pose, beside GTSAM.")
    parser.add_argument("--poses", type=int, default=3500, help="how many of the graph's poses")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--page", type=Path, default=PAGE)
    arguments = parser.parse_args()
    pin()
    folder = data_folder()
    whole = manhattan(arguments.poses).pose_graph if folder is None else read_g2o(folder / "M3500.g2o.gz")
    graph = first_poses(whole, arguments.poses)
    stated, x, guess = graph.graph()
    optimum = GaussNewton().solve(stated, guess)
    peer = available()
    for candidate in incremental(first_poses(graph, 60), False) + fixed_lag(first_poses(graph, 60), graph.poses, False):
        candidate.drive()  # compiles
    head = ["median [ms]", "mean [ms]", "95 % [ms]", "99 % [ms]", "largest [ms]", "stating, median [ms]"]
    text = [
        f"{'M3500' if folder else 'A generated grid'}, {len(graph.poses)} poses, {len(graph.edges)} edges; "
        f"{arguments.rounds} rounds. {machine('numpy', 'numba', 'gtsam')}",
        table(
            ["smoother", "relinearise, every", *head, "1/2 chi2 at the end"],
            measured(incremental(graph, peer), arguments.rounds),
            2,
        ),
        f"The batch optimum is {optimum.cost:.6g}; GTSAM's value is that of its complete back-substitution.",
        table(
            ["smoother", "lag", *head, "error of a relative position [m]"],
            measured(fixed_lag(graph, optimum[x], peer), arguments.rounds),
            2,
        ),
    ]
    put_results(arguments.page, "Smoothing while driving", "\n\n".join(text))


if __name__ == "__main__":
    main()
