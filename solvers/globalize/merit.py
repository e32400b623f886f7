"""Merit functions: what a step has to lower, and how the penalty of violation is set."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from unifg.codegen.inner import inner
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.linearization import Evaluation, Linearization
from unifg.typing import Array

Point: TypeAlias = Linearization | Evaluation

ARMIJO = 1e-4
FARTHEST = 1e4  # violation that a step may lead to, relative to the start's (Waechter and Biegler 2006, eq. 21)
MARGIN = 0.3  # share of the violation's penalty that every step must earn (Nocedal and Wright, eq. 18.36)


class Merit:
    """The cost alone, for graphs without constraints.

    Attributes:
        program: the compiled graph.
    """

    def __init__(self, program: CompiledProblem) -> None:
        """Remember the program."""
        self.program = program

    def value(self, point: Point) -> float:
        """Merit at a point."""
        return point.cost

    def accepts(self, trial: Point, here: float, slope: float, length: float, slack: float) -> bool:
        """Armijo's condition."""
        return trial.finite and self.value(trial) <= here + ARMIJO * length * slope + slack

    def outside(self, constraints: Array) -> Array:
        """(M,) by how much each row is violated."""
        return np.abs(self.program.violation(constraints))


class OnePrice(Merit):
    """l1 merit with one penalty, which rises until every step is one of descent (Nocedal and Wright, chapter 18).

    Attributes:
        penalty: per unit of violation of any row; the first step that needs one raises it.
    """

    penalty = 0.0

    def value(self, point: Point) -> float:
        """Merit at a point."""
        return point.cost + self.penalty * float(self.outside(point.constraints).sum())

    def rounding(self, lin: Linearization) -> float:
        """Rounding of the merit: coordinates off by half a spacing in every row."""
        largest = float(np.abs(self.program.columns.values(lin.values).flat).max(initial=0.0))
        return self.penalty * 0.5 * float(np.spacing(largest)) * len(lin.constraints)

    def slope(self, lin: Linearization, step: Array, linear: Array, most: float = np.inf) -> float:
        """Bound of the merit's derivative along a step, after the penalty was raised to make it one of descent.

        Args:
            lin: where.
            step: (n,).
            linear: (M,) A times the step.
            most: penalty that suffices where the step solves the linearised problem.
        """
        descent = inner(lin.gradient[self.program.columns.free], step)
        gain = float(self.outside(lin.constraints).sum()) - float(self.outside(lin.constraints + linear).sum())
        if gain > 0.0:
            curved = self._curved(lin, step)
            needed = (descent + 0.5 * curved) / ((1.0 - MARGIN) * gain)
            if needed > self.penalty:
                self.penalty = max(self.penalty, min(1.5 * needed, most))
        return descent - self.penalty * gain

    def predicted(self, lin: Linearization, step: Array, linear: Array) -> float:
        """Decrease by the model, quadratic in the cost and linear in the constraints; arguments as for `slope`."""
        return -self.slope(lin, step, linear) - 0.5 * self._curved(lin, step)

    def _curved(self, lin: Linearization, step: Array) -> float:
        """Curvature of the cost along a step, which may be too long for the range of numbers."""
        with np.errstate(over="ignore", invalid="ignore"):
            return inner(step, self.program.hessian.times(self.program.hessian_entries(lin), step))
