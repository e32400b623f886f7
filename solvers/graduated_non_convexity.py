"""Graduated non-convexity: robust estimation without a good start (Yang et al. 2020).

A robust loss that ignores outliers has many minima. Its surrogates begin nearly quadratic, where a global minimum is
within reach, and sharpen step by step; each problem starts from the solution of the one before. By the duality of
Black and Rangarajan the weights of a surrogate are those its reweighted least squares would find, so any least-squares
backend does.

H. Yang, P. Antonante, V. Tzoumas, L. Carlone, "Graduated non-convexity for robust spatial perception: from non-minimal
solvers to global outlier rejection", IEEE RA-L 5(2), 2020.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, field, replace

import numpy as np

from unifg.errors import BackendError, NotConverged
from unifg.graph import Graph
from unifg.history import Iteration
from unifg.robust import Graduated, Loss
from unifg.solution import Solution
from unifg.solver import Callback, Prepared, Solver, Start
from unifg.solvers.levenberg_marquardt import LevenbergMarquardt
from unifg.status import Status
from unifg.terms import Cost
from unifg.typing import Array, ArrayLike
from unifg.variables import Data

DECIDED = 1e-3  # a truncated loss is done when every weight is this close to zero or one


class _Square:
    """No loss: where the graduation begins."""

    held = False

    def value(self, squared: Array) -> Array:
        return squared

    def weight(self, squared: Array) -> Array:
        return np.ones_like(squared)


class _Stage:
    """A loss that is replaced between solves without a new graph, and remembers what it was last asked."""

    held = False

    def __init__(self, goal: Graduated) -> None:
        self.goal = goal
        self.now: Loss = _Square()
        self.squared = np.zeros(0)
        self.largest = 0.0

    def value(self, squared: Array) -> Array:
        return self.now.value(squared)

    def weight(self, squared: Array) -> Array:
        self.squared = squared.copy()
        self.largest = max(self.largest, float(squared.max(initial=0.0)))
        return self.now.weight(squared)

    @property
    def decided(self) -> bool:
        """Whether every factor counts in full or not at all."""
        weights = self.now.weight(self.squared)
        return bool((np.minimum(weights, 1.0 - weights) < DECIDED).all())


@dataclass(kw_only=True)
class GraduatedNonConvexity:
    """Solves graphs with `unifg.TruncatedLeastSquares` or `unifg.GemanMcClure` in one or more terms.

    It is called like a backend. Terms with other losses, or none, take part as they are: measurements that can be
    trusted, such as odometry, are stated without a loss.

    Attributes:
        solver: the least-squares backend inside. Its options hold for the first solve, without the losses, and for the
            last one, with the losses themselves.
        growth: how much sharper each surrogate is than the one before (1.4 in the paper).
        stage_iterations: iterations of the backend for each surrogate.
    """

    solver: Solver = field(default_factory=LevenbergMarquardt)
    growth: float = 1.4
    stage_iterations: int = 5

    def __post_init__(self) -> None:
        """Refuse options no solve could honour."""
        if not self.growth > 1.0:
            raise BackendError(f"{self.name}: growth must be above 1, found {self.growth}")
        if self.stage_iterations < 1:
            raise BackendError(f"{self.name}: stage_iterations must be positive, found {self.stage_iterations}")

    @property
    def name(self) -> str:
        """The class name."""
        return type(self).__name__

    def solve(
        self,
        graph: Graph,
        guess: Start,
        *,
        data: Mapping[Data, ArrayLike] | None = None,
        check: bool = False,
        callback: Callback | None = None,
    ) -> Solution:
        """Solve without the losses, through their surrogates, and with the losses themselves.

        Args:
            graph: the problem.
            guess: values per family.
            data: values of data for this solve.
            check: raise instead of returning a solution that did not converge.
            callback: called with every row of the history; returning True ends the solve.

        Returns:
            The solution of the graph as stated, judged with its own losses. The history holds all stages, numbered
            through; ``stage`` among the details of a row is 0 without the losses.

        Raises:
            GraphError: when the graph, guess or data is malformed.
            BackendError: when no term has a loss with surrogates, or the backend cannot take the graph.
            NotConverged: with ``check=True``.
        """
        started = time.perf_counter()
        staged, stages = _staged(graph)
        if not stages:
            raise BackendError(
                f"{self.name}: no term has a loss with surrogates; use robust=TruncatedLeastSquares(...) or "
                f"GemanMcClure(...), or give the graph to {self.solver.name}"
            )
        history = _History(callback)
        solution = history.add(self.solver.prepare(staged), guess, data)
        # The largest residual on the way from the guess: the solution without losses may hide an outlier by spreading
        # it over many weak measurements.
        paths = [stage.goal.surrogates(stage.largest, self.growth) for stage in stages]
        run = replace(self.solver, max_iterations=self.stage_iterations).prepare(staged)
        for stage, path in zip(stages, paths, strict=True):
            stage.now = next(path)
        while any(stage.now is not stage.goal for stage in stages) and solution.status is not Status.INTERRUPTED:
            solution = history.add(run, solution, data)
            if all(stage.decided for stage in stages):
                break
            for stage, path in zip(stages, paths, strict=True):
                stage.now = next(path, stage.goal)
        interrupted = solution.status is Status.INTERRUPTED
        last = replace(self.solver, max_iterations=0) if interrupted else self.solver
        solution = history.add(last.prepare(graph), solution.values, data)
        if interrupted:
            solution.status = Status.INTERRUPTED
        solution.history, solution.iterations = history.rows, history.rows[-1].number
        solution.seconds, solution.solver = time.perf_counter() - started, f"{self.name} ({self.solver.name})"
        if check and not solution.converged:
            raise NotConverged(solution)
        return solution


class _History:
    """Rows of several solves, numbered through; each solve after the first repeats the last row of the one before."""

    def __init__(self, callback: Callback | None) -> None:
        self.rows: list[Iteration] = []
        self._callback = callback
        self._stage = -1

    def add(self, run: Prepared, start: Start, data: Mapping[Data, ArrayLike] | None) -> Solution:
        """Solve and keep the rows."""
        self._stage += 1
        return run.solve(start, data=data, callback=self._row)

    def _row(self, row: Iteration) -> bool | None:
        before = self.rows[-1].number if self.rows else 0
        number = before + (1 if row.number else 0)
        row = replace(row, number=number, details={**row.details, "stage": self._stage})
        if self.rows and number == before:
            self.rows.pop()  # the same point, seen through the next loss
        self.rows.append(row)
        return None if self._callback is None else self._callback(row)


def _staged(graph: Graph) -> tuple[Graph, list[_Stage]]:
    """The same graph with a `_Stage` in place of every loss that has surrogates."""
    staged, stages = copy(graph), []
    staged.terms = list(graph.terms)
    staged._program = None
    for k, term in enumerate(staged.terms):
        if isinstance(term, Cost) and isinstance(term.robust, Graduated):
            stages.append(_Stage(term.robust))
            staged.terms[k] = replace(term, robust=stages[-1])
    return staged, stages
