"""Gauss-Newton on published pose graphs, beside GTSAM: per iteration, whole solves, and where our time goes."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

import unifg as fg
from benchmarks.gtsam_peer import ORDERINGS, Peer, available
from benchmarks.report import CHECKOUT, table
from benchmarks.timing import Spread, Stopwatch, interleave, milliseconds, number, shown, spread
from unifg.answers import solver
from unifg.elimination import factorization, fronts, substitution
from unifg.files.g2o import read_g2o
from unifg.pose_graphs import PoseGraph, manhattan, sphere
from unifg.program import passes
from unifg.program.program import Program
from unifg.solvers import GaussNewton
from unifg.typing import Array

Result: TypeAlias = dict[str, Any]

SAME = 1e-6  # relative difference of chi2
# What the compiled passes and Python around them do in a solve; linearising adds up the normal equations too.
WATCHED: dict[str, tuple[Any, str]] = {
    "linearise": (passes, "linearize"),
    "eliminate": (fronts, "factor"),
    "substitute": (substitution, "solve"),
    "retract": (Program, "retract"),
    "KKT test": (solver, "optimality"),
    "bind data": (Program, "bind"),
}


@dataclass(frozen=True)
class Case:
    """One pose graph.

    Attributes:
        name: for the tables.
        pose_graph: measurements and start.
        chi2: best value known, not a number where none is.
        target, floor: how many times faster than GTSAM an iteration should and must be.
    """

    name: str
    pose_graph: PoseGraph
    chi2: float
    target: float
    floor: float


# Best chi2 known of the published files, full logarithm, without 1/2; then target and floor.
PUBLISHED = {
    "M3500": (137.9148782, 6.0, 4.0),
    "intel": (45.0042331, 6.0, 4.0),
    "parking-garage": (1.2683848, 2.5, 1.5),
    "sphere2500": (1351.4019259, 2.0, 1.5),
}


def data_folder() -> Path | None:
    """The folder with the pose graphs, if there is one."""
    folder = Path(os.environ.get("UNIFG_DATA", CHECKOUT.parent / "shared" / "data")) / "pose_graphs"
    return folder if folder.is_dir() else None


def cases(small: bool = False) -> list[Case]:
    """The published graphs, or made-up ones where the files are absent."""
    if small:
        planar, spatial = manhattan(40).pose_graph, sphere(4, 5).pose_graph
        return [Case("manhattan 40", planar, np.nan, 6.0, 4.0), Case("sphere 20", spatial, np.nan, 2.0, 1.5)]
    folder = data_folder()
    if folder is None:
        city, ball = manhattan(3500), sphere(50, 50)
        return [
            Case("manhattan 3500", city.pose_graph.with_poses(city.truth), np.nan, 6.0, 4.0),
            Case("sphere 2500", ball.pose_graph.with_poses(ball.truth), np.nan, 2.0, 1.5),
        ]
    return [Case(name, read_g2o(folder / f"{name}.g2o.gz"), *numbers) for name, numbers in PUBLISHED.items()]


def measure(rounds: int, small: bool = False) -> Result:
    """All cases."""
    generated = small or data_folder() is None
    found = [measure_case(case, rounds) for case in cases(small)]
    goals = [
        {"name": f"{row['name']}, iteration", "unit": "times faster than GTSAM", "value": row["ratio"],
         "target": row["target"], "floor": row["floor"]}
        for row in found if row["ratio"]
    ]  # fmt: skip
    return {"rows": found, "generated": generated, "rounds": rounds, "goals": goals}


def measure_case(case: Case, rounds: int) -> Result:
    """One case: iterations, whole solves and parts in one set of rounds."""
    graph, x, guess = case.pose_graph.graph()
    run = GaussNewton().prepare(graph)
    first = run.solve(guess)
    count = first.iterations
    watch = Stopwatch(WATCHED)
    parts: dict[str, list[float]] = {part: [] for part in (*WATCHED, "Python")}
    analysis = Stopwatch({"analyse": (factorization, "analyse")})
    compiling: list[float] = []
    analysing: list[float] = []

    def ours() -> float:
        begin = time.perf_counter()
        run.solve(guess)
        return (time.perf_counter() - begin) / count

    def split() -> float:
        with watch:
            begin = time.perf_counter()
            run.solve(guess)
            elapsed = time.perf_counter() - begin
        for part, seconds in watch.seconds.items():
            parts[part].append(seconds / count)
        parts["Python"].append((elapsed - sum(watch.seconds.values())) / count)
        return elapsed / count

    def whole() -> float:
        fresh, _, start = case.pose_graph.graph()
        with analysis:
            begin = time.perf_counter()
            prepared = GaussNewton().prepare(fresh)
            between = time.perf_counter()
            prepared.solve(start)
            end = time.perf_counter()
        compiling.append(between - begin)
        analysing.append(analysis.seconds["analyse"])
        return end - begin

    candidates: dict[str, Callable[[], float]] = {"ours": ours, "split": split, "whole": whole}
    ends: dict[str, tuple[int, float]] = {}
    if available():
        peer = Peer(case.pose_graph)
        for ordering in ORDERINGS:
            candidates[ordering] = lambda ordering=ordering: peer.iterate(ordering, count)[0]  # type: ignore[misc]
        pilot = {ordering: min(peer.solve(ordering)[0] for _ in range(2)) for ordering in ORDERINGS}
        best_whole = min(pilot, key=lambda ordering: pilot[ordering])
        candidates["GTSAM, whole"] = lambda: _whole(peer, best_whole, ends)
    times = interleave(candidates, rounds)
    result: Result = {
        "name": case.name,
        "poses": len(case.pose_graph.poses),
        "edges": len(case.pose_graph.edges),
        "target": case.target,
        "floor": case.floor,
        "known": case.chi2 if np.isfinite(case.chi2) else None,
        "chi2": case.pose_graph.with_poses(first[x]).chi2(),
        "iterations": count,
        "status": first.status.name.lower().replace("_", " "),
        "ours": milliseconds(times["ours"]),
        "whole": milliseconds(times["whole"]),
        "compile": milliseconds(np.array(compiling[-rounds:])),
        "analyse": milliseconds(np.array(analysing[-rounds:])),
        "parts": {part: milliseconds(np.array(values[-rounds:])) for part, values in parts.items()},
        "ratio": None,
    }
    if available():
        result |= _compared(times, best_whole, *ends[best_whole])
    return result


def _whole(peer: Peer, ordering: str, ends: dict[str, tuple[int, float]]) -> float:
    elapsed, iterations, chi2 = peer.solve(ordering)
    ends[ordering] = iterations, chi2
    return elapsed


def _compared(times: Mapping[str, Array], best_whole: str, iterations: int, chi2: float) -> Result:
    """Ratios to the faster of GTSAM's orderings."""
    best = min(ORDERINGS, key=lambda ordering: float(np.median(times[ordering])))
    return {
        "gtsam": {ordering: milliseconds(times[ordering]) for ordering in ORDERINGS},
        "best": best,
        "ratio": spread(times[best] / times["ours"]),
        "gtsam_whole": milliseconds(times["GTSAM, whole"]),
        "best_whole": best_whole,
        "ratio_whole": spread(times["GTSAM, whole"] / times["whole"]),
        "gtsam_iterations": iterations,
        "gtsam_chi2": chi2,
    }


