"""A control tick of microseconds between solves: predict, solve in the background, correct to first order.

While a control acts, the plan from where it should lead is solved, and how it depends on that state. What is measured
then is another, and the control is moved by the sensitivity times the deviation (advanced step, Zavala and Biegler,
Automatica 45 (2009)). The judge solves after it has measured. Gusts push a unicycle that follows a lane past a disc;
where a gust moves the plan to the other side of the disc, the first order does not help.

    python examples/first_order_tick.py [FOLDER]
"""

import sys
from pathlib import Path
from time import perf_counter

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Circle

import unifg as fg
from unifg.models import obstacles, unicycle
from unifg.solvers import InteriorPoint

N, dt, ticks, top, px = 20, 0.1, 90, np.array([1.2, 2.0]), 0.06 * np.arange(111)  # 0.6 m/s along a wave
lane = np.stack([px, 0.4 * np.sin(1.5 * px), np.arctan(0.6 * np.cos(1.5 * px))], axis=1)
graph = fg.Graph()
x, u = graph.variables("x", fg.SE2, N + 1), graph.variables("u", fg.Rn(2), N)
here, wanted = graph.data("here", lane[0]), graph.data("wanted", lane[1 : N + 1], each=True)
graph.fix(x[0], here)
graph.minimize(unicycle.tracking, x[1:], wanted, sigma=[0.2, 0.2, 0.5], name="lane")
graph.minimize(fg.prior, u, [0.6, 0.0], sigma=[0.5, 1.0], name="effort")
graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], dt, lower=0, upper=0, name="motion")
graph.constrain(obstacles.disc_clearance, x[1:], np.array([[2.6, -0.1]]), np.array([0.3]), lower=0, name="disc")
graph.bound(u, lower=-top, upper=top, name="limits")

background, judge = (InteriorPoint(tolerance=1e-9).prepare(graph) for _ in range(2))
rng, state, control, rows = np.random.default_rng(0), lane[0], np.zeros(2), []
plan = background.solve({x: lane[: N + 1], u: np.tile([0.6, 0.0], (N, 1))}, check=True)
for k in range(1, ticks):
    ahead = unicycle.step(state[None], control[None], dt)[0]  # where the control should lead, in the background
    now = {wanted: lane[k + 1 : k + N + 1]}
    plan = background.solve(plan.shifted(x, u), data={here: ahead, **now}, check=True)
    gain, first = plan.sensitivity(u[0], here), plan[u][0]  # refused at a tick where a limit is just about to act
    state = fg.SE2.retract(ahead, rng.normal(size=3) * [0.02, 0.02, 0.04])  # what is measured then
    began = perf_counter()
    control = np.clip(first + gain @ fg.SE2.local(ahead, state), -top, top)
    took = 1e6 * (perf_counter() - began)
    full = judge.solve(plan, data={here: state, **now}, check=True)
    off = [float(np.linalg.norm(tick - full[u][0])) for tick in (first, control)]
    rows.append([*state[:2], *off, took, 1e6 * full.seconds])
table, results = np.array(rows), np.median(rows, axis=0)[2:]
print("off the full tick: {:.4f} uncorrected, {:.4f} to first order; {:.0f} us, full tick {:.0f} us".format(*results))
figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 2.6), width_ratios=[3, 2], layout="constrained")
left.plot(*lane[:ticks, :2].T, "k:", *table[:, :2].T)
left.add_patch(Circle((2.6, -0.1), 0.3, alpha=0.3))
left.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
right.semilogy(table[:, 2:4] + 1e-6, label=["plan for the predicted state", "corrected to first order"])
right.legend(fontsize=7, title="off the full tick")
(folder := Path(*sys.argv[1:] or ["out"])).mkdir(parents=True, exist_ok=True)
figure.savefig(folder / "first_order_tick.png", dpi=80)
