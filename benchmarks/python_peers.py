"""SNOPT through drake and crocoddyl's Box-FDDP, whose functions of the robot are called in Python.

Both call back into Python for the dynamics, which casadi evaluates there; a robot would have them compiled. That time
is measured and left out, so nothing is held against these solvers that a compiled model would not have.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from benchmarks.control_peers import MODELS
from problems.control import Problem
from unifg.typing import Array

R = TypeVar("R")


class Functions:
    """A robot's dynamics and its derivatives, and the time spent in them.

    Attributes:
        step: next state of a state and a control, a function of casadi.
        inside: seconds since the last solve began.
    """

    def __init__(self, problem: Problem) -> None:
        """Differentiate."""
        import casadi as ca

        x, u = ca.SX.sym("x", len(problem.start)), ca.SX.sym("u", len(problem.effort))
        after = -MODELS[problem.robot][1](x, u, ca.DM.zeros(x.shape[0]), problem.dt)
        self.step: Any = ca.Function("step", [x, u], [after])
        self._slope: Any = ca.Function("slope", [x, u], [ca.jacobian(after, ca.vertcat(x, u))])
        self.inside = 0.0

    def slope(self, x: Array, u: Array) -> Array:
        """(n, n + m) derivative of a step."""
        return np.array(self._slope(x, u))

    def clocked(self, action: Callable[[], R]) -> R:
        """Result of an action whose time is left out."""
        begin = time.thread_time()
        result = action()
        self.inside += time.thread_time() - begin
        return result


class Called:
    """A solver that calls functions in Python.

    Attributes:
        problem: to be solved.
        answer: states and controls of the last solve.
        status: of the last solve, in words.
        iterations: of the last solve; 0 where the solver tells none.
        inside: share of the last solve that was spent in Python's functions.
    """

    def __init__(self, problem: Problem, tolerance: float) -> None:
        """Begin at the cold guess."""
        self.problem = problem
        self.answer: Any = problem.guess()
        self.status, self.iterations, self.inside, self._functions = "", 0, 0.0, Functions(problem)
        self._solve = self._built(tolerance)

    def __call__(self) -> float:
        """Solve from the cold guess; seconds outside Python's functions."""
        self._functions.inside = 0.0
        begin = time.thread_time()
        self._solve()
        spent = time.thread_time() - begin
        self.inside = self._functions.inside / spent
        return spent - self._functions.inside

    def _built(self, tolerance: float) -> Callable[[], None]:
        raise NotImplementedError


class Snopt(Called):
    """SNOPT on the direct transcription, its dynamics differentiated by casadi, obstacles as formulas in drake."""

    def _built(self, tolerance: float) -> Callable[[], None]:
        from pydrake import autodiffutils, math
        from pydrake.solvers import MathematicalProgram, SnoptSolver, SolverOptions

        problem, functions, n = self.problem, self._functions, self.problem.horizon
        size, program = len(problem.start), MathematicalProgram()
        x = program.NewContinuousVariables(n + 1, size, "x")
        u = program.NewContinuousVariables(n, len(problem.effort), "u")
        wanted, cruise = problem.reference()

        def defect(z: Any) -> Any:
            def gap() -> Any:
                plain = z if z.dtype == float else autodiffutils.ExtractValue(z).ravel()
                after, now, control = np.split(plain, [size, 2 * size])
                value = after - np.array(functions.step(now, control)).ravel()
                if z.dtype == float:
                    return value
                slope = np.hstack([np.eye(size), -functions.slope(now, control)])
                return autodiffutils.InitializeAutoDiff(value, slope @ autodiffutils.ExtractGradient(z)).ravel()

            return functions.clocked(gap)

        program.AddBoundingBoxConstraint(problem.start, problem.start, x[0])
        for k in range(n):
            row = np.concatenate([x[k + 1], x[k], u[k]])
            program.AddConstraint(defect, lb=np.zeros(size), ub=np.zeros(size), vars=row)
            program.AddBoundingBoxConstraint(problem.lower, problem.upper, u[k])
            program.AddQuadraticErrorCost(np.diag(problem.stage) / 2, wanted[k], x[k])
            program.AddQuadraticErrorCost(np.diag(problem.effort) / 2, cruise[k], u[k])
            near = x[k + 1, : problem.axes]
            if rows := [((near - disc[:-1]) ** 2).sum() - disc[-1] ** 2 for disc in problem.discs]:
                program.AddConstraint(math.ge(np.array(rows), np.zeros(len(rows))))
        program.AddQuadraticErrorCost(np.diag(problem.terminal) / 2, wanted[n], x[n])
        guess, options = np.zeros(program.num_vars()), SolverOptions()
        for variables, values in zip((x, u), problem.guess(), strict=True):
            program.SetDecisionVariableValueInVector(variables, values, guess)
        for name in ("optimality", "feasibility"):
            options.SetOption(SnoptSolver.id(), f"Major {name} tolerance", tolerance)

        def solve() -> None:
            result = SnoptSolver().Solve(program, guess, options)
            self.answer = result.GetSolution(x), result.GetSolution(u).reshape(u.shape)  # a column comes flat
            self.status = "converged" if result.is_success() else result.get_solution_result().name[1:]

        return solve


class Crocoddyl(Called):
    """Box-FDDP, with an action model in Python."""

    def _built(self, tolerance: float) -> Callable[[], None]:
        import crocoddyl

        problem, functions, n = self.problem, self._functions, self.problem.horizon
        wanted, cruise = problem.reference()

        class Model(crocoddyl.ActionModelAbstract):  # type: ignore[misc]
            def __init__(self, k: int) -> None:
                state = crocoddyl.StateVector(len(problem.start))
                crocoddyl.ActionModelAbstract.__init__(self, state, len(problem.effort), 1)
                self.wanted, self.cruise = wanted[k], cruise[min(k, n - 1)]
                self.weights = problem.stage if k < n else problem.terminal
                self.u_lb, self.u_ub = problem.lower, problem.upper

            def calc(self, data: Any, x: Array, u: Array | None = None) -> None:
                functions.clocked(lambda: self.values(data, x, u))

            def calcDiff(self, data: Any, x: Array, u: Array | None = None) -> None:
                functions.clocked(lambda: self.slopes(data, x, u))

            def values(self, data: Any, x: Array, u: Array | None) -> None:
                data.cost, data.xnext = 0.5 * self.weights @ (x - self.wanted) ** 2, x.copy()
                if u is not None:
                    data.cost += 0.5 * problem.effort @ (u - self.cruise) ** 2
                    data.xnext = np.array(functions.step(x, u)).ravel()

            def slopes(self, data: Any, x: Array, u: Array | None) -> None:
                data.Lx, data.Lxx = self.weights * (x - self.wanted), np.diag(self.weights)
                if u is not None:
                    data.Lu, data.Luu = problem.effort * (u - self.cruise), np.diag(problem.effort)
                    data.Fx, data.Fu = np.hsplit(functions.slope(x, u), [len(x)])

        shooting = crocoddyl.ShootingProblem(problem.start, [Model(k) for k in range(n)], Model(n))
        states, controls = (list(part) for part in problem.guess())

        def solve() -> None:
            solver = crocoddyl.SolverBoxFDDP(shooting)
            solver.th_stop = tolerance**2  # of squares
            done = solver.solve(states, controls, 200, False)
            self.answer, self.iterations = (np.array(solver.xs), np.array(solver.us)), solver.iter
            self.status = "converged" if done else "iteration limit"

        return solve
