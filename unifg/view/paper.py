"""A frame of a scene on axes of matplotlib: from above, or in space on three-dimensional ones.

What is drawn is what a browser is sent; what lies higher hides what lies below it.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np

from unifg.errors import ViewError
from unifg.lie import SO3
from unifg.style.colours import css
from unifg.style.figures import ground as set_ground
from unifg.style.figures import word
from unifg.typing import Array, Axes
from unifg.view.content import Content, Shot
from unifg.view.recording import ground_of, keys_of
from unifg.view.shapes import Mesh, copies
from unifg.view.things import MOST, Surface, draw_way

__all__ = ["draw_frame", "draw_shot"]

_FACES = 50_000  # triangles in space, from which on they are not made smaller
_SIDE = 30.0  # longest side of a triangle in space, over half the width of a line
_DOT = 0.55  # size of a dot in points, over its pixels
_MARK: dict[str, Any] = {"ls": "none", "marker": "o"}
_SWATCHES: dict[str, dict[str, Any]] = {
    "line": {"lw": 2.0}, "thin": {"lw": 0.9}, "disc": _MARK, "ghost": {**_MARK, "alpha": 0.45},
    "ring": {**_MARK, "mfc": "none"}, "dots": {**_MARK, "ms": 3.0}, "block": {**_MARK, "marker": "s"},
    "flag": {**_MARK, "marker": ">"}, "arrow": {**_MARK, "marker": ">"}, "axes": {**_MARK, "marker": "+"},
}  # fmt: skip
"""Swatch of a legend to the style of a line."""


class Paper:
    """Axes that take what a stage takes.

    Attributes:
        stroke: half the width of a line that is to be seen well [m].
    """

    def __init__(self, ax: Any, stroke: float) -> None:
        """Draw on axes; those with three dimensions hide by the distance from the eye, by means of :meth:`finish`."""
        self.stroke, self._ax, self._spatial = stroke, ax, ax.name == "3d"
        self._faces, self._colours = list[Array](), list[Array]()

    def mesh(self, path: str, mesh: Mesh, colour: str, *, lit: bool = False, opacity: float = 1.0) -> None:
        """Draw the triangles of a mesh in one colour."""
        from matplotlib.collections import PolyCollection
        from matplotlib.colors import to_rgba

        triangles, shade = mesh[0][mesh[1]], to_rgba(css(colour), opacity)
        if self._spatial:
            self._faces.append(triangles)
            self._colours.append(np.tile(shade, (len(triangles), 1)))
            return
        sides = np.diff(triangles[..., :2], axis=1)
        seen = np.abs(sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]) > 0.0  # else upright
        edge: dict[str, Any] = {"edgecolors": "none"} if opacity < 1.0 else {"edgecolors": [shade], "linewidths": 0.5}
        order, faces = _order(triangles), list(triangles[seen, :, :2])
        self._ax.add_collection(PolyCollection(faces, facecolors=[shade], zorder=order, **edge), autolim=False)

    def points(self, path: str, points: Array, colour: str, pixels: float) -> None:
        """Draw dots (n, 3) [m]."""
        places = points.T if self._spatial else points.T[:2]
        self._ax.plot(
            *places, ls="none", marker="o", mew=0.0, ms=_DOT * pixels, color=css(colour), zorder=_order(points)
        )

    def lines(self, path: str, lines: Array, colour: str) -> None:
        """Draw thin straight lines (n, 2, 3) [m]."""
        style: dict[str, Any] = {"colors": css(colour), "linewidths": 0.6, "alpha": 0.55}
        if self._spatial:
            self._ax.add_collection3d(_art3d().Line3DCollection(lines, **style))
        else:
            from matplotlib.collections import LineCollection

            self._ax.add_collection(LineCollection(list(lines[..., :2]), zorder=_order(lines), **style), autolim=False)

    def finish(self) -> None:
        """Draw the meshes of a picture in space: small triangles, so that the farther ones can be drawn first."""
        if self._faces:
            faces, shades = np.concatenate(self._faces), np.concatenate(self._colours)
            sides = np.linalg.norm(np.roll(faces, -1, axis=1) - faces, axis=2)
            while len(faces) < _FACES and (long := sides.max(axis=1) > _SIDE * self.stroke).any():
                order = (sides[long].argmax(axis=1)[:, None] + np.arange(3)) % 3
                begin, end, tip = np.take_along_axis(faces[long], order[..., None], axis=1).transpose(1, 0, 2)
                middle = 0.5 * (begin + end)
                halves = [np.stack(half, axis=1) for half in ((begin, middle, tip), (middle, end, tip))]
                faces = np.concatenate([faces[~long], *halves])
                shades = np.concatenate([shades[~long], shades[long], shades[long]])
                sides = np.linalg.norm(np.roll(faces, -1, axis=1) - faces, axis=2)
            style = {"facecolors": shades, "edgecolors": "none", "antialiaseds": False}
            self._ax.add_collection3d(_art3d().Poly3DCollection(faces, **style))


def draw_frame(content: Content, ax: Axes, frame: int = -1) -> Axes:
    """Draw a frame of a scene on axes, with what stays, ways as they have grown until then, labels and extent.

    Args:
        content: of the scene.
        ax: axes; those with three dimensions show it in space.
        frame: which.

    Raises:
        ViewError: nothing is drawn, or there is no such frame.
    """
    shots = content.shots or [Shot(0)]
    if frame not in range(-len(shots), len(shots)):
        raise ViewError(f"there is no frame {frame!r}: the scene has {len(shots)}, counted from 0 or backwards from -1")
    shots = shots[: frame % len(shots) + 1]
    shot, ground = shots[-1], ground_of(content, shots)
    paper = Paper(ax, ground.stroke)
    for name, thing in content.things.items():
        thing.put(paper, name, MOST, content.layers[name])
    draw_shot(paper, content, shots)
    paper.finish()
    for key in keys_of(content, [shot]):
        ax.plot([], [], color=css(key.colour), label=key.text, **_SWATCHES[key.shape])
    for label in content.labels:
        followed = shot.placed.get(label.follows or "")
        place = label.at if followed is None else followed.position
        if place is not None and ax.name != "3d":
            offset, side = ((0, -7), "top") if followed is None else ((0, 7), "bottom")
            word(ax, np.asarray(place), label.text, offset, va=side, fontsize=8)
    margin = 0.02 * ground.size
    low, high = ground.low - margin, ground.high + margin
    if ax.name == "3d":
        low[2] = min(low[2], high[2] - 0.1 * ground.size)
        space: Any = ax
        space.set(zlim=(low[2], high[2]), zlabel="z [m]", box_aspect=high - low)
        for axis, share in zip("xyz", (high - low) / (high - low).max(), strict=True):
            space.locator_params(axis=axis, nbins=max(1, round(6 * float(share))))  # short axes have little room
    set_ground(ax, low[:2], high[:2])
    return ax


def draw_shot(surface: Surface, content: Content, shots: list[Shot]) -> None:
    """Draw the last of some frames, with ways as they have grown until then and without what stays."""
    for name, thing in shots[-1].things.items():
        thing.put(surface, name, MOST, content.layers[name])
    for name, placed in shots[-1].placed.items():
        turn = SO3.to_matrix(placed.attitude) * placed.scale
        for part in content.bodies[name].parts:
            mesh = copies(part.mesh, placed.position[None], turn[None])
            surface.mesh(f"{name}/{part.name}", mesh, part.colour, lit=part.lit, opacity=part.opacity)
    for name, flat in content.flat_trails.items():
        places, layer = [past.trails[name] for past in shots if name in past.trails], content.layers[name]
        draw_way(surface, name, MOST, layer, points=np.array(places).reshape(-1, 3), flat=flat, width=layer.width)


def _art3d() -> Any:
    return import_module("mpl_toolkits.mplot3d.art3d")


def _order(places: Array) -> float:
    """Rank: what lies higher is drawn later, the floor before anything else that axes may hold."""
    height = float(places[..., 2].max())
    return 2.0 + height if height > 0.0 else -1.0
