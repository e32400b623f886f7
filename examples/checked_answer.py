"""Check of an answer by the functions as written: which errors it finds, and how small ones.

A plan goes to a file and is checked with the script that states its graph, as ``unifg check SCRIPT.py:graph FILE``
does: nothing of what solved it takes part. Then one number of the file is changed: a pose, a control, a multiplier, the
cost. The picture shows from which size on each change is found.

    python examples/checked_answer.py [FOLDER]
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import unifg as fg
from unifg.models import obstacles, unicycle
from unifg.solution.saved import check_answer
from unifg.solvers import InteriorPoint

N = 20
graph = fg.Graph()
x, u = graph.variables("x", fg.SE2, N + 1), graph.variables("u", fg.Rn(2), N)
graph.fix(x[0], [0.0, 0.0, 0.0], name="start")
graph.minimize(fg.prior, x[-1], [1.5, 0.6, 0.0], sigma=0.1, name="goal")
graph.minimize(fg.prior, u, [0.0, 0.0], name="effort")
graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], 0.1, lower=0, upper=0, name="motion")
graph.constrain(obstacles.disc_clearance, x[1:], np.array([[0.8, 0.1]]), np.array([0.3]), lower=0, name="disc")
graph.bound(u, lower=-1.5, upper=1.5, name="limits")
solution = InteriorPoint(tolerance=1e-9).solve(graph, {x: np.zeros((N + 1, 3)), u: np.full((N, 2), 0.5)}, check=True)

folder = Path(*sys.argv[1:] or ["out"])
folder.mkdir(parents=True, exist_ok=True)
solution.save(folder / "answer.npz")
sound = check_answer(graph, folder / "answer.npz")
print("as it was solved", sound, sep=": ")

sizes = 10.0 ** np.arange(-10.0, 0.0)
places = {"values/x": (10, 1), "values/u": (5, 0), "multipliers/motion": (10, 0), "cost": ()}
found = {}
for name, place in places.items():
    for size in sizes:
        arrays = dict(np.load(folder / "answer.npz"))
        arrays[name][place] += size
        np.savez(folder / "changed.npz", **arrays)
        found[name, size] = check_answer(graph, folder / "changed.npz")
    least = min(size for size in sizes if not found[name, size])
    print(f"{name}, changed by {least:.0e}: {found[name, least]}")

figure, ax = plt.subplots(figsize=(6.0, 2.6), layout="constrained")
shades = {"passes": "tab:green", "undecided": "tab:orange", "fails": "tab:red"}
for row, name in enumerate(places):
    ax.scatter(sizes, np.full(len(sizes), row), c=[shades[found[name, size].verdict] for size in sizes], s=60)
for verdict, shade in shades.items():
    ax.scatter([], [], c=shade, label=verdict)
ax.axvline(1e-6, color="0.7", zorder=0)
ax.set(xscale="log", xlabel="change of one number; tolerance 1e-6", yticks=range(len(places)), yticklabels=places)
ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
figure.savefig(folder / "checked_answer.png", dpi=80)
