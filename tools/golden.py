"""Results of a fixed set of solves, to the last bit: recorded before the code is moved, compared after.

    python -m tools.golden record [--parts PART ...] [--file FILE]
    python -m tools.golden compare [--parts PART ...] [--file FILE]

A row is one solve, update or episode: its status, its iterations, its cost and a digest of all its values. Code that
only moves changes nothing here, not the last bit; code that is meant to change something changes the rows it is meant
to change and no other. ``compare`` says how many rows are the same to the bit, which are the same but for rounding and
which are not, and ends with exit code 1 if there are any of the last. The file belongs to one machine and one set of
versions: it is not part of the project. Record and compare with warm caches: a process that compiles rounds otherwise.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from tqdm import tqdm

import unifg as fg
from benchmarks import control_cases, incremental, pose_graphs
from benchmarks.navigation import CASES, settings_of
from benchmarks.report import OUT
from problems import collection
from problems.control import Problem, blocked, problems
from unifg.errors import UnifgError
from unifg.pose_graphs import PoseGraph
from unifg.scenarios import manoeuvres
from unifg.scenarios.course import CourseSettings, run_course
from unifg.scenarios.flight import FlightSettings, run_flight
from unifg.scenarios.navigation import NavigationSettings, run_navigation
from unifg.scenarios.papers import ecg2o
from unifg.solvers import DogLeg, GaussNewton, GraduatedNonConvexity
from unifg.solvers.names import backends
from unifg.typing import Array

ROUNDING = 1e-9  # relative difference of costs that a changed order of sums may make
LAG = 50  # poses
CONTROL = backends("ipm", "sqp", "alm")


@dataclass(frozen=True)
class Row:
    """End of one solve.

    Attributes:
        status: in words; what was raised, if it was refused.
        iterations: of the solve, ticks of an episode.
        cost: at the end.
        digest: of the bytes of all values.
    """

    status: str
    iterations: int
    cost: float
    digest: str

    def change(self, before: Row) -> str:
        """Change in words: "same", "rounding" or a few others."""
        if self.digest == before.digest and self.status == before.status and self.iterations == before.iterations:
            return "same"
        if self.status != before.status:
            return f"{before.status} -> {self.status}"
        if self.iterations != before.iterations:
            return f"{before.iterations} -> {self.iterations} iterations"
        return "rounding" if math.isclose(self.cost, before.cost, rel_tol=ROUNDING) else f"{before.cost} -> {self.cost}"


Start: TypeAlias = fg.Guess | dict[fg.Family, Array]
Solving: TypeAlias = fg.Solver | GraduatedNonConvexity
Rows: TypeAlias = Iterator[tuple[str, Callable[[], Row]]]


def digest(*arrays: Any) -> str:
    """Of the bytes of some arrays."""
    total = hashlib.sha256()
    for array in arrays:
        total.update(np.ascontiguousarray(array).tobytes())
    return total.hexdigest()[:16]


def row_of(solution: fg.Solution) -> Row:
    """Kept numbers of a solve."""
    values = [solution.values[family] for family in solution.values]
    return Row(solution.status.name, solution.iterations, solution.cost, digest(*values))


def solved(solver: Solving, graph: fg.Graph, guess: Start) -> Row:
    """Solve and keep; a refusal is kept, too."""
    try:
        return row_of(solver.solve(graph, guess))
    except UnifgError as error:
        return Row(type(error).__name__, 0, 0.0, digest(np.frombuffer(str(error).encode(), np.uint8)))


def cold(problem: Problem, solver: fg.Solver) -> Row:
    """A control case from its listed guess."""
    stated = problem.formulation()
    return solved(solver, stated.graph, stated.guess)


def started(run: fg.Prepared, guess: fg.Guess) -> Row:
    """A prepared control case from one of its random starts."""
    return row_of(run.solve(guess))


def built(solver: Solving, build: Callable[[], tuple[fg.Graph, Start]]) -> Row:
    """A problem that states itself."""
    return solved(solver, *build())


def marginals(pose_graph: PoseGraph) -> Row:
    """Joint covariance of every fiftieth pose."""
    graph, x, guess = pose_graph.graph()
    solution = GaussNewton().solve(graph, guess)
    blocks = solution.covariance(x[::50])
    return Row(solution.status.name, solution.iterations, float(np.trace(blocks)), digest(blocks))


def smoothed(pose_graph: PoseGraph, make: Callable[[], Any], lag: float) -> Row:
    """A graph fed pose by pose."""
    run = incremental.drive(
        pose_graph, lambda: incremental.Fed(make()), lag, None if np.isinf(lag) else pose_graph.poses
    )
    return Row("smoothed", len(run.update), run.quality, digest(run.quality))


def manoeuvred(case: manoeuvres.Case, solver: str) -> Row:
    """A manoeuvre from its cold guess."""
    return row_of(manoeuvres.run_manoeuvre(case, solver).solution)


def driven(settings: NavigationSettings) -> Row:
    """A drive in closed loop."""
    log = run_navigation(settings)
    status = f"{sum(log.reached)} of {len(log.goals)} goals, {log.collisions} collisions"
    far = float(np.linalg.norm(log.true_pose))
    return Row(status, len(log.time), far, digest(log.true_pose, log.estimate, log.control))


def flown(settings: FlightSettings) -> Row:
    """A flight through a corridor."""
    log = run_flight(settings)
    status = "reached" if log.reached else "not reached"
    return Row(status, log.ticks, float(np.linalg.norm(log.truth)), digest(log.truth, log.controls))


def of_control() -> Rows:
    """The control cases, cold."""
    for problem in problems():
        for name, solver in CONTROL.items():
            yield f"{problem.title}, {name}", partial(cold, problem, solver)


def of_starts() -> Rows:
    """The control cases with obstacles, from random starts."""
    for problem in blocked():
        stated = problem.formulation()
        runs = {name: solver.prepare(stated.graph) for name, solver in control_cases.SOLVERS.items()}
        for k, (states, controls) in enumerate(problem.starts(control_cases.STARTS)):
            guess = fg.Guess({stated.x: states, stated.u: controls})
            for name, run in runs.items():
                yield f"{problem.title}, {name}, start {k}", partial(started, run, guess)


def of_collection() -> Rows:
    """Hock and Schittkowski's and the other small problems."""
    for case in collection.CASES.values():
        for name, solver in collection.BACKENDS.items():
            yield f"{case.name}, {name}", partial(built, solver, case.build)


