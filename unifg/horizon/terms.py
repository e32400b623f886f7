"""Terms of a window or a horizon: each defined once, whatever graphs it is added to.

A term is an object with two methods. ``state(graph, x, u)`` adds costs and constraints on the nodes it is given, of the
past or of the future; ``data(now)`` gives the values of the data that it declared, by their names. The same object may
stand in several graphs, the one of the past alone and the one of past and future, so it keeps nothing of them. What it
keeps between ticks, as measurements that have arrived, it forgets when a window or a loop is reset, if it has a method
``reset()``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

import numpy as np

from unifg.errors import GraphError
from unifg.horizon.history import History
from unifg.horizon.tree import Tree, tree_of
from unifg.modeling.duplicates import doubles
from unifg.modeling.factors import difference, prior
from unifg.modeling.model import AnyResidual
from unifg.modeling.variables import Data, Family, Selection
from unifg.solution.graph import Graph
from unifg.typing import Array, ArrayLike

G = TypeVar("G")


@dataclass(frozen=True)
class Context(Generic[G]):
    """Context of terms at a tick.

    Attributes:
        given: what the caller hands to this tick: a reference, a goal, a map.
        present: (storage,) state by the past alone; for a plan that acts later, where the robot will be by then.
        last: (m,) control that was applied last, before the horizon begins.
        constants: (count, storage) values by the past alone, by name.
        history: what was done and measured; None without a window.
        times: (N + 1,) of the nodes of the future from the present on [s]; empty for a window.
        tree: order of these nodes; None where each follows the one before it.
    """

    given: G
    present: Array
    last: Array
    constants: Mapping[str, Array] = field(default_factory=dict)
    history: History | None = None
    times: Array = field(default_factory=lambda: np.zeros(0))
    tree: Tree | None = None

    @property
    def lengths(self) -> Array:
        """(N,) lengths of the steps of the future [s]."""
        return self.times[1:] - (self.times[:-1] if self.tree is None else self.times[self.tree.begins])

    @property
    def past(self) -> History:
        """The history.

        Raises:
            GraphError: without a window.
        """
        if self.history is None:
            raise GraphError("a term asks for the past, but there is no window")
        return self.history


class Term(Protocol):
    """A part of what a window or a horizon says."""

    def state(self, graph: Graph, x: Selection, u: Any) -> None:
        """Add costs and constraints to a graph.

        Args:
            graph: which also holds the robot's constants, and of the past its steps, in ``graph.families``.
            x: the nodes: of the past L + 1, the present being the last; of the future N + 1, the present the first.
            u: (L,) controls that were applied, which are data; or the N controls to come.

        Which node follows which, :func:`unifg.horizon.tree_of` tells of x; in a horizon that branches slices as
        ``x[:-1]`` are refused.
        """

    def data(self, now: Context[Any]) -> Mapping[str, ArrayLike]:
        """Values of the data that :meth:`state` declared, by name; others keep what they were declared with.

        A class that inherits from this one declares nothing that changes, unless it says otherwise.
        """
        return {}


@runtime_checkable
class Recording(Protocol):
    """A term of the past that has measurements recorded at nodes."""

    @property
    def records(self) -> Mapping[str, tuple[int, ...]]:
        """Shape of a measurement at one node, by name."""


@runtime_checkable
class Resetting(Protocol):
    """A term that keeps something between ticks, as measurements that have arrived, which a new episode forgets."""

    def reset(self) -> None:
        """Forget it: the window or the loop begins anew."""


@runtime_checkable
class Guessing(Protocol):
    """A term of the future with unknowns of its own, as slacks."""

    def guess(self, now: Context[Any]) -> Mapping[str, ArrayLike]:
        """Values (count, storage) for a first guess, by the names of the families."""


@dataclass(frozen=True)
class Measurement:
    """A measurement of the state at nodes of the past, those at which it was made.

    Attributes:
        name: under which it is recorded.
        residual: ``residual(x, z)`` or, with constants, ``residual(x, s_1, ..., z)``: (n, m).
        shape: of one measured value.
        sigma: standard deviations in the residual's units.
        constants: names of families of one member that the residual takes, too.
        robust: loss.
        component: of the state, as "pose"; None for all of it.
    """

    name: str
    residual: AnyResidual
    shape: tuple[int, ...]
    sigma: ArrayLike
    constants: tuple[str, ...] = ()
    robust: Any = None
    component: str | None = None

    def __post_init__(self) -> None:
        """Refuse a shape that is none."""
        sizes = self.shape if isinstance(self.shape, tuple) else (None,)
        if not all(isinstance(size, int | np.integer) and size >= 0 for size in sizes):
            raise GraphError(f"measurement '{self.name}': its shape is a tuple, as (2,); found {self.shape!r}")

    @property
    def records(self) -> Mapping[str, tuple[int, ...]]:
        """One value per node."""
        return {self.name: self.shape}

    def state(self, graph: Graph, x: Selection, u: Any) -> None:
        """Add a cost at every node, active where something was measured."""
        values = graph.data(self.name, np.zeros((len(x), *self.shape)), each=True)
        measured = graph.data(f"{self.name}: measured", np.zeros(len(x), dtype=bool), each=True)
        shared = _shared(graph, self.constants, self.name)
        where = x if self.component is None else getattr(x, self.component)
        graph.minimize(
            self.residual, where, *shared, values, sigma=self.sigma, robust=self.robust, active=measured, name=self.name
        )

    def data(self, now: Context[Any]) -> Mapping[str, ArrayLike]:
        """Measurements."""
        values, measured = now.past.recorded(self.name)
        return {self.name: values, f"{self.name}: measured": measured}


@dataclass(frozen=True)
class Dynamics:
    """Dynamics from node to node by the controls between them: in the past or in the future.

    Attributes:
        residual: ``residual(x, u, x_next, h)`` or, with constants, ``residual(x, u, s_1, ..., x_next, h)``: (n, m).
        step: h [s], for all steps or (N,) for each; None in a horizon for those between its node times, which may then
            change from tick to tick, or for the robot's tick.
        sigma: (m,) standard deviations of the process noise; None where the model holds exactly.
        constants: names of families of one member that the residual takes, too.
        name: of the term, and with "past" added where the controls are those that were applied.
    """

    residual: AnyResidual
    step: ArrayLike | None = None
    sigma: ArrayLike | None = None
    constants: tuple[str, ...] = ()
    name: str = "dynamics"

    def __post_init__(self) -> None:
        """Refuse steps that lead nowhere, or back."""
        steps = None if self.step is None or isinstance(self.step, Data) else doubles("step", self.step, term=self.name)
        if steps is not None and not ((steps > 0.0) & (steps < np.inf)).all():
            raise GraphError(f"term '{self.name}': its step must be positive [s], found {self.step}", term=self.name)

    def require_step(self, lengths: Array | None) -> None:
        """Refuse a step that contradicts the lengths (N,) of steps [s], and none where there are none."""
        step: Any = lengths if self.step is None or isinstance(self.step, Data) else self.step
        if self.step is None and lengths is None:
            raise GraphError(
                f"term '{self.name}' has no step, and the horizon no node times: give Dynamics its step [s], the "
                "horizon times=, or the robot its tick",
                term=self.name,
            )
        fits = lengths is not None and np.size(step) in (1, len(lengths))  # the graph refuses other shapes
        if lengths is not None and fits and not np.allclose(np.ravel(step), lengths, rtol=1e-9, atol=0.0):
            raise GraphError(
                f"term '{self.name}': its step is {self.step} s, but the nodes of the horizon are {lengths} s apart: "
                "leave step= out to follow them, or in a window give the length of a tick",
                term=self.name,
            )

    def state(self, graph: Graph, x: Selection, u: Any) -> None:
        """Add a cost or an equality for every step."""
        shared = _shared(graph, self.constants, self.name)
        step: Any = self.step
        if step is None:
            if isinstance(u, Data):
                raise GraphError(f"the past needs the step of '{self.name}': give it a length [s]", term=self.name)
            step = graph.data(f"{self.name}: step", np.ones(len(u)), each=True)
        arguments, name = (x[tree_of(x).begins], u, *shared, x[1:], step), self.name
        if isinstance(u, Data):
            name = f"past {name}"
        if self.sigma is not None:
            graph.minimize(self.residual, *arguments, sigma=self.sigma, name=name)
        else:
            graph.constrain(self.residual, *arguments, lower=0.0, upper=0.0, name=name)

    def data(self, now: Context[Any]) -> Mapping[str, ArrayLike]:
        """Lengths of the steps, where they may change."""
        return {} if self.step is not None else {f"{self.name}: step": now.lengths}


@dataclass(frozen=True)
class ControlCost:
    """Costs of controls: how far they are from wanted ones, and how they change, the one applied last included.

    Attributes:
        sigma: (m,) standard deviations of the first.
        change: (m,) of the second; None for no such cost.
        wanted: (m,) or (N, m), for good or as ``wanted(now)`` says at a tick.
    """

    sigma: ArrayLike
    change: ArrayLike | None = None
    wanted: ArrayLike | Callable[[Context[Any]], ArrayLike] = 0.0

    def state(self, graph: Graph, x: Selection, u: Any) -> None:
        """Add the costs."""
        shape = len(u), u.manifold.storage
        constant = 0.0 if callable(self.wanted) else self.wanted
        wanted = graph.data("wanted controls", _spread_out(constant, shape), each=True)
        graph.minimize(prior, u, wanted, sigma=self.sigma, name="effort")
        if self.change is not None:
            last = graph.data("last control", np.zeros(shape[1]))
            graph.minimize(prior, u[0], last, sigma=self.change, name="first change")
            if shape[0] > 1:
                tree = tree_of(x)
                graph.minimize(difference, u[tree.earlier], u[tree.later], sigma=self.change, name="change")

    def data(self, now: Context[Any]) -> Mapping[str, ArrayLike]:
        """The control applied last, and those wanted now."""
        found: dict[str, ArrayLike] = {} if self.change is None else {"last control": now.last}
        if callable(self.wanted):
            found["wanted controls"] = self.wanted(now)
        return found


def values_of(terms: Sequence[Term], now: Context[Any], handles: Mapping[str, Data]) -> dict[Data, ArrayLike]:
    """Data of several terms, by the handles of one graph.

    Raises:
        GraphError: when a term gives a value for data that the graph does not read, or two give the same.
    """
    found: dict[Data, ArrayLike] = {}
    for term in terms:
        given = term.data(now)
        if not isinstance(given, Mapping):
            raise GraphError(f"{type(term).__name__}.data must return values by name, found {f'{given!r}'[:80]}")
        for name, value in given.items():
            if name not in handles:
                known = ", ".join(handles) or "none"
                raise GraphError(f"{type(term).__name__} gives data '{name}', which its graph does not read ({known})")
            if handles[name] in found:
                raise GraphError(f"{type(term).__name__} gives data '{name}', which another term has given")
            found[handles[name]] = _spread_out(value, handles[name].value.shape)
    return found


def _spread_out(value: ArrayLike, shape: tuple[int, ...]) -> ArrayLike:
    """A value for all factors alike, once for each; what does not fit is refused by the graph, which knows its name."""
    own = np.shape(value)
    alike = len(own) < len(shape) and own == shape[len(shape) - len(own) :]
    return np.broadcast_to(np.asarray(value), shape) if alike or not own else value


def _shared(graph: Graph, constants: Sequence[str], term: str) -> list[Family]:
    """Families of constants that a term takes."""
    for name in constants:
        if name not in graph.families:
            known = ", ".join(graph.families)
            raise GraphError(f"term '{term}' takes static '{name}', which the robot does not have ({known})", term=term)
    return [graph.families[name] for name in constants]


def looked_at(terms: Iterable[Term]) -> tuple[Term, ...]:
    """Terms that are some.

    Raises:
        GraphError: for an object without the methods of a term, or a class that has not been called.
    """
    if not isinstance(terms, Iterable):
        raise GraphError(f"terms are a list, as [Dynamics(...), goal], found {type(terms).__name__}")
    found = tuple(terms)
    for term in found:
        lacking = [name for name in ("state", "data") if not callable(getattr(term, name, None))]
        if lacking or isinstance(term, type):
            name = term.__name__ if isinstance(term, type) else type(term).__name__
            raise GraphError(f"{name} is no term: a term is an object with methods state(graph, x, u) and data(now)")
    return found


def reset_all(terms: Iterable[Term]) -> None:
    """Let those terms that keep something forget it."""
    for term in terms:
        if isinstance(term, Resetting):
            term.reset()


def handles_of(graph: Graph) -> dict[str, Data]:
    """The data that the terms and fixes of a graph read, by name."""
    read = [fix.data for fix in graph.fixes] + [term.data for term in graph.terms]
    return {value.name: value for data in read for value in data}
