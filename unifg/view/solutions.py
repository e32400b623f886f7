"""Drawing of a solution: its families, their uncertainties, and its factors as lines between variables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from unifg.errors import ViewError
from unifg.modeling.variables import Family, Selection, Variable, as_selection
from unifg.plots.shown import every
from unifg.solution.solution import Solution
from unifg.typing import Array
from unifg.view.canvas import Canvas, Frame
from unifg.view.members import Members, Position, Values, members_of

__all__ = ["Recipe", "recipe_of"]

_ALONG = 20  # ellipses along a way


@dataclass(frozen=True)
class Recipe:
    """Drawing recipe of every solution of a graph.

    Attributes:
        shown: families, in order.
        sigmas: half axes of ellipses in standard deviations; None draws none.
        terms: whose factors are lines.
        position: where members are that are neither poses nor points.
    """

    shown: Sequence[Members]
    sigmas: float | None
    terms: Sequence[str]
    position: Position | None

    def draw(self, canvas: Canvas, values: Values, solution: Solution | None, terms_of: Solution) -> None:
        """Draw some values.

        Args:
            canvas: to draw on.
            values: of all families.
            solution: whose covariances are those of the values, if any is.
            terms_of: a solution of the graph.

        Raises:
            ViewError: a value is not finite.
            GraphError: covariances are asked for and do not exist.
        """
        for entry in self.shown:
            places, poses = entry.read(entry.of(values))
            if entry.joined and len(places) != 1:
                canvas.way(entry.name, places)
            if poses is not None:
                if len(places) == 1:
                    canvas.poses(entry.name, poses)
                else:
                    canvas.poses(f"{entry.name}: poses", poses, colour=canvas.colour(entry.name))
            elif not entry.joined or len(places) == 1:
                canvas.points(entry.name, places)
            if self.sigmas is not None and solution is not None and len(places):
                some = every(len(places), _ALONG) if entry.joined else np.arange(len(places))
                marginals = solution.marginals(entry.selection[some])
                spread = entry.covariances(entry.of(values)[some], marginals)
                name = f"{entry.name}: {self.sigmas:g}\u03c3"
                canvas.covariances(name, places[some], spread, sigmas=self.sigmas, colour="estimate")
        for term in self.terms:
            canvas.lines(term, self._lines(term, values, terms_of))

    def tell(self, frame: Frame, solution: Solution) -> None:
        """Say how a solve went."""
        frame.readout("solver", solution.solver)
        frame.readout("status", solution.status.name.lower().replace("_", " "), alarm=not solution.converged)
        frame.readout("iterations", str(solution.iterations))
        frame.readout("cost", f"{solution.cost:.6g}")
        frame.value("solve time", 1e3 * solution.seconds)

    def _lines(self, term: str, values: Values, solution: Solution) -> Array:
        """(n, 2, 2 or 3) between the first variable of each factor that has a place and each other one."""
        ends = []
        for selection in solution.selections(term):
            try:
                members = members_of(selection, self.position)
            except ViewError:
                continue  # controls, biases, ...: they are nowhere
            ends.append(members.read(members.of(values))[0])
        if len(ends) < 2:
            raise ViewError(
                f"the factors of '{term}' touch {len(ends)} variable{'s' * (len(ends) != 1)} with a place: "
                "a line needs two; for a term that takes whole products give position=",
                term=term,
            )
        size, count = max(end.shape[1] for end in ends), max(len(end) for end in ends)
        full = [np.pad(end, ((0, 0), (0, size - end.shape[1]))) for end in ends]
        full = [np.broadcast_to(end, (count, size)) for end in full]
        return np.concatenate([np.stack([full[0], end], axis=1) for end in full[1:]])


def recipe_of(
    solution: Solution,
    shown: Sequence[Variable],
    sigmas: float | None,
    terms: Sequence[str],
    position: Position | None,
) -> Recipe:
    """Drawing recipe of a solution.

    Args:
        solution: of the graph.
        shown: families or parts of them; none for all poses or, where there are none, all points.
        sigmas: half axes of ellipses in standard deviations.
        terms: names.
        position: for what is neither a pose nor a point.

    Raises:
        ViewError: a family cannot be drawn, or none can.
        GraphError: the graph has no such term or family.
    """
    if sigmas is not None and not (np.isfinite(sigmas) and sigmas > 0.0):
        raise ViewError(f"sigmas={sigmas!r}: half axes are a positive number of standard deviations")
    entries: list[Members] = []
    if shown:
        for variable in shown:
            if not isinstance(variable, Family | Selection):
                raise ViewError(
                    f"Scene.of shows families and parts of them, found {type(variable).__name__}: draw arrays by "
                    "scene.way, scene.points or scene.poses"
                )
            selection = as_selection(variable)
            solution[selection]
            entries.append(members_of(selection, position))
    else:
        tried: list[str] = []
        for family in solution.values:
            try:
                entries.append(members_of(family[:], position))
            except ViewError:
                tried.append(f"'{family.name}' of {family.manifold.name}")
        poses = [entry for entry in entries if entry.kind != "points"]
        entries = poses or entries  # beside poses, a family of R^2 may as well be controls
        if not entries:
            raise ViewError(
                f"no family of this solution has a place ({', '.join(tried)}): name a component, as in "
                "Scene.of(solution, x.pose), or give position="
            )
    for term in terms:
        solution.selections(term)
    return Recipe(entries, sigmas, tuple(terms), position)
