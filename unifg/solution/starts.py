"""Further starts around a guess, for problems with several minima (multistart).

Families of many members, which mostly run along a trajectory, move by smooth curves that leave their ends alone; others
member by member. The moves are as large as what the guess itself covers, so that they are in the user's units.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from unifg.lie import Manifold
from unifg.problem.compiled_problem import CompiledProblem
from unifg.solution.guess import Guess
from unifg.typing import Array

WAVES = 3  # half waves along a family at most
LONG = 5  # members from which on a family is taken for a trajectory


def spread(program: CompiledProblem, guess: tuple[Array, Array, Array], count: int) -> Iterator[Guess]:
    """Starts around a guess, the same ones each time, within the bounds of the unknowns; made one by one.

    Args:
        program: the compiled graph, with its data bound whenever a start is asked for.
        guess: stored values, multipliers and penalties.
        count: of starts.
    """
    rng, (values, multipliers, penalties) = np.random.default_rng(0), guess
    for _ in range(count):
        moved = program.columns.view(values.copy())
        for family, points in moved.items():
            points[:] = family.manifold.retract(points, _steps(family.manifold, points, rng))
        program.retraction.fix(moved)
        yield Guess.stored(program, (program.within_bounds(moved).flat, multipliers, penalties))


def extent(manifold: Manifold, points: Array) -> Array:
    """(d,) largest tangent coordinates from the first of (n, storage) points to the others; 1 where all are one."""
    covered = np.abs(manifold.local(np.repeat(points[:1], len(points), axis=0), points)).max(axis=0, initial=0.0)
    return np.asarray(np.where(covered > 0.0, covered, covered.max(initial=0.0) or 1.0))


def _steps(manifold: Manifold, points: Array, rng: np.random.Generator) -> Array:
    """(n, d) random tangent steps for (n, storage) points."""
    count, size = len(points), extent(manifold, points)
    if count < LONG:
        return np.asarray(size * rng.standard_normal((count, manifold.dim)))
    waves = np.sin(np.pi * np.outer(np.linspace(0.0, 1.0, count), np.arange(1, WAVES + 1)))
    heights = rng.standard_normal((WAVES, manifold.dim)) / np.arange(1, WAVES + 1)[:, None]
    return np.asarray(0.5 * size * (waves @ heights))