def render(result: Result) -> str:
    """Tables of iterations, solves and parts."""
    rows = result["rows"]
    if result["generated"]:
        source = "The published files are not here: these graphs are generated, and start at the truth."
    else:
        source = "Published graphs from the poses in their files."
    head = (
        "graph", "poses", "edges", "iterations", "ours [ms]", "GTSAM, COLAMD [ms]", "GTSAM, METIS [ms]",
        "times faster", "target (floor)",
    )  # fmt: skip
    lines = [
        (
            row["name"], str(row["poses"]), str(row["edges"]), str(row["iterations"]), shown(row["ours"]),
            *(shown(row.get("gtsam", {}).get(ordering)) for ordering in ORDERINGS),
            shown(row["ratio"]), f"{row['target']:g} ({row['floor']:g})",
        )
        for row in rows
    ]  # fmt: skip
    return "\n\n".join(
        [
            f"{source} Per Gauss-Newton iteration:",
            table(head, lines),
            "Where an iteration of ours goes [ms]:",
            _parts(rows),
            "Whole solves, symbolic work included:",
            _wholes(rows),
        ]
    )


def _parts(rows: list[Result]) -> str:
    names = list(rows[0]["parts"])
    lines = []
    for row in rows:
        total = sum(row["parts"][name][0] for name in names)
        cells = (f"{number(row['parts'][name][0])} ({100 * row['parts'][name][0] / total:.0f} %)" for name in names)
        lines.append((row["name"], *cells))
    return table(("graph", *names), lines)


def _wholes(rows: list[Result]) -> str:
    head = (
        "graph", "ours [ms]", "of it compiling", "of it ordering and symbolic", "iterations", "GTSAM [ms]", "ordering",
        "its iterations", "times faster", "chi2, ours", "chi2, GTSAM", "best known", "both within 1e-6",
    )  # fmt: skip
    lines = []
    for row in rows:
        known: Spread = [row["known"]] if row["known"] else [row["chi2"]]
        ends = [row["chi2"], *([row["gtsam_chi2"]] if "gtsam_chi2" in row else [])]
        close = all(abs(end - known[0]) <= SAME * known[0] for end in ends)
        lines.append(
            (
                row["name"], shown(row["whole"]), number(row["compile"][0]), number(row["analyse"][0]),
                f"{row['iterations']}, {row['status']}",
                shown(row.get("gtsam_whole")), row.get("best_whole", "-"), str(row.get("gtsam_iterations", "-")),
                shown(row.get("ratio_whole")), *(f"{end:.7f}" for end in ends), *["-"] * (2 - len(ends)),
                f"{known[0]:.7f}" if row["known"] else "-", "yes" if close else "no",
            )
        )  # fmt: skip
    return table(head, lines)


def posed(pose_graph: PoseGraph, sigma: float) -> tuple[fg.Graph, fg.Family]:
    """The same measurements with a prior on the first pose where `PoseGraph.graph` fixes it."""
    edges = pose_graph.edges
    graph = fg.Graph()
    x = graph.variables("poses", pose_graph.group, len(pose_graph.poses))
    graph.minimize(fg.between, x[edges.first], x[edges.second], edges.measured, information=edges.information)
    graph.minimize(fg.prior, x[0], pose_graph.poses[0], sigma=sigma)
    return graph, x
