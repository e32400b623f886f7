"""A solved pose graph as one HTML file: look around in it, and step through the iterations, offline.

As in `unifg.scenarios.show.drive_scene` the file carries its viewer (meshcat) and needs neither a server nor a network.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from unifg.pose_graphs.pose_graph import PoseGraph
from unifg.scenarios.pose_graph import SolvedGraph
from unifg.scenarios.show.graph_page import solve_page
from unifg.scenarios.show.graph_plot import segments
from unifg.scenarios.show.palette import COLOURS
from unifg.scenarios.show.recorder import Recorder, load_meshcat, viewer_script
from unifg.scenarios.show.shapes import Mesh
from unifg.typing import Array

if TYPE_CHECKING:
    from meshcat.visualizer import Visualizer

__all__ = ["record_scene", "strips", "write_scene"]

_MOST = 60_000  # edges drawn over all iterations; beyond, only the first guess and the solution are shown
_MOST_STRIPS = 30_000  # odometry edges drawn with a width; beyond, as hair-thin lines


def write_scene(path: str | Path, solved: SolvedGraph) -> Path:
    """Write the scene of a solved pose graph.

    Args:
        path: HTML file to write; an existing one is replaced.
        solved: a solved pose graph.

    Returns:
        The path written.

    Raises:
        ScenarioError: meshcat is not installed.
    """
    path = Path(path)
    script = viewer_script()
    recorder, shown = record_scene(solved)
    page = solve_page(solved, shown, recorder.packed_base64(), script)
    path.write_text(page, encoding="utf-8", newline="\n")
    return path


def record_scene(solved: SolvedGraph) -> tuple[Recorder, list[int]]:
    """Draw into a recorder: ``start``, and one group ``steps/k`` for each iterate shown.

    Returns:
        The recorded meshcat commands, and which of ``solved.steps`` are shown.

    Raises:
        ScenarioError: meshcat is not installed.
    """
    load_meshcat()
    from meshcat.visualizer import Visualizer

    recorder = Recorder()
    scene = _Scene(solved, Visualizer(window=recorder))
    return recorder, scene.draw()


class _Scene:
    """Everything drawn, with the sizes that follow from the extent of the solution."""

    def __init__(self, solved: SolvedGraph, viewer: Visualizer) -> None:
        self.solved, self.viewer = solved, viewer
        graph = solved.after
        self.size = graph.group.point_dim
        extent = float(np.ptp(graph.poses[:, : self.size], axis=0).max())
        self.width = (0.0022 if self.size == 2 else 0.004) * extent  # strips in space are seen from the side
        odometry = graph.edges.odometry
        self.parts = {
            "trajectory": odometry,
            "closures": ~odometry & ~solved.outliers,
            "outliers": solved.outliers,
        }
        self.ribbons = int(odometry.sum()) <= _MOST_STRIPS

    def draw(self) -> list[int]:
        """Send every object; return which iterates were drawn."""
        self._surroundings()
        solved, graph = self.solved, self.solved.after
        self._path("start", solved.before, "odometry", 0.6, -2.0)
        last = len(solved.steps) - 1
        count = len(graph.edges)
        shown = list(range(last + 1)) if count * (last + 1) <= _MOST else sorted({0, last})
        for k in shown:
            iterate = graph.with_poses(solved.steps[k])
            for name, colour, height in (("closures", "closure", -1.0), ("outliers", "outlier", 1.0)):
                lines = segments(iterate, self.parts[name])
                if len(lines):
                    self._thin(f"steps/{k}/{name}", self._lift(lines, height), COLOURS[colour])
            self._path(f"steps/{k}/trajectory", iterate, "robot", 1.0, 0.0)
        if len(graph.landmarks):
            self._points("landmarks", self._lift(graph.landmarks, 2.0), COLOURS["landmark"], 7.0)
        first = graph.poses[:1, : self.size]
        self._points("first", self._lift(first, 3.0), 0x1D2430, 9.0)
        return shown

    def _surroundings(self) -> None:
        for path in ("/Grid", "/Axes"):
            self.viewer[path].set_property("visible", False)
        self.viewer["/Background"].set_property("top_color", [0.98, 0.98, 0.985])
        self.viewer["/Background"].set_property("bottom_color", [0.93, 0.94, 0.95])

    def _path(self, path: str, graph: PoseGraph, colour: str, width: float, height: float) -> None:
        """The odometry edges of a graph as strips, or as lines where there are very many."""
        lines = self._lift(segments(graph, self.parts["trajectory"]), height)
        if not len(lines):
            self._points(path, self._lift(graph.poses[:, : self.size], height), COLOURS[colour], 3.0)
        elif self.ribbons:
            self._mesh(path, strips(lines, width * self.width, self.size == 3), COLOURS[colour])
        else:
            self._thin(path, lines, COLOURS[colour])

    def _lift(self, points: Array, height: float) -> Array:
        """Planar points (..., 2) as points in space; a few widths up or down keep layers apart."""
        if points.shape[-1] == 3:
            return points
        level = np.full((*points.shape[:-1], 1), 0.5 * height * self.width)
        return np.concatenate([points, level], axis=-1)

    def _mesh(self, path: str, mesh: Mesh, colour: int) -> None:
        from meshcat.geometry import MeshBasicMaterial, TriangularMeshGeometry

        self.viewer[path].set_object(TriangularMeshGeometry(*mesh), MeshBasicMaterial(color=colour))

    def _thin(self, path: str, lines: Array, colour: int) -> None:
        from meshcat.geometry import LineBasicMaterial, LineSegments, PointsGeometry

        points = lines.reshape(-1, 3).T.astype(np.float32)
        material = LineBasicMaterial(color=colour, transparent=True, opacity=0.55)
        self.viewer[path].set_object(LineSegments(PointsGeometry(points), material))

    def _points(self, path: str, points: Array, colour: int, pixels: float) -> None:
        from meshcat.geometry import GenericMaterial, Points, PointsGeometry

        material = GenericMaterial(color=colour, size=pixels, sizeAttenuation=False)
        material._type = "PointsMaterial"  # meshcat's own insists on a colour per point
        self.viewer[path].set_object(Points(PointsGeometry(points.T.astype(np.float32)), material))


def strips(lines: Array, width: float, crossed: bool) -> Mesh:
    """Straight lines (k, 2, 3) as level strips of that width [m]; crossed with upright ones to be seen from all sides.

    Returns:
        Vertices (4 k or 8 k, 3) and faces.
    """
    along = lines[:, 1] - lines[:, 0]
    level = np.cross(along, [0.0, 0.0, 1.0])
    vertical = np.linalg.norm(level, axis=1, keepdims=True) < 1e-9 * np.linalg.norm(along, axis=1, keepdims=True)
    level = np.where(vertical, np.array([1.0, 0.0, 0.0]), level)
    sides = [level]
    if crossed:
        sides.append(np.cross(level, along))
    corners = []
    for side in sides:
        arm = 0.5 * width * side / np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-300)
        # A little longer than the line: the joints of a bent path close.
        end = 0.5 * width * along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-300)
        low, high = lines[:, 0] - end, lines[:, 1] + end
        corners.append(np.stack([low - arm, low + arm, high + arm, high - arm], axis=1))
    vertices = np.concatenate(corners).reshape(-1, 3)
    begin = 4 * np.arange(len(vertices) // 4, dtype=np.intp)[:, None, None]
    faces = (begin + np.array([[0, 1, 2], [0, 2, 3]], dtype=np.intp)).reshape(-1, 3)
    return vertices, faces
