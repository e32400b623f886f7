"""Measurements with time stamps: from several sensors, at several rates, late, missing, or between two nodes.

A measurement taken between the nodes x_k and x_{k+1} is compared with the state there was at its stamp, by
:mod:`unifg.models.interpolation`. A graph that is solved again and again has one structure, so every interval between
two nodes gets a fixed number of slots; what is in them are data, and empty slots are inactive.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from unifg.errors import ModelError, require_kinds
from unifg.factors.autodiff.stated import StatedKernel
from unifg.factors.residuals import Function, Residual
from unifg.factors.robust import Loss
from unifg.locks import ReentrantLock
from unifg.modeling.duplicates import doubles, kept
from unifg.modeling.model import Model
from unifg.modeling.variables import Data, Family, Variable, as_selection
from unifg.models.interpolation import Interpolation, geodesic
from unifg.typing import Array, ArrayLike, BoolArray, IntArray

__all__ = ["Counts", "StampedMeasurements"]

CLOSE = 1e-6  # of a step: how far from a node a stamp still falls on it


class Nodes(Protocol):
    """Nodes of a window, as in :class:`unifg.horizon.history.History`."""

    times: Array

    @property
    def empty(self) -> int:
        """Places that no node has entered yet; the index of the oldest node."""


class Present(Protocol):
    """Context of a term in a window, as in :class:`unifg.horizon.Now`."""

    @property
    def constants(self) -> Mapping[str, Array]:
        """(count, storage) believed constants, by name."""

    @property
    def past(self) -> Any:
        """The history: :class:`Nodes`, and what is believed of their states."""


@dataclass(frozen=True)
class Counts:
    """Counts of measurements by outcome.

    Attributes:
        placed: in slots, when data were asked for last.
        waiting: kept, because their stamps lie ahead of the newest node.
        late: refused, because their stamps lie before the oldest node.
        full: refused, because all slots of their interval were taken.
        ahead: refused, because as many as there are slots were waiting.
        invalid: refused, because a stamp or a value was not finite.
    """

    placed: int = 0
    waiting: int = 0
    late: int = 0
    full: int = 0
    ahead: int = 0
    invalid: int = 0


class StampedMeasurements:
    """One sensor's measurements, as factors between the nodes of a trajectory.

    ``add`` takes measurements as they arrive, in any order. As a term of a window (:class:`unifg.horizon.Window`) it is
    asked for the rest; in a graph by hand, ``state`` adds the factors once and ``at`` gives what a solve needs of them
    for nodes that stand at given times. Nothing is compiled or laid out again in between.

    A stamp on a node falls on it; equal stamps take a slot each. The oldest nodes leave, and with them the measurements
    before what is the oldest then. What arrives after that is refused and counted, as is all else that finds no slot.
    So one sensor serves one window: nodes that need what has left with those of another are refused. Threads may add
    while others ask.

    Attributes:
        counts: what has become of the measurements so far.
    """

    def __init__(
        self,
        error: Function | Residual,
        size: int,
        *,
        capacity: int,
        sigma: ArrayLike,
        between: Interpolation | None = None,
        constants: Sequence[str] = (),
        offset: str | None = None,
        component: str | None = None,
        robust: Loss | None = None,
        name: str = "stamped",
    ) -> None:
        """Describe the sensor.

        Args:
            error: ``error(x, z)`` or, with constants, ``error(x, s_1, ..., z)``, (n, m): what measurements z (n, size)
                differ by from what they should be at states x (n, storage). A batched function, or a residual made of
                one.
            size: how many numbers a measurement has.
            capacity: slots of an interval between two nodes.
            sigma: standard deviations, one or (m,).
            between: how states x are interpolated; the geodesic of their manifold by default.
            constants: names of families of one member that ``error`` takes, too: a landmark, a lever arm.
            offset: name of a family of one member on Rn(1): by how much the sensor's clock is behind [s], so that a
                measurement was taken at its stamp plus this. None: not at all.
            component: of the nodes, which takes the place of x; None for all of them.
            robust: loss.
            name: of the term.

        Raises:
            ModelError: when there is no slot or nothing measured, ``error`` is no batched function, or another argument
                is not what it should be.
        """
        stated = {**StampedMeasurements.__init__.__annotations__, "error": "Callable", "between": "Callable | None"}
        require_kinds(f"'{name}'", ModelError, stated, locals(), str, Sequence)
        if size < 1 or capacity < 1:
            raise ModelError(f"'{name}': size {size} and capacity {capacity} must be at least 1")
        self.name, self.size, self.capacity = name, size, capacity
        self.constants, self.offset, self.component = tuple(constants), offset, component
        self._error, self._sigma, self._between, self._robust = _batched(error, name), kept(sigma), between, robust
        self._lock = ReentrantLock()
        self.reset()

    def reset(self) -> None:
        """Forget all measurements, and what has become of them."""
        with self._lock:
            self._stamps: Array = np.empty(0)
            self._values: Array = np.empty((0, self.size))
            self._known: BoolArray = np.empty(0, dtype=bool)  # whether they have been placed before
            self._left = self._since = -np.inf  # the last stamp that has left, and the oldest node at that time
            self.counts = Counts()

    def state(self, graph: Model, x: Variable, u: Any = None) -> None:
        """Add the factors, all inactive, between the nodes x, two or more in the order of time.

        Raises:
            ModelError: when there are fewer than two nodes, a static or the offset is not in the graph, or the offset
                is no number.
            GraphError: as the graph raises it. Either way the graph is as it was.
        """
        nodes = as_selection(x) if self.component is None else getattr(as_selection(x), self.component)
        if len(nodes) < 2:
            raise ModelError(f"'{self.name}' needs two nodes or more to stand between, found {len(nodes)}")
        shared = [self._family(graph, "constants", name) for name in self.constants]
        clock = [] if self.offset is None else [self._family(graph, "offset", self.offset)]
        if any((len(family), family.manifold.dim) != (1, 1) for family in clock):
            raise ModelError(f"'{self.name}': the offset of a clock is one variable on Rn(1)")
        empty = self._filled(np.arange(float(len(nodes))), np.empty(0, dtype=np.intp), 0.0)
        before = np.repeat(np.arange(len(nodes) - 1), self.capacity)
        error = _at_stamp(self._error, self._between or geodesic(nodes.manifold), bool(clock))

        def stated(graph: Model) -> None:
            into, step, values, measured = (graph.data(name, value, each=True) for name, value in empty.items())
            graph.minimize(
                error,
                *(nodes[before], nodes[before + 1], *clock, into, step, *shared, values),
                sigma=self._sigma,
                robust=self._robust,
                active=measured,
                name=self.name,
            )

        state_whole(graph, stated)

    def _family(self, graph: Model, role: str, name: str) -> Family:
        if name not in graph.families:
            there = ", ".join(f"'{other}'" for other in graph.families)
            raise ModelError(
                f"'{self.name}': {role}= names '{name}', which the graph does not have (there are: {there})"
            )
        return graph.families[name]

    def add(self, stamp: ArrayLike, value: ArrayLike) -> None:
        """Take measurements: one stamp [s] and (size,) value, or (k,) stamps and (k, size) values, in any order.

        Numbers that are not finite are no measurement: they are left out and counted.

        Raises:
            ModelError: on another shape.
            GraphError: on masked arrays, dates, and what is no real number.
        """
        stamps = np.array(doubles(f"'{self.name}': stamps", stamp))
        values = np.array(doubles(f"'{self.name}': values", value))
        wanted = (*stamps.shape, self.size)
        if stamps.ndim > 1 or (values.shape != wanted and not (self.size == 1 and values.shape == stamps.shape)):
            raise ModelError(f"'{self.name}': stamps {stamps.shape} need values {wanted}, found {values.shape}")
        stamps, values = np.atleast_1d(stamps), values.reshape(-1, self.size)
        good = np.isfinite(stamps) & np.isfinite(values).all(axis=1)
        with self._lock:
            self._count(invalid=int((~good).sum()))
            self._stamps = np.concatenate([self._stamps, stamps[good]])
            self._values = np.concatenate([self._values, values[good]])
            self._known = np.concatenate([self._known, np.zeros(int(good.sum()), dtype=bool)])

    def data(self, now: Present) -> dict[str, Array]:
        """Values of the data, by name, for the nodes of a window.

        Raises:
            ModelError: when measurements of theirs have left with the nodes of another window.
        """
        history: Nodes = now.past
        offset = 0.0 if self.offset is None else float(np.ravel(now.constants[self.offset])[0])
        return self._given(np.array(history.times), history.empty, offset)

    def at(self, graph: Model, times: ArrayLike, offset: float = 0.0) -> dict[Data, Array]:
        """Data of a graph for one solve, with nodes at these times.

        Args:
            graph: to which the factors have been added.
            times: (n,) of the nodes, increasing [s].
            offset: of the sensor's clock, as it is believed to be: it says between which nodes a measurement lies.

        Raises:
            ModelError: when times are not one for each node, finite and increasing, the offset is not finite, or
                measurements between them have left for later nodes.
            GraphError: when they have not been added.
        """
        term: Any = graph.term(self.name)
        nodes = term.count // self.capacity + 1
        at = doubles(f"'{self.name}': times", times, error=ModelError)
        good = at.shape == (nodes,) and np.isfinite(at).all() and (np.diff(at) > 0.0).all()
        if not (good and np.isfinite(offset)):
            raise ModelError(f"'{self.name}': times must be {nodes} finite, increasing numbers, found {at}")
        return by_handle(graph, (self.name,), self._given(at, 0, offset))

    def _given(self, times: Array, first: int, offset: float) -> dict[str, Array]:
        """Values of the data, by name, for nodes of which those before the first are not there yet."""
        oldest = int(np.searchsorted(times, times[first], side="right")) - 1  # steps before it have no duration
        with self._lock:
            if oldest < len(times) - 1:
                interval, place = self._place(times[oldest:], offset)
                slot = (interval + oldest) * self.capacity + place
            else:
                slot = np.empty(0, dtype=np.intp)
            return self._filled(times, slot, 0.0 if self.offset else offset)

    def _filled(self, times: Array, slot: IntArray, offset: float) -> dict[str, Array]:
        """The same, the first measurements being in these slots."""
        count, interval = (len(times) - 1) * self.capacity, slot // self.capacity
        into, step, measured = np.zeros(count), np.ones(count), np.zeros(count, dtype=bool)
        values = np.zeros((count, self.size))
        into[slot] = (self._stamps[: len(slot)] - times[interval]) + offset
        step[slot] = np.diff(times)[interval]
        values[slot] = self._values[: len(slot)]
        measured[slot] = True
        names = (f"{self.name}: time into step", f"{self.name}: length of step", self.name, f"{self.name}: measured")
        return dict(zip(names, (into, step, values, measured), strict=True))

    def _place(self, at: Array, offset: float) -> tuple[IntArray, IntArray]:
        """Keep what has a slot, first, and what waits; returns intervals and places in them of the former."""
        taken = self._stamps + offset
        slack = CLOSE * float(np.diff(at).min()) + 4.0 * float(np.spacing(np.abs(at).max()))
        if at[0] < self._since - slack and self._left + offset >= at[0] - slack:
            raise ModelError(
                f"'{self.name}': nodes from {at[0]:.12g} s on are asked for, but what was measured before "
                f"{self._since:.12g} s has left: give every window a sensor of its own, and call reset() where time "
                "begins anew"
            )
        late, ahead = taken < at[0] - slack, taken > at[-1] + slack
        inside = np.flatnonzero(~late & ~ahead)
        interval = np.clip(np.searchsorted(at, taken[inside], side="right") - 1, 0, len(at) - 2)
        kept = _ranks(interval) < self.capacity  # first come, first served
        chosen, interval = inside[kept], interval[kept]
        order = np.lexsort((taken[chosen], interval))  # in whatever order they came
        chosen, interval = chosen[order], interval[order]
        most = (len(at) - 1) * self.capacity
        waiting = np.flatnonzero(ahead)
        waiting = np.sort(waiting[np.argsort(taken[waiting], kind="stable")[:most]])
        self._count(
            late=int((late & ~self._known).sum()),  # those known have left with their nodes
            full=int((~kept).sum()),
            ahead=int(ahead.sum()) - len(waiting),
        )
        if late.any():
            self._left, self._since = max(self._left, float(self._stamps[late].max())), float(at[0])
        stay = np.concatenate([chosen, waiting])
        self._stamps, self._values = self._stamps[stay], self._values[stay]
        self._known = np.arange(len(stay)) < len(chosen)
        self.counts = replace(self.counts, placed=len(chosen), waiting=len(waiting))
        return interval, _ranks(interval)

    def _count(self, **more: int) -> None:
        """Add to the counts."""
        self.counts = replace(self.counts, **{name: getattr(self.counts, name) + n for name, n in more.items()})


def state_whole(graph: Model, stated: Callable[[Model], None]) -> None:
    """State several things that belong together, or nothing: what is refused is refused on a snapshot first."""
    stated(graph.snapshot())
    stated(graph)


def _ranks(groups: IntArray) -> IntArray:
    """Number of earlier entries of the same group."""
    order = np.argsort(groups, kind="stable")
    ordered = groups[order]
    ranks = np.empty(len(groups), dtype=np.intp)
    ranks[order] = np.arange(len(groups)) - np.searchsorted(ordered, ordered, side="left")
    return ranks


def _batched(error: Function | Residual, name: str) -> Function:
    """The function that may be traced behind a residual."""
    if not isinstance(error, Residual):
        return error
    if isinstance(error.kernel, StatedKernel):
        return error.kernel.function
    if error.rows:
        raise ModelError(f"'{name}': '{error.name}' is compiled for one factor; give a batched function")
    return error.function


def _at_stamp(error: Function, between: Interpolation, clocked: bool) -> Function:
    """The residual of a measurement between two nodes, at the fraction that its stamp says."""

    def stamped(x: Array, y: Array, into: Array, step: Array, *measured: Array) -> Array:
        return error(between(x, y, into / step, step), *measured)

    def clocked_stamped(x: Array, y: Array, late: Array, into: Array, step: Array, *measured: Array) -> Array:
        return error(between(x, y, (into + late[:, 0]) / step, step), *measured)

    return clocked_stamped if clocked else stamped


def by_handle(graph: Model, terms: Sequence[str], values: Mapping[str, Array]) -> dict[Data, Array]:
    """Values of data by the handles that terms of a graph read."""
    found: dict[Data, Array] = {}
    for name in terms:
        term: Any = graph.term(name)
        for handle in (*term.arguments, term.active, term.sigma, term.information):
            if isinstance(handle, Data) and handle.name in values:
                found[handle] = values[handle.name]
    return found
