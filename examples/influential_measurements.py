"""Influence of every measurement on an estimate: which moves it, and how much.

A robot drives through a city and closes loops where it recognises a crossing. ``solution.sensitivity(x[-1], measured)``
is one adjoint solve for each coordinate of the last pose, for all measurements at once. Times the sigma it is how far
the noise of each measurement moves the last pose. The odometry and the loop closure that matter most are moved by three
sigmas each, and the problem is solved again.

    python examples/influential_measurements.py [FOLDER]
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import LineCollection

import unifg as fg
from unifg.pose_graphs import manhattan
from unifg.solvers import LevenbergMarquardt

made = manhattan(160, seed=3)
edges, sigma = made.pose_graph.edges, np.array([0.05, 0.05, 0.02])
graph = fg.Graph()
x = graph.variables("x", fg.SE2, len(made.truth))
measured = graph.data("measured", edges.measured, each=True)
graph.fix(x[0], made.truth[0])
graph.minimize(fg.between, x[edges.first], x[edges.second], measured, sigma=sigma, robust=fg.Huber(2.0))
run = LevenbergMarquardt(tolerance=1e-9).prepare(graph)
solution = run.solve({x: made.pose_graph.poses}, check=True)

slopes = solution.sensitivity(x[-1], measured).reshape(3, -1, 3)  # of the last pose by every measurement
moved = np.linalg.norm(slopes[:2] * sigma, axis=(0, 2))  # of its position, by the noise of each [m]
odometry, results = edges.odometry, {}
for kind, of in (("odometry", odometry), ("loop closure", ~odometry)):
    k = int(np.argmax(np.where(of, moved, 0.0)))
    step = np.linalg.svd(slopes[:2, k] * sigma)[2][0] * sigma * 3.0  # three sigmas, where it moves the position most
    wrong = edges.measured.copy()
    wrong[k] = fg.SE2.retract(wrong[k], step)
    again = run.solve(solution, data={measured: wrong}, check=True)
    true = fg.SE2.local(solution[x][-1], again[x][-1])
    results[kind] = moved[k], slopes[:, k] @ step, true
    print(f"{kind} {edges.first[k]} -> {edges.second[k]}: {100 * moved[k]:.1f} cm a sigma; by three sigmas", end=" ")
    print(
        f"{100 * np.linalg.norm(slopes[:2, k] @ step):.1f} cm foretold, {100 * np.linalg.norm(true[:2]):.1f} cm found"
    )

figure, ax = plt.subplots(figsize=(6.0, 4.5), layout="constrained")
lines = solution[x][:, :2][np.column_stack([edges.first, edges.second])]
order = np.argsort(moved)
drawn = LineCollection(list(lines[order]), array=100 * moved[order], cmap="viridis_r", linewidths=2.5)
figure.colorbar(ax.add_collection(drawn), label="its noise moves the last position by [cm]")
ax.plot(*solution[x][-1, :2], "r*", markersize=14)
ax.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
ax.autoscale()
folder = Path(*sys.argv[1:] or ["out"])
folder.mkdir(parents=True, exist_ok=True)
figure.savefig(folder / "influential_measurements.png", dpi=80)
