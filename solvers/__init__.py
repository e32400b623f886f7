"""Backends. Each sees only the compiled program; swapping one for another is one word."""

from unifg.solvers.augmented_lagrangian import AugmentedLagrangian
from unifg.solvers.dog_leg import DogLeg
from unifg.solvers.gauss_newton import GaussNewton
from unifg.solvers.graduated_non_convexity import GraduatedNonConvexity
from unifg.solvers.interior_point import InteriorPoint
from unifg.solvers.kkt import KKT
from unifg.solvers.levenberg_marquardt import LevenbergMarquardt
from unifg.solvers.linearized_graph import LinearGraphs
from unifg.solvers.penalty import Penalty
from unifg.solvers.sqp import SQP

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
