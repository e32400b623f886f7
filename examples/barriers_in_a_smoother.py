"""Past and plan of a robot as one trajectory that grows: measured behind, kept off two discs by barriers ahead.

A smoother solves least squares, so a barrier is its hinge max(-b, 0), stated like any measurement. Every tick adds one
node at the far end of the plan, with the barriers of its interval, and one measured position at the near end.

    python examples/barriers_in_a_smoother.py [FOLDER]
"""

import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Circle

import unifg as fg
from unifg.models import barriers, clearances, keeping
from unifg.solvers import LevenbergMarquardt

dt, ahead, ticks, weight, rng = 0.1, 10, 50, 1e4, np.random.default_rng(1)
discs = [(np.array([2.0, 0.15]), 0.5), (np.array([4.2, -0.2]), 0.45)]  # centre and radius [m]
kept = keeping.hinge(barriers.decay(barriers.still(clearances.to_point), alpha=2.0))


def plan(graph: Any, x: Any, y: Any) -> None:  # a smoother and a graph understand the same statements
    graph.minimize(lambda x, y: y[:, :2] - x[:, :2] - dt / 2 * (x[:, 2:] + y[:, 2:]), x, y, sigma=0.005, name="motion")
    graph.minimize(lambda x, y: (y[:, 2:] - x[:, 2:]) / dt, x, y, sigma=1.5, name="push")
    graph.minimize(lambda y: y[:, 1:] - [0.0, 1.0, 0.0], y, sigma=[1.0, 0.3, 0.3], name="wish")
    for k, (centre, radius) in enumerate(discs):
        graph.minimize(kept, x, y, 0.0, dt, centre, radius, sigma=weight**-0.5, name=f"disc {k}")


start, seen, driven = np.array([0.0, 0.0, 1.0, 0.0]), [], []
x = (smoother := fg.Incremental(relinearize=0.01)).variables("x", fg.Rn(4))
smoother.minimize(fg.prior, x[0], start, sigma=[0.05, 0.05, 0.2, 0.2])
smoother.update({x: start})
for k in range(ahead + ticks):
    if k >= ahead:  # the robot is where its plan had it, but for a centimetre; a position is seen with two
        driven.append(smoother.estimate(x[k - ahead + 1])[0, :2] + 0.01 * rng.normal(size=2))
        seen.append(driven[-1] + 0.02 * rng.normal(size=2))
        smoother.minimize(lambda x, z: x[:, :2] - z, x[k - ahead + 1], seen[-1], sigma=0.02, name="fix")
    plan(smoother, x[k], x[k + 1])
    effort = smoother.update({x: smoother.estimate(x[k])[0]})
z = (graph := fg.Graph()).variables("x", fg.Rn(4), ahead + ticks + 1)  # the same, all at once
graph.minimize(fg.prior, z[0], start, sigma=[0.05, 0.05, 0.2, 0.2])
plan(graph, z[:-1], z[1:])
graph.minimize(lambda x, z: x[:, :2] - z, z[1 : ticks + 1], np.array(seen), sigma=0.02, name="fix")
batch = LevenbergMarquardt().solve(graph, {z: smoother.estimate(x)})
apart = np.abs(batch[z] - smoother.estimate(x)).max()
print(f"{effort.eliminated} of {len(batch[z])} nodes eliminated in a tick; the batch is {apart:.1e} apart")
figure, axes = plt.subplots(figsize=(8.0, 2.4), layout="constrained", subplot_kw={"aspect": "equal"})
for centre, radius in discs:
    axes.add_patch(Circle((centre[0], centre[1]), radius, color="0.8"))
axes.plot(*np.array(seen).T, ".", *smoother.estimate(x)[:, :2].T)
folder = Path(*sys.argv[1:] or ["out"])
folder.mkdir(parents=True, exist_ok=True)
figure.savefig(folder / "barriers_in_a_smoother.png", dpi=80)