def of_ecg2o() -> Rows:
    """Both case studies."""
    solvers = {**backends("kkt", "penalty", "gn"), **CONTROL}
    for drag in ("quadratic", "linear"):
        for length in ecg2o.LENGTHS:
            for name, solver in solvers.items():
                yield f"drive {drag} {length}, {name}", partial(built, solver, partial(ecg2o.drive, length, drag))
    for start in ecg2o.STARTS:
        for name, solver in {**solvers, "literal": ecg2o.literal(10.0), "damped": ecg2o.damped(10.0)}.items():
            yield f"small {start}, {name}", partial(built, solver, partial(ecg2o.small, start))


def of_graphs() -> Rows:
    """Pose graphs, marginals of some poses, and smoothing pose by pose."""
    solvers: dict[str, Solving] = {
        **backends("gn", "lm"), "dog-leg": DogLeg(), "gnc": GraduatedNonConvexity(),
    }  # fmt: skip
    cases = pose_graphs.cases()
    for case in cases:
        graph, _, guess = case.pose_graph.graph()
        for name, solver in solvers.items():
            if name != "gnc" or case.name in ("M3500", "intel"):
                yield f"{case.name}, {name}", partial(solved, solver, graph, guess)
        yield f"{case.name}, covariance", partial(marginals, case.pose_graph)
    city = cases[0].pose_graph
    whole = partial(fg.Incremental, relinearize=0.1, every=10)
    yield f"{cases[0].name}, pose by pose", partial(smoothed, city, whole, np.inf)
    yield f"{cases[0].name}, fixed lag", partial(smoothed, city, partial(fg.FixedLag, LAG), LAG)


