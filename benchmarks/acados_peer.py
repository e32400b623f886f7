"""Control problems for acados: C code generated from the expressions that solvers of casadi get, and compiled.

acados is installed with its libraries by the package comma-deps-acados, whose interface is an old one: stage costs and
penalties are multiplied by the time step, and references are set stage by stage. Only the call that solves is timed.
"""

from __future__ import annotations

import contextlib
import ctypes
import io
import os
import sys
import time
from functools import cache
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from benchmarks.compiled_peers import FLAGS
from benchmarks.control_peers import MODELS
from benchmarks.report import OUT
from problems.control import Problem, Tick
from unifg.typing import Array

LIBRARIES = OUT / "acados"
STATUS = ("converged", "not a number", "iteration limit", "step too short", "QP failure", "ready")
SOFT = 1e3  # price of a violation, per squared metre of an obstacle's row


@cache
def interface() -> Any:
    """Python interface of acados, its libraries loaded."""
    import acados

    paths = {"SOURCE_DIR": acados.DIR, "PYTHON_INTERFACE_PATH": acados.TEMPLATE_DIR}
    os.environ |= {"TERA_PATH": acados.TERA_PATH, **{f"ACADOS_{name}": path for name, path in paths.items()}}
    for name in ("blasfeo", "qpOASES_e", "hpipm", "acados"):
        ctypes.CDLL(f"{acados.LIB_DIR}/lib{name}.so", ctypes.RTLD_GLOBAL)
    sys.path.append(os.path.dirname(acados.__file__))
    with contextlib.redirect_stdout(io.StringIO()):
        import acados_template
    return acados_template


