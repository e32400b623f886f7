"""Solving a pose graph from a file: reading, a first guess, a backend, a robust loss, and how it went.

The command ``unifg solve`` is this and `unifg.scenarios.commands.graphs`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from unifg.codegen.threads import threads, use_threads
from unifg.errors import ScenarioError
from unifg.factors.robust import DCS, Cauchy, Huber, Loss, TruncatedLeastSquares, Tukey
from unifg.files.contents import legible
from unifg.files.pose_graph import read_pose_graph
from unifg.pose_graphs.information import REPAIRS, Repair, indefinite
from unifg.pose_graphs.initialise import chordal, incremental, lago, odometric, starts
from unifg.pose_graphs.judgement import judge
from unifg.pose_graphs.pose_graph import PoseGraph, ResidualName, RobustOn
from unifg.pose_graphs.verdict import Judgement, Verdict
from unifg.scenarios.episode import Progress, silent
from unifg.scenarios.options import Settings, count, existing, option, positive, read_word
from unifg.scenarios.stopwatch import Stopwatch
from unifg.solution.chi_squared import upper_quantile
from unifg.solution.history import Iteration
from unifg.solution.solution import Solution
from unifg.solution.status import Status
from unifg.solvers import GraduatedNonConvexity, names
from unifg.solvers.least_squares import MAP
from unifg.typing import Array, BoolArray

__all__ = ["OUTLIER_WEIGHT", "SolveSettings", "SolvedGraph", "robust_loss", "solve_file", "threshold"]

AUTO = "auto"
GUESSES: dict[str, Callable[[PoseGraph], PoseGraph]] = {
    "file": lambda read: read,
    "odometry": lambda read: read.with_poses(odometric(read)),
    "lago": lambda read: read.with_poses(lago(read)),
    "chordal": lambda read: read.with_poses(chordal(read)),
    "incremental": incremental,
}
LOSSES: dict[str, Callable[[float], Loss]] = {
    "huber": Huber,
    "cauchy": Cauchy,
    "tukey": Tukey,
    "dcs": DCS,
    "gnc": TruncatedLeastSquares,
}
_JUDGED = {"optimum": 1e-6, "map": 1e-4}  # share of the cost by which maps are told apart: a map ends within 1e-5
_DEFAULTS = {"huber": 1.345, "cauchy": 2.385, "tukey": 4.685, "dcs": 1.0}
MOST_SHOWN = 12  # iterates of a picture
_INLIERS = 0.99  # of right measurements lie within the default threshold of gnc
OUTLIER_WEIGHT = 0.5
"""A measurement that the robust loss gives less weight than this is called an outlier."""


@dataclass(frozen=True)
class SolveSettings(Settings):
    """Settings of a solve.

    Attributes:
        file: pose graph: .g2o or .graph (TORO), also .gz.
        solver: one of `unifg.solvers.names.LEAST_SQUARES`.
        robust: loss on loop closures, if any: huber, cauchy, tukey, dcs, or gnc (truncated least squares, graduated),
            with its parameter after a colon if it is not the usual one.
        robust_on: the measurements with this loss: loop closures, or odometry and sightings of landmarks as well. All
            can be wrong then, and gnc begins at several first guesses.
        init: first guess: poses of the file, a spanning tree, LAGO (2D), chordal relaxation, or a map that grows along
            the odometry; or the one of them that costs least, but for the tree.
        residual: full logarithm, as GTSAM, or the chart of g2o; their optima differ in 3D.
        tolerance: "optimum", to all digits, or "map", until a step would lower the cost by less than 1e-5 of it.
        repair_information: what to do about information matrices with negative eigenvalues: leave these measurements
            out, or keep what is left without them. By default such a file is refused.
        max_iterations: before giving up.
        threads: that share the work of a large graph; no more than there are free cores.
        scene: draw a picture and a scene, too, which takes longer than the solve.
        effort: spent on the verdict: none, cheap (a bound on what another map could gain, closures that the others
            contradict or do not support), or full (a better map is looked for as well, and taken).
        keep_map: keep the map of the first solve although a better one was found; that is a failure.
    """

    file: Path = option(text=existing("a pose graph (g2o or TORO)"), metavar="GRAPH")
    solver: str = "gn"
    robust: str | None = option(None, metavar="LOSS[:PARAM]")
    robust_on: RobustOn = option("closures")
    init: str = option(AUTO, choices=(AUTO, *GUESSES))
    residual: ResidualName = option("log")
    tolerance: Literal["optimum", "map"] = option("optimum")
    repair_information: Repair | None = option(None, choices=REPAIRS)
    max_iterations: int = option(100, metavar="N")
    threads: int = option(1, text=partial(count, least=1), metavar="N")
    scene: bool = option(False)
    effort: Literal["none", "cheap", "full"] = option("cheap")
    keep_map: bool = option(False)


@dataclass(frozen=True, eq=False)
class SolvedGraph:
    """A solved pose graph.

    Attributes:
        settings: what was asked.
        before: the graph at its first guess.
        after: the graph at the solution.
        chi2: sum of r' Omega r, without losses: in the file, NaN where it has no poses, at the first guess, and at the
            solution.
        solution: what the backend returned.
        loss: on the loop closures, or on all measurements; None for none.
        squared: (m,) r' Omega r of every edge at the solution.
        outliers: (m,) edges that the loss gives less than half of their weight.
        steps: (k, n, storage) poses of up to a dozen iterates, the first guess and the solution among them.
        step_numbers: (k,) iteration of each.
        begun: name of the first guess that was taken.
        judgement: what the graph says about itself at the solution, outliers left out.
        verdict: on the solution, outliers left out; None where none was asked for.
        better: cost, as stated, of a better map that was found and not taken; None without one.
        seconds: wall-clock time by what it was spent on: read, initialise, compile, solve, verdict.
    """

    settings: SolveSettings
    before: PoseGraph
    after: PoseGraph
    chi2: tuple[float, float, float]
    solution: Solution
    loss: Loss | None
    squared: Array
    outliers: BoolArray
    steps: Array
    step_numbers: list[int]
    begun: str
    judgement: Judgement
    verdict: Verdict | None
    better: float | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    interrupted: bool = False

    @property
    def name(self) -> str:
        """The file's name without its endings."""
        return legible(self.settings.file.name).removesuffix(".gz").rsplit(".", 1)[0]

    @property
    def chi2_inliers(self) -> float:
        """chi2 at the solution without the outliers."""
        return self.chi2[2] - float(self.squared[self.outliers].sum())


