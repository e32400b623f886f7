"""A solver of quadratic programs of your own inside SQP: registered with qpsolvers, swapped by its name.

Here it is Mehrotra's interior point (Nocedal and Wright, algorithm 16.4), dense and in twenty lines. Whatever solves
min 1/2 x'Px + q'x, Gx <= h, Ax = b and returns multipliers will do: SQP measures every answer before it is used.

    python examples/own_qp_solver.py [FOLDER]
"""

import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import qpsolvers

import unifg as fg
from unifg.models import obstacles, unicycle
from unifg.solvers import SQP


def mehrotra(problem: Any, **options: Any) -> qpsolvers.Solution:
    P, q, G, h, A, b, *_ = problem.unpack()
    x, y, s, z = 0.0 * q, 0.0 * b, np.ones(len(h)), np.ones(len(h))
    for _ in range(50):
        slope, off, slack, gap = P @ x + q + A.T @ y + G.T @ z, A @ x - b, G @ x + s - h, s @ z / len(h)
        if max(gap, *(np.abs(part).max() for part in (slope, off, slack))) < 1e-9:
            return qpsolvers.Solution(problem, found=True, x=x, y=y, z=z)
        kkt = np.block([[P + G.T @ (G * (z / s)[:, None]), A.T], [A, np.zeros((len(b), len(b)))]])
        bent = s * z  # the predictor aims at s z = 0
        for _ in range(2):
            dx, dy = np.split(np.linalg.solve(kkt, -np.r_[slope + G.T @ ((z * slack - bent) / s), off]), [len(q)])
            dz = -(bent + z * (ds := -slack - G @ dx)) / s
            length = min(1.0, 0.99 / max(1e-9, (-ds / s).max(), (-dz / z).max()))
            left = (s + length * ds) @ (z + length * dz) / len(h) / gap
            bent = s * z + ds * dz - left**3 * gap  # the corrector
        x, y, s, z = x + length * dx, y + length * dy, s + length * ds, z + length * dz
    return qpsolvers.Solution(problem, found=False)


qpsolvers.solvers.solve_function["mehrotra"] = mehrotra
qpsolvers.available_solvers += ["mehrotra"]
qpsolvers.dense_solvers += ["mehrotra"]  # it wants matrices of NumPy
N, graph, (figure, ax) = 15, fg.Graph(), plt.subplots(figsize=(5.0, 2.6), layout="constrained")
x, u = graph.variables("x", fg.SE2, N + 1), graph.variables("u", fg.Rn(2), N)
graph.fix(x[[0, N]], [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
graph.minimize(fg.prior, u, [0.0, 0.0], name="effort")
graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], 0.18, lower=0, upper=0, name="motion")
graph.constrain(obstacles.disc_clearance, x[1:], np.array([[1.0, 0.1]]), np.array([0.4]), lower=0, name="disc")
guess, solutions = {x: np.linspace([0.0, -0.2, 0.0], [2.0, -0.2, 0.0], N + 1), u: np.full((N, 2), 0.5)}, {}
for name in qpsolvers.available_solvers:
    s = solutions[name] = SQP(qp=name).solve(graph, guess)
    own = sum(row.details.get("qp") == name for row in s.history)
    print(f"{name:10} solves {own} of {s.iterations} programs; cost {s.cost:.6f}, {s.status.name}")
    ax.semilogy([row.stationarity for row in s.history], label=name)
ax.legend(title="gradient of the Lagrangian", fontsize=8)
folder = Path(*sys.argv[1:] or ["out"])
folder.mkdir(parents=True, exist_ok=True)
figure.savefig(folder / "own_qp_solver.png", dpi=80)
