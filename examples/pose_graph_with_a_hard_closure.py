"""A pose graph with a closure that holds exactly: a robot leaves its dock, drives a loop and docks again.

Wheel odometry drifts; the dock does not. That the last pose is at the dock is no measurement but a fact: a constraint,
one line more, which takes the uncertainty of the last pose to zero and has no sigma to tune. Its multiplier says how
strongly the odometry resists: what the least cost loses per metre or radian by which the dock is moved.

    python examples/pose_graph_with_a_hard_closure.py [FOLDER]
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import unifg as fg
from unifg.solvers import KKT, SQP, AugmentedLagrangian, GaussNewton, InteriorPoint

N, sigma = 60, np.array([0.06, 0.02, 0.04])  # of odometry, per step [m, m, rad]
turns = 2.0 * np.pi / N * (1.0 + 0.9 * np.sin(6.0 * np.pi * np.arange(N) / N))
steps = fg.SE2.exp(np.stack([np.full(N, 0.5), np.zeros(N), turns], axis=1))
seen = fg.SE2.retract(steps, sigma * np.random.default_rng(4).standard_normal((N, 3)))
truth, drifted = np.zeros((N + 1, 3)), np.zeros((N + 1, 3))
for k in range(N):
    truth[k + 1], drifted[k + 1] = fg.SE2.compose(truth[k], steps[k]), fg.SE2.compose(drifted[k], seen[k])

graph = fg.Graph()
x, dock = graph.variables("x", fg.SE2, N + 1), graph.data("dock", truth[-1])
graph.fix(x[0], [0.0, 0.0, 0.0])
graph.minimize(fg.between, x[:-1], x[1:], seen, sigma=sigma, name="odometry")
solutions = {"GaussNewton": GaussNewton().solve(graph, {x: drifted})}
graph.constrain(fg.prior, x[-1], dock, lower=0, upper=0, name="docking")
solutions |= {s.name: s.solve(graph, {x: drifted}) for s in (KKT(), SQP(), AugmentedLagrangian(), InteriorPoint())}

print("backend              cost      off by, and 3 sigma, after half a loop [m]   off the dock [m]")
for name, s in solutions.items():
    half, last = (np.linalg.norm((s[x] - truth)[k, :2]) for k in (N // 2, N))
    spread = 3.0 * np.sqrt(np.trace(s.covariance(x[N // 2])[:2, :2]))
    print(f"{name:20} {s.cost:.6f}  {half:.2f}  {spread:.2f} {last:36.1e}  {s.status.name}")
docked = solutions["KKT"]
moved = KKT().solve(graph, docked, data={dock: fg.SE2.retract(truth[-1], [1e-3, 0.0, 0.0])})
slope, pull = (moved.cost - docked.cost) / 1e-3, docked.dual("docking")[0]
print(f"moving the dock ahead costs {slope:.4f} per metre; its multiplier says {-pull[0]:.4f}")

figure, ax = plt.subplots(figsize=(5.0, 4.0), layout="constrained")
for label, poses in {"truth": truth, "odometry": drifted, "docked": docked[x]}.items():
    ax.plot(*poses[:, :2].T, ".-", label=label)
ax.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
ax.legend()
folder = Path(*sys.argv[1:] or ["out"])
folder.mkdir(parents=True, exist_ok=True)
figure.savefig(folder / "pose_graph_with_a_hard_closure.png", dpi=80)
