"""Past and future in one graph: a car parks by noisy positions, with estimation and control coupled by one word.

What it has measured over the last 2 s and what it will do in the next 5 s share the present state. The loop keeps the
window, its prior and the warm start. One position in four is missing. "sequential" is two graphs, "joint" is one.

    python examples/joint_past_future.py [FOLDER]
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import unifg as fg
from unifg.horizon import COUPLINGS, ControlCost, Dynamics, Measurement, RecedingHorizon, Robot, Term, Window
from unifg.models import bicycle, rkmk
from unifg.solvers import InteriorPoint

STATE, h, goal = bicycle.STATE, 0.2, np.array([6.0, 3.0, 0.0, 0.0])  # a step [s]; pose and speed
noise, gps = np.array([0.01, 0.01, 0.005, 0.02]), 0.1  # of a step; of a position [m]
field, motion = bicycle.field(bicycle.Bicycle()), bicycle.dynamics(bicycle.Bicycle())


class Parking(Term):  # what the future is to be, besides the dynamics
    def state(self, graph: fg.Graph, x: fg.Selection, u: fg.Family) -> None:
        graph.minimize(fg.prior, x[1:], goal, sigma=[1.0, 1.0, 1.0, 2.0], name="approach")
        graph.bound(u, lower=[-1.0, -0.5], upper=[1.0, 0.5], name="limits")
        graph.bound(x.speed[1:], lower=-1.5, upper=1.5, name="speed")


results, (figure, axes) = {}, plt.subplots(1, 2, figsize=(8.0, 2.6), sharey=True, layout="constrained")
for coupling, ax in zip(COUPLINGS[1:], axes, strict=True):
    rng = np.random.default_rng(1)
    robot = Robot(STATE, fg.Rn(2), predict=lambda x, u: rkmk.rollout(STATE, field, x, u[None], h=h)[-1])
    past = Dynamics(motion, h, sigma=noise), Measurement("gps", lambda x, z: x[:, :2] - z, (2,), gps)
    window = Window(robot, 10, past, start=np.zeros(4), sigma=[0.3, 0.3, 0.1, 0.1])
    future = Dynamics(motion, h), Parking(), ControlCost(sigma=[1.0, 0.5], change=[0.5, 0.2])
    loop = RecedingHorizon(robot, 25, future, solver=InteriorPoint(), window=window, coupling=coupling)
    truth, believed = np.array([[0.2, -0.2, 0.05, 0.0]]), np.zeros((0, 4))
    for tick in range(60):
        plan = loop.tick(measured={"gps": truth[-1, :2] + gps * rng.normal(size=2)} if tick % 4 else {})
        next_state = STATE.retract(robot.predicted(truth[-1], plan.control), noise * rng.normal(size=4))
        believed, truth = np.vstack([believed, loop.estimate]), np.vstack([truth, next_state])
    away = np.median(np.linalg.norm((truth[-20:] - goal)[:, :2], axis=1))
    off = np.median(np.linalg.norm((truth[:-1] - believed)[:, :2], axis=1))
    results[coupling] = away, off, loop.statuses[fg.Status.CONVERGED]
    print(f"{coupling:10} stands {away:.2f} m from the goal, its estimate {off:.3f} m off")
    ax.plot(*truth[:, :2].T, *believed[:, :2].T, ".")
    ax.set_title(coupling)
folder = Path(*sys.argv[1:] or ["out"])
folder.mkdir(parents=True, exist_ok=True)
figure.savefig(folder / "joint_past_future.png", dpi=80)
