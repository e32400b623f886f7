"""A solved pose graph as a scene: look around in it, and step through the iterations."""

from __future__ import annotations

from typing import Any

import numpy as np

from unifg.pose_graphs.pose_graph import PoseGraph
from unifg.pose_graphs.verdict import Kind, Verdict
from unifg.scenarios.pose_graph import SolvedGraph
from unifg.typing import Array, BoolArray
from unifg.view import Scene
from unifg.view.canvas import Canvas

__all__ = ["declare_layers", "draw_graph", "draw_points", "graph_scene", "line_width", "shown_steps"]

LEVERAGES = (
    (-1.0, "closures", "closure", "loop closures: the same place seen again"),
    (0.5, "leverage over 0.5", "#8cbf26", "of leverage 0.5 to 0.9"),
    (0.9, "leverage over 0.9", "goal", "of leverage 0.9 to 0.99"),
    (0.99, "leverage over 0.99", "fixed", "of leverage over 0.99"),
)
"""Leverage above which closures have a layer of their own, its name, colour and words."""

_MOST = 60_000  # edges drawn over all iterations; beyond, only the first guess and the solution are shown
_MOST_STRIPS = 30_000  # odometry edges drawn with a width; beyond, as hair-thin lines
_MARGIN = 0.3  # of the size of the solution: how far around it the camera looks for the start
_DIRECTIONS = {2: (0.0, -1e-4, 1.0), 3: (0.55, -0.67, 0.5)}  # to the camera, for poses in the plane and in space


def graph_scene(solved: SolvedGraph) -> Scene:
    """The scene of a solved pose graph, one frame for each iterate shown."""
    graph, shown, solution = solved.after, shown_steps(solved), solved.solution
    size, width = graph.group.point_dim, line_width(graph)
    scene = Scene(f"unifg: {solved.name}", counts="iteration")
    scene.around, scene.ground = _corners(solved), False
    declare_layers(scene)
    _trajectory(scene, "start", solved.before, 0.6 * width)
    draw_points(scene, graph)
    costs = {row.number: row.cost for row in solution.history}
    scene.numbers = [int(solved.step_numbers[k]) for k in shown]
    scene.plot("cost", log=True)
    for k, number in zip(shown, scene.numbers, strict=True):
        iterate, frame, cost = graph.with_poses(solved.steps[k]), scene.frame(), costs.get(number, solution.cost)
        draw_graph(frame, iterate, solved.outliers, "trajectory", width, solved.verdict)
        frame.readout("cost", f"{cost:.7g}")
        frame.value("cost", cost)
    scene.outcome, scene.good = solution.status.value, solution.converged
    scene.facts |= _facts(solved)
    scene.view("overview", "Whole graph", _DIRECTIONS[size])
    return scene


def declare_layers(scene: Scene) -> None:
    """Names, colours and words of the parts of a graph."""
    for name, colour, words in (
        ("start", "odometry", "trajectory at the start"),
        *((name, colour, words) for _, name, colour, words in LEVERAGES),
        ("unsupported", "scan", "unsupported, with stretches"),
        ("contradicted", "outlier", "contradicted, with stretches"),
        ("trajectory", "robot", "trajectory: poses joined by odometry"),
        ("outliers", "outlier", "loop closures taken for outliers"),
        ("landmarks", "landmark", "landmarks"),
    ):
        scene.layer(name, "line", colour, words)


def line_width(graph: PoseGraph) -> float:
    """Width of the strips of a trajectory [m]; those in space are seen from the side."""
    size = graph.group.point_dim
    return (0.0022 if size == 2 else 0.004) * float(np.ptp(graph.poses[:, :size], axis=0).max())


def draw_points(canvas: Canvas, graph: PoseGraph) -> None:
    """Draw landmarks and the first pose."""
    if len(graph.landmarks):
        canvas.points("landmarks", graph.landmarks)
    canvas.points("first", graph.poses[:1, : graph.group.point_dim], pixels=9.0, colour="ink", legend="first pose")