def solve_file(settings: SolveSettings, progress: Progress = silent) -> SolvedGraph:
    """Read, initialise and solve.

    Args:
        settings: what to solve, and how.
        progress: called with the share done, a guess, and a line of text; may raise KeyboardInterrupt.

    Raises:
        ScenarioError: the settings do not fit each other or the file.
        FileFormatError: the file cannot be read.
        GraphError: the measurements do not determine the poses.
        UnifgError: there cannot be so many threads.
    """
    before = threads()
    use_threads(settings.threads)
    try:
        return _solve_file(settings, progress)
    finally:
        use_threads(before)


def _solve_file(settings: SolveSettings, progress: Progress) -> SolvedGraph:
    clock = Stopwatch()
    progress(0.0, f"reading {legible(settings.file.name)}")
    read = read_pose_graph(settings.file, repair=settings.repair_information)
    clock.split("read")
    weights = [read.edges.information, *(seen.information for seen in read.sightings.values())]
    weights += [prior.information for prior in read.priors.values()]
    if any(indefinite(information).any() for information in weights):
        raise ScenarioError(f"{settings.file}: {'; '.join(read.remarks)}: --repair-information zero or project")
    if not len(read.edges) and not read.sightings and not read.priors:
        raise ScenarioError(f"{settings.file}: there is no edge in this file, and nothing to solve")
    loss = robust_loss(settings.robust, read.group.dim)
    if settings.init == "lago" and read.group.dim != 3:
        raise ScenarioError("--init lago is for planar pose graphs; use --init chordal")
    progress(0.05, f"first guess: {settings.init}")
    clock.start()
    if settings.init == AUTO:
        found = starts(read, settings.residual, loss)
        best = min(found, key=lambda start: start.cost)
        before = read.with_poses(best.poses, best.landmarks)
        begun, in_file, at_start = best.name, found[0].chi2, best.chi2
    else:
        begun, before, in_file = (
            settings.init,
            GUESSES[settings.init](read),
            read.chi2(settings.residual),
        )
        at_start = in_file if begun == "file" else before.chi2(settings.residual)
    clock.split("initialise")
    solve = _Solve(settings, loss, clock, progress)
    solution, after, squared, outliers = solve(before)
    verdict, worse, stopped = None, None, solution.status is Status.INTERRUPTED
    if settings.effort != "none" and not stopped:
        try:
            while True:
                progress(0.95, "verdict")
                clock.start()
                verdict = after.verdict(
                    effort=settings.effort,
                    residual=settings.residual,
                    used=None if loss is None else ~outliers,
                    tolerance=_JUDGED[settings.tolerance],
                )
                clock.split("verdict")
                if verdict.better is None:
                    break
                again = solve(before.with_poses(verdict.better, verdict.better_landmarks))
                # Compared as stated, losses included.
                if not again[0].cost < (1.0 - _JUDGED[settings.tolerance]) * solution.cost:
                    break
                if settings.keep_map:
                    worse = again[0].cost
                    break
                solution, after, squared, outliers = again
        except KeyboardInterrupt:  # there is something to write
            stopped = True
    stopped = stopped or solution.status is Status.INTERRUPTED
    with suppress(KeyboardInterrupt):  # there is something to write
        progress(1.0, solution.status.name.lower().replace("_", " "))
    numbers, steps = _chosen(solve.iterates)
    chi2 = (in_file if read.placed else np.nan, at_start, float(squared.sum()) + after.seen_chi2())
    judgement = verdict.judgement if verdict else judge(replace(after, edges=after.edges[~outliers]), settings.residual)
    return SolvedGraph(
        settings, before, after, chi2, solution, loss, squared, outliers, steps, numbers, begun, judgement, verdict,
        worse, clock.seconds, stopped,
    )  # fmt: skip


