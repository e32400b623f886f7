"""The present values of all data of a program: which have changed, and parameters of kernels brought up to date.

A control loop gives all its data anew at every tick. One compiled pass finds NaN, compares, and carries numbers to
where the loops over terms read them; Python hears only of data that something must be worked out from.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Protocol, TypeAlias
from weakref import ReferenceType

import numpy as np

from unifg.codegen.jit import compiled
from unifg.errors import GraphError
from unifg.lie.so3 import UNIT, all_unit
from unifg.modeling.elements import elements_of, nearest, particular, quaternions_of
from unifg.modeling.terms import Term
from unifg.modeling.variables import Data
from unifg.typing import Array, ArrayLike, BoolArray, IntArray

FLOAT64 = np.dtype(np.float64)


Moved: TypeAlias = tuple[list[IntArray], list[IntArray], Array]
"""Places as :meth:`Binding.place` gives them, places in an array, and the array."""


class Holder(Protocol):
    """Solution that keeps the data it was found with, once they are replaced."""

    _data: bytes | None


class Binding:
    """Copies of all data that nobody else writes to.

    Attributes:
        present: the value of every datum, an array that keeps its place.
        edition: how often some of them have been replaced by others.
        carried: sources, targets and array of what is copied to parameters, and to fixed variables.
        holder: to whom the present values belong; it gets a copy when they are replaced, if it is still there.
    """

    carried: tuple[IntArray, IntArray, Array, IntArray, IntArray, Array]
    holder: ReferenceType[Holder] | None = None
    _others = False  # whether there are elements of manifolds with other conditions than a norm

    def __init__(self, known: Mapping[str, Data], used: Iterable[Data], terms: Sequence[Term] = ()) -> None:
        """Make room.

        Args:
            known: the data of a graph by their names; the mapping may grow.
            used: those a program reads.
            terms: that read them; what stands for elements of a manifold there is looked at as such.
        """
        elements = [
            (f"term '{term.name}': argument {place} of {term.residual.name}", argument, manifold, term)
            for term in terms
            for place, manifold in elements_of(term.residual).items()
            if isinstance(argument := term.arguments[place], Data) and argument.value.dtype == FLOAT64
            if particular(manifold)
        ]
        self._known = known
        handles = list(dict.fromkeys(used))
        self._numbers = [handle for handle in handles if handle.value.dtype == FLOAT64]
        self._flags = [handle for handle in handles if handle.value.dtype != FLOAT64]
        self._starts = np.cumsum([0, *(handle.value.size for handle in self._numbers)]).astype(np.int64)
        self._flat, self._coming = np.empty(self._starts[-1]), np.empty(self._starts[-1])
        self._slots = dict(zip(self._numbers, self._views(self._coming), strict=True))
        self.present = dict(zip(self._numbers, self._views(self._flat), strict=True))
        # Compiled code tests quaternions, and all are looked at where one is not of norm 1.
        starts, self._elements = [np.zeros(0, dtype=np.int64)], elements
        for _, handle, manifold, _ in elements:
            found, own = quaternions_of(manifold), self.place(handle).reshape(-1, manifold.storage)
            starts += [own[:, start] for start in found or ()]
            self._others = self._others or found is None
        self.quaternions = np.concatenate(starts)
        self.present.update({handle: np.empty_like(handle.value) for handle in self._flags})
        self._changed = np.zeros(len(self._numbers), dtype=np.bool_)
        self._all, self.edition = True, 0
        self.carry(([], [], np.empty(0)), ([], [], np.empty(0)))

    def kept(self) -> bytes:
        """Present numbers side by side, and flags after them; bytes are copied faster than small arrays."""
        return self._flat.tobytes() + b"".join(self.present[handle].tobytes() for handle in self._flags)

    def named(self, kept: bytes) -> dict[Data, Array]:
        """Values of all data, of what :meth:`kept` has returned."""
        found, at = {}, 0
        for handle, own in self.present.items():
            found[handle] = np.frombuffer(kept, own.dtype, own.size, at).reshape(own.shape)
            at += own.nbytes
        return found

    def _views(self, flat: Array) -> list[Array]:
        bounds = zip(self._numbers, self._starts[:-1], self._starts[1:], strict=True)
        return [flat[first:last].reshape(handle.value.shape) for handle, first, last in bounds]

    def place(self, handle: Data) -> IntArray:
        """Position of each number of a datum, in the shape of the datum; for :meth:`carry`."""
        first = int(self._starts[self._numbers.index(handle)])
        return first + np.arange(handle.value.size).reshape(handle.value.shape)

    def carry(self, parameters: Moved, fixed: Moved) -> None:
        """Have numbers copied to parameters and fixed variables from now on, whenever data are taken."""
        none = np.zeros(0, dtype=np.int64)
        flat = [
            np.concatenate([none, *(part.ravel() for part in parts)]).astype(np.int64)
            for parts in (*parameters[:2], *fixed[:2])
        ]
        self.carried = flat[0], flat[1], parameters[2], flat[2], flat[3], fixed[2]

    def rows(self, data: Mapping[Data, Array], count: int) -> Array | None:
        """(count, D) numbers of all data, with one value for each of many instances, as :meth:`take` would hold them.

        Defaults stand for what is not named. None where something else has to be looked at than finite numbers and
        quaternions of norm 1.
        """
        if self._others or self._flags or not data.keys() <= self._slots.keys():
            return None
        rows = np.empty((count, len(self._flat)))
        for handle, first, last in zip(self._numbers, self._starts[:-1], self._starts[1:], strict=True):
            rows[:, first:last] = np.asarray(data.get(handle, handle.value), dtype=np.float64).reshape(-1, last - first)
        quaternions = rows[:, self.quaternions[:, None] + np.arange(4)]
        off = np.abs(np.linalg.norm(quaternions, axis=2) - 1.0) >= UNIT
        return None if np.isnan(rows).any() or off.any() else rows

    def take(self, data: Mapping[Data, ArrayLike]) -> Sequence[Data]:
        """Take new values, defaults for what is not named, and say what is not as it was.

        Raises:
            GraphError: on unknown data, a changed shape, NaN, or elements off their manifold; nothing has changed then.
        """
        if self.holder is not None:
            if (holder := self.holder()) is not None:
                holder._data = self.kept() if self._flags else self._flat.tobytes()
            self.holder = None
        slots = self._slots
        if type(data) is not dict and not isinstance(data, Mapping):
            raise GraphError(f"data of a solve are {{handle: value, ...}}, found {f'{data!r}'[:80]}")
        for handle, value in data.items():
            slot = slots.get(handle)
            if slot is None:
                self._require(handle, value)
            elif type(value) is np.ndarray and value.shape == slot.shape and value.dtype == FLOAT64:
                slot[...] = value
            else:
                slot[...] = handle.check(value)
        if data.keys() != slots.keys():
            self._take_defaults(data)
        flags = {handle: handle.check(data.get(handle, handle.value)) for handle in self._flags} if self._flags else {}
        off = self._others or (len(self.quaternions) > 0 and not all_unit(self._coming, self.quaternions))
        for what, handle, manifold, term in self._elements if off else ():
            mask = flags[term.active].astype(bool) if isinstance(term.active, Data) else term.active
            slots[handle][...] = nearest(what, manifold, slots[handle], mask, term.name)
        count = _renew(self._coming, self._flat, self._starts, self._changed, *self.carried)
        if count < 0:
            self._numbers[-1 - count].check(slots[self._numbers[-1 - count]])
        changed = self._numbers
        if count < len(changed):
            changed = [h for h, new in zip(changed, self._changed.tolist(), strict=True) if new] if count else []
        for handle, array in flags.items():
            if not np.array_equal(array, self.present[handle]):
                self.present[handle][...] = array
                changed = [*changed, handle]
        self.edition += len(changed) > 0
        if self._all:
            self._all, changed = False, [*self._numbers, *self._flags]
        return changed

    def _take_defaults(self, data: Mapping[Data, ArrayLike]) -> None:
        """Take the defaults of what is not named."""
        for handle, slot in self._slots.items():
            if handle not in data:
                if handle.value.shape != slot.shape:
                    raise GraphError(
                        f"data '{handle.name}' has a default of shape {handle.value.shape} now, but the graph was "
                        f"compiled for {slot.shape}: declare new data"
                    )
                slot[...] = handle.value

    def forget(self) -> None:
        """Count everything as changed next time, as after a value that a term has refused."""
        self._all, self.edition = True, self.edition + 1

    def _require(self, handle: Data, value: ArrayLike) -> None:
        """Look at the value of what no kernel parameter is: flags, and data that no term uses."""
        if self._known.get(getattr(handle, "name", "")) is not handle:
            raise GraphError(f"data {handle!r} does not belong to this graph")
        handle.check(value)


@compiled
def _renew(
    coming: Array,
    present: Array,
    starts: IntArray,
    changed: BoolArray,
    sources: IntArray,
    targets: IntArray,
    parameters: Array,
    fixed_sources: IntArray,
    fixed_targets: IntArray,
    fixed: Array,
) -> int:
    """Number of data that have changed; -1 - k without any change when the k-th holds NaN."""
    for k in range(len(changed)):
        for i in range(starts[k], starts[k + 1]):
            if coming[i] != coming[i]:
                return -1 - k
    count = 0
    for k in range(len(changed)):
        new = False
        for i in range(starts[k], starts[k + 1]):
            if coming[i] != present[i]:
                new = True
            present[i] = coming[i]
        changed[k] = new
        count += 1 if new else 0
    for p in range(len(sources)):
        parameters[targets[p]] = present[sources[p]]
    for p in range(len(fixed_sources)):
        fixed[fixed_targets[p]] = present[fixed_sources[p]]
    return count
