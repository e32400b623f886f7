"""An answer that explains itself: which constraints hold a plan, and what a unit of loosening would save.

A robot is to be at the goal soon, past a disc and with limited speed. ``solution.explain()`` names what holds the plan.
The picture shows where: the multipliers of the disc along the path, those of the limits over time. The cost that the
largest ones foretell is compared with that of plans whose disc is a little smaller or whose limit is a little wider.

    python examples/explained_plan.py [FOLDER]
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Circle

import unifg as fg
from unifg.models import obstacles, unicycle
from unifg.solvers import InteriorPoint

N, centre = 30, np.array([[1.4, 0.1]])
graph = fg.Graph()
x, u = graph.variables("x", fg.SE2, N + 1), graph.variables("u", fg.Rn(2), N)
radius, most = graph.data("radius", [0.4]), graph.data("most", [1.05, 1.5])
graph.fix(x[0], [0.0, 0.0, 0.0], name="start")
graph.minimize(lambda pose: pose[:, :2] - [3.0, 0.0], x[-1], sigma=0.1, name="goal")
graph.minimize(fg.prior, u, [0.0, 0.0], sigma=2.0, name="effort")
graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], 0.1, lower=0, upper=0, name="motion")
graph.constrain(obstacles.disc_clearance, x[1:], centre, radius, lower=0, name="disc")
graph.constrain(lambda u, most: u - most, u, most, upper=0, name="limits")

along = np.linspace(0.0, 3.0, N + 1)
guess = {x: np.stack([along, 0.5 * np.sin(along), 0.0 * along], axis=1), u: np.tile([1.0, 0.0], (N, 1))}
run = InteriorPoint(tolerance=1e-9).prepare(graph)
solution = run.solve(guess, check=True)
print(solution.explain())

disc, limits = -solution.dual("disc")[:, 0], solution.dual("limits")[:, 0]
foretold = {"radius": -disc.sum(), "speed": limits.sum()}  # saved for each metre, and for each metre a second
saved = {}
for what, data in (("radius", {radius: [0.399]}), ("speed", {most: [1.051, 1.5]})):
    saved[what] = solution.cost - run.solve(solution, data=data, check=True).cost
    print(f"{what}, loosened by 0.001: {0.001 * abs(foretold[what]):.5f} foretold, {saved[what]:.5f} saved")

figure, (plan, over) = plt.subplots(2, layout="constrained", figsize=(6.0, 4.6), height_ratios=[2, 1])
plan.add_patch(Circle(centre[0], 0.4, color="0.8"))
plan.plot(*solution[x][:, :2].T, "k-", linewidth=1)
plan.scatter(*solution[x][1:, :2].T, s=4 + 60 * disc / disc.max(), c="tab:red", label="held by the disc")
plan.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
plan.legend(loc="lower right")
over.bar(0.1 * np.arange(N), limits, width=0.08, align="edge", color="tab:blue")
over.set(xlabel="time [s]", ylabel="saved for\n1 m/s more")
folder = Path(*sys.argv[1:] or ["out"])
folder.mkdir(parents=True, exist_ok=True)
figure.savefig(folder / "explained_plan.png", dpi=80)
