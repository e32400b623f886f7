"""A model-predictive control loop: follow a lane past a disc that crosses it, in a world that is not the model.

Every 0.1 s the graph of the next 2 s is solved again, from the last plan moved by one stage, values and multipliers.
What changes from tick to tick is data: where the robot is, the lane ahead, the places of the disc. The wheels slip by
5 %. Nothing is compiled in the loop and no solve raises: the loop looks at numbers. Another backend is another word.

    python examples/unicycle_mpc_loop.py [FOLDER]
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Circle

import unifg as fg
from unifg.models import obstacles, unicycle
from unifg.solvers import SQP, AugmentedLagrangian, InteriorPoint

N, dt, ticks, radius, wave = 20, 0.1, 120, 0.4, 0.5 * np.pi
px = 0.6 * dt * np.arange(ticks + N + 1)  # 0.6 m/s along a wave
lane = np.stack([px, 0.4 * np.sin(wave * px), np.arctan(0.4 * wave * np.cos(wave * px))], axis=1)
disc = np.stack([3.4 + 0.0 * px, 1.6 - 0.5 * px], axis=1)  # its centre at every tick

graph = fg.Graph()
x, u = graph.variables("x", fg.SE2, N + 1), graph.variables("u", fg.Rn(2), N)
here, wanted = graph.data("here", lane[0]), graph.data("wanted", lane[1 : N + 1], each=True)
centre = graph.data("centre", disc[1 : N + 1, None], each=True)  # for each pose a set of discs, here of one
graph.fix(x[0], here)
graph.minimize(unicycle.tracking, x[1:], wanted, sigma=[0.2, 0.2, 0.5], name="lane")
graph.minimize(unicycle.rate, u[:-1], u[1:], sigma=[0.1, 0.4], name="smooth")
graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], dt, lower=0, upper=0, name="motion")
graph.constrain(obstacles.disc_clearance, x[1:], centre, np.array([radius + 0.05]), lower=0, name="disc")
graph.bound(u, lower=[-0.2, -2.0], upper=[1.2, 2.0], name="limits")

results, (figure, ax) = {}, plt.subplots(figsize=(8.0, 3.0), layout="constrained")
for solver in (SQP(tolerance=1e-4), AugmentedLagrangian(tolerance=1e-4), InteriorPoint(tolerance=1e-4)):
    run, path, times = solver.prepare(graph), lane[:1], np.zeros(0)
    guess = fg.Guess({x: lane[: N + 1], u: np.tile([0.6, 0.0], (N, 1))})
    for k in range(ticks):
        now = {here: path[-1], wanted: lane[k + 1 : k + N + 1], centre: disc[k + 1 : k + N + 1, None]}
        plan = run.solve(guess, data=now)
        assert plan.violation < 1e-3, plan.report()  # a robot would brake along its last plan instead
        path = np.append(path, unicycle.step(path[-1:], plan[u[0]] * [0.95, 1.0], dt), axis=0)
        guess, times = plan.shifted(x, u), np.append(times, 1e3 * plan.seconds)
    off = np.median(np.linalg.norm((path - lane[: ticks + 1])[:, :2], axis=1))
    gap = np.linalg.norm(path[:, :2] - disc[: ticks + 1], axis=1).min() - radius
    results[solver.name] = off, gap
    print(f"{solver.name:20} median {np.median(times):.1f} ms, gap {gap:.3f} m, off the lane {off:.3f} m")
    ax.plot(*path[:, :2].T, label=solver.name)
ax.plot(*lane[:ticks, :2].T, "k:", label="lane")
for cx, cy in disc[:ticks:15]:
    ax.add_patch(Circle((cx, cy), radius, alpha=0.15))
ax.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", ylim=(-1.2, 1.6))
ax.legend(fontsize=8)
folder = Path(*sys.argv[1:] or ["out"])
folder.mkdir(parents=True, exist_ok=True)
figure.savefig(folder / "unicycle_mpc_loop.png", dpi=80)
