"""The short names of the backends: the one table that commands, scenarios, benchmarks and tests read.

Which graphs a backend takes stands in its class (:class:`unifg.solution.solve_state.Backend`); the lists of names below
are made from that.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from unifg.errors import BackendError
from unifg.solution.solve_state import Backend
from unifg.solution.solver import Solver
from unifg.solvers.augmented_lagrangian import AugmentedLagrangian
from unifg.solvers.graduated_non_convexity import GraduatedNonConvexity
from unifg.solvers.interior_point.method import InteriorPoint
from unifg.solvers.kkt import KKT
from unifg.solvers.least_squares import DogLeg, GaussNewton, LevenbergMarquardt
from unifg.solvers.penalty import Penalty
from unifg.solvers.sqp import SQP

__all__ = ["backend", "backends"]


@dataclass(frozen=True)
class Entry:
    """One backend.

    Attributes:
        made_by: its class.
        title: for pages and help.
    """

    made_by: type[Backend]
    title: str

    @property
    def options(self) -> frozenset[str]:
        """Names of what the class may be given."""
        return frozenset(field.name for field in fields(self.made_by))  # type: ignore[arg-type]  # all are dataclasses


TABLE = {
    "gn": Entry(GaussNewton, "Gauss-Newton"),
    "lm": Entry(LevenbergMarquardt, "Levenberg-Marquardt"),
    "dogleg": Entry(DogLeg, "Powell's dog-leg"),
    "gnc": Entry(GraduatedNonConvexity, "graduated non-convexity"),
    "kkt": Entry(KKT, "KKT Gauss-Newton"),
    "penalty": Entry(Penalty, "quadratic penalty"),
    "alm": Entry(AugmentedLagrangian, "augmented Lagrangian"),
    "sqp": Entry(SQP, "sequential quadratic programming"),
    "ipm": Entry(InteriorPoint, "primal-dual interior point"),
}

_PLAIN = tuple(name for name, entry in TABLE.items() if issubclass(entry.made_by, Solver))
LEAST_SQUARES = tuple(name for name in _PLAIN if TABLE[name].made_by.constraints == "none")
"""Made for sums of squares without constraints."""
CONSTRAINED = tuple(name for name in _PLAIN if TABLE[name].made_by.constraints == "all")
"""Take equalities and inequalities."""
SECOND_ORDER = tuple(name for name in CONSTRAINED if "hessian" in TABLE[name].options)
"""Of these, those that let one choose the Hessian."""


def entry(name: str) -> Entry:
    """Look a backend up.

    Args:
        name: one of `TABLE`, but not "gnc", which runs another backend inside.

    Raises:
        BackendError: for an unknown name.
    """
    if name not in _PLAIN:
        raise BackendError(f"unknown backend '{name}': choose one of {', '.join(_PLAIN)}")
    return TABLE[name]


def backend(name: str, **options: Any) -> Solver:
    """Make a backend; ``options`` are those of its class.

    Raises:
        BackendError: for an unknown name or option.
    """
    chosen = entry(name)
    unknown = sorted(options.keys() - chosen.options)
    if unknown:
        raise BackendError(f"{chosen.made_by.__name__} has no option '{unknown[0]}'")
    made: Any = chosen.made_by(**options)
    return made  # type: ignore[no-any-return]


def backends(*names: str, **options: Any) -> dict[str, Solver]:
    """Make several backends with the same options, by name; raises as :func:`backend`."""
    return {name: backend(name, **options) for name in names}


def choices(names: tuple[str, ...]) -> str:
    """Names with their titles, for the help of a command."""
    return ", ".join(f"{name} ({TABLE[name].title})" for name in names)
