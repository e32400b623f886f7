"""Content of a scene, before it is shown."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from unifg.errors import ViewError
from unifg.style.colours import rgb
from unifg.typing import Array
from unifg.view.bodies import Part
from unifg.view.page import Key, Label, Plot, View
from unifg.view.things import Layer, Thing

__all__ = ["Body", "Content", "Placement", "Shot"]

_PALETTE = ("robot", "landmark", "horizon", "estimate", "moving", "trail", "odometry", "plan")
_RESERVED = re.compile(r"[%/<>\x00-\x1f\ud800-\udfff]")


@dataclass(frozen=True)
class Placement:
    """Place of a body: position (3,) [m], attitude (w, x, y, z), and scale along its axes."""

    position: Array
    attitude: Array
    scale: Array


@dataclass
class Body:
    """Something rigid that frames place.

    Attributes:
        parts: its meshes.
        reach: radius of a ball around its origin that holds it [m].
    """

    parts: Sequence[Part]
    reach: float


class Shot:
    """One frame.

    Attributes:
        number: in the order of making.
        things: seen in this frame, by layer.
        placed: bodies, by name.
        trails: a place (3,) [m] of each way that grows.
        texts: of readouts, each with whether it is an alarm.
        values: that are plotted.
    """

    def __init__(self, number: int) -> None:
        """Hold nothing."""
        self.number = number
        self.things: dict[str, Thing] = {}
        self.placed: dict[str, Placement] = {}
        self.trails: dict[str, Array] = {}
        self.texts: dict[str, tuple[str, bool]] = {}
        self.values: dict[str, float] = {}


class Content:
    """A whole scene.

    Attributes:
        title: of the page.
        dt: time between two frames [s]; None where they are merely counted.
        counts: what is counted then, such as "iteration".
        outcome: a word below the title, green where ``good``.
        facts: names and values, below that; empty values are left out.
        shots: the frames.
        views: of the camera, the first one at the start; by default some that suit what is there.
        labels: words in the picture.
        numbers: what is counted, one per frame; None for 0, 1, ...
        speeds: to choose from where time passes.
        whole: whether the view of everything holds every frame, or only the last one and what stays.
        around: (n, 3) places that a view of everything must hold [m]; None for all that is drawn.
        ground: whether lines on the ground give the scale.
        things: what stays, by layer.
        layers: everything drawn, by name.
        bodies: what frames may place.
        readouts: names of the lines of the panel, in order.
        plots: how numbers are plotted.
        flat_trails: which ways that grow lie in the plane.
        ellipses: middle, half axes and direction of ellipses when they last changed, and how that was placed.
        watchers: to be told of each frame that is done.
    """

    def __init__(self, title: str, dt: float | None, counts: str) -> None:
        """Begin with nothing."""
        self.title, self.dt, self.counts = title, dt, counts
        self.outcome, self.good = "", True
        self.facts: dict[str, str] = {}
        self.shots: list[Shot] = []
        self.views: list[View] = []
        self.labels: list[Label] = []
        self.numbers: list[int] | None = None
        self.speeds: tuple[float, ...] = (0.25, 0.5, 1, 2, 4, 8)
        self.whole = self.ground = True
        self.around: Array | None = None
        self.things: dict[str, Thing] = {}
        self.layers: dict[str, Layer] = {}
        self.bodies: dict[str, Body] = {}
        self.readouts: dict[str, None] = {}
        self.plots: dict[str, Plot] = {}
        self.flat_trails: dict[str, bool] = {}
        self.ellipses: dict[str, tuple[Array, Placement]] = {}
        self.watchers: list[Callable[[Shot], None]] = []
        self.lock = threading.RLock()

    def layer(
        self, name: str, swatch: str, colour: str | None, legend: str | None, width: float | None = None
    ) -> Layer:
        """The layer of a name; a new one gets a line of the legend, in the order of making.

        Args:
            name: of everything drawn in it.
            swatch: of its line: disc, ghost, ring, line, thin, dots, block, flag, arrow or axes.
            colour: of it; None for the next of a palette.
            legend: words; None for the name, empty for no line; layers with the same words share a line.
            width: of lines where they are not given one [m].

        Raises:
            ViewError: the name is empty, or there is no such colour.
        """
        if not name:
            raise ViewError("a name is empty: it is the line of the legend")
        with self.lock:
            layer = self.layers.get(name)
            if layer is None:
                chosen = colour or _PALETTE[len(self.layers) % len(_PALETTE)]
                rgb(chosen)
                path = _RESERVED.sub(lambda found: f"%{ord(found[0]):02x}", name)
                text = name if legend is None else legend
                key = next((one.key for one in self.layers.values() if one.key and one.key.text == text), None)
                if key is not None:
                    key.parts.append(path)
                elif text:
                    key = Key(chosen, swatch, text, [path])
                layer = self.layers[name] = Layer(path, len(self.layers) + 1, key, chosen, width)
        return layer
