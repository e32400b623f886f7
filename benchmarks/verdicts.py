"""Verdicts on maps with planted clusters of loop closures, with slipped odometry, and without; and what they cost.

A cluster between two stretches far apart claims that these are the same place. *Contradictable* ones join any two
stretches. One that is *adrift* joins the beginning of a drive with its end, which nothing else reaches, at the poses of
another drift. An unsupported cluster of a clean graph is one *by construction* where the others, at the true poses,
know the two stretches at least eight times worse than the cluster does.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from benchmarks.comparison import Row, grouped, mean, total, where
from benchmarks.report import listing, told
from benchmarks.runner import Cell, Study
from benchmarks.wrong_closures import published
from problems.closures import adrift, aliased, drive, slipped
from unifg.pose_graphs import PoseGraph, Verdict, best_guess, manhattan, sphere
from unifg.pose_graphs.verdict import Cluster
from unifg.solvers import GaussNewton, LevenbergMarquardt
from unifg.typing import Array, IntArray

WORLDS = ("city", "drive", "drive over hills", "M3500", "intel")
LARGE = ("M3500", "sphere2500", "city of 3500", "city of 8000", "drive of 4500", "hills of 3000", "globe of 2500")
MADE = ("city", "drive", "drive over hills")
WORSE = 8.0  # times the standard deviation of a cluster: what the others know, where it is unsupported by construction
ROUNDS = 5
PUBLISHED = 20  # seeds with which published graphs are planted in


def clean(graph: str, seed: int) -> tuple[PoseGraph, Array]:
    """A graph without wrong measurements, and the poses at which closures are planted."""
    if graph in ("M3500", "intel", "sphere2500"):
        found = optimum(published(graph))
        return found, found.poses
    made = {
        "city": lambda: manhattan(1000, seed),
        "drive": lambda: drive(1500, seed),
        "drive over hills": lambda: drive(1500, seed, spatial=True),
        "city of 3500": lambda: manhattan(3500, seed),
        "city of 8000": lambda: manhattan(8000, seed),
        "drive of 4500": lambda: drive(4500, seed),
        "hills of 3000": lambda: drive(3000, seed, spatial=True),
        "globe of 2500": lambda: sphere(50, 50, seed),
    }[graph]()
    return made.pose_graph, made.truth


def optimum(pose_graph: PoseGraph) -> PoseGraph:
    """The graph at the optimum that the cheapest first guess leads to."""
    graph, x, guess = pose_graph.with_poses(best_guess(pose_graph)[1]).graph()
    return pose_graph.with_poses(LevenbergMarquardt(tolerance="map").solve(graph, guess)[x])


def dirty(graph: str, fault: str, seed: int) -> tuple[PoseGraph, list[IntArray]]:
    """The graph of a job, and the edges of each fault."""
    pose_graph, poses = clean(graph, seed)
    if fault == "none":
        return pose_graph, []
    if fault == "adrift":
        return adrift(drive(1500, seed, spatial=graph != "drive"), seed)
    if fault == "slip":
        rng = np.random.default_rng(seed)
        at, by = int(rng.integers(len(poses) // 4, len(poses) // 2)), np.zeros(pose_graph.group.dim)
        by[0], by[-1] = rng.uniform(1.0, 3.0), rng.uniform(-0.3, 0.3)
        return slipped(pose_graph, at, by), [np.array([at])]
    return aliased(pose_graph, poses, int(fault.split()[0]), seed)


def judged(graph: str, fault: str, seed: int) -> Row:
    """Verdict on the graph of a job."""
    if fault == "time":
        return timed(graph, seed)
    pose_graph, faults = dirty(graph, fault, seed)
    verdict = optimum(pose_graph).verdict(effort="cheap")
    kind = {"adrift": verdict.of("unsupported"), "slip": verdict.of("slipped")}.get(fault, verdict.of("contradicted"))
    named = np.concatenate([np.zeros(0, dtype=np.intp), *(one.edges for one in kind)])
    planted = np.concatenate([np.zeros(0, dtype=np.intp), *faults])
    return {
        "found": all(np.isin(edges, named).mean() > 0.5 for edges in faults),
        "right ones contradicted": sum(not np.isin(one.edges, planted).any() for one in verdict.of("contradicted")),
        "unsupported": len(verdict.of("unsupported")),
        "not so by construction": 0 if faults else not_so(pose_graph, clean(graph, seed)[1], verdict),
    }


def not_so(pose_graph: PoseGraph, truth: Array, verdict: Verdict) -> int:
    """Number of unsupported clusters whose stretches the others know well, at the true poses."""
    return sum(_rest(pose_graph.with_poses(truth), one) < WORSE for one in verdict.of("unsupported"))


def _rest(pose_graph: PoseGraph, cluster: Cluster) -> float:
    """Greatest standard deviation of how two stretches lie by all other edges, in those of the cluster itself.

    The middle closure stands for its stretches; those of the cluster are taken for as many measurements of it.
    """
    edges, group = pose_graph.edges, pose_graph.group
    kept = np.ones(len(edges), dtype=bool)
    kept[cluster.edges] = False
    others = replace(pose_graph, edges=edges[kept])
    if int(others.parts().max()) > 0:
        return np.inf
    graph, x, guess = others.graph()
    solution = LevenbergMarquardt(max_iterations=1).solve(graph, guess)
    middle = cluster.edges[len(cluster.edges) // 2]
    a, b = int(edges.first[middle]), int(edges.second[middle])
    joint = solution.covariance(x[a], x[b])
    back = -group.adjoint(group.between(pose_graph.poses[b], pose_graph.poses[a]))
    jacobian = np.concatenate([back, np.eye(group.dim)], axis=1)
    spread = jacobian @ joint @ jacobian.T
    own = edges.information[cluster.edges].sum(axis=0)
    return float(np.sqrt(np.linalg.eigvals(own @ spread).real.max()))


def timed(graph: str, seed: int) -> Row:
    """Processor time of a solve from nothing, first guesses included, and of the verdict on its map, in turn."""
    pose_graph, rows = clean(graph, seed)[0], []
    for _ in range(ROUNDS):
        begin = time.process_time()
        stated, x, guess = pose_graph.with_poses(best_guess(pose_graph)[1]).graph()
        after = pose_graph.with_poses(GaussNewton().solve(stated, guess)[x])
        between = time.process_time()
        verdict = after.verdict(effort="cheap")
        rows.append((between - begin, time.process_time() - between))
    cold, spent = np.array(rows[1:]).T  # the first round compiles
    parts = {f"{name} [ms]": round(1e3 * value) for name, value in verdict.seconds.items()}
    ratio = float(np.median(spent / cold))
    return {"poses": len(pose_graph.poses), "cold": float(np.median(cold)), "ratio": ratio, **parts}


def cells(seeds: Sequence[int]) -> list[Cell]:
    """All faults on all graphs; published graphs are planted in with fewer seeds, and clean once."""
    faults = ("none", "1 cluster", "3 clusters", "slip", "adrift")
    jobs = [
        {"graph": graph, "fault": fault, "seed": seed} for graph in WORLDS for fault in faults for seed in seeds
        if not (fault == "adrift" and graph not in ("drive", "drive over hills"))
        and not (fault == "slip" and graph not in ("city", "M3500", "intel"))
        and not (graph not in MADE and seed not in seeds[: 1 if fault == "none" else PUBLISHED])
    ]  # fmt: skip
    return [*jobs, *({"graph": graph, "fault": "time", "seed": seeds[0]} for graph in LARGE)]


def tables(rows: list[Row]) -> str:
    """Faults found, and times."""
    groups = grouped((row for row in where(rows) if row["fault"] != "time"), "graph", "fault")
    columns = {
        "named": lambda rows: f"{sum(r['found'] for r in rows)} of {len(rows)}" if rows[0]["fault"] != "none" else "",
        "right clusters contradicted": total("right ones contradicted"),
        "unsupported a graph": mean("unsupported"),
        "of these not by construction": lambda rows: (
            f"{sum(r['not so by construction'] for r in rows)}" if rows[0]["fault"] == "none" else ""
        ),
    }
    times = [row for row in rows if row["fault"] == "time" and "ratio" in row]
    parts = [name for name in times[0] if name.endswith("[ms]")] if times else []
    spent = {
        "poses": told("poses"),
        "cold solve [ms]": told("cold", lambda seconds: f"{1e3 * seconds:.0f}"),
        **{name: told(name) for name in parts},
        "verdict, times a cold solve": told("ratio", "{:.2f}".format),
    }
    median = np.median([row["ratio"] for row in times]) if times else np.nan
    return (
        f"{listing(('graph', 'fault'), groups, columns)}\n\n"
        f"{listing(('graph',), {(row['graph'],): row for row in times}, spent)}\n\n"
        f"Median of the last column: {median:.2f}."
    )


STUDY = Study(cells, judged, tables, range(100, 200), alone=lambda job: job["fault"] == "time")
