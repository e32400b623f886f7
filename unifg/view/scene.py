"""A scene: what stays, what each frame holds, the words beside it; saved as a page of its own, or shown live.

``Scene.of(solution, x).save("scene.html")`` looks at a solution. A scene of one's own is made by the same methods: what
is drawn on the `Scene` stays, what is drawn on a `Frame` is seen while its turn lasts, and a body is placed anew in
every frame.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from unifg.atomic_write import write_atomically
from unifg.errors import ViewError, require_positive
from unifg.modeling.variables import Family, Variable
from unifg.solution.solution import Solution
from unifg.style.colours import rgb
from unifg.style.figures import new_axes
from unifg.typing import Array, ArrayLike, Axes
from unifg.view.bodies import Part, body_of
from unifg.view.canvas import Canvas, Frame
from unifg.view.content import Body, Content
from unifg.view.live import Live
from unifg.view.members import Position
from unifg.view.page import Label, Plot, View
from unifg.view.paper import draw_frame
from unifg.view.recording import recorded
from unifg.view.solutions import Recipe, recipe_of

__all__ = ["Scene"]

OVER = ("solutions", "iterates", "members")
_SIZE = 0.05  # of a body that goes along a way, over the size of that way


class Scene(Content, Canvas):
    """Things, bodies and frames, with a page around them.

    Attributes:
        title: of the page.
        outcome: a word below the title, green where ``good``, otherwise red.
        facts: names and values, below that; empty values are left out.
        whole: whether the view of everything holds every frame, or only the last one and what stays.
        ground: whether lines on the ground give the scale, where there is no map.
        numbers: what is counted where no time passes, one per frame; None for 0, 1, ...
        speeds: to choose from where time passes.
    """

    def __init__(
        self, title: str = "unifg", *, dt: float | None = None, counts: str = "frame", keep: int | None = None
    ) -> None:
        """Begin with nothing.

        Args:
            title: of the page.
            dt: time between two frames [s]; None where they are merely counted.
            counts: what is counted then.
            keep: at most so many frames, the latest ones; None for all.

        Raises:
            ViewError: dt or keep is not positive.
        """
        require_positive("the time between two frames", ViewError, dt=1.0 if dt is None else dt)
        if keep is not None and keep < 1:
            raise ViewError(f"keep={keep!r}: at least one frame must be kept")
        Content.__init__(self, title, dt, counts)
        Canvas.__init__(self, self, self.things)
        self._keep, self._made = keep, 0
        self._recipe: Recipe | None = None

    @classmethod
    def of(
        cls,
        solution: Solution | Sequence[Solution],
        *shown: Variable,
        over: str = "solutions",
        dt: float | None = None,
        sigmas: float | None = None,
        terms: Sequence[str] = (),
        position: Position | None = None,
        body: str | Mapping[Family, str] | None = None,
        size: float | None = None,
        title: str = "unifg",
        keep: int | None = None,
    ) -> Scene:
        """Look at one solution or several of one graph.

        Families on SE2 and SE3 are drawn as poses joined by a way, those on R^2 and R^3 as points; of a product, name
        the component that has a place, as ``x.pose``.

        Args:
            solution: one, or one for each frame.
            shown: families or parts of them; none for all poses or, where there are none, all points.
            over: what the slider counts: "solutions"; "iterates", those of one solution solved with
                ``keep_values=True``; "members", a body that goes along the members of one solution.
            dt: time between two frames [s]: between two solutions or two members; None counts them.
            sigmas: half axes of the ellipses or ellipsoids that show the marginal covariance of every member, in
                standard deviations; None leaves them out. They are those of the solution, not of its iterates.
            terms: names of terms whose factors are drawn as lines between the variables they touch.
            position: takes the values (n, storage) of members that are neither poses nor points and returns (n, 2) or
                (n, 3) places [m], or (n, 7) positions and quaternions (w, x, y, z).
            body: with "members": "arrow", "axes", "ball", "disc", "car" or "quadrotor", for all families or by family.
            size: of the bodies [m]; None suits it to the way.
            title: of the page.
            keep: at most so many frames, the latest ones.

        Returns:
            A scene, to be drawn on, saved, or shown live and added to.

        Raises:
            ViewError: there is no solution; a family has no place; a value is not finite; iterates were not kept.
            GraphError: a family or term is not of this graph, or there is no covariance.
        """
        solutions = [solution] if isinstance(solution, Solution) else list(solution)
        if not solutions:
            raise ViewError("there is no solution to look at: give one, or a list of them")
        if over not in OVER:
            raise ViewError(f"over={over!r}: the slider counts one of {', '.join(OVER)}")
        if over != "solutions" and len(solutions) > 1:
            raise ViewError(f'over="{over}" looks at one solution, found {len(solutions)}')
        first = solutions[0]
        recipe = recipe_of(first, shown, sigmas, terms, position)
        scene = cls(title, dt=None if over == "iterates" else dt, counts={"iterates": "iteration", "members": "member",
                    "solutions": "solution"}[over], keep=keep)  # fmt: skip
        if over == "iterates":
            scene._iterates(first, recipe)
        elif over == "members":
            scene._members(first, recipe, body, size)
        else:
            scene._recipe = recipe
            scene.plot("solve time", unit="ms", log=True)
            for one in solutions:
                scene.add(one)
        if over != "solutions":
            scene.outcome, scene.good = first.status.value, first.converged
            scene.facts |= {"solver": first.solver, "iterations": str(first.iterations), "cost": f"{first.cost:.6g}"}
        return scene

    # ------------------------------------------------------------------- making

    def frame(self) -> Frame:
        """A further frame, to be drawn on."""
        with self.lock:
            made = Frame(self, self._made)
            self._made += 1
            self.shots.append(made)
            if self._keep is not None:
                del self.shots[: -self._keep]
        return made

    def add(self, solution: Solution) -> Frame:
        """A further frame that shows a solution as the one this scene was made of, live where somebody watches.

        Raises:
            ViewError: the scene was not made by `Scene.of` with ``over="solutions"``.
        """
        if self._recipe is None:
            raise ViewError('only a scene made by Scene.of(solution, ..., over="solutions") knows what to draw of it')
        with self.frame() as made:
            self._recipe.draw(made, solution.values, solution, solution)
            self._recipe.tell(made, solution)
        if len(self.shots) == 1:
            self.outcome, self.good = solution.status.value, solution.converged
        elif self._made == 2:
            self.outcome = ""  # it was that of the first
        return made

    def body(
        self, name: str, kind: str | Iterable[Part] = "arrow", *, size: float = 1.0, colour: str | None = None,
        swatch: str = "disc", legend: str | None = None,
    ) -> None:  # fmt: skip
        """Something rigid that frames place.

        Args:
            name: of the layer.
            kind: "arrow", "axes", "disc" (a round robot), "car", "quadrotor", or meshes of one's own.
            size: length of an arrow, of axes or of a car, radius of a disc or of a quadrotor [m].
            colour: of the body.
            swatch: of the legend.
            legend: words of the legend; bodies with the same words share a line, which switches all of them.

        Raises:
            ViewError: there is no such kind, or the size is not positive.
        """
        layer = self.layer(name, swatch, colour, legend)
        parts = body_of(kind, size, layer.colour) if isinstance(kind, str) else list(kind)
        reach = max(float(np.linalg.norm(part.mesh[0], axis=1).max()) for part in parts)
        self.bodies[name] = Body(parts, reach)

    def plot(
        self, name: str, *, unit: str = "", log: bool = False, limit: float | None = None, colour: str = "robot"
    ) -> None:
        """Declare how a number is plotted that frames give by :meth:`Frame.value`.

        Args:
            name: of the number.
            unit: of it.
            log: whether on a logarithmic axis.
            limit: a dashed line.
            colour: of the curve.

        Raises:
            ViewError: the limit is not finite, or there is no such colour.
        """
        if limit is not None and not np.isfinite(limit):
            raise ViewError(f"the limit of the plot '{name}' is {limit}: leave it out")
        rgb(colour)
        self.plots[name] = Plot(name, [], unit, log, limit, colour)

    def label(self, text: str, at: ArrayLike | None = None, *, follows: str | None = None, above: bool = False,
              minor: bool = False) -> None:  # fmt: skip
        """A word at a place (2,) or (3,) [m], or that goes along with a body; a minor one yields to those before it.

        Raises:
            ViewError: there is neither or both, or no such body.
        """
        if (at is None) == (follows is None):
            raise ViewError(f"label {text!r}: give either a place or a body to follow")
        if follows is not None and follows not in self.bodies:
            raise ViewError(f"label {text!r} follows '{follows}', which is no body of this scene")
        place = None if at is None else self._places(text, np.asarray(at, dtype=np.float64)[None])[0][0].tolist()
        self.labels.append(Label(text, place, follows, above, minor))

    def view(self, name: str, text: str, direction: Sequence[float], fov: float = 20.0, *, follows: str | None = None,
             distance: float = 0.0, ahead: Sequence[float] = (0.0, 0.0, 0.0)) -> None:  # fmt: skip
        """A button for the camera: from ``direction`` at everything, or at a body, from a distance [m].

        Args:
            name: in the address of a picture, ``#t=12.5&view=NAME``.
            text: of the button.
            direction: (3,) from what is looked at to the camera.
            fov: vertical angle of view [deg].
            follows: the body to go along with.
            distance: from it [m].
            ahead: (3,) of it, the place in the middle of the picture [m].

        Raises:
            ViewError: there is no such body, or the camera looks from nowhere.
        """
        numbers = np.array([*direction, *ahead, fov, distance])
        if len(numbers) != 8 or not np.isfinite(numbers).all() or not np.any(direction) or not 0.0 < fov < 180.0:
            raise ViewError(
                f"view '{name}': a direction other than zero and a place (3,), an angle between 0 and 180 degrees and "
                f"a distance are finite numbers, found {direction!r}, {ahead!r}, {fov!r} and {distance!r}"
            )
        if follows is not None and follows not in self.bodies:
            raise ViewError(f"view '{name}' follows '{follows}', which is no body of this scene")
        self.views.append(View(name, text, direction, fov, follows, distance, ahead))

    # ------------------------------------------------------------------- showing

    def html(self) -> str:
        """The page, which refers to no other file; the same scene gives the same text.

        Raises:
            ViewError: nothing is drawn, or meshcat is not installed.
        """
        return recorded(self)

    def draw(self, ax: Axes | None = None, frame: int = -1) -> Axes:
        """Draw a frame on axes of matplotlib: from above, or in space on axes with three dimensions.

        Args:
            ax: axes to draw on; None for new ones.
            frame: which, from 0 or backwards from -1; what stays is drawn with each.

        Returns:
            The axes; their legend names what is drawn.

        Raises:
            ViewError: nothing is drawn, or there is no such frame.
        """
        return draw_frame(self, new_axes(ax), frame)

    def _repr_html_(self) -> str:
        """HTML of a notebook: the page in a frame."""
        frame = 'style="width: 100%; height: 520px; border: 0" allowfullscreen'
        return f'<iframe srcdoc="{escape(self.html())}" {frame}></iframe>'

    def save(self, path: str | Path) -> Path:
        """Write the page and return its path; an existing file is replaced.

        Raises:
            ViewError: nothing is drawn, or meshcat is not installed.
        """
        path = Path(path)
        write_atomically(path, self.html())
        return path

    def live(self, port: int = 7000) -> Live:
        """Serve the scene on this machine; from now on every frame is shown when it ends, and only there.

        Does not wait: not for a browser, which may come, go and come back, nor for the picture.

        Args:
            port: tried first; if it is taken, another one is.

        Returns:
            Something to close, also as a context; its ``url`` is what to open.

        Raises:
            ViewError: meshcat is not installed, or no port is free.
        """
        return Live(self, port)

    def rerun(self, path: str | Path | None = None) -> Any:
        """Log the scene in Rerun: to a file ``.rrd``, or without a path to a viewer that is started.

        Returns:
            The ``rerun.RecordingStream``, to log more into.

        Raises:
            ViewError: nothing is drawn, or rerun-sdk is not installed.
        """
        from unifg.view.to_rerun import log_to_rerun

        return log_to_rerun(self, path)

    def viser(self, port: int = 8080) -> Any:
        """Serve the scene by viser on this machine, with a slider for the frames.

        Returns:
            The ``viser.ViserServer``, to be stopped, or added to.

        Raises:
            ViewError: nothing is drawn, or viser is not installed.
        """
        from unifg.view.to_viser import serve_by_viser

        return serve_by_viser(self, port)

    # ------------------------------------------------------------------- inside

    def _iterates(self, solution: Solution, recipe: Recipe) -> None:
        """One frame for each iterate that was kept."""
        rows = [row for row in solution.history if row.values is not None]
        if not rows:
            raise ViewError('over="iterates" needs their values: solve with keep_values=True')
        self.whole, self.numbers = False, [row.number for row in rows]
        self.plot("cost")
        self.plot("stationarity", log=True)
        if any(row.violation > 0.0 for row in rows):
            self.plot("violation", log=True, colour="moving")
        for row in rows:
            assert row.values is not None
            with self.frame() as frame:
                recipe.draw(frame, row.values, solution if row is rows[-1] else None, solution)
                frame.readout("cost", f"{row.cost:.6g}")
                frame.readout("violation", f"{row.violation:.1e}")
                frame.readout("step", f"{row.step_norm:.2e}")
                for name in self.plots:
                    frame.value(name, getattr(row, name))

    def _members(
        self, solution: Solution, recipe: Recipe, body: str | Mapping[Family, str] | None, size: float | None
    ) -> None:
        """Draw the members of families; a body goes along each family that is a way."""
        values = solution.values
        recipe.draw(self, values, solution, solution)
        ways: dict[str, Array] = {}
        for entry in recipe.shown:
            places, poses = entry.read(entry.of(values))
            if len(places) < 2 or not entry.joined:
                continue
            extent = float(np.ptp(places, axis=0).max())
            usual = "ball" if poses is None else "arrow" if poses.shape[1] == 3 else "axes"
            kind = body if isinstance(body, str) else (body or {}).get(entry.selection.family, usual)
            name = f"{entry.name}: {kind}"
            self.body(name, kind, size=size or _SIZE * extent or 1.0, colour="robot")
            if poses is None:
                full = np.pad(places, ((0, 0), (0, 3 - places.shape[1])))
                poses = np.column_stack([full, np.tile([1.0, 0.0, 0.0, 0.0], (len(full), 1))])
            ways[name] = poses
        if not ways:
            raise ViewError('over="members" needs a family of at least two poses, or position=')
        for k in range(max(map(len, ways.values()))):
            with self.frame() as frame:
                for name, poses in ways.items():
                    if k < len(poses):
                        frame.place(name, poses[k])