class _Solve:
    """State, compile and solve, once or again from elsewhere; iterates of all are kept for pictures."""

    def __init__(self, settings: SolveSettings, loss: Loss | None, clock: Stopwatch, progress: Progress) -> None:
        self.settings, self.loss, self.clock, self.progress = settings, loss, clock, progress
        self.iterates: dict[int, Array] = {}
        self.before = 0

    def __call__(self, begin: PoseGraph) -> tuple[Solution, PoseGraph, Array, BoolArray]:
        """The solution, the graph at it, (m,) its r' Omega r and which edges the loss takes for outliers."""
        settings, loss, clock = self.settings, self.loss, self.clock
        clock.start()
        if not self.before:
            self.progress(0.06, "compiling")
        graph, x, guess = begin.graph(robust=loss, residual=settings.residual, robust_on=settings.robust_on)
        graph.compile()
        clock.split("compile")

        def tell(row: Iteration) -> None:
            number = self.before + row.number
            if row.values is not None:
                self.iterates[number] = row.values[x]
            stage = f", stage {row.details['stage']}" if "stage" in row.details else ""
            self.progress(0.95 * (1.0 - 0.95 * 0.9**number), f"iteration {number}{stage}, cost {row.cost:.6g}")

        tolerance = {"tolerance": MAP} if settings.tolerance == "map" else {}
        limit, watched = settings.max_iterations, settings.scene
        backend = names.backend(settings.solver, keep_values=watched, max_iterations=limit, **tolerance)
        solver = GraduatedNonConvexity(solver=backend) if isinstance(loss, TruncatedLeastSquares) else backend
        clock.start()
        solution = solver.solve(graph, guess, callback=tell)
        clock.split("solve")
        landmarks = solution[graph.families["landmarks"]] if len(begin.landmarks) else None
        after = begin.with_poses(solution[x], landmarks)
        errors = after.squared_errors(settings.residual)
        weights = np.ones(len(errors)) if loss is None else np.asarray(loss.weight(errors))
        self.before += solution.iterations
        self.iterates[self.before] = after.poses
        trusted = begin.edges.odometry & (settings.robust_on == "closures")
        return solution, after, errors, (weights < OUTLIER_WEIGHT) & ~trusted


def robust_loss(text: str | None, dim: int) -> Loss | None:
    """The loss that ``NAME`` or ``NAME:PARAMETER`` stands for.

    Args:
        text: for instance "huber" or "cauchy:1.0"; None for no loss.
        dim: degrees of freedom of a pose. The default threshold of gnc is that of a chi-squared test at 99 %.

    Raises:
        ScenarioError: the name is unknown or the parameter is not a positive number.
    """
    if text is None:
        return None
    name, _, parameter = text.partition(":")
    if name not in LOSSES:
        raise ScenarioError(f"--robust {text}: expected one of {', '.join(LOSSES)}, with :PARAMETER if you like")
    if ":" not in text:
        return LOSSES[name](_DEFAULTS[name] if name in _DEFAULTS else threshold(dim))
    return LOSSES[name](read_word(positive, parameter, f"--robust {text}"))


def threshold(dim: int) -> float:
    """The length of a whitened residual that a share of right measurements stays below."""
    return math.sqrt(upper_quantile(dim, 1.0 - _INLIERS))


def _chosen(kept: dict[int, Array]) -> tuple[list[int], Array]:
    """Numbers and poses (k, n, storage) of at most a dozen iterates for pictures; early ones are preferred."""
    numbers = sorted(kept)
    places = np.arange(len(numbers))
    if len(numbers) > MOST_SHOWN:
        places = np.unique(np.geomspace(1, len(numbers), MOST_SHOWN).round().astype(np.intp)) - 1
    chosen = [numbers[k] for k in places]
    return chosen, np.stack([kept[number] for number in chosen])
