"""A backend of your own for equality constraints: Newton's method on the KKT conditions, by SciPy's sparse LU.

A backend sees the compiled program: residuals, Jacobians, limits, and where to put a step. It hands iterates with their
multipliers to run.accept, which measures the KKT conditions and alone says CONVERGED (docs/howto/own-backend.md).

    python examples/own_backend_constrained.py [FOLDER]
"""

import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

import unifg as fg
from unifg.models import unicycle
from unifg.solvers import KKT, AugmentedLagrangian


class Lagrange(fg.Solver):
    constraints = "equalities"  # what has inequalities is refused by name before the first iteration

    def workspace(self, program: Any) -> None:  # what is kept between solves
        return None

    def iterate(self, run: Any, workspace: None) -> fg.Status | None:
        program, damping, price = run.program, 1e-8, 0.0
        while run.status is None and damping < 1e8:
            lin = run.lin
            J, A = program.costs.matrix(lin.jacobian), program.constraints.matrix(lin.constraint_jacobian)
            H, zero = J.T @ J + damping * sp.eye(program.size), -1e-12 * sp.eye(A.shape[0])
            aim = np.concatenate([lin.gradient[program.columns.free], lin.constraints - program.lower])
            step, multipliers = np.split(splu(sp.bmat([[H, A.T], [A, zero]], "csc")).solve(-aim), [program.size])
            price = max(price, 1.1 * np.abs(multipliers).max(initial=0.0))
            reached = program.linearize(program.retract(lin.values, step))
            merits = [at.cost + price * np.abs(at.constraints - program.lower).sum() for at in (lin, reached)]
            better = reached.finite and merits[1] <= merits[0] + 1e-9 * max(1.0, merits[0])
            if better:
                run.accept(reached, multipliers, np.linalg.norm(step), 1.0)
            damping = max(0.1 * damping, 1e-8) if better else max(10.0 * damping, 1e-3)
        return fg.Status.STALLED  # unless run.status says more


N, graph, (figure, ax) = 30, fg.Graph(), plt.subplots(figsize=(5.0, 3.0), layout="constrained")
x, u = graph.variables("x", fg.SE2, N + 1), graph.variables("u", fg.Rn(2), N)
graph.fix(x[[0, N]], [[0.0, 0.0, 0.0], [0.0, 2.0, np.pi]])
graph.minimize(fg.prior, u, [0.0, 0.0])
graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], 0.1, lower=0, upper=0, name="motion")
guess = {x: np.linspace([0.0, 0.0, 0.0], [0.0, 2.0, np.pi], N + 1), u: np.ones((N, 2))}
for s in (solutions := [solver.solve(graph, guess) for solver in (Lagrange(), KKT(), AugmentedLagrangian())]):
    print(s.report(), "pull of the first step:", s.dual("motion")[0].round(4))
    ax.semilogy([max(row.stationarity, row.violation) for row in s.history], label=s.solver)
ax.legend()
folder = Path(*sys.argv[1:] or ["out"])
folder.mkdir(parents=True, exist_ok=True)
figure.savefig(folder / "own_backend_constrained.png", dpi=80)
