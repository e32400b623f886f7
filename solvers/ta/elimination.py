"""Variable elimination on a linear graph whose constraints are enforced: Ta's "special version of QR" (section IV).

Eliminating a variable takes all factors on it. The rows of constraints come first, as rows of infinite weight would:
a Householder QR of their block finds which coordinates of the variable they determine, given its neighbours; what is
left of the rows constrains the neighbours alone. In the coordinates that stay free the other factors are minimised: by
another QR while they are rows, by Cholesky where a quadratic factor has joined them. The result is the variable as a
linear function of its neighbours, and one factor less one variable for the rest.

Cholesky needs the free coordinates to be convex, no more: with all constraints of a variable enforced, they are
whenever the Hessian is positive definite where the constraints leave freedom.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np

from unifg.errors import UnifgError
from unifg.typing import Array

Kind: TypeAlias = Literal["cost", "constraint", "curvature", "damping", "balance"]


@dataclass(frozen=True, eq=False)
class LinearFactor:
    """Rows sum_v A_v d_v = b: to be met in the sense of least squares, or exactly by a constraint.

    Attributes:
        name: of the factor it was made of.
        kind: "constraint" when the rows must hold.
        blocks: (m, d_v) per variable.
        right: (m,) b.
        size: largest entry of the rows when they were made; what is far below it is rounding.
    """

    name: str
    kind: Kind
    blocks: Mapping[str, Array]
    right: Array
    size: float

    @property
    def variables(self) -> tuple[str, ...]:
        """Names of its variables."""
        return tuple(self.blocks)

    @property
    def rows(self) -> int:
        """Number of rows."""
        return len(self.right)

    def residual(self, values: Mapping[str, Array]) -> Array:
        """(m,) A d - b."""
        return sum((block @ values[name] for name, block in self.blocks.items()), -self.right)

    def gradient_at(self, values: Mapping[str, Array]) -> dict[str, Array]:
        """(d_v,) per variable: gradient of 1/2 |A d - b|^2."""
        residual = self.residual(values)
        return {name: block.T @ residual for name, block in self.blocks.items()}

    def __str__(self) -> str:
        """Name, kind and variables."""
        relation = "=" if self.kind == "constraint" else "~"
        return f"{self.name}: {self.kind}, {self.rows} rows: A ({', '.join(self.variables)}) {relation} b"


@dataclass(frozen=True, eq=False)
class QuadraticFactor:
    """1/2 d'Gd + g'd, where G need not be positive: curvature, and costs that are no squares.

    Attributes:
        name: of the factor it was made of.
        kind: what it stands for.
        sizes: d_v per variable, in the order of the rows of G.
        hessian: (D, D) G.
        gradient: (D,) g.
    """

    name: str
    kind: Kind
    sizes: Mapping[str, int]
    hessian: Array
    gradient: Array

    @property
    def variables(self) -> tuple[str, ...]:
        """Names of its variables."""
        return tuple(self.sizes)

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Rows of each variable in G."""
        ends = np.cumsum([0, *self.sizes.values()]).tolist()
        return {name: slice(ends[k], ends[k + 1]) for k, name in enumerate(self.sizes)}

    def gradient_at(self, values: Mapping[str, Array]) -> dict[str, Array]:
        """(d_v,) per variable: G d + g."""
        step = np.concatenate([values[name] for name in self.sizes])
        total = self.hessian @ step + self.gradient
        return {name: total[part] for name, part in self.slices.items()}

    def __str__(self) -> str:
        """Name, kind and variables."""
        return f"{self.name}: {self.kind}, 1/2 d'Gd + g'd over ({', '.join(self.variables)})"


Factor: TypeAlias = LinearFactor | QuadraticFactor

RANK = 1e-10  # relative to a factor's own size: smaller is what rounding left of dependent rows
ROUNDING = 1e-14  # the same where nothing smaller may be lost: weak priors count
CONTRADICTION = 1e-8  # how far a row without variables may be from zero, relative to max(1, |b|)


