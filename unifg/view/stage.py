"""A scene as one HTML file: objects, what becomes of them from frame to frame, and the words around the picture.

The file carries its viewer (meshcat) and needs neither a server nor a network; the same log gives the same bytes,
provided that the same version of meshcat wrote them. What only moves, turns or stretches is animated; what changes
shape from frame to frame is one object per frame, shown in turn.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import resources
from typing import Any

import numpy as np

from unifg.errors import ViewError
from unifg.style.colours import rgb
from unifg.typing import Array, ArrayLike, IntArray
from unifg.view.recorder import Recorder, load_meshcat, viewer_script
from unifg.view.shapes import Mesh

__all__ = ["Stage", "frame_ticks", "page_text"]

MAX_FRAMES = 500
"""Longer runs show every second tick, every third, ..."""

_PIECES = 200  # of a way that appears bit by bit
_KINDS = {"position": "vector3", "scale": "vector3", "quaternion": "quaternion", "visible": "boolean"}


def frame_ticks(count: int) -> IntArray:
    """Of so many ticks those shown, the last one among them; at most about `MAX_FRAMES`."""
    stride = max(1, math.ceil(count / MAX_FRAMES))
    return np.unique(np.append(np.arange(0, count, stride), count - 1))


class Stage:
    """A scene in the making; frame k of its animation is tick k.

    Attributes:
        ticks: (F,) ticks shown.
        last: the last of them.
        dt: seconds per tick.
        recorder: everything sent.
        origin: (3,) of the world, where the stage has its own [m]; a browser reckons in single precision.
        stroke: half the width of a line that is to be seen well [m].
    """

    def __init__(self, ticks: int, dt: float, *, origin: ArrayLike = (0.0, 0.0, 0.0), stroke: float = 0.05) -> None:
        """Set an empty stage of so many ticks.

        Raises:
            ViewError: there is no tick, or meshcat is not installed.
        """
        if ticks == 0:
            raise ViewError("there is no tick, and nothing to show")
        load_meshcat()
        from meshcat.animation import Animation
        from meshcat.visualizer import Visualizer

        self.recorder = Recorder()
        self.ticks, self.last, self.dt = frame_ticks(ticks), ticks - 1, dt
        self.origin, self.stroke = np.asarray(origin, dtype=np.float64), stroke
        self._here = self.origin
        self._viewer, self._animation = Visualizer(window=self.recorder), Animation(default_framerate=1.0 / dt)
        for path in ("/Grid", "/Axes"):
            self._viewer[path].set_property("visible", False)
        self._viewer["/Background"].set_property("top_color", [0.97, 0.97, 0.98])
        self._viewer["/Background"].set_property("bottom_color", [0.86, 0.88, 0.90])
        # Only lights without a range: the default point lights fade within ten metres.
        for name in ("PointLightNegativeX", "PointLightPositiveX"):
            self._viewer[f"/Lights/{name}"].set_property("visible", False)
        self._viewer["/Lights/AmbientLight/<object>"].set_property("intensity", 0.72)
        self._viewer["/Lights/FillLight/<object>"].set_property("intensity", 0.4)
        self._viewer["/Lights/FillLight/<object>"].set_property("position", [-0.5, -0.35, 1.0])

    # ------------------------------------------------------------------- objects

    def mesh(self, path: str, mesh: Mesh, colour: str, *, lit: bool = False, opacity: float = 1.0) -> None:
        """Send a mesh, drawn in its own colour whatever the light unless it is lit."""
        from meshcat.geometry import MeshBasicMaterial, MeshLambertMaterial, TriangularMeshGeometry

        material = MeshLambertMaterial if lit else MeshBasicMaterial
        vertices, faces = mesh
        self._send(path, TriangularMeshGeometry(vertices - self._here, faces), material, colour, opacity)

    def points(self, path: str, points: Array, colour: str, pixels: float) -> None:
        """Send points (n, 3) [m] of a size on the screen."""
        from meshcat.geometry import GenericMaterial, Points, PointsGeometry

        material = GenericMaterial(color=rgb(colour), size=pixels, sizeAttenuation=False)
        material._type = "PointsMaterial"  # meshcat's own insists on a colour per point
        self._viewer[path].set_object(Points(PointsGeometry((points - self._here).T.astype(np.float32)), material))

    def lines(self, path: str, lines: Array, colour: str) -> None:
        """Send straight lines (n, 2, 3) [m], hair-thin."""
        from meshcat.geometry import LineBasicMaterial, LineSegments, PointsGeometry

        points = (lines.reshape(-1, 3) - self._here).T.astype(np.float32)
        material = LineBasicMaterial(color=rgb(colour), transparent=True, opacity=0.55)
        self._viewer[path].set_object(LineSegments(PointsGeometry(points), material))

    @contextmanager
    def around(self) -> Iterator[None]:
        """Place what is sent meanwhile around the origin of something that moves."""
        self._here = np.zeros(3)
        yield
        self._here = self.origin

    def place(self, path: str, matrix: Array) -> None:
        """Put an object somewhere, for good (4, 4) [m]."""
        self._viewer[path].set_transform(matrix)

    def delete(self, path: str) -> None:
        """Take an object, and what lies below it, away."""
        self._viewer[path].delete()

    def _send(self, path: str, shape: Any, material: Any, colour: str, opacity: float = 1.0) -> None:
        extra = {"depthWrite": False} if opacity < 1.0 else {}  # what lies behind shows through
        self._viewer[path].set_object(shape, material(color=rgb(colour), opacity=opacity, **extra))

    # ------------------------------------------------------------------- time

    def key(self, path: str, tick: int, **properties: ArrayLike | bool) -> None:
        """Animate an object: at a tick its position [m], its quaternion (w, x, y, z), its scale, or whether visible."""
        target = self._animation.at_frame(self._viewer[path], tick)
        for name, value in properties.items():
            if name == "position":
                value = np.asarray(value) - self._here
            plain: Any = value if isinstance(value, bool) else np.asarray(value).tolist()
            if name == "quaternion":
                plain = [*plain[1:], plain[0]]  # three.js puts w last
            target.set_property(name, _KINDS[name], plain)

    def appear(self, path: str, begin: int, end: int | None = None) -> None:
        """Show an object from one tick to another (or for good).

        The track holds its first key backwards, hence the key at 0; the key at the very end makes all tracks equally
        long, which lets the viewer stop and restart them together.
        """
        keys = {0: False, begin: True}
        if end is not None:
            keys[end] = False
        keys.setdefault(self.last, end is None)
        for tick, visible in keys.items():
            self.key(path, tick, visible=visible)

    def turns(self) -> Iterator[tuple[int, int | None]]:
        """Ticks shown, each with the one that follows; None after the last."""
        return zip(self.ticks.tolist(), [*self.ticks[1:].tolist(), None], strict=True)

    def pieces(self) -> Iterator[tuple[int, int]]:
        """First and last tick of the pieces of a way that is to appear bit by bit."""
        stride = max(1, math.ceil(self.last / _PIECES))
        for begin in range(0, self.last, stride):
            yield begin, min(begin + stride, self.last)

    def play(self) -> None:
        """Send the animation."""
        self._viewer.set_animation(self._animation, play=True, repetitions=1)


def page_text(data: dict[str, Any], commands: list[str], *, connect: str = "", live: str = "") -> str:
    """The page around what is known and sent.

    Args:
        data: what its script knows.
        commands: to the viewer, as text.
        connect: a directive of its policy, for a page that is to be told more.
        live: the script that listens.
    """
    parts = {
        "CONNECT": connect,
        "LIVE": live,
        # Names from outside cannot end the script: no "<" is left in it.
        "DATA": json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"),
        "COMMANDS": json.dumps(commands, indent=0),
        "VIEWER": viewer_script(),
    }
    text = resources.files("unifg.view").joinpath("page.html").read_text(encoding="utf-8")
    return re.sub("@@([A-Z]+)@@", lambda found: parts[found[1]], text)  # in one pass: parts may hold such words, too
