"""Runge-Kutta methods as tables of numbers: explicit ones, and implicit ones whose stages need no unknowns.

In exponential coordinates x(t) = x_i Exp(xi(t)) a motion obeys xi' = dexp_inv(xi) F(x_i Exp(xi)), an equation in a
vector space. One step of length h, from 0 to xi = Log(x_i^-1 x_{i+1}), is

    sigma_s = v_s xi + h sum_{t < s} a_st k_t,      k_s = dexp_inv(sigma_s) F(x_i Exp(sigma_s)),
    xi = h sum_s b_s k_s.

With v = 0 this is an explicit Runge-Kutta-Munthe-Kaas method (Munthe-Kaas 1998; Iserles, Munthe-Kaas, Norsett, Zanna,
*Lie-group methods*, Acta Numerica 2000, section 4). With v it is *mono-implicit* (Cash and Singhal, IMA J. Numer. Anal.
1982): both ends of a step are variables of a graph, so stages may be placed between them at no cost, and the step stays
one condition on (x_i, u_i, x_{i+1}).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from unifg.errors import ModelError
from unifg.typing import Array

__all__ = ["Tableau"]


@dataclass(frozen=True)
class Tableau:
    """The numbers of a method.

    Attributes:
        name: for messages.
        order: of convergence.
        weights: b, one number per stage; they sum to 1.
        matrix: a, one row per stage with a number for each stage before it.
        ends: v, how far each stage goes towards the end of the step; () for an explicit method.
        flat: stages that use F as it is, where the method would have dexp_inv(sigma) F. This is the same solution
            when sigma is parallel to the velocity of the stage itself, because dexp(k) k = k; elsewhere it is another
            method.

    Raises:
        ModelError: when the numbers do not make a method.
    """

    name: str
    order: int
    weights: tuple[float, ...]
    matrix: tuple[tuple[float, ...], ...]
    ends: tuple[float, ...] = ()
    flat: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        """Check the numbers."""
        stages = len(self.weights)
        if tuple(len(row) for row in self.matrix) != tuple(range(stages)):
            rows = [len(row) for row in self.matrix]
            raise ModelError(f"{self.name}: the rows of the matrix have {rows} numbers, expected {list(range(stages))}")
        if len(self.ends) not in (0, stages):
            raise ModelError(f"{self.name}: {len(self.ends)} ends for {stages} stages")
        if not abs(sum(self.weights) - 1.0) <= 1e-12:
            raise ModelError(f"{self.name}: the weights sum to {sum(self.weights)}, expected 1")
        if not set(self.flat) <= set(range(stages)):
            raise ModelError(f"{self.name}: flat names stages {self.flat}, there are {stages}")

    @property
    def stages(self) -> int:
        """Evaluations of F in a step."""
        return len(self.weights)

    @property
    def explicit(self) -> bool:
        """True if a step can be taken without solving for its end."""
        return not any(self.ends)

    @cached_property
    def rows(self) -> Array:
        """(stages, 3 + stages): for each stage b, v, whether dexp_inv is left out, and a."""
        result = np.zeros((self.stages, 3 + self.stages))
        result[:, 0] = self.weights
        if self.ends:
            result[:, 1] = self.ends
        result[list(self.flat), 2] = 1.0
        for s, row in enumerate(self.matrix):
            result[s, 3 : 3 + s] = row
        return result

    @cached_property
    def numbers(self) -> tuple[tuple[float, ...], ...]:
        """The same as :attr:`rows`."""
        return tuple(map(tuple, self.rows.tolist()))


METHODS = {
    tableau.name: tableau
    for tableau in (
        Tableau("explicit euler", 1, (1.0,), ((),)),
        Tableau("implicit euler", 1, (1.0,), ((),), (1.0,), flat=(0,)),
        Tableau("implicit midpoint", 2, (1.0,), ((),), (0.5,), flat=(0,)),
        Tableau("full trapezoid", 2, (0.5, 0.5), ((), (0.0,)), (0.0, 1.0)),
        Tableau("simplified trapezoid", 2, (0.5, 0.5), ((), (0.0,)), (0.0, 1.0), flat=(0, 1)),
        Tableau("rk4", 4, (1 / 6, 1 / 3, 1 / 3, 1 / 6), ((), (0.5,), (0.0, 0.5), (0.0, 0.0, 1.0))),
        Tableau(
            "hermite-simpson", 4, (1 / 6, 1 / 6, 2 / 3), ((), (0.0,), (1 / 8, -1 / 8)), (0.0, 1.0, 0.5)
        ),
    )
}  # fmt: skip
"""The methods that come with the library, by name."""
