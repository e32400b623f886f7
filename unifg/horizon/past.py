"""The past in a graph: what the terms of a window say, and the prior that stands for all that has left it.

What leaves takes its costs and equalities along: they are marginalised into a prior on the nodes and constants they
reach, at the point where they were last linearised (:mod:`unifg.solution.marginal`); inequalities are dropped. While
the window is not full, factors that touch an empty place do not count, and the empty places are held by a weak prior.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Protocol, TypeAlias

import numpy as np

from unifg.errors import GraphError
from unifg.factors.residuals import Residual
from unifg.horizon.history import History
from unifg.horizon.robot import Robot
from unifg.horizon.terms import Context, Term, handles_of, values_of
from unifg.lie import Manifold
from unifg.modeling.factors import prior
from unifg.modeling.joint_prior import joint_prior
from unifg.modeling.terms import Constraint, ScalarCost
from unifg.modeling.terms import Term as Stated
from unifg.modeling.variables import Data, Family, Selection
from unifg.solution.graph import Graph
from unifg.solution.solution import Solution
from unifg.typing import Array, ArrayLike, BoolArray, IntArray

Place: TypeAlias = tuple[slice, slice, slice]
"""Of a member in the reference of an arrival, in its information, and in an offset behind the reference."""

NOTHING = 1e-12  # information in directions that what has left says nothing about; a matrix without zeros has a root


class Arrival(Protocol):
    """Coordinates in which the prior of what has left is a quadratic."""

    def residual(self, *manifolds: Manifold) -> Residual:
        """``r(v_1, ..., v_k, reference)``: difference (n, D) of variables from a reference.

        The reference is (S,), the storage of all variables side by side, followed by what :meth:`express` adds.
        """

    def more(self, dim: int) -> int:
        """Numbers that follow the storage in the reference, for a prior over ``dim`` tangents; at rest all zero."""

    def express(self, here: Array, step: Array, lowest: Array, information: Array) -> tuple[Array, Array]:
        """Reference and information (D, D) in these coordinates.

        Args:
            here: (S,) where the prior was linearised.
            step: (D,) from there to its lowest point, a right perturbation.
            lowest: (S,) that point.
            information: (D, D) over right perturbations.
        """


class Tangent:
    """The tangent spaces of the variables themselves, at the point of linearisation: :func:`unifg.joint_prior`.

    The quadratic stays what it was made: its lowest point may be so far along what it hardly knows that no point of a
    group is there.
    """

    def residual(self, *manifolds: Manifold) -> Residual:
        """Local differences side by side, less an offset."""
        return joint_prior(*manifolds, offset=True)

    def more(self, dim: int) -> int:
        """The offset."""
        return dim

    def express(self, here: Array, step: Array, lowest: Array, information: Array) -> tuple[Array, Array]:
        """As they are."""
        return np.concatenate([here, step]), information


class MarginalPrior:
    """Marginal prior of the nodes that left the window.

    Attributes:
        initial: reference (storage,) and information (d, d) about the node everything began at.
        constants: reference (count, storage) and information (count, d, d) of unknown constants at the start, by name.
        arrival: reference (S + more,) and information (D, D) about the oldest nodes and the constants, as
            :class:`Arrival` has them; None before any has left.
        pending_prior: what ``arrival`` becomes with the next node that leaves.
    """

    def __init__(self, robot: Robot, start: Array, covariance: Array) -> None:
        """Begin with what is believed at the start."""
        self._robot = robot
        self.begin(start, covariance)

    def begin(self, start: Array, covariance: Array) -> None:
        """Forget what has left; a state (storage,) is believed with a covariance (d, d)."""
        robot = self._robot
        self.initial = start.copy(), np.linalg.inv(covariance)
        unknown = [static for static in robot.constants if not static.known]
        self.constants = {static.name: (static.values, static.information) for static in unknown}
        self.arrival: tuple[Array, Array] | None = None
        self.pending_prior: tuple[Array, Array] | None = None

    def admit(
        self, name: str, member: int, value: Array, information: Array, place: tuple[slice, slice, slice]
    ) -> None:
        """Begin a static anew: what has left says nothing about it.

        Args:
            name: of the static.
            member: which of its members.
            value: (storage,) where it is believed to be.
            information: (d, d) of that belief.
            place: of the member in the arrival.
        """
        self.forget(place[1])
        values, weights = (array.copy() for array in self.constants[name])
        values[member], weights[member] = value, information
        self.constants[name] = values, weights
        if self.arrival is not None:
            reference, information = self.arrival[0].copy(), self.arrival[1]
            reference[place[0]] = value
            reference[place[2]] = 0.0
            self.arrival = reference, information

    def forget(self, columns: slice) -> None:
        """Marginalise some columns out of the arrival."""
        self.pending_prior = None
        if self.arrival is not None:
            reference, information = self.arrival
            own = np.arange(columns.start, columns.stop)
            kept = without(information, own)
            kept[own, own] = NOTHING
            self.arrival = reference, kept


class Past:
    """The terms of a window in one graph, alone or joined to a future.

    Attributes:
        x: (L + 1) nodes, the present last.
        names: of the costs and equalities that are marginalised.
        reach: how many nodes a factor of the past spans at most, less one.
    """

    def __init__(
        self,
        graph: Graph,
        x: Selection,
        robot: Robot,
        history: History,
        left: MarginalPrior,
        terms: Sequence[Term],
        arrival: Arrival,
    ) -> None:
        """Add everything the past says to a graph that holds the robot's constants.

        Raises:
            GraphError: for a scalar cost, which cannot be marginalised, and a factor that reaches into the future.
        """
        self.x, self._robot, self._history, self._left, self._terms = x, robot, history, left, terms
        self._arrival = arrival
        length = history.length
        self._steps = {name: graph.variables(name, kind, length) for name, kind in robot.steps.items()}
        self._constants = {static.name: graph.families[static.name] for static in robot.constants}
        self._known = {static.name for static in robot.constants if static.known}
        self._applied = graph.data("applied controls", np.zeros((length, robot.control.storage)), each=True)
        before = len(graph.terms)
        for term in terms:
            term.state(graph, x, self._applied)
        stated = graph.terms[before:]
        self._handles = handles_of(graph)
        self._entered, self._own_activity = self._switch(graph, stated)
        self.names = ["initial", "arrival", *(term.name for term in stated if _leaves(term))]
        self._state_priors(graph)

    def _switch(self, graph: Graph, stated: list[Stated]) -> tuple[list[tuple[Data, IntArray]], dict[Data, Any]]:
        """Make every factor wait until all its nodes have entered; also find how many nodes factors span."""
        oldest, self.reach = int(self.x.indices[0]), 1
        switches: list[tuple[Data, IntArray]] = []
        own: dict[Data, Any] = {}
        for term in stated:
            if isinstance(term, ScalarCost):
                raise GraphError(
                    f"term '{term.name}': a scalar cost of the past cannot be marginalised; state it as a square",
                    term=term.name,
                )
            nodes = [
                np.broadcast_to(s.indices - (oldest if s.family is self.x.family else 0), term.count)
                for s in term.selections
                if s.family is self.x.family or s.family in self._steps.values()
            ]
            if not nodes:
                continue
            first, last = np.min(nodes, axis=0), np.max(nodes, axis=0)
            if first.min() < 0 or last.max() > self._history.length:
                raise GraphError(f"term '{term.name}' of the past reaches into the future", term=term.name)
            self.reach = max(self.reach, int((last - first).max()))
            if self._history.filled:
                continue
            switch = graph.data(f"{term.name}: entered", np.zeros(term.count, dtype=bool), each=True)  # none has yet
            own[switch], term.active = term.active, switch
            switches.append((switch, first.astype(np.intp)))
        return switches, own

    def _state_priors(self, graph: Graph) -> None:
        """Priors at the start, of dropped nodes, and of empty places."""
        x, history, left = self.x, self._history, self._left
        self._beginning = x[:1] if history.filled else x  # of a window that is never empty it leaves at once
        self._initial = graph.data("initial", np.zeros(len(self._beginning), dtype=bool), each=True)
        self._start = graph.data("start", left.initial[0]), graph.data("information at the start", left.initial[1])
        start, information = self._start
        about_start = self._beginning, start
        graph.minimize(prior, *about_start, information=information, active=self._initial, name="initial")
        self._resting = graph.data("empty places", left.initial[0])
        self._empty = graph.data("empty", np.zeros(history.length, dtype=bool), each=True)
        if not history.filled:
            # Any weight will do; one of other units would set the scale that solvers take curvatures by.
            resting = x[:-1], self._resting
            graph.minimize(prior, *resting, information=information, active=self._empty, name="empty places")
            for name, family in self._steps.items():
                graph.minimize(prior, family, family.manifold.identity(), active=self._empty, name=f"empty {name}")
        self._believed: dict[str, tuple[Data, Data]] = {}
        for name, family in self._constants.items():
            if name in self._known:
                continue
            values, weights = left.constants[name]
            reference = graph.data(f"{name} at the start", values, each=True)
            weight = graph.data(f"information about {name} at the start", weights, each=True)
            graph.minimize(prior, family, reference, information=weight, name=f"prior of {name}")
            self._believed[name] = reference, weight
        members = [family[k] for family in self._constants.values() for k in range(len(family))]
        about = [*(x[k] for k in range(self.reach)), *members]
        size = sum(variable.manifold.dim for variable in about)
        identity = np.concatenate([variable.manifold.identity() for variable in about])
        self._reference = graph.data("arrival", np.concatenate([identity, np.zeros(self._arrival.more(size))]))
        self._information = graph.data("arrival information", np.eye(size))
        self._arrived = graph.data("arrived", np.zeros(1, dtype=bool), each=True)
        graph.minimize(
            self._arrival.residual(*(variable.manifold for variable in about)), *about, self._reference,
            information=self._information, active=self._arrived, name="arrival",
        )  # fmt: skip

    @property
    def families(self) -> tuple[Family, ...]:
        """Families of the steps, which run along the window."""
        return tuple(self._steps.values())

    @property
    def constants(self) -> tuple[Family, ...]:
        """Families of the constants."""
        return tuple(self._constants.values())

    def data(self, now: Context[Any]) -> dict[Data, ArrayLike]:
        """Data of the window."""
        history, left = self._history, self._left
        found = values_of(self._terms, now, self._handles)
        for switch, first in self._entered:
            own = self._own_activity[switch]
            if isinstance(own, Data):
                own = found.get(own, own.value)
            entered: BoolArray = first >= history.empty
            found[switch] = entered if own is None else entered & np.asarray(own, dtype=bool)
        found |= {
            self._applied: history.controls,
            self._initial: history.initial[: len(self._beginning)],
            self._start[0]: left.initial[0],
            self._start[1]: left.initial[1],
            self._arrived: np.array([left.arrival is not None]),
        }
        if not history.filled:
            found |= {self._resting: history.present, self._empty: np.arange(history.length) < history.empty}
        for name, (reference, weight) in self._believed.items():
            found[reference], found[weight] = left.constants[name]
        if left.arrival is not None:
            found[self._reference], found[self._information] = left.arrival
        return found

    def guess(self) -> dict[Family, Array]:
        """Beliefs about everything but the nodes."""
        history = self._history
        steps = {family: history.steps[name] for name, family in self._steps.items()}
        return steps | {family: history.constants[name] for name, family in self._constants.items()}

    def nodes(self) -> Array:
        """(L + 1, storage) what is believed about the nodes; empty places are guessed at the present."""
        states = self._history.states.copy()
        states[: self._history.empty] = self._history.present
        return states

    def take(self, solution: Solution) -> None:
        """Believe what a solution says of the past."""
        history = self._history
        history.states[history.empty :] = solution[self.x][history.empty :]
        for name, family in self._steps.items():
            history.steps[name][:] = solution[family]
        for name, family in self._constants.items():
            history.constants[name][:] = solution[family]

    def depart(self, solution: Solution) -> None:
        """Marginalise the oldest node, if the next step drops it, where a solution was linearised."""
        if not self._history.full:
            return
        x, reach = self.x, self.reach
        kept: list[Family | Selection] = [x[1 : reach + 1], *self.constants]
        leaving = [x[0], *(f[0] for f in self.families)]
        found, information = solution.marginal_prior(self.names, leaving, kept, offset=True)
        here, step = np.split(found[0], [len(found[0]) - len(information)])
        lowest = np.concatenate(list(_moved(kept, here, step)))
        nothing = np.flatnonzero(np.diag(information) == 0.0)
        information[nothing, nothing] = NOTHING
        self._left.pending_prior = self._arrival.express(here, step, lowest, information)


def _moved(variables: Sequence[Family | Selection], here: Array, step: Array) -> Iterator[Array]:
    """Members of variables at ``here`` (S,) side by side, moved by ``step`` (D,) in their tangent spaces."""
    at = row = 0
    for variable in variables:
        kind, count = variable.manifold, len(variable)
        points = here[at : at + count * kind.storage].reshape(count, kind.storage)
        yield kind.retract(points, step[row : row + count * kind.dim].reshape(count, kind.dim)).ravel()
        at, row = at + points.size, row + count * kind.dim


def without(information: Array, columns: IntArray) -> Array:
    """Information (D, D) once some columns are marginalised: theirs are zero."""
    kept = information.copy()
    kept[columns], kept[:, columns] = 0.0, 0.0
    known = columns[information[columns, columns] > 0.0]
    if len(known):
        across = information[:, known]
        across[columns] = 0.0
        lost = across @ np.linalg.solve(information[np.ix_(known, known)], across.T)
        kept -= 0.5 * (lost + lost.T)
    return kept


def _leaves(term: Stated) -> bool:
    """Test whether a term is marginalised: costs and equalities, no inequalities."""
    if not isinstance(term, Constraint):
        return True
    if isinstance(term.lower, Data) or isinstance(term.upper, Data):
        return term.lower is term.upper
    return bool(np.all(np.asarray(term.lower) == np.asarray(term.upper)))
