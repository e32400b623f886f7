"""The values a solve starts from: a guess, checked, with fixed variables where they are fixed."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from unifg.codegen.jit import compiled
from unifg.errors import GraphError
from unifg.lie import LieGroup, Manifold
from unifg.lie.so3 import all_unit
from unifg.modeling.duplicates import doubles
from unifg.modeling.elements import QUATERNIONS
from unifg.modeling.model import Model
from unifg.modeling.soft import SlackFamily
from unifg.modeling.variables import Family
from unifg.problem.columns import Columns, Values
from unifg.problem.linearization import all_finite
from unifg.problem.retraction import Retraction
from unifg.typing import Array, ArrayLike, IntArray


class GuessReader:
    """Reads guesses for the families of a graph.

    Attributes:
        quaternions: places where quaternions start among stored values.
        particular: other parts of families whose points are not all finite numbers.
    """

    def __init__(self, graph: Model, columns: Columns, retraction: Retraction) -> None:
        """Find the parts of the families that need more of a look than whether they are finite."""
        self._graph = graph
        self._columns = columns
        self._retraction = retraction
        self.particular: list[tuple[Family, slice, Manifold]] = []
        starts = [np.zeros(0, dtype=np.int64)]
        for family in columns.families:
            members = columns.storage[family] + np.arange(family.count) * family.manifold.storage
            for leaf, storage, _ in columns.leaves[family]:
                if isinstance(leaf, QUATERNIONS):
                    starts.append(members + storage + leaf.storage - 4)
                elif getattr(type(leaf), "is_valid", None) is not LieGroup.is_valid:
                    self.particular.append((family, slice(storage, storage + leaf.storage), leaf))
        self.quaternions = np.concatenate(starts)

    def __call__(self, guess: Mapping[Family, ArrayLike] | Array) -> Values:
        """Copy and check a guess, by families or as it is stored, and give fixed variables their values.

        Raises:
            GraphError: naming the family and index of what is missing, misshapen, NaN or off its manifold.
        """
        if isinstance(guess, np.ndarray):
            values = Values(self._columns, guess.copy())
        elif isinstance(guess, Values) and guess.columns is self._columns and guess.intact:
            values = Values(self._columns, guess.flat.copy())
        else:
            values = self._read(guess)
        fine = self.settles(values.flat)
        if not (fine and all(leaf.is_valid(values[f][:, part]).all() for f, part, leaf in self.particular)):
            self._name_invalid(values)
        return values

    def settles(self, stored: Array) -> bool:
        """Give fixed variables their values; test that all numbers are finite, and quaternions of norm 1."""
        fixed = self._retraction
        return bool(settle(stored, fixed.fixed, fixed.fixed_values, self.quaternions))

    def _read(self, guess: Mapping[Family, ArrayLike]) -> Values:
        """A copy of values from anywhere."""
        for family in guess:
            if isinstance(family, SlackFamily):  # whose values are those of the limits' violation
                continue
            if not isinstance(family, Family) or self._graph.families.get(family.name) is not family:
                named = isinstance(family, str) and family in self._graph.families
                hint = ": take the family itself, as graph.variables returned it, not its name" if named else ""
                raise GraphError(f"the guess contains {family!r}, which is no family of this graph{hint}")
        values = Values(self._columns, np.empty(self._columns.stored))
        for family, own in values.items():
            given = guess.get(family)
            if given is None:
                if not self._columns.all_fixed(family) and not isinstance(family, SlackFamily):
                    raise GraphError(
                        f"the guess has no values for family '{family.name}': give an array of shape {own.shape}",
                        family=family.name,
                    )
                own[:] = family.manifold.identity()
                continue
            array = doubles(f"the guess for family '{family.name}'", given)
            if array.shape != own.shape:
                raise GraphError(
                    f"the guess for family '{family.name}' has shape {array.shape}, expected {own.shape}",
                    family=family.name,
                )
            own[:] = array
        return values

    def _name_invalid(self, values: Values) -> None:
        for family, array in values.items():
            valid = family.manifold.is_valid(array)
            if not valid.all():
                index = int(np.flatnonzero(~valid)[0])
                part, (_, storage) = self._columns.place(family)
                own = np.arange(storage) + part.start + index * storage
                what = "the value that fixes" if np.isin(own, self._retraction.fixed).all() else "the guess for"
                raise GraphError(
                    f"{what} {family.name}[{index}] is not on {family.manifold.name}: {array[index]}",
                    family=family.name,
                    index=index,
                )


@compiled
def settle(values: Array, fixed: IntArray, fixed_values: Array, quaternions: IntArray) -> bool:
    """Give fixed variables their values; tell whether all numbers are finite, and quaternions of norm 1."""
    for k in range(len(fixed)):
        values[fixed[k]] = fixed_values[k]
    return all_finite(values) and all_unit(values, quaternions)
