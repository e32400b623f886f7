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
from functools import cache
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from benchmarks.compiled_peers import FLAGS
from benchmarks.control_peers import MODELS
from benchmarks.report import OUT
from benchmarks.timing import clocked
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
        iterations: of the last solve; those of the subproblem for a single one.
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

        made, n, self.problem = interface(), problem.horizon, problem
        self.plan: Any = problem.guess()
        self.answer: Any = self.plan
        self.status, self.iterations = "", 0
        error, gap = MODELS[problem.robot]
        size, controls, count = len(problem.start), len(problem.effort), len(problem.discs)
        x, u, reference = ca.SX.sym("x", size), ca.SX.sym("u", controls), ca.SX.sym("reference", size)
        off, one = error(x, reference), np.ones(count)
        name = f"{problem.robot}_{problem.instance}_{count}_{n}_{soft:d}{single:d}_{steps}".replace("-", "_")
        model = {
            "name": name, "x": x, "u": u, "p": reference, "disc_dyn_expr": -gap(x, u, ca.DM.zeros(size), problem.dt),
            "cost_y_expr": ca.vertcat(off, u), "cost_y_expr_0": ca.vertcat(off, u), "cost_y_expr_e": off,
        }  # fmt: skip
        running = block_diag(np.diag(problem.stage), np.diag(problem.effort)) / problem.dt
        zero = np.zeros(len(running))
        cost: dict[str, Any] = {f"cost_type{where}": "NONLINEAR_LS" for where in ("", "_0", "_e")}
        cost |= {"W": running, "W_0": running, "W_e": np.diag(problem.terminal)}
        cost |= {"yref": zero, "yref_0": zero, "yref_e": zero[:-controls]}
        limits = {"x0": problem.start, "idxbu": np.arange(controls), "lbu": problem.lower, "ubu": problem.upper}
        if count:
            rows = [ca.sumsqr(x[: problem.axes] - disc[:-1]) - disc[-1] ** 2 for disc in problem.discs]
            model |= {"con_h_expr": ca.vertcat(*rows), "con_h_expr_e": ca.vertcat(*rows)}
            limits |= {"lh": 0.0 * one, "lh_e": 0.0 * one, "uh": 1e6 * one, "uh_e": 1e6 * one}
        for where, scale in (("", 1.0 / problem.dt), ("_e", 1.0)) if soft else ():
            limits[f"idxsh{where}"] = np.arange(count)
            cost |= {f"{side}{where}": SOFT * scale * one for side in ("zl", "zu")}
            cost |= {f"{side}{where}": scale * one for side in ("Zl", "Zu")}
        options = {
            "tf": n * problem.dt, "integrator_type": "DISCRETE", "hessian_approx": "GAUSS_NEWTON",
            "nlp_solver_type": "SQP_RTI" if single else "SQP", "nlp_solver_max_iter": 200,
            "qp_solver": "PARTIAL_CONDENSING_HPIPM", "qp_solver_cond_N": n // 5, "qp_solver_iter_max": 100,
            "hpipm_mode": "SPEED_ABS" if single and not soft else "SPEED", "qp_solver_warm_start": 1,
            "qp_tol": 0.1 * tolerance, "globalization": "FIXED_STEP" if steps == "full" else "MERIT_BACKTRACKING",
            "globalization_use_SOC": int(steps == "corrected"),
            # Without it hard constraints let corrected steps cycle.
            "levenberg_marquardt": 0.1 if steps == "corrected" and not soft else 0.0,
            "ext_fun_compile_flags": " ".join(FLAGS[:2]),
            **{f"nlp_solver_tol_{kind}": tolerance for kind in ("stat", "eq", "ineq", "comp")},
        }  # fmt: skip
        LIBRARIES.mkdir(parents=True, exist_ok=True)
        ocp, folder = made.AcadosOcp(), str(LIBRARIES / name)
        own = {"model": made.AcadosModel(), "parameter_values": problem.start, "code_export_directory": folder}
        parts = (ocp, own), (ocp.dims, {"N": n}), (ocp.cost, cost), (ocp.constraints, limits)
        for part, values in (*parts, (ocp.solver_options, options), (own["model"], model)):
            for field, value in values.items():
                setattr(part, field, value)
        with contextlib.chdir(LIBRARIES), contextlib.redirect_stdout(io.StringIO()):
            self._solver = made.AcadosOcpSolver(ocp, json_file=f"{name}.json", verbose=False)
        self._solve = getattr(self._solver.shared_lib, f"{name}_acados_solve")
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

    def _from(self, states: Array, controls: Array, state: Array, first: int) -> float:
        """Solve closed-loop step ``first`` from a guess; seconds of the call that solves.

        acados measures elapsed time. Where the processor was taken away meanwhile, processor time of the call is less.
        """
        solver, n = self._solver, self.problem.horizon
        wanted, cruise = self.problem.reference(first)
        zero = np.zeros(len(self.problem.stage))
        for k in range(n + 1):
            given = {"x": states[k], "p": wanted[k]} | ({"u": controls[k]} if k < n else {})
            for name, value in (given | ({} if k else {"lbx": state, "ubx": state})).items():
                solver.set(k, name, value)
            if k < n:
                solver.cost_set(k, "yref", np.append(zero, cruise[k]))
        status, spent = clocked(self._solve, solver.capsule)
        self.status, self.iterations = STATUS[status], int(solver.get_stats(self._counted)[-1])
        self.answer = [np.array([solver.get(k, name) for k in range(m)]) for name, m in (("x", n + 1), ("u", n))]
        return min(spent, float(solver.get_stats("time_tot")[0]))
