"""Residuals against what was stated: chi2 beside its degrees of freedom, and the factors that disagree most.

Where weights are those of the noise, the sum of squared residuals is chi-squared distributed with as many degrees of
freedom as there are rows less unknowns. Weights are seldom calibrated, so a ratio is a hint and never a verdict; one
that is far too large is said, one that is too small is not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unifg.codegen.inner import inner
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.linearization import Linearization
from unifg.solution.history import FactorNorms

__all__ = ["FAR", "Fit", "fit_of", "is_far", "ratio_sentence"]

FAR = 4.0  # chi2 per degree of freedom: residuals twice as large as stated
UNLIKELY = 1e-6  # and not by chance
NOTHING = 1e-12  # of the largest row of its term: rows that carry no information
WORST = 3  # factors named


@dataclass(frozen=True)
class Fit:
    """Goodness of fit of least squares.

    Attributes:
        chi2: sum of squared whitened residuals, as robust losses weigh them.
        freedom: rows that carry information less unknowns.
        worst: up to three factors whose residuals are larger than `FAR` allows, by their terms, with their squared
            norms; by the size of the latter.
    """

    chi2: float
    freedom: int
    worst: tuple[tuple[str, int, float], ...]

    @property
    def far(self) -> bool:
        """True if residuals are far larger than stated."""
        return is_far(self.chi2, self.freedom)

    def sentence(self) -> str:
        """The numbers, and what a user should know."""
        text = f"chi2 {self.chi2:.6g} with {self.freedom} degrees of freedom"
        if not self.far:
            return text
        named = ", ".join(f"'{name}', factor {index} ({squared:.3g})" for name, index, squared in self.worst)
        return f"{text}: {ratio_sentence(self.chi2, self.freedom)}{f'; largest: {named}' if named else ''}"


def is_far(chi2: float, freedom: int) -> bool:
    """Test whether residuals are far larger than stated, and not by chance."""
    if not (freedom > 0 and chi2 > FAR * freedom):
        return False
    from scipy.special import chdtrc  # slow to load, and seldom asked

    return bool(chdtrc(freedom, chi2) < UNLIKELY)


def ratio_sentence(chi2: float, freedom: int) -> str:
    """Reasons for residuals far larger than stated, as a sentence."""
    return (
        f"residuals are {(chi2 / freedom) ** 0.5:.3g} times as large as stated: weights are too sure, some "
        "measurements are wrong, or this is not the best solution"
    )


def fit_of(program: CompiledProblem, lin: Linearization, norms: FactorNorms) -> Fit | None:
    """Residuals at a point against their weights; None where these mean nothing, or nothing is left to compare.

    Args:
        program: the compiled graph.
        lin: where.
        norms: of the factors there, before robust losses.
    """
    if not (program.least_squares and lin.finite):
        return None
    sizes = program.costs.times(np.abs(lin.jacobian), np.ones(program.size))
    rows, at = 0, 0
    candidates = []
    for term in program.cost_terms:
        own = sizes[at : at + term.count * term.size]
        at += term.count * term.size
        rows += int((own > NOTHING * own.max(initial=0.0)).sum())
        squared = norms[term.name] ** 2
        order = np.argsort(-squared, kind="stable")[:WORST]
        candidates += [(term.name, int(k), float(squared[k])) for k in order if squared[k] > FAR * term.size]
    if rows <= program.size:
        return None
    candidates.sort(key=lambda named: -named[2])
    return Fit(inner(lin.residual, lin.residual), rows - program.size, tuple(candidates[:WORST]))
