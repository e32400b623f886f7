"""SNOPT through drake and crocoddyl's Box-FDDP, whose functions of the robot are called in Python.

Both call back into Python for the dynamics, which casadi evaluates there; a robot would have them compiled. That time
is measured and left out, so nothing is held against these solvers that a compiled model would not have.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from benchmarks.control_peers import MODELS
from benchmarks.timing import clocked
from problems.control import Problem
from unifg.typing import Array

R = TypeVar("R")
Solved = tuple[Array, Array, bool, int]
"""States, controls, whether the solver says that it converged, and iterations, 0 where it does not tell."""


class Called(ABC):
    """A solver that calls functions in Python.

    Attributes:
        problem: to be solved.
        answer: states and controls of the last solve.
        status: of the last solve, in words.
        iterations: of the last solve; 0 where the solver does not tell.
        inside: share of the last solve that was spent in Python's functions.
        step, slope: next state of a state and a control and its derivative, functions of casadi.
    """

    def __init__(self, problem: Problem, tolerance: float) -> None:
        """Differentiate."""
        import casadi as ca

        x, u = ca.SX.sym("x", len(problem.start)), ca.SX.sym("u", len(problem.effort))
        after = -MODELS[problem.robot][1](x, u, ca.DM.zeros(x.shape[0]), problem.dt)
        self.step: Any = ca.Function("step", [x, u], [after])
        self.slope: Any = ca.Function("slope", [x, u], [ca.jacobian(after, ca.vertcat(x, u))])
        self.problem, self.status, self.iterations, self.inside, self._seconds = problem, "", 0, 0.0, 0.0
        self.answer: Any = problem.guess()
        self._solve = self._built(tolerance)

    def __call__(self) -> float:
        """Solve from the cold guess; seconds outside Python's functions."""
        self._seconds = 0.0
        (*self.answer, done, self.iterations), spent = clocked(self._solve)
        self.status, self.inside = "converged" if done else "failed", self._seconds / spent
        return spent - self._seconds

    def clocked(self, function: Callable[..., R]) -> Callable[..., R]:
        """The function, its time left out."""

        def timed(*given: Any) -> R:
            result, spent = clocked(function, *given)
            self._seconds += spent
            return result

        return timed

    @abstractmethod
    def _built(self, tolerance: float) -> Callable[[], Solved]:
        """The whole solve."""


class Snopt(Called):
    """SNOPT on the direct transcription, its dynamics differentiated by casadi, obstacles as formulas in drake."""

    def _built(self, tolerance: float) -> Callable[[], Solved]:
        from pydrake import autodiffutils, math
        from pydrake.solvers import MathematicalProgram, SnoptSolver, SolverOptions

        p, n, size, program = self.problem, self.problem.horizon, len(self.problem.start), MathematicalProgram()
        x, u = program.NewContinuousVariables(n + 1, size), program.NewContinuousVariables(n, len(p.effort))
        wanted, cruise = p.reference()

        def gap(z: Any) -> Any:
            plain = z if z.dtype == float else autodiffutils.ExtractValue(z).ravel()
            after, now, control = np.split(plain, [size, 2 * size])
            value = after - np.array(self.step(now, control)).ravel()
            if z.dtype == float:
                return value
            slope = np.hstack([np.eye(size), -np.array(self.slope(now, control))])
            return autodiffutils.InitializeAutoDiff(value, slope @ autodiffutils.ExtractGradient(z)).ravel()

        program.AddBoundingBoxConstraint(p.start, p.start, x[0])
        program.AddBoundingBoxConstraint(np.tile(p.lower, (n, 1)), np.tile(p.upper, (n, 1)), u)
        for k in range(n):
            row = np.concatenate([x[k + 1], x[k], u[k]])
            program.AddConstraint(self.clocked(gap), np.zeros(size), np.zeros(size), row)
            program.AddQuadraticErrorCost(np.diag(p.stage) / 2, wanted[k], x[k])
            program.AddQuadraticErrorCost(np.diag(p.effort) / 2, cruise[k], u[k])
            for disc in p.discs:
                near = x[k + 1, : p.axes] - disc[:-1]
                program.AddConstraint(math.ge((near**2).sum(keepdims=True), disc[-1:] ** 2))
        program.AddQuadraticErrorCost(np.diag(p.terminal) / 2, wanted[n], x[n])
        options = SolverOptions()
        for variables, values in zip((x, u), p.guess(), strict=True):
            program.SetInitialGuess(variables, values)
        for name in ("optimality", "feasibility"):
            options.SetOption(SnoptSolver.id(), f"Major {name} tolerance", tolerance)

        def solve() -> Solved:
            result = SnoptSolver().Solve(program, None, options)
            found = (result.GetSolution(part).reshape(part.shape) for part in (x, u))  # a column comes flat
            return *found, result.is_success(), 0

        return solve


class Crocoddyl(Called):
    """Box-FDDP, with an action model in Python."""

    def _built(self, tolerance: float) -> Callable[[], Solved]:
        import crocoddyl

        solver, p, (wanted, cruise) = self, self.problem, self.problem.reference()

        class Model(crocoddyl.ActionModelAbstract):  # type: ignore[misc]
            def __init__(self, k: int) -> None:
                state = crocoddyl.StateVector(len(p.start))
                crocoddyl.ActionModelAbstract.__init__(self, state, len(p.effort), 1)
                self.wanted, self.cruise = wanted[k], cruise[min(k, p.horizon - 1)]
                self.weights = p.stage if k < p.horizon else p.terminal
                self.u_lb, self.u_ub = p.lower, p.upper

            @solver.clocked
            def calc(self, data: Any, x: Array, u: Array | None = None) -> None:
                data.cost, data.xnext = 0.5 * self.weights @ (x - self.wanted) ** 2, x.copy()
                if u is not None:
                    data.cost += 0.5 * p.effort @ (u - self.cruise) ** 2
                    data.xnext = np.array(solver.step(x, u)).ravel()

            @solver.clocked
            def calcDiff(self, data: Any, x: Array, u: Array | None = None) -> None:
                data.Lx, data.Lxx = self.weights * (x - self.wanted), np.diag(self.weights)
                if u is not None:
                    data.Lu, data.Luu = p.effort * (u - self.cruise), np.diag(p.effort)
                    data.Fx, data.Fu = np.hsplit(np.array(solver.slope(x, u)), [len(x)])

        stages = [Model(k) for k in range(p.horizon + 1)]
        shooting = crocoddyl.ShootingProblem(p.start, stages[:-1], stages[-1])

        def solve() -> Solved:
            states, controls = (list(part) for part in p.guess())
            ddp = crocoddyl.SolverBoxFDDP(shooting)
            ddp.th_stop = tolerance**2  # of squares
            done = ddp.solve(states, controls, 200, False)
            return np.array(ddp.xs), np.array(ddp.us), done, ddp.iter

        return solve
