"""Real-time iteration: is one step per tick enough to balance a pole while the cart is sent about and the pole is hit?

A cart is sent here and there with its pole upright; every second something hits the pole. In each tick the graph of the
next 1.5 s is solved to the end, by one quadratic program, or by one step of an interior point and more of them only
while the plan violates constraints. What counts is the cost of what was driven, and the time of a tick.

    python examples/real_time_iteration.py [FOLDER]
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import unifg as fg
from unifg.models import cart_pole, rkmk
from unifg.solvers import SQP, InteriorPoint

STATE, robot, h, N, ticks = cart_pole.STATE, cart_pole.CartPole(), 0.05, 30, 160
field, sigma = cart_pole.field(robot), np.array([0.3, 0.3, 1.0, 1.0])
wanted = np.tile([0.0, np.pi, 0.0, 0.0], (ticks + N + 1, 1))  # upright is half a turn from hanging
wanted[30:90, 0], wanted[90:, 0] = 1.0, -0.5  # where the cart is sent

graph = fg.Graph()
x, u = graph.variables("x", STATE, N + 1), graph.variables("u", fg.Rn(1), N)
here, ahead = graph.data("here", wanted[0]), graph.data("ahead", wanted[1 : N + 1], each=True)
graph.fix(x[0], here)
graph.minimize(fg.prior, x[1:], ahead, sigma=sigma, name="wanted")
graph.minimize(fg.prior, u, [0.0], sigma=5.0, name="effort")
graph.constrain(cart_pole.dynamics(robot, "rk4"), x[:-1], u, x[1:], h, lower=0, upper=0, name="motion")
graph.bound(u, lower=-8.0, upper=8.0)
graph.bound(x.cart[1:], lower=-1.2, upper=1.2)

solvers = {
    "to the end": SQP(qp="graph", hessian="exact"),
    "one program": SQP(qp="graph", max_iterations=1),
    "one step": InteriorPoint(step_tolerance=np.inf),
}
results, (figure, ax) = {}, plt.subplots(figsize=(8.0, 3.0), layout="constrained")
for name, solver in solvers.items():
    run, driven, times, cost = solver.prepare(graph), wanted[:1], np.zeros(0), 0.0
    guess = fg.Guess({x: np.tile(wanted[0], (N + 1, 1)), u: np.zeros((N, 1))})
    for k in range(ticks):
        plan = run.solve(guess, data={here: driven[-1], ahead: wanted[k + 1 : k + N + 1]})
        push = np.clip(plan[u[0]], -8.0, 8.0)
        moved = rkmk.rollout(STATE, field, driven[-1], push, h=h, substeps=4)[-1]
        moved[3] += (1.0 if k % 40 == 20 else -1.0) * (k % 20 == 0)  # a hit [rad/s]
        driven, guess, times = np.vstack([driven, moved]), plan.shifted(x, u), np.append(times, 1e3 * plan.seconds)
        cost += 0.5 * float(np.sum((STATE.local(wanted[k + 1], moved) / sigma) ** 2) + np.sum((push / 5.0) ** 2))
    results[name] = cost, driven
    print(f"{name:12} costs {cost:.2f}, takes {np.median(times):.2f} ms, 95 % within {np.percentile(times, 95):.2f} ms")
    ax.plot(h * np.arange(ticks + 1), driven[:, 0], label=name)
ax.step(h * np.arange(ticks + 1), wanted[: ticks + 1, 0], "k:", label="wanted")
ax.set(xlabel="time [s]", ylabel="cart [m]")
ax.legend(fontsize=8)
folder = Path(*sys.argv[1:] or ["out"])
folder.mkdir(parents=True, exist_ok=True)
figure.savefig(folder / "real_time_iteration.png", dpi=80)
