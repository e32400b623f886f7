"""Plans from five hundred places where a robot may be: one graph, many data, one compiled call.

The robot knows where it is to 15 cm. Its plan around a disc is solved from 500 such places, in one call that Python has
no part in: which way round it goes depends on the place, and so does the price.

    python examples/many_plans.py [FOLDER]
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import Normalize
from matplotlib.patches import Circle

import unifg as fg
from unifg.models import obstacles, unicycle
from unifg.solvers import InteriorPoint

N, K, centre, radius = 30, 500, np.array([[1.5, 0.05]]), np.array([0.5])
graph = fg.Graph()
x, u = graph.variables("x", fg.SE2, N + 1), graph.variables("u", fg.Rn(2), N)
here = graph.data("here", [0.0, 0.0, 0.0])
graph.fix(x[0], here, name="start")
graph.minimize(lambda pose: pose[:, :2] - [3.0, 0.0], x[-1], sigma=0.1, name="arrive")
graph.minimize(fg.prior, u, [0.0, 0.0], sigma=1.0, name="effort")
graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], 0.1, lower=0, upper=0, name="motion")
graph.constrain(obstacles.disc_clearance, x[1:], centre, radius, lower=0, name="disc")
graph.bound(u, lower=[-0.2, -2.0], upper=[1.6, 2.0], name="limits")

rng, along = np.random.default_rng(0), np.linspace(0.0, 3.0, N + 1)
places = rng.normal(size=(K, 3)) * [0.15, 0.15, 0.3]
guesses = [
    {
        x: np.stack([along, np.sign(y) * np.sin(np.pi * along / 3.0), 0.0 * along], axis=1),
        u: np.tile([1.0, 0.0], (N, 1)),
    }
    for y in places[:, 1]
]
prepared = InteriorPoint().prepare(graph)
found = prepared.solve_many(guesses, data={here: places})
above = found[x][:, N // 2, 1] > 0.0
print(f"{sum(s.converged for s in found.statuses)} of {K} plans found, {above.sum()} above the disc")

figure, ax = plt.subplots(figsize=(6.4, 3.6), layout="constrained")
colour = plt.get_cmap("viridis")((found.cost - found.cost.min()) / np.ptp(found.cost))
for path, shade in zip(found[x], colour, strict=True):
    ax.plot(*path[:, :2].T, color=shade, linewidth=0.5, alpha=0.5)
ax.add_patch(Circle(centre[0], radius[0], color="0.6"))
ax.plot(*places[:, :2].T, "k.", markersize=1.5)
ax.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
scale = plt.cm.ScalarMappable(Normalize(found.cost.min(), found.cost.max()), "viridis")
figure.colorbar(scale, ax=ax, label="cost of the plan")
(folder := Path(*sys.argv[1:] or ["out"])).mkdir(parents=True, exist_ok=True)
figure.savefig(folder / "many_plans.png", dpi=80)
