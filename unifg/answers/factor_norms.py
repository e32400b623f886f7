"""How badly each factor fits: the norm of its residual, term by term, worked out only where somebody asks.

A factor of a cost has the norm of its whitened residual, before any robust loss; a factor of a constraint or a bound
the norm of what lies outside its limits, in the constraint's own units; a factor of a scalar cost the magnitude of its
value. The square root of the sum of squares over a term (for scalar costs the sum) is what ``Iteration.terms`` shows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import numpy as np

from unifg.errors import GraphError
from unifg.program.linearization import Linearization
from unifg.program.program import Program
from unifg.typing import Array


class FactorNorms(Mapping[str, Array]):
    """Norms (n,) of the factors of every term, by its name, in the order of the graph."""

    def __init__(self, parts: dict[str, Array]) -> None:
        """Keep one array per term."""
        self._parts = parts

    def __getitem__(self, term: str) -> Array:
        """(n,) norms of a term's factors; zero where a factor is inactive.

        Raises:
            GraphError: when no term has that name.
        """
        if term not in self._parts:
            raise GraphError(f"no term is called '{term}' (there are: {', '.join(self._parts) or 'none'})", term=term)
        return self._parts[term]

    def __contains__(self, term: object) -> bool:
        """Whether a term has that name."""
        return term in self._parts

    def __iter__(self) -> Iterator[str]:
        """Names of the terms."""
        return iter(self._parts)

    def __len__(self) -> int:
        """Number of terms."""
        return len(self._parts)

    def __repr__(self) -> str:
        """Terms with their numbers of factors."""
        return f"<FactorNorms {', '.join(f'{name}: {len(part)}' for name, part in self._parts.items())}>"


def factor_norms(program: Program, lin: Linearization, outside: Array) -> FactorNorms:
    """The norms at a linearisation, in new arrays.

    Args:
        program: the compiled graph.
        lin: where.
        outside: (M,) violation there, see :meth:`unifg.program.program.Program.violation`.
    """
    robust = {term.name: np.sqrt(lin.squares[part]) for term, part in program.table.robust}
    parts: dict[str, Array] = {}
    for term in program.terms:
        name = term.name
        if name in robust:
            parts[name] = robust[name]
        elif name in lin.scalars:
            parts[name] = np.abs(lin.scalars[name])
        else:
            rows = program.rows_of(term, lin.residual, outside)
            parts[name] = np.sqrt(np.einsum("nm,nm->n", rows, rows))
    return FactorNorms(parts)


class Deferred:
    """Norms of one iterate, worked out when they are first asked for, as long as the iterate is at hand."""

    def __init__(self, measure: Callable[[], FactorNorms]) -> None:
        """Nothing is computed yet."""
        self._measure: Callable[[], FactorNorms] | None = measure
        self._found: FactorNorms | None = None

    def __call__(self) -> FactorNorms | None:
        """The norms, None when nobody asked in time."""
        if self._found is None and self._measure is not None:
            self._found = self._measure()
        return self._found

    def close(self) -> None:
        """Let go of the iterate; what has been asked for stays."""
        self._measure = None
