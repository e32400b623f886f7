"""Gauss-Newton on published pose graphs, beside GTSAM: per iteration, whole solves, and from the file."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

import unifg as fg
from benchmarks.gtsam_peer import ORDERINGS, Peer, available
from benchmarks.report import Columns, listing, shared, told, words
from benchmarks.section import Result, goal
from benchmarks.timing import Contestants, clock, interleave, milliseconds, ratio, shown, timed
from problems.graphs import graph_with
from unifg.files.g2o import read_g2o, write_g2o
from unifg.lie import SE3
from unifg.pose_graphs import PoseGraph, manhattan, sphere
from unifg.solvers import GaussNewton
from unifg.typing import Array

SAME = 1e-6  # relative difference of chi2


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

    @property
    def whole(self) -> float:
        """Target from the file to the map, in times faster than GTSAM."""
        return 3.0 if self.pose_graph.group is SE3 else 5.0


# Best chi2 known of the published files, full logarithm, without 1/2; then target and floor.
PUBLISHED = {
    "M3500": (137.9148782, 6.0, 4.0),
    "intel": (45.0042331, 6.0, 4.0),
    "parking-garage": (1.2683848, 2.5, 1.5),
    "sphere2500": (1351.4019259, 2.0, 1.5),
}


def cases(small: bool = False) -> list[Case]:
    """The published graphs, or made-up ones where the files are absent."""
    if small:
        planar, spatial = manhattan(40).pose_graph, sphere(4, 5).pose_graph
        return [Case("manhattan 40", planar, np.nan, 6.0, 4.0), Case("sphere 20", spatial, np.nan, 2.0, 1.5)]
    folder = shared("pose_graphs")
    if folder is None:
        city, ball = manhattan(3500), sphere(50, 50)
        return [
            Case("manhattan 3500", city.pose_graph.with_poses(city.truth), np.nan, 6.0, 4.0),
            Case("sphere 2500", ball.pose_graph.with_poses(ball.truth), np.nan, 2.0, 1.5),
        ]
    return [Case(name, read_g2o(folder / f"{name}.g2o.gz"), *numbers) for name, numbers in PUBLISHED.items()]


def measure(rounds: int, small: bool = False) -> Result:
    """All cases."""
    generated = small or shared("pose_graphs") is None
    found = [measure_case(case, rounds) for case in cases(small)]
    goals = [
        goal(f"{row['name']}, iteration", "times faster than GTSAM", row["ratio"], row["target"], row["floor"])
        for row in found
        if row["ratio"]
    ] + [
        goal(f"{filed['name']}, from the file to the map", "times faster than GTSAM", filed["ratio"], filed["target"])
        for filed in (row["file"] for row in found)
        if filed["ratio"]
    ]
    return {"rows": found, "generated": generated, "rounds": rounds, "goals": goals}


def measure_case(case: Case, rounds: int) -> Result:
    """One case: iterations, whole solves and parts in one set of rounds."""
    pose_graph = case.pose_graph
    graph, x, guess = pose_graph.graph()
    run = GaussNewton().prepare(graph)
    first = run.solve(guess)
    count = first.iterations

    def fresh() -> tuple[fg.Graph, dict[fg.Family, Array]]:
        graph, _, start = pose_graph.graph()
        return graph, start

    def whole() -> float:
        graph, start = fresh()
        return clock(lambda: GaussNewton().prepare(graph).solve(start))

    candidates: Contestants = {"ours": timed(partial(run.solve, guess), count), "whole": whole}
    ends: list[tuple[int, float]] = []
    best_whole = ""
    if available():
        peer = Peer(pose_graph)
        candidates |= {ordering: partial(peer.iterate, ordering, count) for ordering in ORDERINGS}
        best_whole = min(ORDERINGS, key=lambda ordering: min(peer.solve(ordering)[0] for _ in range(2)))
        candidates["GTSAM, whole"] = lambda: _whole(peer, best_whole, ends)
    times = interleave(candidates, rounds)
    result: Result = {
        "name": case.name,
        "poses": len(pose_graph.poses),
        "edges": len(pose_graph.edges),
        "target": case.target,
        "floor": case.floor,
        "known": case.chi2 if np.isfinite(case.chi2) else None,
        "chi2": pose_graph.with_poses(first[x]).chi2(),
        "iterations": count,
        "status": words(first.status),
        "ours": milliseconds(times["ours"]),
        "whole": milliseconds(times["whole"]),
        "ratio": None,
    }
    result["file"] = measure_file(case, rounds)
    return result | _compared(times, best_whole, *ends[-1]) if ends else result


def measure_file(case: Case, rounds: int) -> Result:
    """Read, state, order and solve, until each stops by GTSAM's rule."""
    spatial = case.pose_graph.group is SE3
    ends: dict[str, tuple[int, float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        path = write_g2o(Path(folder) / "graph.g2o", case.pose_graph)

        def ours() -> fg.Solution:
            graph, x, guess = read_g2o(path).graph()
            solution = GaussNewton(tolerance="map").prepare(graph).solve(guess)
            ends["ours"] = solution.iterations, case.pose_graph.with_poses(solution[x]).chi2()
            return solution

        def theirs(ordering: str) -> float:
            elapsed, iterations, chi2 = Peer.solve_file(path, spatial, ordering)
            ends[ordering] = iterations, chi2
            return elapsed

        candidates: Contestants = {"ours": timed(ours)}
        if available():
            candidates |= {ordering: partial(theirs, ordering) for ordering in ORDERINGS}
        times = interleave(candidates, rounds)
    result: Result = {
        "name": case.name, "ours": milliseconds(times["ours"]), "iterations": ends["ours"][0],
        "chi2": ends["ours"][1], "ratio": None, "target": case.whole,
    }  # fmt: skip
    if available():
        best = fastest(times)
        result |= {
            "gtsam": milliseconds(times[best]), "best": best, "gtsam_iterations": ends[best][0],
            "gtsam_chi2": ends[best][1], "ratio": ratio(times[best], times["ours"]),
        }  # fmt: skip
    return result


def fastest(times: Mapping[str, Array]) -> str:
    """The ordering of GTSAM's that takes the least time."""
    return min(ORDERINGS, key=lambda ordering: float(np.median(times[ordering])))


def _whole(peer: Peer, ordering: str, ends: list[tuple[int, float]]) -> float:
    elapsed, iterations, chi2 = peer.solve(ordering)
    ends.append((iterations, chi2))
    return elapsed


def _compared(times: Mapping[str, Array], best_whole: str, iterations: int, chi2: float) -> Result:
    """Ratios to the faster of GTSAM's orderings."""
    best = fastest(times)
    return {
        "gtsam": {ordering: milliseconds(times[ordering]) for ordering in ORDERINGS},
        "best": best,
        "ratio": ratio(times[best], times["ours"]),
        "gtsam_whole": milliseconds(times["GTSAM, whole"]),
        "best_whole": best_whole,
        "ratio_whole": ratio(times["GTSAM, whole"], times["whole"]),
        "gtsam_iterations": iterations,
        "gtsam_chi2": chi2,
    }


def within(row: Result) -> str:
    """Compare all found chi2 with the best known one."""
    known = row["known"] or row["chi2"]
    return "yes" if all(abs(row.get(end, known) - known) <= SAME * known for end in ("chi2", "gtsam_chi2")) else "no"


ITERATIONS: Columns[Result] = {
    "poses": told("poses"),
    "edges": told("edges"),
    "iterations": told("iterations"),
    "ours [ms]": told("ours", shown),
    "GTSAM, COLAMD [ms]": lambda row: shown(row.get("gtsam", {}).get("COLAMD")),
    "GTSAM, METIS [ms]": lambda row: shown(row.get("gtsam", {}).get("METIS")),
    "times faster": told("ratio", shown),
    "target (floor)": lambda row: f"{row['target']:g} ({row['floor']:g})",
}
WHOLE: Columns[Result] = {
    "ours [ms]": told("whole", shown),
    "iterations": lambda row: f"{row['iterations']}, {row['status']}",
    "GTSAM [ms]": told("gtsam_whole", shown),
    "ordering": told("best_whole"),
    "its iterations": told("gtsam_iterations"),
    "times faster": told("ratio_whole", shown),
    "chi2, ours": told("chi2", "{:.7f}".format),
    "chi2, GTSAM": told("gtsam_chi2", "{:.7f}".format),
    "best known": told("known", "{:.7f}".format),
    "both within 1e-6": within,
}


FILED: Columns[Result] = {
    "ours [ms]": told("ours", shown),
    "iterations": told("iterations"),
    "GTSAM [ms]": told("gtsam", shown),
    "ordering": told("best"),
    "its iterations": told("gtsam_iterations"),
    "times faster": told("ratio", shown),
    "target": told("target", "{:g}".format),
    "chi2, ours": told("chi2", "{:.7f}".format),
    "chi2, GTSAM": told("gtsam_chi2", "{:.7f}".format),
}


def render(result: Result) -> str:
    """Tables of iterations, solves and parts."""
    graphs = {(row["name"],): row for row in result["rows"]}
    source = "Published graphs from the poses in their files."
    if result["generated"]:
        source = "The published files are not here: these graphs are generated, and start at the truth."
    return "\n\n".join(
        [
            f"{source} Per Gauss-Newton iteration:",
            listing(("graph",), graphs, ITERATIONS),
            "Whole solves, symbolic work included:",
            listing(("graph",), graphs, WHOLE),
            "From the file to the map: a g2o file is read, stated, ordered and solved until the cost falls by less "
            'than a share of 1e-5, with us `tolerance="map"`:',
            listing(("graph",), {(row["name"],): row["file"] for row in result["rows"]}, FILED),
        ]
    )


def posed(pose_graph: PoseGraph, sigma: float) -> tuple[fg.Graph, fg.Family]:
    """The same measurements with a prior on the first pose where `PoseGraph.graph` fixes it."""
    edges = pose_graph.edges
    graph, x = graph_with(pose_graph.group, len(pose_graph.poses), "poses")
    graph.minimize(fg.between, x[edges.first], x[edges.second], edges.measured, information=edges.information)
    graph.minimize(fg.prior, x[0], pose_graph.poses[0], sigma=sigma)
    return graph, x
