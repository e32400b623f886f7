"""A solved pose graph as one picture: before, after, and how the cost fell."""

from __future__ import annotations

from itertools import pairwise
from textwrap import fill
from typing import Any

import numpy as np

from unifg.plots.descent import draw_cost
from unifg.pose_graphs.pose_graph import PoseGraph
from unifg.pose_graphs.verdict import NAMED, Verdict
from unifg.scenarios.pose_graph import SolvedGraph
from unifg.scenarios.scenes.graph_scene import declare_layers, draw_graph, draw_points, line_width, segments
from unifg.style.colours import INK
from unifg.style.figures import headline, key_of, new_figure
from unifg.typing import Axes, BoolArray, Figure
from unifg.view import Scene

__all__ = ["picture", "plot_cost", "plot_graph"]

_STRIPS = 3_000  # edges, up to which a trajectory has a width; beyond, it is hair-thin


def picture(solved: SolvedGraph) -> Figure:
    """Start on the left, solution on the right, cost over iterations below."""
    with new_figure((13.0, 8.4)) as figure:
        spatial = solved.after.group.point_dim == 3
        projection = {"projection": "3d"} if spatial else {}
        grid = figure.add_gridspec(2, 2, height_ratios=(4.2, 1.0))
        left, right = (figure.add_subplot(grid[0, k], **projection) for k in (0, 1))
        below = figure.add_subplot(grid[1, :])
        origin = {"file": "the poses in the file", "odometry": "odometry alone"}.get(
            solved.begun, f"first guess by {solved.begun}"
        )
        none = np.zeros(len(solved.outliers), dtype=bool)
        plot_graph(solved.before, none, "start", left)
        left.set_title(f"Before: {origin}, $\\chi^2$ = {solved.chi2[1]:.6g}")
        plot_graph(solved.after, solved.outliers, "trajectory", right, solved.verdict)
        right.set_title(f"After: $\\chi^2$ = {_ending(solved)}")
        plot_cost(solved, below)
        figure.legend(*key_of((left, right)), loc="outside lower center", ncols=5)
        graph = solved.after
        edges = f"{len(graph.edges) - len(graph.closures)} odometry edges, {len(graph.closures)} loop closures"
        said = [solved.verdict.sentence()] if solved.verdict else solved.judgement.sentences()
        headline(figure, f"{solved.name}: {len(graph.poses)} poses, {edges}")
        below.set_xlabel("\n".join(fill(sentence, 190) for sentence in said), ha="left", x=0.0)
    return figure


def plot_graph(graph: PoseGraph, outliers: BoolArray, name: str, ax: Axes, verdict: Verdict | None = None) -> Axes:
    """Poses, edges and landmarks where they are, drawn as in the scene.

    Args:
        graph: poses and edges.
        outliers: (m,) edges drawn as outliers.
        name: layer of the trajectory, "start" or "trajectory".
        ax: axes to draw into, three-dimensional ones for poses in space.
        verdict: by which closures are coloured, and clusters numbered as it names them.
    """
    scene = Scene()
    declare_layers(scene)
    width = (1.5 if verdict is None else 0.6) * line_width(graph) if len(graph.edges) <= _STRIPS else 0.0
    draw_graph(scene, graph, outliers, name, width, verdict)
    draw_points(scene, graph)
    ax = scene.draw(ax)
    for number, cluster in enumerate(verdict.clusters[:NAMED] if verdict else (), start=1):
        if cluster.sightings is not None:
            kind, which = cluster.sightings
            pose = graph.sightings[kind].pose[which[len(which) // 2]]
            place: Any = graph.poses[pose, : graph.group.point_dim]
        else:
            chosen = np.zeros(len(graph.edges), dtype=bool)
            chosen[cluster.edges[len(cluster.edges) // 2]] = True
            place = segments(graph, chosen)[0].mean(axis=0)
        label: Any = ax.text  # on axes in space it takes three numbers
        label(*place, f"{number}", fontweight="bold", color=INK, bbox={"facecolor": "white", "pad": 1.5, "lw": 0.5})
    return ax


def plot_cost(solved: SolvedGraph, ax: Axes) -> Axes:
    """The cost that was minimised over iterations; a line begins the next surrogate of a robust loss."""
    rows = solved.solution.history
    stages = [k for k, (before, row) in enumerate(pairwise(rows), start=1) if _stage(before) != _stage(row)]
    for number in stages:
        ax.axvline(number - 0.5, color="#d5d9df", lw=0.8, zorder=0)
    what = "Cost with the robust loss" if solved.loss is not None else "Cost, half of $\\chi^2$"
    more = "; a line begins the next surrogate of the loss" if stages else ""
    solve = 1e3 * solved.seconds["solve"]
    title = f"{what}, per iteration: {solved.solution.iterations} in {solve:.0f} ms{more}"
    return draw_cost(ax, rows.column("cost"), title)


def _stage(row: Any) -> Any:
    return row.details.get("stage", 0)


def _ending(solved: SolvedGraph) -> str:
    """chi2 at the solution, apart from what the loss took for outliers."""
    found, freedom = int(solved.outliers.sum()), f"{solved.judgement.freedom} degrees of freedom"
    if not found:
        return f"{solved.chi2[2]:.6g}, {freedom}"
    return f"{solved.chi2_inliers:.6g}, {freedom}, without {found} outlier{'' if found == 1 else 's'}"
