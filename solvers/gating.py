"""Measurements compared with what the others say about them, whether a robust loss kept them or left them out.

Far from the answer a right measurement may have a large residual only because nothing else holds the variables it
connects. Its innovation tells: with r the whitened residual, J its Jacobian and S the covariance of the unknowns from
all measurements that count, r' (I + J S J')^-1 r follows the chi-squared distribution of a right measurement, whatever
the odometry drifted in between. This is the individual gate of data association (Bar-Shalom and Fortmann, "Tracking
and data association", 1988), with the marginals of the whole graph.

A wrong measurement that counts hides in the same way: what nothing else holds bends until it fits. With weight w in
the covariance S, r' (I / w - J S J')^-1 r is its innovation if it were taken out, and by as much twice the cost would
fall. It is compared with how the rest scatters rather than with one (Pope, "The statistics of residuals and the
detection of outliers", NOAA Technical Report NOS 65 NGS 1, 1976): information matrices are often guessed on the safe
side, and a contradiction within them is still one if everything else agrees ten times better.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unifg.elimination.components import components
from unifg.elimination.factorization import Factorization
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.linearization import Linearization
from unifg.problem.table import ENTRY, ROW, WIDTH
from unifg.problem.term import CompiledTerm
from unifg.solution.chi_squared import upper_quantile
from unifg.typing import Array, BoolArray, IntArray

NEAR = 10  # members of a family between two measurements of one group, at most
FEWEST = 3  # measurements that are a group
CHANCE = 0.01  # that a right measurement among all is called wrong
STEPS = 30  # of conjugate gradients
EXACT = 1e-4  # residual they end at
UNCHECKED = 1e-9  # share of a residual that the others can see: below, it is rounding


@dataclass(frozen=True)
class VarianceFactor:
    """Variance factor of the measurements in use.

    Attributes:
        squared: sum of their weighted squared residuals.
        freedom: number of their residuals less the number of unknowns; infinite where their noise is known.
    """

    squared: float
    freedom: float

    @property
    def unit(self) -> float:
        """Variance of unit weight, the upper end of its confidence interval; never above one.

        It is about one where information matrices are right, and one where too few measurements tell.
        """
        if not 1.0 <= self.freedom < np.inf or self.squared <= 0.0:
            return 1.0
        return min(1.0, self.squared / upper_quantile(self.freedom, 1.0 - CHANCE))

    def rejects(self, innovation: Array, size: int, count: int) -> BoolArray:
        """Test whether measurements scatter more than the others, at a false-alarm rate of ``CHANCE`` in ``count``.

        Args:
            innovation: (n,) what the sum of squares loses with each of them.
            size: numbers in a measurement.
            count: how many are looked at.
        """
        if np.isinf(self.freedom):
            return innovation > upper_quantile(size, CHANCE / max(count, 1))
        rest = self.freedom - size
        if rest < 1.0:
            return np.zeros(len(innovation), dtype=np.bool_)
        without = np.maximum(self.squared - innovation, np.finfo(np.float64).eps * self.squared) / rest
        from scipy.special import fdtri  # slow to load

        limit = float(fdtri(size, rest, 1.0 - CHANCE / max(count, 1)))
        return innovation > size * limit * without

    def limit(self, size: int, count: int) -> float:
        """Normalised squared innovation up to which a measurement left out agrees with those that count."""
        if self.freedom < 1.0:
            return np.inf
        from scipy.special import fdtri

        return size * float(fdtri(size, self.freedom, 1.0 - CHANCE / max(count, 1))) * self.squared / self.freedom


class Innovations:
    """Innovations of the measurements in use and of the others.

    Attributes:
        determined: whether they determine every unknown.
    """

    def __init__(self, program: CompiledProblem, solver: Factorization, information: Array) -> None:
        """Factorise.

        Args:
            program: the compiled graph.
            solver: for matrices in the pattern ``program.normal``.
            information: entries of the Hessian of the measurements that count.
        """
        self._program, self._solver = program, solver
        self.determined = solver.factor(information) and solver.definite
        self._inverse = solver.selected_inverse() if self.determined else np.zeros(0)

    def squared(self, term: CompiledTerm, lin: Linearization, chosen: BoolArray) -> Array:
        """(k,) normalised squared innovations r' (I + J S J')^-1 r.

        Args:
            term: a cost of the graph.
            lin: linearisation without losses, where S was taken.
            chosen: (n,) factors that do not count.
        """
        residual, spread = self._spread(term, lin, chosen)
        innovation = np.eye(term.size) + spread
        squared: Array = np.einsum("ni,ni->n", residual, np.linalg.solve(innovation, residual[:, :, None])[:, :, 0])
        return squared

    def without(self, term: CompiledTerm, lin: Linearization, chosen: BoolArray, weight: Array) -> tuple[Array, Array]:
        """(k,) r' (I / w - J S J')^-1 r, and (k,) squared residuals that measurements would have without themselves.

        Directions in which nothing else holds what a measurement connects say nothing about it and are left out.

        Args:
            term: a cost of the graph.
            lin: linearisation without losses, where S was taken.
            chosen: (n,) factors that count.
            weight: (k,) with which they do.
        """
        residual, spread = self._spread(term, lin, chosen)
        share, axes = np.linalg.eigh(np.eye(term.size) - weight[:, None, None] * spread)
        along = np.einsum("nia,ni->na", axes, residual)
        seen = np.where(share > UNCHECKED, 1.0 / np.maximum(share, UNCHECKED), 0.0)
        return weight * np.einsum("na,na->n", along**2, seen), ((along * seen) ** 2).sum(axis=1)

    def joint(self, term: CompiledTerm, lin: Linearization, chosen: IntArray, weight: Array) -> float:
        """Fall r' (I / W - J S J')^-1 r of the sum of squares without all of several measurements.

        By conjugate gradients, which take few steps: what measurements of a group have in common is all that the others
        leave open. A direction that nothing else holds is left out.

        Args:
            term: a cost of the graph.
            lin: linearisation without losses, where S was taken.
            chosen: (k,) factors that count.
            weight: (k,) with which they do.
        """
        residual, jacobian, columns = self.rows(term, lin, chosen)
        free = columns >= 0

        def spread(errors: Array) -> Array:
            right = np.zeros(self._program.size)
            np.add.at(right, columns[free], np.einsum("nia,ni->na", jacobian, errors)[free])
            moved = self._solver.solve(right)
            seen: Array = np.einsum("nia,na->ni", jacobian, np.where(free, moved[columns], 0.0))
            return seen

        found, left = np.zeros_like(residual), residual
        along, size = left, float(np.sum(left * left))
        first = size
        for _ in range(STEPS):
            if not size > EXACT**2 * first:
                break
            bent = along / weight[:, None] - spread(along)
            curvature = float(np.sum(along * bent))
            if not curvature > UNCHECKED * float(np.sum(along * along)):
                break
            found = found + size / curvature * along
            left = left - size / curvature * bent
            before, size = size, float(np.sum(left * left))
            along = left + size / before * along
        return float(np.sum(residual * found))

    def common(self, rows: tuple[Array, Array, IntArray], shift: Array, starts: IntArray) -> tuple[Array, Array, Array]:
        """Sums over measurements of a group that may have an error in common, which moves their residuals by A e.

        With these, pull' (own - taken)^-1 pull is what the sum of squares loses where a group that counts is given such
        an error of its own, and pull' (own + taken)^-1 pull is the squared innovation of one that does not count.

        Args:
            rows: see :meth:`rows`; one group after the other.
            shift: (n, m, q) A of each of them.
            starts: (c,) first measurement of each group.

        Returns:
            (c, q, q) A' A, (c, q, q) A' J S J' A, and (c, q) A' r.
        """
        residual, jacobian, columns = rows
        own = np.add.reduceat(np.einsum("nmi,nmj->nij", shift, shift), starts)
        pull = np.add.reduceat(np.einsum("nmi,nm->ni", shift, residual), starts)
        free = columns >= 0
        values = np.einsum("nma,nmi->nai", jacobian, shift)[free]
        ends = np.concatenate([[0], np.cumsum(free.sum(axis=1))])
        taken = self._solver.products(ends[np.append(starts, len(residual))], columns[free], values)
        return own, taken, pull

    def redundancy(self, term: CompiledTerm, lin: Linearization, weight: Array) -> float:
        """Residuals of a term that count, less those that the unknowns take up: sum w (m - w tr J S J').

        Args:
            term: a cost of the graph.
            lin: linearisation without losses, where S was taken.
            weight: (n,) with which factors count.
        """
        counts = weight > 0.0
        spread = np.einsum("nii->n", self._spread(term, lin, counts)[1])
        return float(np.sum(weight[counts] * (term.size - weight[counts] * spread)))

    def _spread(self, term: CompiledTerm, lin: Linearization, chosen: BoolArray) -> tuple[Array, Array]:
        """(k, m) residuals and (k, m, m) J S J' of some factors."""
        residual, jacobian, columns = self.rows(term, lin, chosen)
        spread = np.einsum("nia,nab,njb->nij", jacobian, self._covariance(columns), jacobian, optimize=True)
        return residual, 0.5 * (spread + spread.transpose(0, 2, 1))

    def rows(
        self, term: CompiledTerm, lin: Linearization, chosen: BoolArray | IntArray
    ) -> tuple[Array, Array, IntArray]:
        """(k, m) residuals, (k, m, w) Jacobians and (k, w) their unknowns of some factors."""
        size, width, count = term.size, int(term.place[WIDTH]), term.count
        row, entry = int(term.place[ROW]), int(term.place[ENTRY])
        residual = lin.residual[row : row + count * size].reshape(count, size)[chosen]
        jacobian = lin.jacobian[entry : entry + count * size * width].reshape(count, size, width)[chosen]
        return residual, jacobian, self._program.columns.unknown[np.concatenate(term.columns, axis=1)[chosen]]

    def _covariance(self, columns: IntArray) -> Array:
        """(k, w, w) joint covariances of the unknowns of a factor, zero for fixed ones."""
        normal = self._program.normal
        first, second = np.broadcast_arrays(columns[:, :, None], columns[:, None, :])
        free = (first >= 0) & (second >= 0)
        covariance = np.zeros(free.shape)
        places = normal.positions(np.minimum(first, second)[free], np.maximum(first, second)[free])
        covariance[free] = self._inverse[places]
        return covariance


def groups_of(term: CompiledTerm, chosen: BoolArray) -> list[IntArray]:
    """Groups of at least three factors that join the same stretches of a family, such as two drives along one street.

    Args:
        term: a term whose factors are told apart by the positions of their variables.
        chosen: (n,) factors to be grouped.
    """
    selections = [one for one in term.term.selections if one.count == term.count]
    which = np.flatnonzero(chosen)
    if len(selections) < 2 or len(which) < FEWEST:
        return []
    places = np.stack([one.indices[which] for one in selections], axis=1)
    return [np.sort(which[group]) for group in neighbours(places, NEAR) if len(group) >= FEWEST]


def neighbours(places: IntArray, near: int) -> list[IntArray]:
    """Groups of rows of (n, k) places that lie near each other in every place, one by one; every row is in a group."""
    order = np.argsort(places[:, 0], kind="stable")
    places = places[order]
    pairs = [(np.zeros(0, dtype=np.intp),) * 2]
    for apart in range(1, len(order)):
        first, second = np.arange(len(order) - apart), np.arange(apart, len(order))
        if not (close := places[second, 0] - places[first, 0] <= near).any():
            break
        close &= (np.abs(places[second] - places[first]) <= near).all(axis=1)
        pairs.append((first[close], second[close]))
    part = components(len(order), *(np.concatenate(ends) for ends in zip(*pairs, strict=True)))
    inner = np.argsort(part, kind="stable")
    return np.split(order[inner], np.flatnonzero(np.diff(part[inner])) + 1) if len(order) else []
