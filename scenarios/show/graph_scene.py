"""A solved pose graph as a scene: look around in it, and step through the iterations."""

from __future__ import annotations

import numpy as np

from unifg.pose_graphs.pose_graph import PoseGraph
from unifg.scenarios.pose_graph import SolvedGraph
from unifg.scenarios.show.graph_plot import segments
from unifg.typing import Array
from unifg.view.page import Key, Page, Readout, View
from unifg.view.shapes import strips
from unifg.view.stage import Stage

__all__ = ["graph_scene", "shown_steps"]

_MOST = 60_000  # edges drawn over all iterations; beyond, only the first guess and the solution are shown
_MOST_STRIPS = 30_000  # odometry edges drawn with a width; beyond, as hair-thin lines
_STEP = 0.5  # seconds an iterate is shown when they are played; sums of it are exact, as seeking one needs
_MARGIN = 0.3  # of the size of the solution: how far around it the camera looks for the start
_DIRECTIONS = {2: (0.0, -1e-4, 1.0), 3: (0.55, -0.67, 0.5)}  # to the camera, for poses in the plane and in space


def graph_scene(solved: SolvedGraph) -> Stage:
    """The scene of a solved pose graph: ``start``, and one group ``steps/k`` for each iterate shown.

    Raises:
        ViewError: meshcat is not installed.
    """
    graph, shown = solved.after, shown_steps(solved)
    stage = Stage(len(shown), _STEP)
    size, odometry = graph.group.point_dim, graph.edges.odometry
    extent = float(np.ptp(graph.poses[:, :size], axis=0).max())
    width = (0.0022 if size == 2 else 0.004) * extent  # strips in space are seen from the side
    closures = {
        "closures": (~odometry & ~solved.outliers, "closure", -1.0),
        "outliers": (solved.outliers, "outlier", 1),
    }

    def lift(points: Array, height: float) -> Array:
        """Planar points (..., 2) as points in space; half widths up or down keep layers apart."""
        if size == 3:
            return points
        return np.concatenate([points, np.full((*points.shape[:-1], 1), 0.5 * height * width)], axis=-1)

    def trajectory(path: str, poses: PoseGraph, colour: str, share: float, height: float) -> None:
        """The odometry edges as strips, or as lines where there are very many."""
        lines = lift(segments(poses, odometry), height)
        if not len(lines):
            stage.points(path, lift(poses.poses[:, :size], height), colour, 3.0)
        elif len(lines) <= _MOST_STRIPS:
            stage.mesh(path, strips(lines, share * width, size == 3), colour)
        else:
            stage.lines(path, lines, colour)

    trajectory("start", solved.before, "odometry", 0.6, -2.0)
    parts: dict[str, list[str]] = {"trajectory": [], "closures": [], "outliers": []}
    for tick, k in enumerate(shown):
        iterate = graph.with_poses(solved.steps[k])
        for name, (edges, colour, height) in closures.items():
            if edges.any():
                parts[name].append(f"steps/{k}/{name}")
                stage.lines(parts[name][-1], lift(segments(iterate, edges), height), colour)
        parts["trajectory"].append(f"steps/{k}/trajectory")
        trajectory(parts["trajectory"][-1], iterate, "robot", 1.0, 0.0)
        stage.appear(f"steps/{k}", tick, tick + 1 if tick < stage.last else None)
    if len(graph.landmarks):
        stage.points("landmarks", lift(graph.landmarks, 2.0), "landmark", 7.0)
    stage.points("first", lift(graph.poses[:1, :size], 3.0), "ink", 9.0)
    return stage.finish(_page(solved, shown, parts))


def shown_steps(solved: SolvedGraph) -> list[int]:
    """Which of ``solved.steps`` are drawn: all, or of a large graph the first and the last."""
    last = len(solved.steps) - 1
    return list(range(last + 1)) if len(solved.after.edges) * (last + 1) <= _MOST else sorted({0, last})


def _page(solved: SolvedGraph, shown: list[int], parts: dict[str, list[str]]) -> Page:
    graph, settings, solution = solved.after, solved.settings, solved.solution
    legend = [
        Key("odometry", "line", "trajectory at the start", ["start"]),
        Key("robot", "line", "trajectory: poses joined by odometry", parts["trajectory"]),
        Key("closure", "line", "loop closures: the same place seen again", parts["closures"]),
    ]
    if solved.outliers.any():
        legend.append(Key("outlier", "line", "loop closures taken for outliers", parts["outliers"]))
    if len(graph.landmarks):
        legend.append(Key("landmark", "line", "landmarks", ["landmarks"]))
    costs = {row.number: row.cost for row in solution.history}
    numbers = [int(solved.step_numbers[k]) for k in shown]
    return Page(
        title=f"unifg: {solved.name}",
        outcome=solution.status.value,
        good=solution.converged,
        facts={
            "poses": f"{len(graph.poses)} in {graph.group.point_dim}D",
            "edges": f"{len(graph.edges)}, {len(graph.closures)} close loops",
            "landmarks": f"{len(graph.landmarks)}" if len(graph.landmarks) else "",
            "first guess": settings.init,
            "solver": settings.solver,
            "residual": settings.residual,
            "robust loss": settings.robust or "",
            "outliers": f"{int(solved.outliers.sum())}" if solved.loss else "",
            "\u03c7\u00b2 before": f"{solved.chi2[1]:.7g}",
            "\u03c7\u00b2 after": f"{solved.chi2[2]:.7g}",
            "without outliers": f"{solved.chi2_inliers:.7g}" if solved.outliers.any() else "",
            "solved in": f"{solution.iterations} iterations, {1e3 * solved.seconds['solve']:.0f} ms",
        },
        corners=_corners(solved),
        legend=legend,
        labels=[],
        readouts=[Readout("cost", [f"{costs.get(number, solution.cost):.7g}" for number in numbers])],
        views=[View("overview", "Whole graph", _DIRECTIONS[graph.group.point_dim], 20.0)],
        counts="iteration",
        numbers=numbers,
    )


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
