"""One problem, every backend: who takes it, how long it takes, and how well the KKT conditions hold.

A unicycle is to be 3 m ahead in 4 s; two discs leave it a bend between them. Cost and constraints are stated once, each
backend is named and timed on the same cold guess, in its second solve. Stationarity, violation and complementarity are
measured by one function for all, after the backend has stopped. A backend that knows no constraints says so.

    python examples/swap_backends.py [FOLDER]
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Circle

import unifg as fg
from unifg.models import obstacles, unicycle
from unifg.solvers import KKT, SQP, AugmentedLagrangian, InteriorPoint, LevenbergMarquardt, Penalty

N, dt = 40, 0.1
centres, radii = np.array([[1.0, -0.2], [2.2, 0.4]]), np.array([0.5, 0.5])
graph = fg.Graph()
x, u = graph.variables("x", fg.SE2, N + 1), graph.variables("u", fg.Rn(2), N)
graph.fix(x[0], [0.0, 0.0, 0.0])
graph.minimize(unicycle.tracking, x[-1], [3.0, 0.0, 0.0], sigma=0.05, name="goal")
graph.minimize(fg.prior, u, [0.0, 0.0], sigma=[1.0, 0.7], name="effort")
graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], dt, lower=0, upper=0, name="motion")
graph.constrain(obstacles.disc_clearance, x[1:], centres, radii, lower=0, name="discs")
graph.bound(u, lower=[-1.2, -2.0], upper=[1.2, 2.0], name="limits")
t = np.linspace(0.0, 1.0, N + 1)
guess = {x: np.stack([3.0 * t, 0.3 * np.sin(2 * np.pi * t), 0 * t], axis=1), u: np.tile([0.75, 0.0], (N, 1))}

sqps = SQP(), SQP(qp="piqp"), SQP(qp="graph"), SQP(qp="graph", hessian="exact")
solutions, refusals = {}, {}
figure, (plan, progress) = plt.subplots(1, 2, figsize=(9.0, 3.0), layout="constrained")
for solver in (AugmentedLagrangian(), InteriorPoint(), *sqps, Penalty(), KKT(), LevenbergMarquardt()):
    label = solver.name + (f" {solver.qp} {solver.hessian}" if isinstance(solver, SQP) else "")
    try:
        run = solver.prepare(graph)
    except fg.BackendError as error:
        refusals[label] = str(error)
        print(f"{label:24}", error)
        continue
    _, s = run.solve(guess), run.solve(guess)
    kkt = f"KKT {s.stationarity:.0e} {s.violation:.0e} {s.complementarity:.0e}"
    took = f"{s.iterations:3} iterations {1e3 * s.seconds:6.1f} ms"
    print(f"{label:24} {took}  cost {s.cost:.4f}  {kkt}  {s.status.name}")
    solutions[label] = s
    plan.plot(*s[x][:, :2].T, label=label)
    progress.semilogy([max(row.stationarity, row.violation) for row in s.history])
for (cx, cy), radius in zip(centres, radii, strict=True):
    plan.add_patch(Circle((cx, cy), radius, color="0.8"))
plan.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
progress.set(xlabel="iteration", ylabel="stationarity or violation")
figure.legend(loc="outside right upper", fontsize=8)
folder = Path(*sys.argv[1:] or ["out"])
folder.mkdir(parents=True, exist_ok=True)
figure.savefig(folder / "swap_backends.png", dpi=80)
