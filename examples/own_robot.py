"""A robot of your own: a car whose front wheels take time to turn reverses into a gap between two parked ones.

A robot is where its state lies and F, its velocity in the axes of its body. This one has a pose on SE(2), a speed and
the angle of its wheels, and is driven by acceleration and steering rate. rkmk makes the defect of a step of F, with
exact derivatives. Cars are covered by three discs each. Components have limits of their own: x.speed, x.steer.

    python examples/own_robot.py [FOLDER]
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Circle

import unifg as fg
from unifg.models import rkmk
from unifg.solvers import AugmentedLagrangian, InteriorPoint
from unifg.typing import Array

STATE, base = fg.Product(pose=fg.SE2, speed=fg.Rn(1), steer=fg.Rn(1)), 2.6  # from axle to axle [m]
along, reach = np.array([-0.3, 1.3, 2.9]), 1.1  # discs that cover a car, ahead of its rear axle [m]
parked = np.array([[rear + a, 0.0] for rear in (-7.4, 5.8) for a in along])


def car(x: Array, u: Array) -> Array:
    """F (n, 5): forwards, sideways, turning, change of speed, change of steer."""
    v, steer = x[:, 3], x[:, 4]  # stored in the order of STATE
    return np.stack([v, 0.0 * v, v * np.tan(steer) / base, u[:, 0], u[:, 1]], axis=1)


def gaps(x: Array) -> Array:
    """Gaps between the discs of the car and those of the parked ones (n, 18) [m]."""
    discs = [x[:, :2] + a * np.stack([np.cos(x[:, 2]), np.sin(x[:, 2])], axis=1) for a in along]
    return np.stack([np.linalg.norm(disc - other, axis=1) - 2 * reach for disc in discs for other in parked], axis=1)


graph, N, dt, ends = fg.Graph(), 60, 0.15, np.array([[5.0, 3.0, 0.0, 0.0, 0.0], [-0.6, 0.0, 0.0, 0.0, 0.0]])
x, u = graph.variables("x", STATE, N + 1), graph.variables("u", fg.Rn(2), N)
graph.fix(x[[0, N]], ends)
graph.minimize(fg.prior, u, [0.0, 0.0], sigma=[1.0, 0.4], name="effort")
graph.constrain(rkmk.integrator(STATE, car, "rk4"), x[:-1], u, x[1:], dt, lower=0, upper=0, name="motion")
graph.constrain(gaps, x[1:-1], lower=0.05, name="parked cars")
graph.bound(x.speed, lower=-2.0, upper=2.0)
graph.bound(x.steer, lower=-0.6, upper=0.6)
guess = {x: np.linspace(ends[0], ends[1], N + 1), u: np.zeros((N, 2))}
solutions, (figure, ax) = {}, plt.subplots(figsize=(8.0, 2.6), layout="constrained")
for solver in (InteriorPoint(), AugmentedLagrangian()):
    s = solutions[solver.name] = solver.solve(graph, guess)
    print(s.report())
    ax.plot(*s[x.pose][:, :2].T, ".-", label=solver.name)
for disc in parked:
    ax.add_patch(Circle((disc[0], disc[1]), reach, color="0.8"))
ax.axis("equal")
ax.legend()
folder = Path(*sys.argv[1:] or ["out"])
folder.mkdir(parents=True, exist_ok=True)
figure.savefig(folder / "own_robot.png", dpi=80)
