"""Linearisations in the memory of compiled loops, copied as one block; arrays are viewed when somebody reads them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from itertools import accumulate, pairwise
from typing import Any

import numpy as np

from unifg.modeling.variables import Family
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.linearization import Linearization
from unifg.typing import Array

MADE = ("norms", "scalars", "rounding")  # of other arrays


class LinearizationMemory:
    """Arrays of one linearisation that compiled code writes to, side by side.

    Attributes:
        arrays: by their names in :class:`Linearization`; ``values`` are stored ones, ``heights`` are the values of all
            scalar costs, ``sizes`` what the norms are made of.
    """

    def __init__(self, program: CompiledProblem) -> None:
        """Make room."""
        table, columns, normal = program.table, program.columns, program.normal.nnz
        sizes = {
            "values": columns.stored,
            "residual": table.residuals,
            "jacobian": table.entries,
            "constraints": table.constraints,
            "constraint_jacobian": table.constraint_entries,
            "gradient": columns.width,
            "hessian": normal,
            "weights": table.weights,
            "squares": table.weights,
            "concavity": normal if table.scalars else 0,
            "heights": table.scalars,
            "sizes": len(program.arrays.fields),
        }
        ends = list(accumulate(sizes.values(), initial=0))
        self._program, self._flat = program, np.zeros(ends[-1])
        self._parts = {name: slice(*part) for name, part in zip(sizes, pairwise(ends), strict=True)}
        self.arrays = {name: self._flat[part] for name, part in self._parts.items()}

    def copied(self, cost: float) -> Linearization:
        """The linearisation that stands there now."""
        return Snapshot(self._program, cost, self._flat.copy(), self._parts)


class Snapshot(Linearization):
    """A linearisation whose arrays are parts of one."""

    def __init__(self, program: CompiledProblem, cost: float, flat: Array, parts: Mapping[str, slice]) -> None:
        """Made by :meth:`LinearizationMemory.copied`."""
        self.cost = cost
        self._program, self._flat, self._parts = program, flat, parts
        self._stored = flat[parts["values"]]

    @property
    def stored(self) -> Array:
        """Stored values of all families."""
        return self._stored

    def of(self, family: Family) -> Array:
        """(count, storage) values of one family, without a look at the others."""
        part, shape = self._program.columns.place(family)
        return self._stored[part].reshape(shape)

    def __getattr__(self, name: str) -> Any:
        """View an array, once."""
        if name not in MADE and name not in self.__dict__.get("_parts", ()):
            raise AttributeError(name)
        found = self.__dict__[name] = self._made(name)
        return found

    def _made(self, name: str) -> Any:
        program = self._program
        if (part := self._parts.get(name)) is not None:
            return program.columns.view(self.stored) if name == "values" else self._flat[part]
        if name == "norms":
            return program.norms(self.sizes, self.heights)
        if name == "scalars":
            return program.by_scalar(self.heights)
        return np.zeros(program.columns.width if program.scalar_terms else 0)

    def __reduce__(self) -> tuple[type[Linearization], tuple[Any, ...]]:
        """Pickle plain arrays: views of one array would become arrays of their own."""
        return Linearization, tuple(getattr(self, field.name) for field in fields(Linearization))
