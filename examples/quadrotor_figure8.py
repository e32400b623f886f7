"""A quadrotor flies a figure of eight, in wind and with drag that its model does not know.

Its state is (p, R, v), with the attitude on SO(3); body rates and thrust are its controls, within limits. Wanted are
places: a cost on x.p and nothing else, attitude and thrust follow from the dynamics. The next second is planned every
0.05 s, by the backend that is named.

    python examples/quadrotor_figure8.py [FOLDER]
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import unifg as fg
from unifg.models import quadrotor
from unifg.solvers import SQP, AugmentedLagrangian, InteriorPoint

N, h, ticks, model = 20, 0.05, 160, quadrotor.Parameters(mass=1.0)
world = quadrotor.Parameters(mass=1.05, drag=(0.1, 0.1, 0.2), wind=(0.5, 0.0))  # what flies is another vehicle
t = h * np.arange(ticks + N + 1)
eight = np.stack([1.5 * np.sin(2 * np.pi * t / 6.0), 1.0 * np.sin(4 * np.pi * t / 6.0), 1.0 + 0.2 * t / 6.0], axis=1)
hover = quadrotor.hover(model)

graph = fg.Graph()
x, u = graph.variables("x", quadrotor.STATE, N + 1), graph.variables("u", quadrotor.CONTROL, N)
start = quadrotor.STATE.pack(p=eight[0], R=fg.SO3.identity(), v=(eight[1] - eight[0]) / h)
here, wanted = graph.data("here", start), graph.data("wanted", eight[1 : N + 1], each=True)
graph.fix(x[0], here)
graph.minimize(fg.prior, x[1:].p, wanted, sigma=0.05, name="eight")
graph.minimize(fg.prior, u, hover, sigma=[3.0, 3.0, 1.0, 3.0], name="effort")
graph.constrain(quadrotor.dynamics, x[:-1], u, x[1:], model.packed, h, lower=0, upper=0, name="dynamics")
graph.bound(u, lower=[-6.0, -6.0, -3.0, 2.0], upper=[6.0, 6.0, 3.0, 20.0])

results = {}
figure, ax = plt.subplots(figsize=(5.0, 3.4), layout="constrained")
for solver in (InteriorPoint(tolerance=1e-4), AugmentedLagrangian(tolerance=1e-4), SQP(qp="graph", tolerance=1e-4)):
    run, flown, times = solver.prepare(graph), start[None], np.zeros(0)
    guess = fg.Guess({x: np.tile(start, (N + 1, 1)), u: np.tile(hover, (N, 1))})
    for k in range(ticks):
        plan = run.solve(guess, data={here: flown[-1], wanted: eight[k + 1 : k + N + 1]})
        flown = np.vstack([flown, quadrotor.fly(flown[-1], plan[u[0]][0], h, world)])
        guess, times = plan.shifted(x, u), np.append(times, 1e3 * plan.seconds)
    off = np.linalg.norm(flown[20:, :3] - eight[20 : ticks + 1], axis=1)
    tilt = np.degrees(np.arccos(fg.SO3.act(flown[:, 3:7], [0.0, 0.0, 1.0])[:, 2])).max()
    results[solver.name] = off.max(), tilt, plan.status
    print(f"{solver.name:20} {np.median(times):.2f} ms, at most {off.max():.3f} m off, tilts by up to {tilt:.0f} deg")
    ax.plot(*flown[:, :2].T, label=solver.name)
ax.plot(*eight[:, :2].T, "k:", label="wanted")
ax.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
ax.legend(fontsize=8)
folder = Path(*sys.argv[1:] or ["out"])
folder.mkdir(parents=True, exist_ok=True)
figure.savefig(folder / "quadrotor_figure8.png", dpi=80)
