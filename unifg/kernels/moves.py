"""Points of a batch moved along their tangent directions, many moves at a time.

A move is a row of multiples of the steps along all directions. What belongs to the manifolds and the moves alone is
found once; at a point everything is done for all moves together, because the cost of small arrays is in the calls.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from unifg.kernels.steps import ANGLE, OTHER, TURN, VECTOR, Part, parts_of, rotations, steps_for
from unifg.lie import Manifold
from unifg.typing import Array, IntArray

FURTHER = 1024.0  # steps of ``Directions.anywhere``, at most
KEPT = 64  # sets of directions whose pairs are kept
OBLIQUE = (32, 64)  # 64ths of a step along each direction, so that points stay numbers of their own


class Steps(NamedTuple):
    """Steps of every factor along every direction.

    Attributes:
        length: (n, D) as asked for.
        half: (n, D) half of what a step there and one back come to in the numbers that are stored.
    """

    length: Array
    half: Array


class Moves:
    """Multiples of the steps, and what they move.

    Attributes:
        count: number of moves K.
        multiples: (K, D).
    """

    def __init__(self, directions: Directions, multiples: Array) -> None:
        """Find what each move touches."""
        self.count, self.multiples = len(multiples), multiples
        self.added: list[tuple[IntArray, IntArray, IntArray, Array]] = []
        self.turned: list[list[tuple[Part, Manifold, slice, IntArray, Array]]] = []
        for own in directions.parts:
            added = [np.zeros(0, dtype=np.int64)]
            axes, places = added.copy(), added.copy()
            turned = []
            for part, leaf, columns in own:
                mine = multiples[:, columns]
                if part.kind == VECTOR:
                    move, axis = np.nonzero(mine)
                    added.append(move)
                    axes.append(axis + columns.start)
                    places.append(axis + part.start)
                else:
                    rows = np.flatnonzero(mine.any(axis=1))
                    turned.append((part, leaf, columns, rows, mine[rows][:, None, :]))
            move, axis, place = (np.concatenate(found) for found in (added, axes, places))
            self.added.append((move, axis, place, multiples[move, axis][:, None]))
            self.turned.append(turned)


class Directions:
    """The tangent directions of the variables of a factor, side by side.

    Attributes:
        width: number of them, D.
        parts: for each variable its parts, the manifold of each, and the columns of each among all.
        poses: positions that turn with a rotation: variable, part, columns.
        storage: numbers in the variables.
        ends: where the columns of one variable end and those of the next begin.
        places, summed: where the coordinate of each direction is stored, and whether steps are added to it.
        ruling: places of the coordinates that rule the steps of a whole factor.
        shared, turns: columns whose steps are those of the largest of some numbers, and those of a rotation.
        two_sided, four_points: a step ahead along each direction, then one back; after these the same with two steps.
        anywhere: a few moves along all directions at once.
        across: none, one along all directions at once, one ahead and one back along each, those ahead with the second.
        lower: every pair of directions.
        scalar: none, half a step ahead and back, a step ahead and back, and both ahead, either, none for each pair.
    """

    def __init__(self, manifolds: Sequence[Manifold]) -> None:
        """Take the manifolds of the variables."""
        self.parts: list[list[tuple[Part, Manifold, slice]]] = []
        self.poses: list[tuple[int, Part, slice]] = []
        places: list[int] = []
        summed: list[bool] = []
        self.shared: list[tuple[slice, slice]] = []  # columns whose step is that of the largest of some numbers
        self.turns: list[slice] = []
        numbers: list[int] = []  # which rule the steps of all
        at = column = 0
        for k, manifold in enumerate(manifolds):
            own = []
            for part, leaf in parts_of([manifold]):
                columns = slice(column + part.column, column + part.column + part.dim)
                stored = slice(at + part.start, at + part.start + part.storage)
                own.append((part, leaf, columns))
                if part.turn >= 0:
                    self.poses.append((k, part, columns))
                if part.kind in (VECTOR, OTHER):
                    numbers += range(stored.start, stored.stop)
                    if part.turn >= 0 or part.kind == OTHER:
                        self.shared.append((columns, stored))
                if part.kind == TURN:
                    self.turns.append(columns)
                places += [stored.start + (axis if part.kind != OTHER else 0) for axis in range(part.dim)]
                summed += [part.kind in (VECTOR, ANGLE)] * part.dim
            self.parts.append(own)
            at, column = at + manifold.storage, column + manifold.dim
        self.width = column
        self.ends = np.cumsum([manifold.dim for manifold in manifolds])[:-1]
        self.places, self.summed = np.array(places, dtype=np.int64), np.array(summed, dtype=bool)
        self.all_summed, self.ruling = all(summed), np.array(numbers, dtype=np.int64)
        self.storage, self.all_rule, self.in_place = at, len(numbers) == at, places == list(range(at))
        self._pairs: dict[bytes, tuple[IntArray, IntArray, Moves]] = {}
        one = np.eye(column)
        self.two_sided = Moves(self, np.concatenate([one, -one]))
        self.four_points = Moves(self, np.concatenate([one, -one, 2.0 * one, -2.0 * one]))
        rng = np.random.default_rng(0)
        self.anywhere = Moves(self, rng.uniform(-FURTHER, FURTHER, (3, column)))
        oblique = rng.integers(*OBLIQUE, column) / OBLIQUE[1] * rng.choice([-1.0, 1.0], column)
        nowhere = np.zeros((1, column))
        self.across = Moves(self, np.concatenate([nowhere, [oblique], one, -one, one + oblique]))
        self.lower = a, b = np.tril_indices(column, -1)
        corners = [s * one[a] + t * one[b] for s in (1.0, -1.0) for t in (1.0, -1.0)]
        self.scalar = Moves(self, np.concatenate([nowhere, 0.5 * one, -0.5 * one, one, -one, *corners]))

    def pairs(self, chosen: IntArray) -> tuple[IntArray, IntArray, Moves]:
        """Every pair of the chosen directions, and the moves ahead along both, then those back."""
        key = chosen.tobytes()
        if key not in self._pairs:
            row, column = np.tril_indices(len(chosen), -1)
            first, second = chosen[row], chosen[column]
            ahead = np.zeros((len(first), self.width))
            ahead[np.arange(len(first)), first] = ahead[np.arange(len(first)), second] = 1.0
            if len(self._pairs) >= KEPT:
                self._pairs.clear()
            self._pairs[key] = first, second, Moves(self, np.concatenate([ahead, -ahead]))
        return self._pairs[key]


class Near:
    """The points of a batch, and what can be reached from them.

    Attributes:
        directions: of the variables.
        points: one (n, storage) array per variable.
        joined: (n, storage) of all variables side by side.
        size: (n,) the largest of the coordinates that rule the steps of a factor.
    """

    def __init__(self, directions: Directions, points: Sequence[Array]) -> None:
        """Look at some points."""
        self.directions, self.points = directions, points
        self.joined = points[0] if len(points) == 1 else np.concatenate(points, axis=1)
        ruling = self.joined if directions.all_rule else self.joined[:, directions.ruling]
        self._stepped = self.joined if directions.in_place else self.joined[:, directions.places]
        self.size: Array = np.abs(ruling).max(axis=1, initial=0.0)

    @property
    def coordinates(self) -> Array:
        """(n, D) numbers that steps are added to; zero for directions of another kind."""
        directions, x = self.directions, self._stepped
        return x if directions.all_summed else np.where(directions.summed, x, 0.0)

    def steps(self, root: int) -> Steps:
        """Steps by the rule of :mod:`unifg.kernels.steps`."""
        directions = self.directions
        x = self._stepped
        size: Array = np.abs(x)
        for columns, stored in directions.shared:
            size[:, columns] = np.abs(self.joined[:, stored]).max(axis=1)[:, None]
        for columns in directions.turns:
            size[:, columns] = 1.0
        return self._realised(x, steps_for(size, root))

    def wider(self, steps: Steps, root: int) -> Steps:
        """Steps as long as those of the largest coordinate, or longer."""
        least = steps_for(self.size, root)[:, None]
        return self._realised(self._stepped, np.maximum(steps.length, least))

    def _realised(self, x: Array, length: Array) -> Steps:
        half = 0.5 * ((x + length) - (x - length))
        directions = self.directions
        return Steps(length, half if directions.all_summed else np.where(directions.summed, half, length))

    def moved(self, steps: Steps, moves: Moves, first: int, last: int) -> list[Array]:
        """One (k, n, storage) array per variable: the points after each move from ``first`` up to ``last``."""
        result = []
        for point, added, turned in zip(self.points, moves.added, moves.turned, strict=True):
            stack = np.empty((last - first, *point.shape))
            stack[:] = point
            move, axis, place, times = added
            if last - first < moves.count:
                mine = (move >= first) & (move < last)
                move, axis, place, times = move[mine] - first, axis[mine], place[mine], times[mine]
            if len(move):
                stack[move, :, place] += times * steps.length.T[axis]
            for part, leaf, columns, rows, multiples in turned:
                mine = (rows >= first) & (rows < last)
                rows = rows[mine] - first
                if len(rows):
                    tangent = multiples[mine] * steps.length[:, columns]
                    stored = np.ascontiguousarray(stack[rows, :, part.start : part.start + part.storage])
                    found = leaf.retract(stored.reshape(-1, part.storage), tangent.reshape(-1, part.dim))
                    stack[rows, :, part.start : part.start + part.storage] = found.reshape(stored.shape)
            result.append(stack)
        return result

    def after(self, steps: Steps, moves: Moves, k: int) -> list[Array]:
        """(n, storage) points after one move, one array per variable; what it leaves where it is is not copied."""
        result = []
        for point, (move, axis, place, times), turned in zip(self.points, moves.added, moves.turned, strict=True):
            entries = np.flatnonzero(move == k)
            parts = [(part, leaf, columns, many[rows == k]) for part, leaf, columns, rows, many in turned if k in rows]
            moved = np.array(point) if len(entries) or parts else point
            for e in entries:
                moved[:, place[e]] += times[e] * steps.length[:, axis[e]]
            for part, leaf, columns, multiples in parts:
                stored = moved[:, part.start : part.start + part.storage]
                stored[:] = leaf.retract(stored, multiples[0] * steps.length[:, columns])
            result.append(moved)
        return result

    def rotations(self) -> list[tuple[slice, Array]]:
        """Columns of the positions that belong to a rotation, and the (n, d, d) rotations."""
        poses = self.directions.poses
        return [(columns, rotations(self.points[k], part.turn, part.dim)) for k, part, columns in poses]


@lru_cache(maxsize=256)
def directions_of(manifolds: tuple[Manifold, ...]) -> Directions:
    """The directions of some manifolds, found once."""
    return Directions(manifolds)
