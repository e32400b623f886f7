"""``unifg solve``: what a solved pose graph leaves in its folder, and the table printed for people."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np

from unifg.files.contents import legible
from unifg.files.g2o import write_g2o
from unifg.files.tum import write_tum
from unifg.pose_graphs.verdict import Certificate, Verdict
from unifg.scenarios import pose_graph
from unifg.scenarios.commands.extras import absent, remedy
from unifg.scenarios.commands.outcome import Outcome, Progress, Writer
from unifg.scenarios.logs.metrics import table, write_metrics
from unifg.scenarios.pose_graph import AUTO, SolvedGraph

__all__ = ["SETTINGS", "metrics", "results", "run", "summary"]

SETTINGS = pose_graph.SolveSettings

logger = logging.getLogger("unifg")


def run(settings: pose_graph.SolveSettings, progress: Progress) -> Outcome:
    """Solve the graph of a file."""
    solved = pose_graph.solve_file(settings, progress)
    numbers = metrics(solved)
    return Outcome(
        solved.solution.converged and solved.better is None,
        solved.interrupted,
        summary(solved),
        numbers,
        results(solved),
    )


def results(solved: SolvedGraph) -> dict[str, Writer]:
    """Results of a solve: graph, trajectory (the positions in the file as times), numbers.

    A picture and a scene, too, where they are asked for and what draws them is installed.
    """
    poses = solved.after.poses
    files: dict[str, Writer] = {
        "metrics.json": lambda path: write_metrics(path, metrics(solved)),
        "trajectory.tum": lambda path: write_tum(path, np.arange(len(poses), dtype=np.float64), poses),
        "graph.g2o": lambda path: write_g2o(path, solved.after),
    }
    if not solved.settings.scene:
        return files
    if lacking := absent("view"):  # numbers need nothing but the library
        logger.warning("no picture and no scene: %s", remedy(lacking))
        return files
    from unifg.scenarios.scenes.graph_plot import picture
    from unifg.scenarios.scenes.graph_scene import graph_scene
    from unifg.style.figures import write_figure

    files["graph.png"] = lambda path: write_figure(path, picture(solved), 130)
    files["scene.html"] = lambda path: graph_scene(solved).save(path)
    return files


def metrics(solved: SolvedGraph) -> dict[str, Any]:
    """The numbers of a solve, ready for JSON. chi2 is the sum of r' Omega r, without 1/2 and without robust loss."""
    settings, graph, solution = solved.settings, solved.after, solved.solution
    (in_file, at_start, at_end), edges, ids = solved.chi2, graph.edges, graph.ids
    return {
        "file": legible(settings.file.name),
        "poses": len(graph.poses),
        "dimension": graph.group.point_dim,
        "edges": len(graph.edges),
        "loop_closures": len(graph.closures),
        "landmarks": len(graph.landmarks),
        "sightings": sum(map(len, graph.sightings.values())),
        "priors": sum(map(len, graph.priors.values())),
        "skipped_lines": dict(graph.skipped),
        "solver": solution.solver,
        "robust": settings.robust,
        "robust_on": settings.robust_on,
        "init": solved.begun,
        "residual": settings.residual,
        "status": solution.status.name,
        "converged": solution.converged,
        "interrupted": solved.interrupted,
        "iterations": solution.iterations,
        "chi2_file": in_file if graph.placed else None,
        "chi2_start": at_start,
        "chi2": at_end,
        "chi2_inliers": solved.chi2_inliers,
        "degrees_of_freedom": solved.judgement.freedom,
        "worst_edges": solved.judgement.worst.tolist(),
        "worst_edges_chi2": solved.judgement.worst_chi2.tolist(),
        "parts": solved.judgement.parts,
        "anchors_added": list(solved.judgement.anchors),
        "remarks": [*graph.remarks, *solved.judgement.sentences()],
        "better_cost": solved.better,
        "verdict": None if solved.verdict is None else _verdict(solved.verdict),
        "cost": solution.cost,
        "stationarity": solution.stationarity,
        "outliers": int(solved.outliers.sum()),
        "outlier_edges": np.stack([ids[edges.first], ids[edges.second]], axis=1)[solved.outliers].tolist(),
        "rivals": [] if solution.verdict is None else [rival.cost for rival in solution.verdict.rivals],
        "groups": []
        if solution.verdict is None
        else [
            {"term": one.term, "factors": one.factors.tolist(), "kept": one.kept, "cost": one.other.cost}
            for one in solution.verdict.groups
        ],
        "seconds": {name: round(value, 6) for name, value in solved.seconds.items()},
    }


