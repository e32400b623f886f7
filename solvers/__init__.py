"""Backends. Each sees only the compiled program; swapping one for another is one word."""

from unifg.solvers.augmented_lagrangian import AugmentedLagrangian
from unifg.solvers.graduated_non_convexity import GraduatedNonConvexity
from unifg.solvers.interior_point.method import InteriorPoint
from unifg.solvers.kkt import KKT
from unifg.solvers.least_squares import DogLeg, GaussNewton, LevenbergMarquardt
from unifg.solvers.penalty import Penalty
from unifg.solvers.sqp import SQP
from unifg.solvers.ta.linear_graphs import LinearGraphs

__all__ = [
    "KKT",
    "SQP",
    "AugmentedLagrangian",
    "DogLeg",
    "GaussNewton",
    "GraduatedNonConvexity",
    "InteriorPoint",
    "LevenbergMarquardt",
    "LinearGraphs",
    "Penalty",
]


__dir__ = __all__.copy