class Contradiction(UnifgError):
    """Linear constraints that contradict each other."""


class Undetermined(UnifgError):
    """Factors that leave a variable undetermined, or have no minimum over it."""


@dataclass(frozen=True, eq=False)
class Conditional:
    """A variable as a function of those eliminated after it: d = offset + sum_s B_s d_s.

    Attributes:
        variable: its name.
        size: its dimension.
        held: how many of its coordinates constraints determine; costs determine the others.
        offset: (d,).
        blocks: (d, d_s) per variable of the separator.
    """

    variable: str
    size: int
    held: int
    offset: Array
    blocks: Mapping[str, Array]

    def value(self, later: Mapping[str, Array]) -> Array:
        """(d,) given the separator."""
        return sum((block @ later[name] for name, block in self.blocks.items()), self.offset.copy())

    def __str__(self) -> str:
        """Variable, separator, and what determines it."""
        given = f" | {' '.join(self.blocks)}" if self.blocks else ""
        return f"{self.variable}{given}  ({self.held} of {self.size} coordinates from constraints)"


@dataclass(frozen=True, eq=False)
class Elimination:
    """Result of elimination: a Bayes net.

    Attributes:
        conditionals: in the order of elimination.
    """

    conditionals: Sequence[Conditional]

    def solve(self) -> dict[str, Array]:
        """Values by name, by substitution from the last variable back to the first."""
        values: dict[str, Array] = {}
        for conditional in reversed(self.conditionals):
            values[conditional.variable] = conditional.value(values)
        return values

    def __str__(self) -> str:
        """A line for each conditional, in the order of elimination."""
        return "\n".join(map(str, self.conditionals))


def eliminate(
    sizes: Mapping[str, int],
    factors: Iterable[Factor],
    order: Sequence[str],
    *,
    undetermined: Literal["refuse", "zero"] = "refuse",
) -> Elimination:
    """Eliminate all variables.

    Args:
        sizes: dimension of each variable, by name.
        factors: what to solve.
        order: every variable once.
        undetermined: "refuse" coordinates that no factor determines, or set them to "zero".

    Raises:
        Contradiction: when constraints cannot all hold.
        Undetermined: when there is no unique minimum.
    """
    place = {name: k for k, name in enumerate(order)}
    waiting: list[list[Factor]] = [[] for _ in order]
    for factor in factors:
        if factor.variables:
            waiting[min(place[name] for name in factor.variables)].append(factor)
        elif isinstance(factor, LinearFactor) and factor.kind == "constraint":
            _require_zero(factor, factor.right, float(np.abs(factor.right).max(initial=0.0)))
    conditionals = []
    for k, name in enumerate(order):
        separator = sorted({v for factor in waiting[k] for v in factor.variables if v != name}, key=place.__getitem__)
        conditional, left = _eliminate(
            name, {v: sizes[v] for v in (name, *separator)}, waiting[k], undetermined == "zero"
        )
        conditionals.append(conditional)
        for factor in left:
            waiting[min(place[v] for v in factor.variables)].append(factor)
    return Elimination(tuple(conditionals))