def summary(solved: SolvedGraph) -> str:
    """The outcome as a table of two columns."""
    numbers, report, graph = metrics(solved), solved.solution.verdict, solved.after
    chosen = solved.settings.init
    more = f", {numbers['landmarks']} landmarks" if numbers["landmarks"] else ""
    flagged = "loop closures" if solved.settings.robust_on == "closures" else "measurements"
    skipped = ", ".join(f"{tag} ({count})" for tag, count in numbers["skipped_lines"].items())
    milliseconds = {name: 1e3 * value for name, value in solved.seconds.items()}
    rows = [
        ("file", numbers["file"]),
        (
            "graph",
            f"{numbers['poses']} poses in {numbers['dimension']}D, {numbers['edges']} edges, "
            f"{numbers['loop_closures']} of them loop closures{more}",
        ),
        ("skipped lines", skipped),
        ("solver, residual", f"{numbers['solver']}, {numbers['residual']}"),
        ("robust loss", "" if solved.loss is None else f"{solved.loss}, on {flagged}"),
        ("chi2 in the file", f"{numbers['chi2_file']:.9g}" if graph.placed else "it has no poses"),
        ("chi2 at the start", f"{numbers['chi2_start']:.9g} ({numbers['init']})"),
        ("chi2 at the end", f"{numbers['chi2']:.9g}, {numbers['degrees_of_freedom']} degrees of freedom"),
        ("without outliers", f"{numbers['chi2_inliers']:.9g}" if numbers["outliers"] else ""),
        ("outliers", "" if solved.loss is None else f"{numbers['outliers']} of the {flagged}"),
        *(("remark", sentence) for sentence in (graph.remarks if solved.verdict else numbers["remarks"])),
        ("held where it was", ", ".join(f"pose {name}" for name in numbers["anchors_added"][:5])),
        ("kept all the same", "" if solved.better is None else f"cost {solved.better:.6g} was found"),
        ("believed", "" if report is None else report.sentence(numbers["cost"])),
        ("iterations", f"{numbers['iterations']}"),
        ("status", solved.solution.status.value),
        ("try first", "" if solved.solution.converged or chosen == AUTO else f"--init auto instead of --init {chosen}"),
        ("time", ", ".join(f"{name} {value:.1f} ms" for name, value in milliseconds.items())),
        *_words(solved.verdict),
    ]
    return table(rows)


def _certificate(certificate: Certificate) -> dict[str, Any]:
    return {
        "certified": certificate.certified,
        "chi2_chordal": certificate.chi2,
        "dual": certificate.dual,
        "gap": certificate.gap,
        "least_eigenvalue": certificate.least_eigenvalue,
        "rank": certificate.rank,
        "moved": list(certificate.moved),
        "interval": None if certificate.interval is None else list(certificate.interval),
        "better_chi2": None if certificate.better_chi2 is None else certificate.better_chi2[1],
        "caveats": list(certificate.caveats),
    }


def _verdict(verdict: Verdict) -> dict[str, Any]:
    return {
        "sentence": verdict.sentence(),
        "claim": verdict.claim,
        "effort": verdict.effort,
        "interval": None if verdict.interval is None else list(verdict.interval),
        "starts": verdict.starts,
        "basins": verdict.basins,
        "closures": None if verdict.closures is None else dict(zip(("kept", "at_most"), verdict.closures, strict=True)),
        "better_chi2": None if verdict.better_chi2 is None else verdict.better_chi2[1],
        "certificate": None if verdict.certificate is None else _certificate(verdict.certificate),
        "uncertified": verdict.uncertified,
        "clusters": [
            {
                "kind": one.kind,
                "edges": one.edges.tolist(),
                "sightings": None if one.sightings is None else [one.sightings[0], one.sightings[1].tolist()],
                "stretches": one.stretches.tolist(),
                "leverage": one.leverage,
                "squared": one.squared,
                "moved": None if one.moved is None else list(one.moved),
                "chi2": None if one.chi2 is None else list(one.chi2),
            }
            for one in verdict.clusters
        ],
        "hardly_determined": list(verdict.weak),
        "seconds": {name: round(value, 6) for name, value in verdict.seconds.items()},
    }


def _words(verdict: Verdict | None) -> list[tuple[str, str]]:
    """Rows of the verdict, the sentence last."""
    if verdict is None:
        return []
    spent = ", ".join(f"{name} {1e3 * value:.1f} ms" for name, value in verdict.seconds.items())
    bounds = verdict.uncertified if verdict.certificate is None else verdict.certificate.sentence()
    return [
        ("time of the verdict", spent),
        ("bounds", bounds if verdict.effort == "full" else ""),
        ("verdict", verdict.sentence()),
    ]
