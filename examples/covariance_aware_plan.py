"""A plan that knows how well it will know where it is: clearance in standard deviations, predicted along the way.

A robot drives ten metres between two rocks. Its motion is noisy; a beacon tells it where it is, as far as it reaches.
The covariance of a filter is a variable of each node, its recursion a constraint: a plan detours to fit the gap.

    python examples/covariance_aware_plan.py [FOLDER]
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Circle

import unifg as fg
from unifg.models.uncertainty import packed, unpacked, updated
from unifg.solvers import SQP
from unifg.typing import Array

N, beacon, reach, unit = 24, np.array([3.5, 3.0]), 2.5, 0.01  # steps; [m]; [m]; of covariances [m^2]
rocks, radius, noise, begin = np.array([[6.5, 1.0], [6.5, -1.0]]), 0.6, 0.05, 0.15  # [m]; noise of a step


def step(P: Array, after: Array) -> Array:
    """Packed covariance (n, 3) of the position after a step: what is likely to be seen from there counts."""
    far = np.sqrt(np.sum((after - beacon) ** 2, axis=1))
    information = (0.5 - 0.5 * np.tanh((far - reach) / 0.4))[:, None, None] * np.eye(2) / 0.1**2
    return packed(updated(unpacked(unit * P) + noise**2 * np.eye(2), information)) / unit


def kept(x: Array, P: Array, k: Array) -> Array:
    """Distances to the rocks (n, 2) [m], less k standard deviations, which are the same in all directions here."""
    distance: Array = np.sqrt(np.sum((x[:, None] - rocks) ** 2, axis=2)) - radius
    return distance - k * np.sqrt(np.maximum(unit * P[:, :1], 0.0) + 1e-6)


graph = fg.Graph()
x, P, k = graph.variables("x", fg.Rn(2), N + 1), graph.variables("P", fg.Rn(3), N + 1), graph.data("k", 0.0)
graph.fix(x[[0, N]], [[0.0, 0.0], [10.0, 0.0]])
graph.fix(P[0], [begin**2 / unit, 0.0, begin**2 / unit])
graph.minimize(lambda a, b: b - a, x[:-1], x[1:], name="way")
graph.constrain(lambda P, after, there: there - step(P, after), P[:-1], x[1:], P[1:], lower=0, upper=0, name="filter")
graph.constrain(kept, x[1:-1], P[1:-1], k, lower=0.0, name="rocks")
guess = {x: np.linspace([0.0, 0.5], [10.0, 0.0], N + 1), P: np.full((N + 1, 3), [2.0, 0.0, 2.0])}
plans, run, (figure, ax) = {}, SQP().prepare(graph), plt.subplots(figsize=(8.0, 4.2), layout="constrained")
for value in (0.0, 3.0, 4.0):
    plan = plans[value] = run.solve(guess, data={k: value})
    sigma = np.sqrt(unit * plan[P][:, 0])
    print(f"{value:g} sigma: {plan.status.name}, {100 * sigma[15:18].mean():.0f} cm between the rocks")
    (line,) = ax.plot(*plan[x].T, ".-", label=f"{value:g} standard deviations")
    low, high = plan[x][:, 1] - value * sigma, plan[x][:, 1] + value * sigma
    ax.fill_between(plan[x][:, 0], low, high, color=line.get_color(), alpha=0.15)
for centre, size, colour in ((rocks[0], radius, "0.6"), (rocks[1], radius, "0.6"), (beacon, reach, "#fff3c0")):
    ax.add_patch(Circle((centre[0], centre[1]), size, color=colour, zorder=0))
ax.legend(loc="lower left")
ax.axis("equal")
(folder := Path(*sys.argv[1:] or ["out"])).mkdir(parents=True, exist_ok=True)
figure.savefig(folder / "covariance_aware_plan.png", dpi=80)