def _eliminate(
    name: str, sizes: dict[str, int], factors: Sequence[Factor], zero: bool
) -> tuple[Conditional, list[Factor]]:
    """One variable, first in ``sizes``; the others are its separator."""
    d, width = sizes[name], sum(sizes.values())
    separator = {v: size for v, size in sizes.items() if v != name}
    linear = [factor for factor in factors if isinstance(factor, LinearFactor)]
    hard = [factor for factor in linear if factor.kind == "constraint"]
    soft = [factor for factor in linear if factor.kind != "constraint"]
    quadratic = [factor for factor in factors if isinstance(factor, QuadraticFactor)]
    left: list[Factor] = []

    # d_v = fixed + follow d_s + free z
    fixed, follow, free = np.zeros(d), np.zeros((d, width - d)), np.eye(d)
    if hard:
        fixed, follow, free, rest = _enforce(name, d, separator, hard)
        left += rest
    k = free.shape[1]
    basis = np.zeros((width, k + width - d))  # all coordinates from (z, d_s)
    basis[:d, :k], basis[:d, k:], basis[d:, k:] = free, follow, np.eye(width - d)
    offset = np.concatenate([fixed, np.zeros(width - d)])

    rows, right = _stack(soft, sizes)
    rows, right = rows @ basis, right - rows @ offset
    if quadratic:
        hessian, gradient = _sum(quadratic, sizes)
        gradient = basis.T @ (hessian @ offset + gradient) - rows.T @ right
        constant, slope, rest = _by_cholesky(name, basis.T @ hessian @ basis + rows.T @ rows, gradient, k, separator)
    else:
        constant, slope, rest = _by_qr(name, rows, right, k, separator, zero)
    left += rest
    total = follow + free @ slope
    ends = np.cumsum([0, *separator.values()])
    blocks = {v: total[:, ends[i] : ends[i + 1]] for i, v in enumerate(separator)}
    return Conditional(name, d, d - k, fixed + free @ constant, blocks), left


def _enforce(
    name: str, d: int, separator: dict[str, int], hard: Sequence[LinearFactor]
) -> tuple[Array, Array, Array, list[Factor]]:
    """Coordinates of a variable that constraints determine, those they leave free, and what is left of the rows."""
    from scipy.linalg import qr, solve_triangular  # slow to load, here and below

    rows, right = _stack(hard, {name: d, **separator})
    scale = np.concatenate([np.full(factor.rows, factor.size or 1.0) for factor in hard])
    rows, right = rows / scale[:, None], right / scale
    q, r, pivots = qr(rows[:, :d], pivoting=True)
    rank = int((np.abs(np.diag(r)) > RANK).sum())
    rows, right = q.T @ rows[:, d:], q.T @ right
    determined = np.empty((rank, d))
    determined[:, pivots] = r[:rank]
    turn, corner = qr(determined.T) if rank else (np.eye(d), np.zeros((0, 0)))
    # determined = corner' turn[:, :rank]': its range is solved for, its null space stays free.
    held, free = turn[:, :rank], turn[:, rank:]
    fixed = held @ solve_triangular(corner[:rank], right[:rank], trans="T") if rank else np.zeros(d)
    follow = -held @ solve_triangular(corner[:rank], rows[:rank], trans="T") if rank else np.zeros((d, rows.shape[1]))
    rows, bound = rows[rank:], right[rank:]
    empty = np.abs(rows).max(axis=1, initial=0.0) <= RANK
    names = " and ".join(dict.fromkeys(factor.name for factor in hard))
    whole = LinearFactor(names, "constraint", {}, bound, 1.0)
    _require_zero(whole, bound[empty], float(np.abs(right).max(initial=0.0)))
    rest: list[Factor] = []
    if not empty.all():
        rest.append(_linear(names, "constraint", rows[~empty], bound[~empty], separator, 1.0))
    return fixed, follow, free, rest


def _by_qr(
    name: str, rows: Array, right: Array, k: int, separator: dict[str, int], zero: bool
) -> tuple[Array, Array, list[Factor]]:
    """Minimise 1/2 |rows (z, d_s) - right|^2 over z: z = constant + slope d_s, and the rows that remain."""
    from scipy.linalg import qr, solve_triangular

    constant, slope = np.zeros(k), np.zeros((k, rows.shape[1] - k))
    rank = 0
    size = float(np.abs(rows).max(initial=0.0))
    if k and len(rows):
        q, r, pivots = qr(rows[:, :k], pivoting=True)
        rank = int((np.abs(np.diag(r)) > (RANK if zero else ROUNDING) * size).sum())
        rows, right = q.T @ rows, q.T @ right
        constant[pivots[:rank]] = solve_triangular(r[:rank, :rank], right[:rank])
        slope[pivots[:rank]] = -solve_triangular(r[:rank, :rank], rows[:rank, k:])
    if rank < k and not zero:
        raise Undetermined(f"{k - rank} coordinates of {name} are determined by nothing: give the variable a prior")
    rows, right = rows[rank:, k:], right[rank:]
    if not separator or not len(rows):
        return constant, slope, []
    if len(rows) > rows.shape[1]:  # a triangle says the same
        rows, right = _triangle(rows, right)
    return constant, slope, [_linear(f"after {name}", "cost", rows, right, separator, size)]