def of_manoeuvres() -> Rows:
    """The manoeuvres of the unicycle."""
    for name, case in manoeuvres.CASES.items():
        for solver in ("sqp", "alm"):
            yield f"{name}, {solver}", partial(manoeuvred, case, solver)


def of_drives() -> Rows:
    """Drives in closed loop."""
    for (name, case), seeds in zip(CASES.items(), ((0, 1), (0,), (0,), (0, 1)), strict=True):
        for seed, (solver, coupling) in product(seeds, (("alm", "sequential"), ("sqp", "joint"))):
            if case.available:
                drive = settings_of(case, solver, coupling, seed)
                yield f"{name}, {solver}, {coupling}, seed {seed}", partial(driven, drive)


def of_flights() -> Rows:
    """Flights through corridors, and an obstacle course."""
    for seed in (3, 4):
        for solver, coupling in (
            ("ipm", "separate"), ("ipm", "sequential"), ("ipm", "joint"), ("sqp", "sequential"), ("alm", "joint"),
        ):  # fmt: skip
            yield f"flight {seed}, {solver}, {coupling}", partial(flown, FlightSettings(solver, coupling, seed))
    yield "course", lambda: row_of(run_course(CourseSettings(guess="hover")).solution)


PARTS: dict[str, Callable[[], Rows]] = {
    "control": of_control,
    "starts": of_starts,
    "collection": of_collection,
    "ecg2o": of_ecg2o,
    "graphs": of_graphs,
    "manoeuvres": of_manoeuvres,
    "drives": of_drives,
    "flights": of_flights,
}


def measured(parts: Iterable[str]) -> dict[str, Row]:
    """Every row of some parts, by part and name."""
    rows: dict[str, Row] = {}
    for part in parts:
        with tqdm(PARTS[part](), desc=part, unit="row") as bar:
            for name, task in bar:
                rows[f"{part}: {name}"] = task()
    return rows


def main(arguments: list[str] | None = None) -> int:
    """Record or compare; 1 if something that is no rounding has changed."""
    parser = argparse.ArgumentParser(prog="python -m tools.golden", description=__doc__.split("\n")[0])
    parser.add_argument("action", choices=("record", "compare"))
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--file", type=Path, default=OUT / "golden.json", help="where the rows are")
    options = parser.parse_args(arguments)
    known: dict[str, Row] = {}
    if options.file.is_file():
        known = {name: Row(**row) for name, row in json.loads(options.file.read_text(encoding="utf-8")).items()}
    elif options.action == "compare":
        print(f"{options.file} is not there: record it first, on the code to compare with.")
        return 2
    rows = measured(options.parts)
    if options.action == "record":
        options.file.parent.mkdir(parents=True, exist_ok=True)
        kept = {name: vars(row) for name, row in {**known, **rows}.items()}
        options.file.write_text(json.dumps(kept, indent=0) + "\n", encoding="utf-8")
        print(f"{len(rows)} rows recorded in {options.file}")
        return 0
    return compared(rows, known, options.parts)


def compared(rows: dict[str, Row], known: dict[str, Row], parts: Iterable[str]) -> int:
    """Print what has changed."""
    asked = {name: row for name, row in known.items() if name.partition(":")[0] in set(parts)}
    changes = {name: row.change(asked[name]) for name, row in rows.items() if name in asked}
    for name in sorted(set(asked) ^ set(rows)):
        changes[name] = "is gone" if name in asked else "is new"
    others = {name: change for name, change in changes.items() if change not in ("same", "rounding")}
    for name, change in others.items():
        print(f"{name}: {change}")
    counts = {word: sum(change == word for change in changes.values()) for word in ("same", "rounding")}
    print(f"{counts['same']} rows the same to the bit, {counts['rounding']} but for rounding, {len(others)} not")
    return 1 if others else 0


if __name__ == "__main__":
    sys.exit(main())