class Acados:
    """A solver of one problem.

    Attributes:
        problem: to be solved.
        plan: states and controls from which it begins.
        answer: states and controls of the last solve.
        status: of the last solve, in words.
    """

    def __init__(
        self, problem: Problem, tolerance: float, soft: bool = False, single: bool = False, steps: str = "full"
    ) -> None:
        """Generate and compile.

        Args:
            problem: to be solved.
            tolerance: of the answer; subproblems are solved to a tenth of it.
            soft: whether obstacles have slacks, with an exact penalty.
            single: real-time iteration, not SQP to convergence.
            steps: "full", "merit" where a line search shortens them, "corrected" with second-order corrections, too.
        """
        import casadi as ca

        made = interface()
        self.problem, n = problem, problem.horizon
        self.plan: Any = problem.guess()
        self.answer: Any = self.plan
        self.status = ""
        error, gap = MODELS[problem.robot]
        ocp, model = made.AcadosOcp(), made.AcadosModel()
        numbers = f"{problem.blocked:d}_{n}_{soft:d}{single:d}_{steps}"
        model.name = f"{problem.robot}_{problem.instance}_{numbers}".replace("-", "_")
        size, controls = len(problem.start), len(problem.effort)
        x, u, reference = ca.SX.sym("x", size), ca.SX.sym("u", controls), ca.SX.sym("reference", size)
        model.x, model.u, model.p = x, u, reference
        model.disc_dyn_expr = -gap(x, u, ca.DM.zeros(size), problem.dt)
        off = error(x, reference)
        model.cost_y_expr = model.cost_y_expr_0 = ca.vertcat(off, u)
        model.cost_y_expr_e = off
        ocp.model, ocp.dims.N, ocp.parameter_values = model, n, problem.reference()[0][0]
        cost, limits, options = ocp.cost, ocp.constraints, ocp.solver_options
        cost.cost_type = cost.cost_type_0 = cost.cost_type_e = "NONLINEAR_LS"
        cost.W = cost.W_0 = block_diag(np.diag(problem.stage), np.diag(problem.effort)) / problem.dt
        cost.W_e = np.diag(problem.terminal)
        cost.yref = cost.yref_0 = np.zeros(off.shape[0] + controls)
        cost.yref_e = np.zeros(off.shape[0])
        limits.x0, limits.idxbu = problem.start, np.arange(controls)
        limits.lbu, limits.ubu = problem.lower, problem.upper
        if count := len(problem.discs):
            near = x[: problem.axes]
            rows = [ca.sumsqr(near - disc[:-1]) - disc[-1] ** 2 for disc in problem.discs]
            model.con_h_expr = model.con_h_expr_e = ca.vertcat(*rows)
            limits.lh = limits.lh_e = np.zeros(count)
            limits.uh = limits.uh_e = np.full(count, 1e6)
            if soft:
                limits.idxsh = limits.idxsh_e = np.arange(count)
                cost.zl = cost.zu = np.full(count, SOFT / problem.dt)
                cost.Zl = cost.Zu = np.full(count, 1.0 / problem.dt)
                cost.zl_e = cost.zu_e = np.full(count, SOFT)
                cost.Zl_e = cost.Zu_e = np.ones(count)
        options.tf, options.integrator_type, options.hessian_approx = n * problem.dt, "DISCRETE", "GAUSS_NEWTON"
        options.nlp_solver_type, options.nlp_solver_max_iter = "SQP_RTI" if single else "SQP", 200
        options.globalization = "FIXED_STEP" if steps == "full" else "MERIT_BACKTRACKING"
        options.globalization_use_SOC = int(steps == "corrected")
        options.levenberg_marquardt = 0.1 if steps == "corrected" and not soft else 0.0  # else it cycles
        options.qp_solver, options.qp_solver_cond_N = "PARTIAL_CONDENSING_HPIPM", n // 5
        options.hpipm_mode, options.qp_solver_warm_start = "SPEED_ABS" if single and not soft else "SPEED", 1
        options.qp_solver_iter_max, options.qp_tol = 100, 0.1 * tolerance
        options.nlp_solver_tol_stat = options.nlp_solver_tol_eq = tolerance
        options.nlp_solver_tol_ineq = options.nlp_solver_tol_comp = tolerance
        options.ext_fun_compile_flags = " ".join(FLAGS[:2])
        LIBRARIES.mkdir(parents=True, exist_ok=True)
        ocp.code_export_directory = str(LIBRARIES / model.name)
        with contextlib.chdir(LIBRARIES), contextlib.redirect_stdout(io.StringIO()):
            self._solver = made.AcadosOcpSolver(ocp, json_file=f"{model.name}.json", verbose=False)
        self._solve = getattr(self._solver.shared_lib, f"{model.name}_acados_solve")
        self._solve.argtypes, self._solve.restype = [ctypes.c_void_p], ctypes.c_int
        self._counted = "qp_iter" if single else "sqp_iter"

    def __call__(self) -> float:
        """Solve from the plan as if nothing had been solved before; seconds."""
        self._solver.reset()
        states, controls = self.plan
        return self._from(states, controls, self.problem.start, 0)

    def control(self, state: Array, index: int) -> Tick:
        """One step of a closed loop from the shifted answer; the first one from the plan, repeated."""
        if index == 0:
            self._solver.reset()
            self.answer = self.plan
        for _ in range(1 if index else 5):
            states, controls = self.answer
            if index:
                states, controls = (np.vstack([part[1:], part[-1:]]) for part in self.answer)
            states[0] = state
            seconds = self._from(states, controls, state, index)
        return Tick(self.answer[1][0], 1e3 * seconds, self.iterations, self.status)

    @property
    def iterations(self) -> int:
        """Of the last solve; those of the subproblem for a single one."""
        return int(self._solver.get_stats(self._counted)[-1])

    def _from(self, states: Array, controls: Array, state: Array, first: int) -> float:
        """Solve closed-loop step ``first`` from a guess; seconds of the call that solves.

        acados measures elapsed time. Where the processor was taken away meanwhile, processor time of the call is less.
        """
        solver, n = self._solver, self.problem.horizon
        wanted, cruise = self.problem.reference(first)
        zero = np.zeros(len(self.problem.stage))
        for k in range(n + 1):
            solver.set(k, "x", states[k])
            solver.set(k, "p", wanted[k])
            if k < n:
                solver.set(k, "u", controls[k])
                solver.cost_set(k, "yref", np.append(zero, cruise[k]))
        for name in ("lbx", "ubx"):
            solver.set(0, name, state)
        begin = time.thread_time()
        status = int(self._solve(solver.capsule))
        spent = time.thread_time() - begin
        self.status = STATUS[status]
        found = [[solver.get(k, name) for k in range(n + last)] for name, last in (("x", 1), ("u", 0))]
        self.answer = np.array(found[0]), np.array(found[1])
        return min(spent, float(solver.get_stats("time_tot")[0]))