def _by_cholesky(
    name: str, hessian: Array, gradient: Array, k: int, separator: dict[str, int]
) -> tuple[Array, Array, list[Factor]]:
    """Minimise 1/2 y'Gy + g'y, y = (z, d_s), over z: z = constant + slope d_s, and the factor that remains."""
    from scipy.linalg import cho_factor, cho_solve

    constant, slope = np.zeros(k), np.zeros((k, len(gradient) - k))
    if k:
        try:
            factor = cho_factor(hessian[:k, :k])
        except np.linalg.LinAlgError as error:
            raise Undetermined(
                f"there is no minimum over {name}: the Hessian is not positive definite there"
            ) from error
        constant, slope = -cho_solve(factor, gradient[:k]), -cho_solve(factor, hessian[:k, k:])
    if not separator:
        return constant, slope, []
    rest = hessian[k:, k:] + hessian[k:, :k] @ slope
    remaining = QuadraticFactor(
        f"after {name}", "cost", separator, 0.5 * (rest + rest.T), gradient[k:] + hessian[k:, :k] @ constant
    )
    return constant, slope, [remaining]


def _stack(factors: Sequence[LinearFactor], sizes: dict[str, int]) -> tuple[Array, Array]:
    """Rows of several factors over the given variables."""
    ends = np.cumsum([0, *sizes.values()])
    start = dict(zip(sizes, ends.tolist(), strict=False))
    rows = np.zeros((sum(factor.rows for factor in factors), int(ends[-1])))
    at = 0
    for factor in factors:
        for name, block in factor.blocks.items():
            rows[at : at + factor.rows, start[name] : start[name] + sizes[name]] = block
        at += factor.rows
    return rows, np.concatenate([np.zeros(0), *(factor.right for factor in factors)])


def _sum(factors: Sequence[QuadraticFactor], sizes: dict[str, int]) -> tuple[Array, Array]:
    """Sum of several quadratic factors over the given variables."""
    ends = np.cumsum([0, *sizes.values()])
    start = dict(zip(sizes, ends.tolist(), strict=False))
    hessian, gradient = np.zeros((int(ends[-1]),) * 2), np.zeros(int(ends[-1]))
    for factor in factors:
        where = np.concatenate([start[name] + np.arange(size) for name, size in factor.sizes.items()])
        hessian[np.ix_(where, where)] += factor.hessian
        gradient[where] += factor.gradient
    return hessian, gradient


def _linear(name: str, kind: str, rows: Array, right: Array, separator: dict[str, int], size: float) -> LinearFactor:
    """Rows over a separator as a factor."""
    ends = np.cumsum([0, *separator.values()])
    blocks = {v: rows[:, ends[i] : ends[i + 1]] for i, v in enumerate(separator)}
    return LinearFactor(name, "constraint" if kind == "constraint" else "cost", blocks, right, size)


def _triangle(rows: Array, right: Array) -> tuple[Array, Array]:
    """Fewer rows with the same least squares, but for a constant."""
    from scipy.linalg import qr

    q, r = qr(rows, mode="economic")
    return r, q.T @ right


def _require_zero(factor: LinearFactor, rest: Array, size: float) -> None:
    """Raise when rows without variables do not read 0 = 0."""
    worst = float(np.abs(rest).max(initial=0.0))
    if worst > CONTRADICTION * max(1.0, size):
        raise Contradiction(f"the linear constraints {factor.name} contradict each other: 0 = {worst:.3g} remains")
