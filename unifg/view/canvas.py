"""Drawing: on a scene, where it stays, or on one frame of it."""

from __future__ import annotations

import math

import numpy as np

from unifg.errors import ViewError
from unifg.files.ros_map import OccupancyMap
from unifg.models.distance_map import DistanceMap
from unifg.typing import Array, ArrayLike
from unifg.view import shapes, things
from unifg.view.content import Content, Placement, Shot
from unifg.view.members import finite
from unifg.view.page import Plot
from unifg.view.shapes import Mesh
from unifg.view.things import Thing

__all__ = ["Canvas", "Frame"]

# How many of each may stand in a file, over all its frames: some ten megabytes.
_WAYS, _TUBES, _DOTS, _MARKS, _OUTLINES = 100_000, 40_000, 200_000, 8_000, 4_000
_STILL = 0.02  # share of its half axis by which an ellipse moves or grows before it is placed anew
_HAIRS, _STRIPS = 300_000, 60_000


class Canvas:
    """Drawing common to a scene and a frame of it.

    Each method takes the name first: a line of the legend, which switches it off and on, and what tells later frames
    that it is the same thing. ``colour`` is a name of `unifg.style.colours.COLOURS` or ``#rrggbb``, by default the next
    of a palette; ``legend`` other words than the name, and no line where it is empty. Places with two columns lie in
    the plane, places with three in space. What is drawn twice under one name on one canvas replaces itself.
    """

    def __init__(self, content: Content, drawn: dict[str, Thing]) -> None:
        """Draw into a part of a scene."""
        self._content, self._drawn = content, drawn

    def way(
        self, name: str, points: ArrayLike, *, width: float | None = None, colour: str | None = None,
        legend: str | None = None,
    ) -> None:  # fmt: skip
        """A line through (n, 2) or (n, 3) places [m], of a width [m].

        Raises:
            ViewError: the shape is another, or a number is not finite.
        """
        places, flat = self._places(name, points)
        layer = self._content.layer(name, "line", colour, legend)
        given = {"points": places, "flat": flat, "width": width or layer.width}
        self._drawn[name] = Thing(things.draw_way, given, places, len(places), _WAYS if flat else _TUBES)

    def points(
        self, name: str, points: ArrayLike, *, pixels: float = 7.0, colour: str | None = None,
        legend: str | None = None,
    ) -> None:  # fmt: skip
        """Dots at (n, 2) or (n, 3) places [m], as large on the screen from near and far.

        Raises:
            ViewError: the shape is another, or a number is not finite.
        """
        places, flat = self._places(name, points)
        self._content.layer(name, "dots", colour, legend)
        given = {"points": places, "flat": flat, "pixels": pixels}
        self._drawn[name] = Thing(things.draw_points, given, places, len(places), _DOTS)

    def lines(
        self, name: str, lines: ArrayLike, *, width: float | None = None, colour: str | None = None,
        legend: str | None = None,
    ) -> None:  # fmt: skip
        """Straight lines (n, 2, 2) or (n, 2, 3) [m], hair-thin unless they are given a width [m].

        Raises:
            ViewError: the shape is another, or a number is not finite.
        """
        ends = np.asarray(lines, dtype=np.float64)
        if ends.ndim != 3 or ends.shape[1] != 2 or ends.shape[2] not in (2, 3):
            raise ViewError(f"'{name}': lines are (n, 2, 2) or (n, 2, 3) [m], found {ends.shape}")
        finite(name, ends, "line")
        places, flat = self._places(name, ends.reshape(-1, ends.shape[2]))
        layer = self._content.layer(name, "thin" if width is None else "line", colour, legend)
        given = {"lines": places.reshape(-1, 2, 3), "flat": flat, "width": width or layer.width}
        most = _HAIRS if width is None else _STRIPS
        self._drawn[name] = Thing(things.draw_segments, given, places, len(ends), most)

    def poses(
        self, name: str, poses: ArrayLike, *, length: float | None = None, colour: str | None = None,
        legend: str | None = None,
    ) -> None:  # fmt: skip
        """Arrows at (n, 3) poses in the plane, or axes at (n, 7) poses in space, of a length [m].

        Args:
            name: of the layer.
            poses: (x, y, theta) [m, m, rad], or position [m] and unit quaternion (w, x, y, z).
            length: of each mark; None suits it to the size of the scene.
            colour: of arrows; axes are red, green and blue.
            legend: words of the legend.

        Raises:
            ViewError: the shape is another, a number is not finite, or a quaternion has not unit length.
        """
        rows = _rows(name, poses, (3, 7), "pose", "poses are (n, 3) x, y, theta or (n, 7) position and quaternion")
        flat = rows.shape[1] == 3
        off = np.abs(np.linalg.norm(rows[:, 3:], axis=1) - 1.0) > 1e-6
        if not flat and off.any():
            k = int(np.argmax(off))
            raise ViewError(
                f"'{name}': the quaternion of pose {k}, {rows[k, 3:].tolist()}, has not unit length", index=k
            )
        self._content.layer(name, "arrow" if flat else "axes", colour, legend)
        draw, most = (things.draw_arrows, _MARKS) if flat else (things.draw_triads, _MARKS // 4)
        corners = shapes.on_ground(rows) if flat else rows[:, :3]
        self._drawn[name] = Thing(draw, {"poses": rows, "length": length}, corners, len(rows), most)

    def covariances(
        self, name: str, centres: ArrayLike, covariances: ArrayLike, *, sigmas: float = 3.0, colour: str | None = None,
        legend: str | None = None,
    ) -> None:  # fmt: skip
        """Ellipses in the plane or ellipsoids in space: places that are so many standard deviations off.

        Args:
            name: of the layer.
            centres: (n, p) [m], p = 2 or 3.
            covariances: (n, p, p) [m^2], symmetric; directions without variance are drawn flat.
            sigmas: half axes in standard deviations.
            colour: of the outlines.
            legend: words of the legend.

        Raises:
            ViewError: shapes do not fit, a number is not finite, or a variance is negative beyond rounding.
        """
        places, flat = self._places(name, centres)
        size = 2 if flat else 3
        given_covariances = np.asarray(covariances, dtype=np.float64)
        if given_covariances.shape != (len(places), size, size):
            raise ViewError(
                f"'{name}': {len(places)} centres in {size} dimensions need covariances ({len(places)}, {size}, "
                f"{size}) [m^2], found {given_covariances.shape}"
            )
        finite(name, given_covariances, "covariance")
        variances, vectors = np.linalg.eigh(0.5 * (given_covariances + given_covariances.transpose(0, 2, 1)))
        wrong = variances.min(axis=1, initial=0.0) < -1e-9 * np.abs(variances).max(axis=1, initial=0.0)
        if wrong.any():
            k = int(np.argmax(wrong))
            raise ViewError(f"'{name}': covariance {k} has a negative variance, {variances[k].min():g} m^2", index=k)
        half = sigmas * np.sqrt(np.maximum(variances, 0.0))
        axes = np.einsum("nij,nj,nkj->nik", vectors, half, vectors)  # symmetric: it turns as little as can be
        self._content.layer(name, "ghost", colour, legend)
        given = {"centres": places, "axes": axes}
        largest = half.max(axis=1, initial=0.0)[:, None]
        corners = np.concatenate([places - largest, places + largest])
        if flat:
            corners[:, 2] = 0.0
        draw = things.draw_ellipses if flat else things.draw_ellipsoids
        slack = 0.01 * float(largest.max(initial=0.0))
        self._drawn[name] = Thing(draw, given, corners, len(places), _OUTLINES if flat else _OUTLINES // 4, slack)

    def discs(
        self, name: str, rows: ArrayLike, *, height: float = 0.0, base: float = 0.0, opacity: float = 1.0,
        colour: str | None = None, legend: str | None = None,
    ) -> None:  # fmt: skip
        """Discs (n, 3) x, y, radius [m] on the ground; with a height [m], upright cylinders from ``base`` up.

        Raises:
            ViewError: the shape is another, a number is not finite, or a radius below zero.
        """
        discs = _rows(name, rows, (3,), "disc", "discs are (n, 3) x, y, radius [m]")
        if (below := np.flatnonzero(discs[:, 2] < 0.0)).size:
            k = int(below[0])
            raise ViewError(f"'{name}': disc {k} has a radius of {discs[k, 2]:g} m", index=k)
        self._content.layer(name, "disc" if opacity == 1.0 else "ghost", colour, legend)
        given = {"rows": discs, "height": height, "base": base, "opacity": opacity}
        low, high = discs - discs[:, 2:], discs + discs[:, 2:]
        low[:, 2], high[:, 2] = base, base + height
        self._drawn[name] = Thing(things.draw_discs, given, np.concatenate([low, high]), len(discs), 4 * _MARKS)

    def boxes(
        self, name: str, poses: ArrayLike, sizes: ArrayLike, *, opacity: float = 1.0, colour: str | None = None,
        legend: str | None = None,
    ) -> None:  # fmt: skip
        """Boxes around their middles.

        Args:
            name: of the layer.
            poses: (n, 3) places [m], the boxes along the axes; or (n, 7) positions and quaternions (w, x, y, z).
            sizes: (3,) or (n, 3) lengths of their edges [m].
            opacity: 1 hides what is behind.
            colour: of all of them.
            legend: words of the legend.

        Raises:
            ViewError: a shape is another, or a number is not finite.
        """
        rows = _rows(name, poses, (3, 7), "box", "boxes stand at (n, 3) places or (n, 7) poses")
        edges = np.asarray(sizes, dtype=np.float64)
        if edges.shape not in ((3,), (len(rows), 3)):
            raise ViewError(f"'{name}': sizes are (3,) or ({len(rows)}, 3) [m], found {edges.shape}")
        edges = np.broadcast_to(edges, (len(rows), 3)).copy()
        finite(name, edges, "size")
        if rows.shape[1] == 3:
            rows = np.column_stack([rows, np.tile([1.0, 0.0, 0.0, 0.0], (len(rows), 1))])
        self._content.layer(name, "block", colour, legend)
        given = {"poses": rows, "sizes": edges, "opacity": opacity}
        half = 0.5 * np.linalg.norm(edges, axis=1)[:, None]
        corners = np.concatenate([rows[:, :3] - half, rows[:, :3] + half])
        self._drawn[name] = Thing(things.draw_boxes, given, corners, len(rows), _MARKS)

    def map(self, name: str, occupancy: OccupancyMap | DistanceMap, *, height: float = 0.6,
            legend: str | None = None) -> None:  # fmt: skip
        """A map as floor and walls of a height [m]; of a distance map, walls where the distance is not positive.

        Raises:
            ViewError: it is neither an occupancy map nor a distance map.
        """
        if isinstance(occupancy, DistanceMap):
            inside = occupancy.values <= 0.0
            occupancy = OccupancyMap(inside, ~inside, occupancy.resolution, occupancy.origin)
        if not isinstance(occupancy, OccupancyMap):
            raise ViewError(
                f"'{name}' is no map but {type(occupancy).__name__}: give what unifg.files.ros_map.load_map returns, "
                "or a unifg.models.distance_map.DistanceMap"
            )
        corners = shapes.known_corners(occupancy)
        box = np.concatenate([np.column_stack([corners, np.full(4, z)]) for z in (0.0, height)])
        self._content.layer(name, "block", "wall", legend)
        given = {"occupancy": occupancy, "height": height}
        self._drawn[name] = Thing(things.draw_walls, given, box)

    def mesh(
        self, name: str, mesh: Mesh, *, lit: bool = False, opacity: float = 1.0, swatch: str = "block",
        colour: str | None = None, legend: str | None = None,
    ) -> None:  # fmt: skip
        """Triangles, as made by `unifg.view.shapes`: vertices (n, 3) [m] and faces (m, 3).

        Raises:
            ViewError: a vertex is not finite, or a face is not three numbers of vertices.
        """
        vertices, faces = np.asarray(mesh[0], dtype=np.float64), np.asarray(mesh[1])
        finite(name, vertices, "vertex")
        whole = faces.ndim == 2 and faces.shape[1] == 3 and faces.dtype.kind in "iu"
        if not whole or (faces.size and not 0 <= faces.min() <= faces.max() < len(vertices)):
            raise ViewError(f"'{name}': faces are (m, 3) numbers of its {len(vertices)} vertices, from 0")
        self._content.layer(name, swatch, colour, legend)
        given = {"mesh": mesh, "lit": lit, "opacity": opacity}
        self._drawn[name] = Thing(things.draw_mesh, given, np.stack([vertices.min(axis=0), vertices.max(axis=0)]))

    def colour(self, name: str) -> str:
        """Colour of a layer."""
        return self._content.layers[name].colour

    def _places(self, name: str, points: ArrayLike) -> tuple[Array, bool]:
        """(n, 3) places, and whether they lie in the plane."""
        rows = _rows(name, points, (2, 3), "place", "places are (n, 2) or (n, 3) [m]")
        flat = rows.shape[1] == 2
        return (shapes.on_ground(rows) if flat else rows), flat


def _rows(name: str, values: ArrayLike, columns: tuple[int, ...], what: str, said: str) -> Array:
    """A copy (n, m) of finite values, m among ``columns``; nothing has the columns that it has, or the first number.

    Raises:
        ViewError: the shape is another than ``said``, or a number is not finite; the message names ``what`` it is of.
    """
    rows = np.atleast_2d(np.array(values, dtype=np.float64))
    if rows.size == 0:
        rows = np.zeros((0, rows.shape[-1] or columns[0]))
    if rows.ndim != 2 or rows.shape[1] not in columns:
        raise ViewError(f"'{name}': {said}, found {np.shape(values)}")
    finite(name, rows, what)
    return rows


class Frame(Shot, Canvas):
    """Content of one frame; made by :meth:`Scene.frame`.

    As a context it is shown, live, when the block ends.
    """

    def __init__(self, content: Content, number: int) -> None:
        """Hold nothing."""
        Shot.__init__(self, number)
        Canvas.__init__(self, content, self.things)

    def place(self, name: str, pose: ArrayLike, *, scale: ArrayLike = (1.0, 1.0, 1.0)) -> None:
        """Put a body of the scene somewhere; a frame that does not place it does not show it.

        Args:
            name: given to :meth:`Scene.body`.
            pose: (3,) x, y, theta on the ground, or (7,) position and quaternion (w, x, y, z).
            scale: (3,) by which it is stretched along its own axes.

        Raises:
            ViewError: there is no such body, or the pose has another shape or is not finite.
        """
        if name not in self._content.bodies:
            known = ", ".join(f"'{body}'" for body in self._content.bodies) or "none"
            raise ViewError(f"there is no body '{name}' (there are: {known}): make it by scene.body('{name}', ...)")
        row = np.array(pose, dtype=np.float64)
        if row.shape not in ((3,), (7,)):
            raise ViewError(f"'{name}': a body is placed at (3,) x, y, theta or (7,) poses, found {row.shape}")
        finite(name, row[None], "pose")
        stretch = np.broadcast_to(np.asarray(scale, dtype=np.float64), (3,))
        if len(row) == 3:
            half = 0.5 * row[2]
            row = np.array([row[0], row[1], 0.0, math.cos(half), 0.0, 0.0, math.sin(half)])
        self.placed[name] = Placement(row[:3], row[3:], stretch)

    def ellipse(
        self, name: str, middle: ArrayLike, covariance: ArrayLike, *, sigmas: float = 3.0, z: float = 0.0
    ) -> None:
        """Stretch a body of radius 1 to the ellipse of a covariance: cheaper than to draw it anew in every frame.

        Args:
            name: of the body, usually of the kind "ellipse".
            middle: (2,) [m].
            covariance: (2, 2) [m^2].
            sigmas: half axes in standard deviations.
            z: height [m].

        Raises:
            ViewError: there is no such body, or a number is not finite.
        """
        place, spread = np.asarray(middle, dtype=np.float64), np.asarray(covariance, dtype=np.float64)
        if place.shape != (2,) or spread.shape != (2, 2):
            raise ViewError(
                f"'{name}': an ellipse has a middle (2,) and a covariance (2, 2), found {place.shape}, {spread.shape}"
            )
        finite(name, place[None], "middle")
        finite(name, spread[None], "covariance")
        long, short, direction = shapes.ellipse_axes(spread, sigmas)
        before = self._content.ellipses.get(name)
        if before is not None:
            values = before[0]
            moved = float(np.abs(place - values[:2]).max()) / max(values[2], 1e-6)
            grown = np.abs(np.array([long, short]) - values[2:4]).max() / max(values[2], 1e-6)
            if name in self._content.bodies and max(moved, grown) < _STILL:
                self.placed[name] = before[1]  # it would only tremble
                return
            # A direction and its opposite are the same: the nearer one, lest the ellipse spin.
            last = float(values[4])
            direction = last + (direction - last + math.pi / 2.0) % math.pi - math.pi / 2.0
        half = 0.5 * direction
        pose = [*place.tolist(), z, math.cos(half), 0.0, 0.0, math.sin(half)]
        self.place(name, pose, scale=(max(long, 1e-6), max(short, 1e-6), 1.0))
        self._content.ellipses[name] = np.array([*place, long, short, direction]), self.placed[name]

    def trail(self, name: str, place: ArrayLike, *, colour: str | None = None, legend: str | None = None) -> None:
        """A place (2,) or (3,) [m] of a way that grows from frame to frame and stays.

        Raises:
            ViewError: the shape is another, or a number is not finite.
        """
        places, _ = self._places(name, np.asarray(place, dtype=np.float64)[None])
        self._content.layer(name, "line", colour, legend)
        self._content.flat_trails.setdefault(name, np.size(place) == 2)
        self.trails[name] = places[0]

    def readout(self, name: str, text: str, *, alarm: bool = False) -> None:
        """A line of the panel; red where it is an alarm."""
        self._content.readouts.setdefault(name)
        self.texts[name] = text, alarm

    def value(self, name: str, value: float) -> None:
        """A number that the strip below the picture plots over the frames; NaN leaves a gap."""
        if name not in self._content.plots:
            self._content.plots[name] = Plot(name)
        self.values[name] = float(value)

    def __enter__(self) -> Frame:
        """Itself."""
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        """Show it, where somebody watches; a frame that was given up is none."""
        if kind is None:
            for watcher in list(self._content.watchers):
                watcher(self)
        elif self in self._content.shots:
            self._content.shots.remove(self)
