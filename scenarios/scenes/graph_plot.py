"""A solved pose graph as one picture: before, after, and how the cost fell."""

from __future__ import annotations

from importlib import import_module
from itertools import pairwise
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np

from unifg.pose_graphs.pose_graph import PoseGraph
from unifg.scenarios.pose_graph import SolvedGraph
from unifg.style.colours import INK, css
from unifg.style.figures import face, headline, key_of, new_figure
from unifg.typing import Array, BoolArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["picture", "plot_cost", "plot_graph", "segments"]


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
        plot_graph(solved.before, none, css("odometry"), "trajectory at the start", left)
        left.set_title(f"Before: {origin}, $\\chi^2$ = {solved.chi2[1]:.6g}")
        plot_graph(solved.after, solved.outliers, css("robot"), "trajectory, solved", right)
        right.set_title(f"After: $\\chi^2$ = {_ending(solved)}")
        plot_cost(solved, below)
        figure.legend(*key_of((left, right)), loc="outside lower center", ncols=5)
        graph = solved.after
        edges = f"{len(graph.edges) - len(graph.closures)} odometry edges, {len(graph.closures)} loop closures"
        remarks = "".join(f"\n{fill(sentence, 110)}" for sentence in solved.judgement.sentences())
        headline(figure, f"{solved.name}: {len(graph.poses)} poses, {edges}{remarks}")
    return figure


def plot_graph(graph: PoseGraph, outliers: BoolArray, colour: str, label: str, ax: Axes) -> Axes:
    """Poses and edges where they are: odometry in ``colour``, loop closures thin, outliers red.

    Args:
        graph: poses and edges.
        outliers: (m,) edges drawn as outliers.
        colour: of the trajectory.
        label: of the trajectory in a legend.
        ax: axes to draw into, three-dimensional ones for poses in space.
    """
    odometry = graph.edges.odometry
    spatial = graph.group.point_dim == 3
    _lines(ax, segments(graph, ~odometry & ~outliers), css("closure"), 0.6, 0.55, "loop closure", 2)
    _lines(ax, segments(graph, outliers), css("outlier"), 0.8, 0.8, "loop closure taken for an outlier", 3)
    _lines(ax, segments(graph, odometry), colour, 1.5, 1.0, label, 4)
    places = graph.poses[:, : graph.group.point_dim]
    ax.plot(*places[:1].T, "o", color=INK, ms=6, label="first pose", zorder=6)
    if len(graph.landmarks):
        marker: dict[str, Any] = {"color": css("landmark"), "ms": 4, "ls": "none", "zorder": 5}
        ax.plot(*graph.landmarks.T, "*", label="landmark", **marker)
    everything = np.concatenate([places, graph.landmarks]) if len(graph.landmarks) else places
    middle, half = _box(everything)
    ax.set_xlim(middle[0] - half[0], middle[0] + half[0])
    ax.set_ylim(middle[1] - half[1], middle[1] + half[1])
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    if spatial:
        three: Any = ax
        three.set_zlim(middle[2] - half[2], middle[2] + half[2])
        three.set_zlabel("z [m]")
        three.set_box_aspect(half)
        for name, share in zip("xyz", half / half.max(), strict=True):  # short axes have no room for many numbers
            three.locator_params(axis=name, nbins=max(1, round(6 * float(share))))
    else:
        ax.set_aspect("equal", adjustable="box")
    return ax


def plot_cost(solved: SolvedGraph, ax: Axes) -> Axes:
    """The cost that was minimised over iterations, on a logarithmic scale where it falls to less than a third."""
    from matplotlib.ticker import MaxNLocator

    rows = solved.solution.history
    numbers, costs = [row.number for row in rows], np.array([row.cost for row in rows])
    ax.plot(numbers, np.maximum(costs, 1e-300), "o-", color=css("robot"), ms=3.5, lw=1.2)
    if costs.min() > 0.0 and costs.max() > 3.0 * costs.min():
        ax.set_yscale("log")
    stages = [row.number for before, row in pairwise(rows) if _stage(before) != _stage(row)]
    for number in stages:
        ax.axvline(number - 0.5, color="#d5d9df", lw=0.8, zorder=0)
    what = "Cost with the robust loss" if solved.loss is not None else "Cost, half of $\\chi^2$"
    more = "; a line begins the next surrogate of the loss" if stages else ""
    solve = 1e3 * solved.seconds["solve"]
    title = f"{what}, per iteration: {solved.solution.iterations} in {solve:.0f} ms{more}"
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    return face(ax, title, "cost", "iteration")


def segments(graph: PoseGraph, chosen: BoolArray) -> Array:
    """Straight lines (k, 2, d) between the poses that the chosen edges join."""
    places = graph.poses[:, : graph.group.point_dim]
    return np.stack([places[graph.edges.first[chosen]], places[graph.edges.second[chosen]]], axis=1)


def _lines(ax: Axes, lines: Array, colour: str, width: float, opacity: float, label: str, order: int) -> None:
    """Draw many lines as one artist."""
    if not len(lines):
        return
    style: dict[str, Any] = {"colors": colour, "linewidths": width, "alpha": opacity, "label": label, "zorder": order}
    if lines.shape[2] == 3:
        three: Any = ax
        three.add_collection3d(import_module("mpl_toolkits.mplot3d.art3d").Line3DCollection(lines, **style))
    else:
        from matplotlib.collections import LineCollection

        ax.add_collection(LineCollection(list(lines), **style))


def _box(points: Array) -> tuple[Array, Array]:
    """Middle and half sizes of what must be seen, no side shorter than a tenth of the longest."""
    low, high = points.min(axis=0), points.max(axis=0)
    half = 0.53 * (high - low)
    return (low + high) / 2.0, np.maximum(half, 0.1 * max(float(half.max()), 1e-3))


def _stage(row: Any) -> Any:
    return row.details.get("stage", 0)


def _ending(solved: SolvedGraph) -> str:
    """chi2 at the solution, apart from what the loss took for outliers."""
    found, freedom = int(solved.outliers.sum()), f"{solved.judgement.freedom} degrees of freedom"
    if not found:
        return f"{solved.chi2[2]:.6g}, {freedom}"
    return f"{solved.chi2_inliers:.6g}, {freedom}, without {found} outlier{'' if found == 1 else 's'}"
