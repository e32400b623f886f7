"""Measurements with time stamps: from several sensors, at several rates, late, missing, or between two nodes.

A measurement taken between the nodes x_k and x_{k+1} is compared with the state there was at its stamp, by
:mod:`unifg.models.interpolation`. A graph that is solved again and again has one structure, so every interval between
two nodes gets a fixed number of slots; what is in them are data, and empty slots are inactive.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from unifg.errors import ModelError
from unifg.kernels.derive.stated import StatedKernel
from unifg.kernels.residuals import Function, Residual
from unifg.kernels.robust import Loss
from unifg.language.statement import Statement
from unifg.language.variables import Data, Variable, as_selection
from unifg.models.interpolation import Interpolation, geodesic
from unifg.typing import Array, ArrayLike, BoolArray, IntArray

CLOSE = 1e-6  # of a step: how far from a node a stamp still falls on it


@dataclass(frozen=True)
class Counts:
    """What became of the measurements.

    Attributes:
        placed: in the slots of the last :meth:`StampedMeasurements.data`.
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


class _Slots(NamedTuple):
    """Data of the slots, one row each, and the number of nodes."""

    into: Data
    step: Data
    value: Data
    filled: Data
    nodes: int
    clocked: bool


class StampedMeasurements:
    """One sensor's measurements, as factors between the nodes of a trajectory.

    ``state`` adds the factors once, ``add`` takes measurements as they arrive, in any order, and ``data`` gives what a
    solve needs of them for nodes that stand at given times. Nothing is compiled or laid out again in between.

    A stamp on a node falls on it; equal stamps take a slot each. The oldest nodes leave, and with them the measurements
    before what is the oldest then. What arrives after that is refused and counted, as is all else that finds no slot.

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
        robust: Loss | None = None,
        name: str = "stamped",
    ) -> None:
        """Describe the sensor.

        Args:
            error: ``error(x, z)`` or ``error(x, other, ..., z)``, (n, m): what measurements z (n, size) differ by from
                what they should be at states x (n, storage). A batched function, or a residual made of one.
            size: how many numbers a measurement has.
            capacity: slots of an interval between two nodes.
            sigma: standard deviations, one or (m,).
            between: how states are interpolated; the geodesic of their manifold by default.
            robust: loss.
            name: of the term.

        Raises:
            ModelError: when there is no slot or nothing measured, or ``error`` is no batched function.
        """
        if size < 1 or capacity < 1:
            raise ModelError(f"'{name}': size {size} and capacity {capacity} must be at least 1")
        self.name, self.size, self.capacity = name, size, capacity
        self._error, self._sigma, self._between, self._robust = _batched(error, name), sigma, between, robust
        self._slots: _Slots | None = None
        self._stamps: Array = np.empty(0)
        self._values: Array = np.empty((0, size))
        self._known: BoolArray = np.empty(0, dtype=bool)  # whether data() has placed them before
        self.counts = Counts()

    def state(self, graph: Statement, nodes: Variable, *others: Any, offset: Variable | None = None) -> str:
        """Add the factors, all inactive; returns the name of their term.

        Args:
            graph: to add to.
            nodes: two or more, in the order of time.
            *others: arguments of ``error`` after the state, the same for all measurements: selections of length
                one, constants, or data.
            offset: a variable on Rn(1): by how much the sensor's clock is behind [s], so that a measurement was taken
                at its stamp plus this.

        Raises:
            ModelError: when it has been stated before, there are fewer than two nodes, or the offset is no number.
        """
        x = as_selection(nodes)
        if self._slots is not None:
            raise ModelError(f"'{self.name}' has been stated already: each graph takes measurements of its own")
        if len(x) < 2:
            raise ModelError(f"'{self.name}' needs two nodes or more to stand between, found {len(x)}")
        if offset is not None and (len(offset), as_selection(offset).manifold.dim) != (1, 1):
            raise ModelError(f"'{self.name}': the offset of a clock is one variable on Rn(1)")
        count = (len(x) - 1) * self.capacity
        slots = _Slots(
            graph.data(f"{self.name}: time into step", np.zeros(count), each=True),
            graph.data(f"{self.name}: length of step", np.ones(count), each=True),
            graph.data(f"{self.name}: values", np.zeros((count, self.size)), each=True),
            graph.data(f"{self.name}: filled", np.zeros(count, dtype=bool), each=True),
            len(x),
            offset is not None,
        )
        before = np.repeat(np.arange(len(x) - 1), self.capacity)
        function = _at_stamp(self._error, self._between or geodesic(x.manifold), offset is not None)
        clock = () if offset is None else (offset,)
        name = graph.minimize(
            function,
            *(x[before], x[before + 1], *clock, slots.into, slots.step, slots.value, *others),
            sigma=self._sigma,
            robust=self._robust,
            active=slots.filled,
            name=self.name,
        )
        self._slots = slots
        return name

    def add(self, stamp: ArrayLike, value: ArrayLike) -> None:
        """Take measurements: one stamp [s] and (size,) value, or (k,) stamps and (k, size) values, in any order.

        Numbers that are not finite are no measurement: they are left out and counted.

        Raises:
            ModelError: on another shape.
        """
        stamps, values = np.array(stamp, dtype=np.float64), np.array(value, dtype=np.float64)
        wanted = (*stamps.shape, self.size)
        if stamps.ndim > 1 or (values.shape != wanted and not (self.size == 1 and values.shape == stamps.shape)):
            raise ModelError(f"'{self.name}': stamps {stamps.shape} need values {wanted}, found {values.shape}")
        stamps, values = np.atleast_1d(stamps), values.reshape(-1, self.size)
        good = np.isfinite(stamps) & np.isfinite(values).all(axis=1)
        self._count(invalid=int((~good).sum()))
        self._stamps = np.concatenate([self._stamps, stamps[good]])
        self._values = np.concatenate([self._values, values[good]])
        self._known = np.concatenate([self._known, np.zeros(int(good.sum()), dtype=bool)])

    def data(self, times: ArrayLike, offset: float = 0.0) -> dict[Data, Array]:
        """What a solve needs, for nodes that stand at these times.

        Args:
            times: (n,) of the nodes, increasing [s].
            offset: of the sensor's clock, as it is believed to be: it says between which nodes a measurement lies.

        Raises:
            ModelError: when nothing has been stated, or times are not one for each node, finite and increasing.
        """
        if self._slots is None:
            raise ModelError(f"'{self.name}' has not been stated: call state(graph, nodes) first")
        slots, at = self._slots, np.asarray(times, dtype=np.float64)
        good = at.shape == (slots.nodes,) and np.isfinite(at).all() and (np.diff(at) > 0.0).all()
        if not (good and np.isfinite(offset)):
            raise ModelError(f"'{self.name}': times must be {slots.nodes} finite, increasing numbers, found {at}")
        interval, place = self._place(at, offset)
        slot = interval * self.capacity + place
        count, stamps = len(slots.filled.value), self._stamps[: len(slot)]
        into, step, filled = np.zeros(count), np.ones(count), np.zeros(count, dtype=bool)
        values = np.zeros((count, self.size))
        into[slot] = (stamps - at[interval]) + (0.0 if slots.clocked else offset)
        step[slot] = np.diff(at)[interval]
        values[slot] = self._values[: len(slot)]
        filled[slot] = True
        return {slots.into: into, slots.step: step, slots.value: values, slots.filled: filled}

    def _place(self, at: Array, offset: float) -> tuple[IntArray, IntArray]:
        """Keep what has a slot, first, and what waits; returns intervals and places in them of the former."""
        taken = self._stamps + offset
        slack = CLOSE * float(np.diff(at).min()) + 4.0 * float(np.spacing(np.abs(at).max()))
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
        stay = np.concatenate([chosen, waiting])
        self._stamps, self._values = self._stamps[stay], self._values[stay]
        self._known = np.arange(len(stay)) < len(chosen)
        self.counts = replace(self.counts, placed=len(chosen), waiting=len(waiting))
        return interval, _ranks(interval)

    def _count(self, **more: int) -> None:
        """Add to the counts."""
        self.counts = replace(self.counts, **{name: getattr(self.counts, name) + n for name, n in more.items()})


def _ranks(groups: IntArray) -> IntArray:
    """How many of its group come before each entry."""
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

    def stamped(x: Array, y: Array, into: Array, step: Array, z: Array, *others: Any) -> Array:
        return error(between(x, y, into / step, step), *others, z)

    def clocked_stamped(x: Array, y: Array, late: Array, into: Array, step: Array, z: Array, *others: Any) -> Array:
        return error(between(x, y, (into + late[:, 0]) / step, step), *others, z)

    return clocked_stamped if clocked else stamped