def draw_graph(
    canvas: Canvas, graph: PoseGraph, outliers: BoolArray, name: str, width: float, verdict: Verdict | None = None
) -> None:
    """Draw closures, by their leverage, outliers and, in the layer of a name, the trajectory of a width [m].

    Args:
        canvas: to draw on.
        graph: poses and edges.
        outliers: (m,) edges that are drawn as such.
        name: layer of the trajectory.
        width: of the trajectory, and of clusters that the verdict names [m]; zero for lines as thin as hair.
        verdict: on the map; None for closures of one colour.
    """
    _trajectory(canvas, name, graph, width)
    edges = graph.edges
    left = ~edges.odometry & ~outliers
    layers = {"outliers": outliers}
    kinds: tuple[Kind, ...] = ("contradicted", "unsupported")
    for kind in kinds:
        chosen = np.zeros_like(left)
        for cluster in verdict.of(kind) if verdict else ():
            chosen[cluster.edges] = True
            ends = np.sort(np.stack([edges.first, edges.second])[:, cluster.edges], axis=0)
            for stretch in ends:  # they may lie on each other, and the closures have no length
                inside = (np.minimum(edges.first, edges.second) >= stretch.min()) & edges.odometry
                chosen |= inside & (np.maximum(edges.first, edges.second) <= stretch.max())
        layers[kind] = chosen & ~outliers
        left &= ~chosen
    leverage = verdict.leverage if verdict else np.zeros(len(left))
    for least, layer, _, _ in reversed(LEVERAGES):
        layers[layer] = left & (leverage > least)
        left &= leverage <= least
    for layer, chosen in reversed(layers.items()):
        if chosen.any():
            canvas.lines(layer, segments(graph, chosen), width=2.0 * line_width(graph) if layer in kinds else None)


def shown_steps(solved: SolvedGraph) -> list[int]:
    """Indices of ``solved.steps`` that are drawn: all, or of a large graph the first and the last."""
    last = len(solved.steps) - 1
    return list(range(last + 1)) if len(solved.after.edges) * (last + 1) <= _MOST else sorted({0, last})


def segments(graph: PoseGraph, chosen: BoolArray) -> Array:
    """Straight lines (k, 2, d) between the poses that the chosen edges join."""
    places = graph.poses[:, : graph.group.point_dim]
    return np.stack([places[graph.edges.first[chosen]], places[graph.edges.second[chosen]]], axis=1)


def _trajectory(canvas: Canvas, name: str, poses: PoseGraph, width: float) -> None:
    """The odometry edges as strips, or as lines where there are very many; without any, the poses as points."""
    lines = segments(poses, poses.edges.odometry)
    if len(lines):
        canvas.lines(name, lines, width=width if len(lines) <= _MOST_STRIPS and width > 0.0 else None)
    else:
        canvas.points(name, poses.poses[:, : poses.group.point_dim], pixels=3.0)


def _facts(solved: SolvedGraph) -> dict[str, Any]:
    graph, settings, solution = solved.after, solved.settings, solved.solution
    return {
        "poses": f"{len(graph.poses)} in {graph.group.point_dim}D",
        "edges": f"{len(graph.edges)}, {len(graph.closures)} close loops",
        "landmarks": f"{len(graph.landmarks)}" if len(graph.landmarks) else "",
        "first guess": solved.begun,
        "solver": settings.solver,
        "residual": settings.residual,
        "robust loss": settings.robust or "",
        "outliers": f"{int(solved.outliers.sum())}" if solved.loss else "",
        "\u03c7\u00b2 before": f"{solved.chi2[1]:.7g}",
        "\u03c7\u00b2 after": f"{solved.chi2[2]:.7g}",
        "without outliers": f"{solved.chi2_inliers:.7g}" if solved.outliers.any() else "",
        "verdict": solved.verdict.claim if solved.verdict else "",
        "solved in": f"{solution.iterations} iterations, {1e3 * solved.seconds['solve']:.0f} ms",
    }


def _corners(solved: SolvedGraph) -> Array:
    """(8, 3) corners of the solution and, unless it strays far from it, of the start."""
    size = solved.after.group.point_dim
    points, start = solved.after.poses[:, :size], solved.before.poses[:, :size]
    low, high = points.min(axis=0), points.max(axis=0)
    reach = _MARGIN * float((high - low).max())
    low = np.maximum(np.minimum(low, start.min(axis=0)), low - reach)
    high = np.minimum(np.maximum(high, start.max(axis=0)), high + reach)
    box = np.zeros((2, 3))
    box[:, :size] = low, high
    return np.stack(np.meshgrid(*box.T), axis=-1).reshape(-1, 3)
