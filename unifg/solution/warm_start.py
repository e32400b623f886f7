"""Answers moved towards the end of a horizon: where each number of the next guess stands in the last answer."""

from __future__ import annotations

import numpy as np

from unifg.errors import GraphError, require_kinds
from unifg.locks import ReentrantLock
from unifg.modeling.soft import SlackFamily
from unifg.modeling.variables import Family
from unifg.problem.compiled_problem import CompiledProblem
from unifg.typing import IntArray

KEPT = 64  # ways to shift that are remembered: control loops ask for the same one every tick


class Shifts:
    """The ways to shift the answers of one program."""

    def __init__(self, program: CompiledProblem) -> None:
        """Nothing is known before somebody asks."""
        self._program, self._lock = program, ReentrantLock()
        self._known: dict[tuple[tuple[Family, ...], int], tuple[IntArray, IntArray]] = {}

    def __call__(self, families: tuple[Family, ...], by: int) -> tuple[IntArray, IntArray]:
        """Places of the stored values (S,) and of the constraint rows (M,) that the next guess takes.

        Args:
            families: those that run along the horizon.
            by: number of stages.

        Raises:
            GraphError: when a family is of another graph, or ``by`` is negative.
        """
        for family in families:
            if not isinstance(family, Family):
                raise GraphError(f"shifted takes whole families, as shifted(x, u), found {family!r}")
        known = self._known.get((families, by))
        if known is None:
            require_kinds("shifted", GraphError, Shifts.__call__.__annotations__, {"by": by})
            if by < 0:
                raise GraphError(f"shifted: by must not be negative, found {by}")
            known = self._stored(families, by), self._rows(families, by)
            with self._lock:
                if len(self._known) >= KEPT:
                    self._known.pop(next(iter(self._known)))
                self._known[families, by] = known
        return known

    def _stored(self, families: tuple[Family, ...], by: int) -> IntArray:
        columns = self._program.columns
        places = columns.view(np.arange(float(columns.stored)))
        for family in families:
            if family not in places:
                raise GraphError(f"family '{family.name}' is not part of this solution", family=family.name)
            stages = np.minimum(np.arange(family.count) + by, family.count - 1)
            places[family][:] = places[family][stages]
        return places.flat.astype(np.intp)

    def _rows(self, families: tuple[Family, ...], by: int) -> IntArray:
        program = self._program
        places = np.arange(program.constraints.count)
        first = None
        for term, rows in zip(program.constraint_terms, program.slices, strict=True):
            selection = term.gathers[0].selection
            if first is None or not isinstance(selection.family, SlackFamily):  # which move with what they slacken
                first = selection
            if first.family in families and len(first) == term.count:
                own = places[rows].reshape(term.count, term.size)
                places[rows] = own[_later(first.indices.tolist(), by)].ravel()
        return places


def _later(stages: list[int], by: int) -> IntArray:
    """For each factor the factor ``by`` stages later with the same rank within its stage.

    Where no such stage exists, the last stage that has that rank serves.

    Args:
        stages: of the factors.
        by: number of stages.
    """
    place: dict[tuple[int, int], int] = {}
    seen: dict[int, int] = {}
    keys = []
    last: dict[int, int] = {}
    for factor, stage in enumerate(stages):
        rank = seen.get(stage, 0)
        seen[stage] = rank + 1
        place[stage, rank] = factor
        keys.append((stage, rank))
        if rank not in last or stage >= keys[last[rank]][0]:
            last[rank] = factor
    return np.array([place.get((stage + by, rank), last[rank]) for stage, rank in keys], dtype=np.intp)
