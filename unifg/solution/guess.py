"""Guesses: values, and the multipliers and penalties that a solve may begin with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from unifg.errors import GraphError, require_kinds
from unifg.modeling.variables import Family
from unifg.problem.compiled_problem import CompiledProblem
from unifg.typing import Array


@dataclass(frozen=True)
class Guess:
    """Values of the families, multipliers and penalties of the constraints by term name.

    Attributes:
        values: (count, storage) per family.
        multipliers: (n, m) per constraint term; absent terms start at zero.
        penalties: (n, m) per constraint term, of backends that have them; absent terms leave them to the backend.
    """

    values: Mapping[Family, Array]
    multipliers: Mapping[str, Array] = field(default_factory=dict)
    penalties: Mapping[str, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse what is no mapping."""
        require_kinds("Guess", GraphError, Guess.__annotations__, vars(self), Mapping)

    @classmethod
    def stored(cls, program: CompiledProblem, arrays: tuple[Array, Array, Array]) -> Guess:
        """A guess of flat arrays - stored values, multipliers (M,), penalties (M,) - viewed when somebody reads it."""
        guess = cls.__new__(cls)
        guess.__dict__["_stored"] = program, arrays
        return guess

    def flat(self, program: CompiledProblem) -> tuple[Array, Array, Array] | None:
        """The flat arrays, if it is made of those of this program and nobody has viewed them."""
        own, arrays = self.__dict__.get("_stored", (None, None))
        return arrays if own is program else None

    def __getattr__(self, name: str) -> Any:
        """View the flat arrays."""
        if name not in ("values", "multipliers", "penalties") or "_stored" not in self.__dict__:
            raise AttributeError(name)
        program, (values, multipliers, penalties) = self.__dict__.pop("_stored")
        self.__dict__["values"] = program.columns.view(values)
        self.__dict__["multipliers"] = program.by_term(multipliers)
        self.__dict__["penalties"] = program.by_term(penalties) if penalties.any() else {}
        return self.__dict__[name]

    def __getstate__(self) -> dict[str, Any]:
        """Pickle what is viewed."""
        return {"values": self.values, "multipliers": self.multipliers, "penalties": self.penalties}
