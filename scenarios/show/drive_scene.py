"""An episode as one HTML file: the building, the robot and what it saw, estimated and planned, played back offline.

The file carries its viewer (meshcat) and needs neither a server nor a network. The same log gives the same
bytes, provided that the same version of meshcat wrote them. What changes shape from frame to frame (scan,
horizon, detections) is one object per frame that is shown in turn; what only moves is animated.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from unifg.errors import ScenarioError
from unifg.scenarios.log.drive_log import EpisodeLog
from unifg.scenarios.show import shapes
from unifg.scenarios.show.drive_page import scene_page
from unifg.scenarios.show.palette import COLOURS
from unifg.scenarios.show.recorder import Recorder, load_meshcat, viewer_script
from unifg.typing import Array, IntArray

if TYPE_CHECKING:
    from meshcat.animation import Animation
    from meshcat.visualizer import Visualizer

__all__ = ["frame_ticks", "record_scene", "scene_html", "write_scene"]

MAX_FRAMES = 500
"""Longer episodes show every second tick, every third, ..."""

_MAX_POINTS = 90_000  # lidar points of the whole file; beyond, every second beam, every third, ...
_WALL = 0.6  # height of walls and obstacles [m]: low enough to look into rooms
_BODY = 0.3  # height of the robot [m]


def write_scene(path: str | Path, log: EpisodeLog) -> Path:
    """Write the scene of an episode.

    Args:
        path: HTML file to write; an existing one is replaced.
        log: an episode of at least one tick.

    Returns:
        The path written.

    Raises:
        ScenarioError: the episode has no tick, or meshcat is not installed.
    """
    path = Path(path)
    path.write_text(scene_html(log), encoding="utf-8", newline="\n")
    return path


def scene_html(log: EpisodeLog) -> str:
    """The scene of an episode as the text of an HTML page; see `write_scene`."""
    script = viewer_script()
    recorder = record_scene(log)
    return scene_page(log, frame_ticks(log), recorder.packed_base64(), script)


def frame_ticks(log: EpisodeLog) -> IntArray:
    """Ticks shown, the last one among them; at most about `MAX_FRAMES`."""
    stride = max(1, math.ceil(log.ticks / MAX_FRAMES))
    shown = np.arange(0, log.ticks, stride)
    last = np.array([log.ticks - 1])
    return shown if shown[-1] == last[0] else np.concatenate([shown, last])


def record_scene(log: EpisodeLog) -> Recorder:
    """Draw an episode into a recorder.

    Args:
        log: an episode of at least one tick.

    Returns:
        The recorded meshcat commands; frame k of the animation is tick k.

    Raises:
        ScenarioError: the episode has no tick, or meshcat is not installed.
    """
    if log.ticks == 0:
        raise ScenarioError("the episode has no tick: there is nothing to show")
    load_meshcat()
    from meshcat.animation import Animation
    from meshcat.visualizer import Visualizer

    recorder = Recorder()
    scene = _Scene(log, Visualizer(window=recorder), Animation(default_framerate=1.0 / log.dt))
    scene.draw()
    return recorder


class _Scene:
    """Everything drawn, with the sizes that follow from the extent of the map."""

    def __init__(self, log: EpisodeLog, viewer: Visualizer, animation: Animation) -> None:
        self.log, self.viewer, self.animation = log, viewer, animation
        self.ticks = frame_ticks(log)
        self.last = int(self.ticks[-1])
        extent = float(np.ptp(shapes.known_corners(log.occupancy), axis=0).max())
        self.stroke = float(np.clip(0.004 * extent, 0.03, 0.14))  # width of ribbons [m]
        self.pin = float(np.clip(0.035 * extent, 0.3, 1.4))  # height of pins and flags [m]

    def draw(self) -> None:
        """Send every object, then the animation."""
        self._surroundings()
        self._building()
        self._route()
        self._robots()
        self._obstacles()
        self._trail()
        self._frames()
        self.viewer.set_animation(self.animation, play=True, repetitions=1)

    def _surroundings(self) -> None:
        for path in ("/Grid", "/Axes"):
            self.viewer[path].set_property("visible", False)
        self.viewer["/Background"].set_property("top_color", [0.97, 0.97, 0.98])
        self.viewer["/Background"].set_property("bottom_color", [0.86, 0.88, 0.90])
        # Only lights without a range: the default point lights fade within ten metres.
        for name in ("PointLightNegativeX", "PointLightPositiveX"):
            self.viewer[f"/Lights/{name}"].set_property("visible", False)
        self.viewer["/Lights/AmbientLight/<object>"].set_property("intensity", 0.72)
        self.viewer["/Lights/FillLight/<object>"].set_property("intensity", 0.4)
        self.viewer["/Lights/FillLight/<object>"].set_property("position", [-0.5, -0.35, 1.0])

    def _building(self) -> None:
        occupancy = self.log.occupancy
        self._mesh("building/floor", shapes.flat(occupancy, occupancy.free, 0.0), COLOURS["floor"], flat=True)
        if occupancy.occupied.any():
            self._mesh("building/walls", shapes.extrude(occupancy, _WALL), COLOURS["wall"])

    def _route(self) -> None:
        log = self.log
        if len(log.path) > 1:
            self._mesh("plan", shapes.ribbon(log.path, 0.6 * self.stroke, 0.02), COLOURS["plan"], flat=True)
        disc = shapes.ring(log.start[:2], 0.0, 1.2 * log.robot_radius, 0.03)
        self._mesh("start", disc, COLOURS["start"], flat=True)
        for index, goal in enumerate(log.goals):
            path = f"goals/{index}"
            floor = shapes.ring(goal[:2], 1.3 * log.robot_radius, self.stroke, 0.03)
            self._mesh(f"{path}/ring", floor, COLOURS["goal"], flat=True)
            self._cylinder(f"{path}/pole", self.pin, 0.25 * self.stroke, COLOURS["pole"], goal[:2])
            low, high, tip = 0.62 * self.pin, self.pin, 0.55 * self.pin
            x, y = goal[:2]
            flag = np.array([[x, y, low], [x, y, high], [x + tip, y, (low + high) / 2]])
            self._mesh(f"{path}/flag", (flag, np.array([[0, 1, 2]])), COLOURS["goal"], flat=True)

    def _robots(self) -> None:
        log, radius = self.log, self.log.robot_radius
        self._cylinder("robot/body", _BODY, radius, COLOURS["robot"])
        self._mesh("robot/heading", shapes.wedge(1.2 * radius, _BODY + 0.02), COLOURS["heading"], flat=True)
        # A pin hovers above the robot, which would be a few pixels in a whole building.
        point = 0.25 * self.pin
        self._cylinder("robot/pin", 0.75 * self.pin, 0.0, COLOURS["robot"], z=_WALL + 0.05, top=point)
        self._cylinder("estimate/body", _BODY + 0.12, radius + 0.06, COLOURS["estimate"], opacity=0.3)
        marker = shapes.wedge(1.2 * radius, _BODY + 0.14)
        self._mesh("estimate/heading", marker, COLOURS["estimate"], flat=True, opacity=0.55)
        self._cylinder("odometry/body", _BODY, radius, COLOURS["odometry"], opacity=0.55)
        marker = shapes.wedge(1.2 * radius, _BODY + 0.02)
        self._mesh("odometry/heading", marker, COLOURS["odometry"], flat=True, opacity=0.8)
        for path, poses in (
            ("robot", log.true_pose),
            ("estimate", log.estimate),
            ("odometry", log.dead_reckoning),
        ):
            self._move(path, poses)

    def _obstacles(self) -> None:
        for index, moves in enumerate(self.log.moving().tolist()):
            places = self.log.obstacles[:, index]
            colour = COLOURS["moving" if moves else "fixed"]
            self._cylinder(f"obstacles/{index}/body", _WALL, float(places[0, 2]), colour)
            self._move(f"obstacles/{index}", np.column_stack([places[:, :2], np.zeros(self.log.ticks)]), moves)

    def _trail(self) -> None:
        """The way driven so far, in pieces that appear as the robot passes."""
        stride = max(1, self.last // 250)
        for begin in range(0, self.last, stride):
            end = min(begin + stride, self.last)
            piece = self.log.true_pose[begin : end + 1]
            if np.ptp(piece[:, :2], axis=0).max() < 1e-3:
                continue
            path = f"trail/{begin}"
            self._mesh(path, shapes.ribbon(piece, 0.9 * self.stroke, 0.04), COLOURS["trail"], flat=True)
            self._show(path, end, None)

    def _frames(self) -> None:
        """Scan, predicted horizon and detections: one group per frame, shown in turn."""
        log = self.log
        beams = np.arange(0, len(log.scan_angles), math.ceil(len(self.ticks) * len(log.scan_angles) / _MAX_POINTS))
        nodes = np.unique(np.linspace(0, log.horizon.shape[1] - 1, 16).round().astype(np.intp))
        endings = [*self.ticks[1:].tolist(), None]
        for tick, ending in zip(self.ticks.tolist(), endings, strict=True):
            path = f"frames/{tick}"
            hits = scan_points(log, tick, beams)
            if len(hits):
                self._points(f"{path}/scan", np.column_stack([hits, np.full(len(hits), _WALL + 0.02)]))
            horizon = log.horizon[tick][nodes]
            if len(horizon) > 1 and np.isfinite(horizon).all():
                self._mesh(
                    f"{path}/horizon",
                    shapes.ribbon(horizon, self.stroke, 0.06),
                    COLOURS["horizon"],
                    flat=True,
                )
            rings = [
                shapes.ring(x[:2], float(x[2]) + 0.03, 0.5 * self.stroke, _WALL + 0.01, corners=10)
                for x in log.detected[tick]
            ]
            if rings:
                self._mesh(f"{path}/detected", shapes.merge(rings), COLOURS["detected"], flat=True)
            self._show(path, tick, ending)

    def _mesh(self, path: str, mesh: shapes.Mesh, colour: int, *, flat: bool = False, opacity: float = 1.0) -> None:
        """Send a mesh; a flat one is drawn in its own colour whatever the light."""
        from meshcat.geometry import MeshBasicMaterial, MeshLambertMaterial, TriangularMeshGeometry

        material = MeshBasicMaterial if flat else MeshLambertMaterial
        self.viewer[path].set_object(TriangularMeshGeometry(*mesh), material(color=colour, opacity=opacity))

    def _points(self, path: str, points: Array) -> None:
        from meshcat.geometry import GenericMaterial, Points, PointsGeometry

        material = GenericMaterial(color=COLOURS["scan"], size=4, sizeAttenuation=False)  # [pixels]
        material._type = "PointsMaterial"  # meshcat's own insists on a colour per point
        self.viewer[path].set_object(Points(PointsGeometry(points.T), material))

    def _cylinder(
        self,
        path: str,
        height: float,
        radius: float,
        colour: int,
        place: Array | None = None,
        *,
        z: float = 0.0,
        top: float | None = None,
        opacity: float = 1.0,
    ) -> None:
        """Send an upright cylinder, or a cone where the radius at its top differs, that stands on height z [m]."""
        from meshcat.geometry import Cylinder, MeshLambertMaterial

        shape = Cylinder(height, radiusBottom=radius, radiusTop=radius if top is None else top)
        self.viewer[path].set_object(shape, MeshLambertMaterial(color=colour, opacity=opacity))
        x, y = (0.0, 0.0) if place is None else place
        # The cylinder's axis is y there: turned by a quarter about x, it is z.
        upright = np.array([[1, 0, 0, x], [0, 0, -1, y], [0, 1, 0, z + height / 2.0], [0, 0, 0, 1]], dtype=np.float64)
        self.viewer[path].set_transform(upright)

    def _move(self, path: str, poses: Array, moves: bool = True) -> None:
        """Place an object at its first pose and, where it moves, animate it through all (T, 3) [m, m, rad]."""
        self.viewer[path].set_transform(_transform(poses[0]))
        if not moves:
            return
        for tick in self.ticks.tolist():
            x, y, heading = poses[tick].tolist()
            key = self._key(path, tick)
            key("position", "vector3", [x, y, 0.0])
            key("quaternion", "quaternion", [0.0, 0.0, math.sin(heading / 2.0), math.cos(heading / 2.0)])

    def _show(self, path: str, begin: int, end: int | None) -> None:
        """Show an object from one tick to another (or for good).

        The track holds its first key backwards, hence the key at 0; the key at the very end makes all tracks equally
        long, which lets the viewer stop and restart them together.
        """
        keys = {0: False, begin: True}
        if end is not None:
            keys[end] = False
        keys.setdefault(self.last, end is None)
        for tick, visible in keys.items():
            self._key(path, tick)("visible", "boolean", visible)

    def _key(self, path: str, tick: int) -> Callable[[str, str, object], None]:
        set_property: Callable[[str, str, object], None] = self.animation.at_frame(self.viewer[path], tick).set_property
        return set_property


def scan_points(log: EpisodeLog, tick: int, beams: IntArray) -> Array:
    """World points (n, 2) [m] where the chosen beams of a tick really ended; dropouts and misses are left out."""
    ranges = log.scan[tick, beams]
    returned = np.isfinite(ranges)
    x, y, heading = log.true_pose[tick]
    angles = log.scan_angles[beams][returned] + heading
    hits: Array = np.column_stack([np.cos(angles), np.sin(angles)]) * ranges[returned, None] + np.array([x, y])
    return hits


def _transform(pose: Array) -> Array:
    """The 4 x 4 matrix of a planar pose (3,) [m, m, rad]."""
    x, y, heading = pose.tolist()
    c, s = math.cos(heading), math.sin(heading)
    return np.array([[c, -s, 0.0, x], [s, c, 0.0, y], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
