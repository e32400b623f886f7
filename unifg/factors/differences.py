"""Batched numerical differentiation on manifolds.

A factor is evaluated for the whole batch at once, and where the function allows it (:mod:`unifg.factors.batched`) for
many perturbations at once: a Jacobian is one call then. Perturbations are on the right: ``x [+] d = x Exp(d)``. Steps
are those of :mod:`unifg.factors.steps`. What the function returns is copied at once: it may use the same memory at each
call.

A move is a row of multiples of the steps along all directions. What belongs to the manifolds and the moves alone is
found once; at a point everything is done for all moves together, because the cost of small arrays is in the calls.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple, TypeAlias

import numpy as np

from unifg.factors.steps import (
    ANGLE,
    EPSILON,
    FAR,
    FIRST,
    OTHER,
    SECOND,
    TURN,
    VECTOR,
    Part,
    parts_of,
    steps_for,
    uncertainties,
)
from unifg.lie import SO2, SO3, Manifold
from unifg.typing import Array, BoolArray, IntArray

FURTHER = 1024.0  # steps of ``Directions.anywhere``, at most
KEPT = 64  # sets of directions whose pairs are kept
OBLIQUE = (32, 64)  # 64ths of a step along each direction, so that points stay numbers of their own
ROUNDING = 16.0  # of what a residual sums up: a mixed difference of four values below this is no curvature


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
            for part, leaf in parts_of(manifold):
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
        """Steps by the rule of :mod:`unifg.factors.steps`."""
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
        """(n, storage) points after one move, one array per variable."""
        return [stack[0] for stack in self.moved(steps, moves, k, k + 1)]

    def rotations(self) -> list[tuple[slice, Array]]:
        """Columns of the positions that belong to a rotation, and the (n, d, d) rotations."""
        found = []
        for k, part, columns in self.directions.poses:
            group, stored = (SO2, 1) if part.dim == 2 else (SO3, 4)
            found.append((columns, group.matrix(self.points[k][:, part.turn : part.turn + stored])))
        return found


@lru_cache(maxsize=256)
def directions_of(manifolds: tuple[Manifold, ...]) -> Directions:
    """The directions of some manifolds, found once."""
    return Directions(manifolds)


Many: TypeAlias = Callable[[Near, Steps, Moves], Array]
"""(K, n, ...) values of a function after K moves, which the next call may overwrite."""


def jacobian(function: Callable[..., Array], points: Sequence[Array], manifolds: Sequence[Manifold]) -> list[Array]:
    """Central differences of a batched function along each tangent direction.

    Args:
        function: maps arrays like ``points`` to (n, m).
        points: one (n, storage_k) array per variable.
        manifolds: the manifold of each variable.

    Returns:
        One (n, m, d_k) array per variable.
    """
    return slopes(one_by_one(function), directions_of(tuple(manifolds)), points)


def slopes(many: Many, directions: Directions, points: Sequence[Array]) -> list[Array]:
    """Central differences of a function (n, m) of many moves: one (n, m, d_k) array per variable."""
    near = Near(directions, points)
    width, steps = directions.width, near.steps(FIRST)
    values = many(near, steps, directions.two_sided)
    found = np.subtract(values[:width], values[width:], out=values[:width])
    found /= 2.0 * steps.half.T[:, :, None]
    far = near.size >= FAR
    if far.any():
        found, wider = found.copy(), near.wider(steps, FIRST)
        values = many(near, wider, directions.four_points)
        ahead, behind, two_ahead, two_behind = values.reshape(4, width, *values.shape[1:])
        half = wider.half.T[:, :, None]
        fourth = (4.0 * ((ahead - behind) / (2.0 * half)) - (two_ahead - two_behind) / (4.0 * half)) / 3.0
        doubt = np.where(wider.half > steps.half, uncertainties(near.size[:, None], steps.half), np.inf).T[:, :, None]
        found = np.where((np.abs(fourth - found) <= doubt) & far[:, None], fourth, found)
    blocks = np.array(np.moveaxis(found, 0, -1), order="C")
    for turned, R in near.rotations():
        along = blocks[..., turned]
        blocks[..., turned] = sum(along[..., k : k + 1] * R[:, None, k] for k in range(R.shape[1]))
    return np.split(blocks, directions.ends, axis=-1)


def scalar_slopes(many: Many, directions: Directions, points: Sequence[Array]) -> tuple[Array, Array, Array]:
    """Gradient (n, D), symmetric Hessian (n, D, D), and rounding of the gradient (n, D), of a scalar function.

    The function is (n,) of many moves, and D the sum of d_k. The gradient comes from two points near the centre, and
    from four points further away where these agree as nearly as rounding of the two lets them: they know more digits
    of a large value. Directions of different variables commute; within one variable the symmetrised second derivative
    of ``t -> f(x Exp(t d))`` is taken, which is the Hessian a Newton step along Exp needs.
    """
    near, width = Near(directions, points), directions.width
    first, steps = near.steps(FIRST), near.steps(SECOND)
    values = many(near, first, directions.two_sided)
    two = (values[:width] - values[width:]).T / (2.0 * first.half)
    values = many(near, steps, directions.scalar)
    centre, values = values[0], values[1:]
    inside, outside, ahead, behind = values[: 4 * width].reshape(4, width, len(centre))
    h, noise = steps.half, EPSILON * np.abs(centre)[:, None]
    four = (8.0 * (inside - outside) - (ahead - behind)).T / (6.0 * h)
    doubt = noise / first.half
    doubt = doubt + np.where((near.size >= FAR)[:, None], uncertainties(near.size[:, None], first.half), 0.0)
    believed = np.abs(four - two) <= doubt
    gradient = np.where(believed, four, two)
    rounding = np.where(believed, 3.0 * noise / h, noise / first.half)
    hessian = np.empty((len(centre), width, width))
    diagonal = np.arange(width)
    hessian[:, diagonal, diagonal] = ((ahead - centre) + (behind - centre)).T / h**2
    a, b = directions.lower
    both, one, other, neither = values[4 * width :].reshape(4, len(a), len(centre))
    hessian[:, a, b] = hessian[:, b, a] = (both - one - other + neither).T / (4.0 * h[:, a] * h[:, b])
    _to_body(near, gradient, hessian)
    return gradient, hessian, rounding


def weighted_hessian(many: Many, directions: Directions, points: Sequence[Array], weights: Array) -> Array:
    """(n, D, D) second differences of weights' r for a residual r (n, m) of many moves.

    All steps are those of a factor's largest coordinate, because that is what the residual may round. Most residuals
    are straight along most of their directions. Which ones is asked anew at every point, because a residual may be
    straight here and bent elsewhere: the mixed differences along each direction and one that lies across all of them
    are, to rounding, zero for all rows that count. Only between directions that bend are pairs looked at.

    Args:
        many: the residual.
        directions: of its variables.
        points: one (n, storage_k) array per variable.
        weights: (n, m).
    """
    near, width = Near(directions, points), directions.width
    hessian = np.zeros((len(weights), width, width))
    if not weights.any():
        return hessian
    steps = near.wider(near.steps(SECOND), SECOND)
    values = many(near, steps, directions.across)
    centre = values[0].copy()
    change = values[1:] - centre
    across = change[0]
    ahead, behind, mixed = change[1:].reshape(3, width, *centre.shape)
    slope = ahead - behind
    reach = 0.5 * (1.0 + np.abs(near.coordinates) / steps.half)
    rounding = ROUNDING * EPSILON * (np.abs(centre) + np.einsum("nc,cnm->nm", reach, np.abs(slope)))
    straight = (np.abs(mixed - ahead - across) <= rounding) | (weights == 0.0)
    bent: BoolArray = ~straight.reshape(width, -1).all(axis=1)
    chosen = np.flatnonzero(bent)
    if len(chosen):
        both = np.einsum("nm,cnm->nc", weights, ahead + behind)
        hessian[:, chosen, chosen] = both[:, chosen] / steps.half[:, chosen] ** 2
    if len(chosen) > 1:
        first, second, moves = directions.pairs(chosen)
        values = many(near, steps, moves) - centre
        pairs = np.einsum("nm,cnm->nc", weights, values[: len(first)] + values[len(first) :])
        pairs -= both[:, first] + both[:, second]
        pairs /= 2.0 * steps.half[:, first] * steps.half[:, second]
        hessian[:, first, second] = hessian[:, second, first] = pairs
    if directions.poses:
        gradient = np.einsum("nm,cnm->nc", weights, slope) / (2.0 * steps.half)
        _to_body(near, gradient, hessian)
    return hessian


def one_by_one(function: Callable[..., Array]) -> Many:
    """Call a function once for each move."""

    def many(near: Near, steps: Steps, moves: Moves) -> Array:
        return np.stack([np.array(function(*near.after(steps, moves, k))) for k in range(moves.count)])

    return many


def convexified(blocks: Array) -> Array:
    """Hessian blocks of scalar costs with negative curvature removed: a Gauss-Newton step must descend."""
    if not np.isfinite(blocks).all():
        return blocks
    eigenvalues, vectors = np.linalg.eigh(blocks)
    result: Array = (vectors * np.maximum(eigenvalues, 0.0)[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    return result


def _to_body(near: Near, gradient: Array, hessian: Array) -> None:
    """Turn derivatives along stored positions into those along the axes of the body, in place.

    With t the translation and r the rotation that follows it, the position moves by ``R (t + 1/2 r x t + ...)``: to
    second order a mixed entry of t and r also has half of the gradient along ``r x t``.
    """
    for columns, R in near.rotations():
        stop, turned = columns.stop, _TURNED[columns.stop - columns.start]
        gradient[:, columns] = np.einsum("nk,nki->ni", gradient[:, columns], R)
        hessian[:, columns, :] = np.swapaxes(R, 1, 2) @ hessian[:, columns, :]
        hessian[:, :, columns] = hessian[:, :, columns] @ R
        bent = 0.5 * np.einsum("nk,ijk->nij", gradient[:, columns], turned)
        after = slice(stop, stop + turned.shape[1])
        hessian[:, columns, after] += bent
        hessian[:, after, columns] += np.swapaxes(bent, 1, 2)


_TURNED = {
    2: np.array([[[0.0, 1.0]], [[-1.0, 0.0]]]),
    3: np.array([[np.cross(r, t) for r in np.eye(3)] for t in np.eye(3)]),
}
"""Products r x t of a turn r and a translation t: axes of t, axes of r, coordinates."""
