"""A flight as one HTML file: what stood there, what was believed of it, and where the vehicle flew and meant to fly.

As in `unifg.scenarios.show.drive_scene` the file carries its viewer (meshcat) and needs neither a server nor a network.
Frame k of the animation is tick k. Ways that change shape from frame to frame are one object per frame, shown in turn;
what only moves, turns or changes its size is animated.

A flight that nobody estimated, such as a plan flown as it is, has no sigmas, windows, landmarks or sightings; it is
shown without them, and with all cylinders solid from the start.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from unifg.errors import ScenarioError
from unifg.scenarios.log.flight_log import FlightLog
from unifg.scenarios.log.flight_metrics import has_estimate
from unifg.scenarios.show import drone, shapes
from unifg.scenarios.show.flight_page import scene_page
from unifg.scenarios.show.palette import COLOURS
from unifg.scenarios.show.recorder import Recorder, load_meshcat, viewer_script
from unifg.scenarios.worlds.air import VEHICLE_RADIUS
from unifg.scenarios.worlds.bearing_range import SensorModel
from unifg.typing import Array, IntArray

if TYPE_CHECKING:
    from meshcat.animation import Animation
    from meshcat.visualizer import Visualizer

__all__ = ["first_sights", "frame_ticks", "record_scene", "scene_html", "sensor_reach", "write_scene"]

MAX_FRAMES = 400
"""Longer flights show every second tick, every third, ..."""

SIGMAS = 2.0
"""Half axes of ellipses in standard deviations."""

_HEIGHT = 2.0  # of walls, cylinders and movers [m]; there they have no top
_FLOOR = -0.02  # drawn a little lower than it is, clear of what stands on it [m]
_FAINT = 0.22  # opacity of cylinders not seen yet
_NODES = 16  # of a way that changes from frame to frame
_STILL = (0.002, 0.02)  # an ellipse that moved [m] or grew (share) by less is not told anew
_PIECES = 150  # of the way flown


def write_scene(path: str | Path, log: FlightLog) -> Path:
    """Write the scene of a flight.

    Args:
        path: HTML file to write; an existing one is replaced.
        log: a flight of at least one tick.

    Returns:
        The path written.

    Raises:
        ScenarioError: the flight has no tick, or meshcat is not installed.
    """
    path = Path(path)
    path.write_text(scene_html(log), encoding="utf-8", newline="\n")
    return path


def scene_html(log: FlightLog) -> str:
    """The scene of a flight as the text of an HTML page; see `write_scene`."""
    script = viewer_script()
    recorder = record_scene(log)
    return scene_page(log, frame_ticks(log), recorder.packed_base64(), script)


def frame_ticks(log: FlightLog) -> IntArray:
    """Ticks shown, the last one among them; at most about `MAX_FRAMES`."""
    stride = max(1, math.ceil(log.ticks / MAX_FRAMES))
    return np.unique(np.append(np.arange(0, log.ticks, stride), log.ticks - 1))


def first_sights(log: FlightLog) -> list[int | None]:
    """Tick at which each cylinder of the layout was first seen; None for never, all 0 in a flight without a sensor."""
    count = len(log.layout.cylinders)
    if not any(len(ids) for ids in log.seen):
        return [0] * count
    first: list[int | None] = [None] * count
    for tick in reversed(range(log.ticks)):
        for name in log.seen[tick].tolist():
            if name < count:
                first[name] = tick
    return first


def sensor_reach(log: FlightLog) -> float | None:
    """Reach of the sensor [m], ``settings["sensor_range"]`` or the usual one; None in a flight without a sensor."""
    if not any(len(ids) for ids in log.seen):
        return None
    return float(log.settings.get("sensor_range", SensorModel().range_max))


def record_scene(log: FlightLog) -> Recorder:
    """Draw a flight into a recorder.

    Args:
        log: a flight of at least one tick.

    Returns:
        The recorded meshcat commands; frame k of the animation is tick k.

    Raises:
        ScenarioError: the flight has no tick, or meshcat is not installed.
    """
    if log.ticks == 0:
        raise ScenarioError("the flight has no tick: there is nothing to show")
    load_meshcat()
    from meshcat.animation import Animation
    from meshcat.visualizer import Visualizer

    recorder = Recorder()
    _Scene(log, Visualizer(window=recorder), Animation(default_framerate=1.0 / log.dt)).draw()
    return recorder


class _Scene:
    """Everything drawn."""

    def __init__(self, log: FlightLog, viewer: Visualizer, animation: Animation) -> None:
        self.log, self.viewer, self.animation = log, viewer, animation
        self.ticks = frame_ticks(log)
        self.last = int(self.ticks[-1])

    def draw(self) -> None:
        """Send every object, then the animation."""
        self._surroundings()
        self._ground()
        self._walls()
        self._cylinders()
        self._ends()
        self._landmarks()
        self._movers()
        self._drone()
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

    def _ground(self) -> None:
        """The floor, with lines every metre to judge distances by."""
        (left, low), (right, high) = self.log.layout.size
        floor = np.array([[[left, low, _FLOOR], [right, low, _FLOOR], [right, high, _FLOOR], [left, high, _FLOOR]]])
        self._mesh("ground/floor", drone.quads(floor), COLOURS["floor"], flat=True)
        across = [[[x, low], [x, high]] for x in np.arange(math.ceil(left), right + 1e-9)]
        along = [[[left, y], [right, y]] for y in np.arange(math.ceil(low), high + 1e-9)]
        lines = [shapes.ribbon(np.array(line), 0.02, 0.0) for line in across + along]
        self._mesh("ground/metres", shapes.merge(lines), 0xE2DFD6, flat=True)

    def _walls(self) -> None:
        for index, wall in enumerate(self.log.layout.walls):
            low, high = (np.column_stack([wall, np.full(2, z)]) for z in (0.0, _HEIGHT))
            sheet = np.concatenate([low, high[::-1]])[None]
            self._mesh(f"walls/{index}/sheet", drone.quads(sheet), COLOURS["wall"], flat=True, opacity=0.22)
            frame = [drone.tube(line, 0.03, 4) for line in (low, high)]
            frame += [drone.tube(np.stack([low[k], high[k]]), 0.03, 4) for k in range(2)]
            self._mesh(f"walls/{index}/frame", shapes.merge(frame), COLOURS["wall"])

    def _cylinders(self) -> None:
        for index, first in enumerate(first_sights(self.log)):
            x, y, radius = self.log.layout.cylinders[index].tolist()
            if first != 0:
                path = f"cylinders/{index}/unseen"
                self._cylinder(path, _HEIGHT, radius, COLOURS["wall"], (x, y), opacity=_FAINT)
                if first is not None:
                    self._show(path, 0, first)
            if first is not None:
                path = f"cylinders/{index}/seen"
                self._cylinder(f"{path}/body", _HEIGHT, radius, COLOURS["fixed"], (x, y))
                self._rim(f"{path}/rim", np.array([x, y]), radius)
                if first > 0:
                    self._show(path, first, None)

    def _rim(self, path: str, place: Array, radius: float) -> None:
        rim = shapes.ring(place, radius - 0.03, 0.03, _HEIGHT + 0.01, corners=32)
        self._mesh(path, rim, COLOURS["start"], flat=True)

    def _ends(self) -> None:
        start, target = self.log.layout.start, self.log.layout.target
        self._mesh("start", shapes.ring(start[:2], 0.18, 0.07, 0.012, corners=32), COLOURS["start"], flat=True)
        rings = [shapes.ring(target[:2], r, 0.07, 0.012, corners=40) for r in (0.12, 0.4)]
        self._mesh("target/rings", shapes.merge(rings), COLOURS["goal"], flat=True)
        self._cylinder("target/pole", float(target[2]), 0.025, COLOURS["pole"], target[:2])
        self._ball("target/ball", 0.16, COLOURS["goal"], target)

    def _landmarks(self) -> None:
        """One ellipse for each name a landmark was ever given, moved and stretched as it becomes better known."""
        told: dict[int, dict[int, Array]] = {}
        radii: dict[int, float] = {}
        for tick in self.ticks.tolist():
            row = self.log.landmarks[tick]
            radii |= dict(zip(row.ids.tolist(), row.radii.tolist(), strict=True))
            for name, mean, covariance in zip(row.ids.tolist(), row.means, row.covariances, strict=True):
                long, short, direction = drone.ellipse_axes(covariance, SIGMAS)
                earlier = told.setdefault(name, {})
                if earlier:  # a direction and its opposite are the same: the nearer one, lest the ellipse spin
                    last = float(next(reversed(earlier.values()))[4])
                    direction = last + (direction - last + math.pi / 2.0) % math.pi - math.pi / 2.0
                earlier[tick] = np.array([*mean, long, short, direction])
        for name, ellipses in sorted(told.items()):
            self._landmark(f"landmarks/{name}", ellipses, radii[name])

    def _landmark(self, path: str, ellipses: dict[int, Array], radius: float) -> None:
        """Its ellipse, on top of the cylinder it stands for, and the cylinder's outline as believed."""
        height = _HEIGHT + 0.02 if radius > 0.0 else 0.03
        disc, _ = ellipse = drone.unit_disc()
        disc[:, 2] = height
        self._mesh(f"{path}/ellipse/disc", ellipse, COLOURS["estimate"], flat=True, opacity=0.5)
        edge = shapes.ring(np.zeros(2), 0.86, 0.14, height + 0.005, corners=32)
        self._mesh(f"{path}/ellipse/edge", edge, COLOURS["estimate"], flat=True)
        if radius > 0.0:
            outline = shapes.ring(np.zeros(2), radius, 0.05, 0.02, corners=32)
            self._mesh(f"{path}/outline", outline, COLOURS["estimate"], flat=True)
        hidden = True
        for tick in self.ticks.tolist():
            if (tick not in ellipses) != hidden or tick in (0, self.last):
                hidden = tick not in ellipses
                self._key(path, tick)("visible", "boolean", not hidden)
        told, previous = -1, -1
        for tick, values in ellipses.items():
            if told < 0 or _changed(ellipses[told], values):
                if previous > told:
                    self._place_ellipse(path, previous, ellipses[told])  # it has stood still until then
                self._place_ellipse(path, tick, values)
                told = tick
            previous = tick

    def _place_ellipse(self, path: str, tick: int, ellipse: Array) -> None:
        x, y, long, short, direction = ellipse.tolist()
        self._key(path, tick)("position", "vector3", [x, y, 0.0])
        key = self._key(f"{path}/ellipse", tick)
        key("scale", "vector3", [max(long, 1e-3), max(short, 1e-3), 1.0])
        key("quaternion", "quaternion", [0.0, 0.0, math.sin(direction / 2.0), math.cos(direction / 2.0)])

    def _movers(self) -> None:
        for index in range(self.log.movers.shape[1]):
            places = self.log.movers[:, index]
            self._cylinder(f"movers/{index}/body", _HEIGHT, float(places[0, 2]), COLOURS["moving"])
            self._rim(f"movers/{index}/rim", np.zeros(2), float(places[0, 2]))
            self._travel(f"movers/{index}", np.column_stack([places[:, :2], np.zeros(self.log.ticks)]))

    def _drone(self) -> None:
        """The vehicle, its shadow with a plumb line, and the circle the sensor reaches."""
        truth = self.log.truth
        self._mesh("drone/body", drone.body(VEHICLE_RADIUS), COLOURS["robot"])
        self._mesh("drone/nose", drone.nose(VEHICLE_RADIUS), COLOURS["goal"])
        self._mesh("drone/arms", drone.arms(VEHICLE_RADIUS), 0x2B3340)
        for name, front, colour in (("front", True, COLOURS["scan"]), ("back", False, 0x2B3340)):
            self._mesh(f"drone/{name}/rotors", drone.rotors(VEHICLE_RADIUS, front=front), colour, flat=True)
            swept = drone.swept(VEHICLE_RADIUS, front=front)
            self._mesh(f"drone/{name}/swept", swept, colour, flat=True, opacity=0.4)
        self._travel("drone", truth[:, :3], truth[:, 3:7])

        below = np.column_stack([truth[:, :2], np.zeros(self.log.ticks)])
        disc = shapes.ring(np.zeros(2), 0.0, VEHICLE_RADIUS, 0.016, corners=24)
        self._mesh("shadow/disc", disc, COLOURS["start"], flat=True, opacity=0.4)
        plumb = drone.tube(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), 0.012)
        self._mesh("shadow/plumb", plumb, COLOURS["start"], flat=True, opacity=0.5)
        for tick in self.ticks.tolist():
            self._key("shadow/plumb", tick)("scale", "vector3", [1.0, 1.0, max(float(truth[tick, 2]), 1e-3)])
        self._travel("shadow", below)
        reach = sensor_reach(self.log)
        if reach is not None:
            self._mesh(
                "sensor", shapes.ring(np.zeros(2), reach - 0.07, 0.07, 0.014, corners=96), COLOURS["scan"], flat=True
            )
            self._travel("sensor", below)

    def _trail(self) -> None:
        """The way flown so far, as believed and as it truly was, in pieces that appear as the vehicle passes."""
        ways = [("believed", self.log.believed[:, :3], "trail", 0.03)]
        if has_estimate(self.log):
            ways.append(("truth", self.log.truth[:, :3], "odometry", 0.014))
        stride = max(1, math.ceil(self.last / _PIECES))
        for begin in range(0, self.last, stride):
            end = min(begin + stride, self.last)
            for name, way, colour, radius in ways:
                points = drone.thin(way[begin : end + 1], 3)
                if len(points) > 1:
                    self._mesh(f"flown/{begin}/{name}", drone.tube(points, radius), COLOURS[colour], flat=True)
            self._show(f"flown/{begin}", end, None)

    def _frames(self) -> None:
        """Predicted way and window of the estimator: one group per frame, shown in turn."""
        endings = [*self.ticks[1:].tolist(), None]
        for tick, ending in zip(self.ticks.tolist(), endings, strict=True):
            path, drawn = f"frames/{tick}", False
            for name, way, colour, radius in (
                ("past", self.log.pasts[tick], "robot", 0.045),
                ("horizon", self.log.plans[tick], "horizon", 0.05),
            ):
                points = drone.thin(way, _NODES) if len(way) > 1 and np.isfinite(way).all() else way[:0]
                if len(points) > 1:
                    drawn = True
                    self._mesh(f"{path}/{name}", drone.tube(points, radius), COLOURS[colour], flat=True)
                    if name == "horizon":
                        below = shapes.ribbon(points, 0.06, 0.018)
                        self._mesh(f"{path}/below", below, COLOURS["horizon"], flat=True, opacity=0.35)
            if drawn:
                self._show(path, tick, ending)

    def _mesh(self, path: str, mesh: shapes.Mesh, colour: int, *, flat: bool = False, opacity: float = 1.0) -> None:
        """Send a mesh; a flat one is drawn in its own colour whatever the light."""
        from meshcat.geometry import MeshBasicMaterial, MeshLambertMaterial, TriangularMeshGeometry

        material = MeshBasicMaterial if flat else MeshLambertMaterial
        extra: dict[str, Any] = {"depthWrite": False} if opacity < 1.0 else {}  # what lies behind shows through
        self.viewer[path].set_object(TriangularMeshGeometry(*mesh), material(color=colour, opacity=opacity, **extra))

    def _ball(self, path: str, radius: float, colour: int, place: Array) -> None:
        from meshcat.geometry import MeshLambertMaterial, Sphere

        self.viewer[path].set_object(Sphere(radius), MeshLambertMaterial(color=colour))
        transform = np.eye(4)
        transform[:3, 3] = place
        self.viewer[path].set_transform(transform)

    def _cylinder(
        self,
        path: str,
        height: float,
        radius: float,
        colour: int,
        place: tuple[float, float] | Array = (0.0, 0.0),
        *,
        opacity: float = 1.0,
    ) -> None:
        """Send an upright cylinder that stands on the ground."""
        from meshcat.geometry import Cylinder, MeshLambertMaterial

        extra: dict[str, Any] = {"depthWrite": False} if opacity < 1.0 else {}
        self.viewer[path].set_object(
            Cylinder(height, radius), MeshLambertMaterial(color=colour, opacity=opacity, **extra)
        )
        x, y = place
        # The cylinder's axis is y there: turned by a quarter about x, it is z.
        upright = np.array([[1, 0, 0, x], [0, 0, -1, y], [0, 1, 0, height / 2.0], [0, 0, 0, 1]], dtype=np.float64)
        self.viewer[path].set_transform(upright)

    def _travel(self, path: str, places: Array, attitudes: Array | None = None) -> None:
        """Animate an object through places (T, 3) [m] and attitudes (T, 4) (w, x, y, z)."""
        for tick in self.ticks.tolist():
            key = self._key(path, tick)
            key("position", "vector3", places[tick].tolist())
            if attitudes is not None:
                w, x, y, z = attitudes[tick].tolist()
                key("quaternion", "quaternion", [x, y, z, w])

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


def _changed(before: Array, now: Array) -> bool:
    distance, share = _STILL
    moved = float(np.abs(now[:2] - before[:2]).max()) > distance
    return moved or bool((np.abs(now[2:4] - before[2:4]) > share * np.maximum(before[2:4], distance)).any())
