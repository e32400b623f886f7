"""Terms evaluated as they were written: the user's functions, weights, losses and limits, called by NumPy.

No trace, no compiled problem and no linear algebra of the engine takes part, so that a mistake in one of these shows.
Slopes are central differences of two step lengths, extrapolated (Richardson); what the two disagree by, and rounding,
bounds their error. Every factor reads arguments of its own, so that one call moves the same argument of all factors.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from unifg.factors.autodiff.derived import in_python
from unifg.modeling.terms import Constraint, Cost, Fix, ScalarCost, Term
from unifg.modeling.variables import Data, Family, Selection
from unifg.problem.columns import Columns
from unifg.problem.term import resolve
from unifg.problem.traced import has_rows
from unifg.typing import Array, BoolArray, IntArray

STEP = 6e-5  # the longer of two steps [m, rad, ...]
LENGTHS = STEP * np.array([1.0, -1.0, 0.5, -0.5])
EPSILON = 2.0 * float(np.finfo(np.float64).eps)
NOISE = 20.0  # roundings in second differences
LONGEST = 1 << 18  # numbers in the points of one call
ALIKE = 10.0 * EPSILON  # relative difference of a factor's rows in a call of more factors
BEND = 1e-5  # of a squared norm, by which the slope of a robust loss is found


class WrittenTerm:
    """One term at an answer.

    Attributes:
        term: as stated.
        columns: (n, D) tangent coordinates of its variables, numbered over all variables.
        active: (n,) factors that count.
        rows: (n, m) residuals, not whitened; (n, 1) values of a scalar cost; zero where inactive.
        rounding: (n, 1) of the variables of each factor.
    """

    def __init__(self, term: Term, columns: Columns, values: Mapping[Family, Array], data: Mapping[Data, Array]):
        """Evaluate the term.

        Args:
            term: as stated.
            columns: numbering of the tangent coordinates.
            values: (count, storage) of each family.
            data: values of data; defaults stand for others.
        """
        self.term, self._data, n = term, data, term.count
        self._arguments = [resolve(a, data) if isinstance(a, Data) else a for a in term.arguments]
        self._places = [k for k, a in enumerate(term.arguments) if isinstance(a, Selection)]
        own = []
        for k, chosen in zip(self._places, term.selections, strict=True):
            times = n if len(chosen) == 1 else 1
            self._arguments[k] = np.repeat(values[chosen.family][chosen.indices][:, chosen.storage], times, axis=0)
            own.append(np.repeat(columns.of(chosen), times, axis=0))
        self._long = not term.residual.rows  # whether many moves stand in one call
        self.columns: IntArray = np.concatenate(own, axis=1)
        mask = resolve(term.active, data) if isinstance(term.active, Data) else term.active
        self.active: BoolArray = np.ones(n, dtype=bool) if mask is None else mask.astype(bool)
        points = [self._arguments[k] for k in self._places]
        self.rows, sizes = self._rows(points), [np.abs(point).max(axis=1, keepdims=True) for point in points]
        self.rounding = EPSILON * np.maximum(1.0, np.max(sizes, axis=0))  # of zero, that of a number of order one

    def _rows(self, points: list[Array], times: int = 1) -> Array:
        """(times n, m) rows with the variable arguments at some points (times n, storage)."""
        own, n = self.term.residual, self.term.count * times
        declared = list(zip(self._arguments, self.term.rows, strict=True))
        arguments = [
            np.tile(a, (times, *[1] * (a.ndim - 1)))
            if times > 1 and k not in self._places and rows is not False and np.ndim(a) and len(a) == self.term.count
            else a
            for k, (a, rows) in enumerate(declared)
        ]
        for k, point in zip(self._places, points, strict=True):
            arguments[k] = point.copy()  # the function may write into it
        if own.rows:
            each = [k in self._places or (has_rows(a, rows) and len(a) == n) for k, (a, rows) in enumerate(declared)]
            found = np.zeros((n, own.rows))
            for i in np.flatnonzero(self.active):
                given = [np.array(a[i] if row else a) for a, row in zip(arguments, each, strict=True)]
                found[i] = in_python(own.function, [a if a.ndim else float(a) for a in given], own.rows)
            return found
        found = np.array(own.function(*arguments)).reshape(n, -1)
        return found if self.active.all() else np.where(np.tile(self.active, times)[:, None], found, 0.0)

    def _moved(self, there: list[Array]) -> Array:
        """(K, n, m) rows with each variable argument at (K + 2, n, storage) points, in one call where that is allowed.

        The function may know how many factors there are: then the call fails, or its last rows differ from those by
        themselves. The two last points move all arguments, and an odd number of points stands before the last.
        """
        times, n = there[0].shape[:2]
        if self._long and sum(points.size for points in there) <= LONGEST:
            last = self._rows([points[-1] for points in there])
            try:
                found = self._rows([points.reshape(times * n, -1) for points in there], times)
                found = found.reshape(times, *last.shape)
                if (np.abs(found[-1] - last) <= ALIKE * (1.0 + np.abs(last))).all():
                    return found[:-2]
            except Exception:  # of the user's function
                pass
            self._long = False
        return np.stack([self._rows([points[k] for points in there]) for k in range(times - 2)])

    def slopes(self) -> tuple[Array, Array, Array]:
        """(n, m, D) derivatives along right perturbations, bounds of their errors, and rough second derivatives.

        A kink at the point itself makes both quotients alike. It shows in second differences, which are there
        proportional to the step, and to its square where a function is smooth.
        """
        (n, width), count, first, there = self.columns.shape, len(LENGTHS), 0, []
        for place, chosen in zip(self._places, self.term.selections, strict=True):
            point, dim = self._arguments[place], chosen.manifold.dim
            points = np.empty((count * width + 2, *point.shape))
            points[:] = point
            own = points[:-2].reshape(count, width, *point.shape)[:, first : first + dim]
            steps = np.repeat((LENGTHS[:, None, None] * np.eye(dim)).reshape(-1, dim), n, axis=0)
            own[:] = np.asarray(chosen.manifold.retract(own.reshape(-1, point.shape[1]), steps)).reshape(own.shape)
            points[-2:], first = own[-1, -1], first + dim
            there.append(points)
        found = self._moved(there).reshape(count, width, *self.rows.shape)
        ahead, behind, near, nearly = np.ascontiguousarray(found.transpose(0, 2, 3, 1))
        here = self.rows[:, :, None]
        long, short = (ahead - behind) / (2.0 * STEP), (near - nearly) / STEP
        bend = ahead - here + (behind - here)
        numbers = here, short, bend / STEP**2
        small = min(1.0, max(float(np.abs(part).max(initial=0.0)) for part in numbers))  # where all the term's are
        of_variables = self.rounding[:, :, None] * np.maximum(small, np.abs(short))
        rounding = (of_variables + EPSILON * np.abs(here) * np.maximum(1.0, np.abs(short))) / STEP
        kink = np.abs(4.0 * (near - here + (nearly - here)) - bend) / STEP
        doubt = np.abs(long - short) + np.maximum(kink - NOISE * rounding, 0.0) + np.where(short == 0.0, 0.0, rounding)
        return (4.0 * short - long) / 3.0, doubt, numbers[2]

    def cost(self) -> tuple[Array, Array, Array]:
        """(n,) what each factor costs, (n, m) its derivatives with respect to the rows, (n, m, m) those of squares.

        The last is the Gauss-Newton matrix of a factor, by its rows.
        """
        term, r = self.term, self.rows
        n, m = r.shape
        if isinstance(term, ScalarCost):
            return r[:, 0], np.where(self.active[:, None], 1.0, 0.0), np.zeros((n, 1, 1))
        assert isinstance(term, Cost)
        weights = np.broadcast_to(np.eye(m), (n, m, m))
        if term.sigma is not None:
            weights = weights / np.broadcast_to(resolve(term.sigma, self._data), (n, m))[:, :, None] ** 2
        if term.information is not None:
            weights = np.broadcast_to(resolve(term.information, self._data), (n, m, m))
        weighted = np.einsum("nab,nb->na", weights, r)
        squared = np.einsum("na,na->n", weighted, r)
        if term.robust is None:
            return 0.5 * squared, weighted, weights
        loss, weight = term.robust, term.robust.weight(squared)
        value = (lambda s: weight * s) if loss.held else loss.value  # a held weight is no function of the residual
        ahead, behind = value(squared * (1.0 + BEND)), value(squared * (1.0 - BEND))
        slope = np.where(squared > 0.0, (ahead - behind) / np.where(squared > 0.0, 2.0 * BEND * squared, 1.0), 1.0)
        cost = np.where(self.active, 0.5 * value(squared), 0.0)
        return cost, slope[:, None] * weighted, slope[:, None, None] * weights

    def limits(self) -> tuple[Array, Array]:
        """(n, m) lower and upper limits of a constraint; none where a factor is inactive."""
        term = self.term
        assert isinstance(term, Constraint)
        stated = [resolve(limit, self._data) for limit in (term.lower, term.upper)]
        lower, upper = (np.broadcast_to(limit, self.rows.shape) for limit in stated)
        return np.where(self.active[:, None], lower, -np.inf), np.where(self.active[:, None], upper, np.inf)


def off_manifold(values: Mapping[Family, Array]) -> tuple[str, int] | None:
    """Family and index of the first member that is no point of its manifold."""
    for family, points in values.items():
        wrong = np.flatnonzero(~(family.manifold.is_valid(points) & np.isfinite(points).all(axis=1)))
        if len(wrong):
            return family.name, int(wrong[0])
    return None


def moved_fix(fix: Fix, values: Mapping[Family, Array], data: Mapping[Data, Array]) -> float:
    """Largest difference of fixed variables from the value they are fixed at."""
    chosen = fix.selection
    here = values[chosen.family][chosen.indices][:, chosen.storage]
    value = resolve(fix.value, data)
    return float(np.abs(here - value).max(initial=0.0))
