"""A loop for a robot and its parameter: an arm swings up while it learns the friction of its joints.

Encoders measure the angles, the elbow's fails one time in five. The friction is an unknown constant that past and
future share. Two graphs in turn ("sequential"), then one ("joint").

    python examples/own_robot_loop.py [FOLDER]
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import unifg as fg
from unifg.horizon import COUPLINGS, Constant, ControlCost, Dynamics, Measurement, RecedingHorizon, Robot, Term, Window
from unifg.models import manipulator, rkmk
from unifg.solvers import SQP
from unifg.typing import Array

STATE, h, goal, most = manipulator.STATE, 0.05, np.array([np.pi / 2, 0.0, 0.0, 0.0]), np.array([15.0, 8.0])  # [N m]
bare, friction, noise = manipulator.field(manipulator.Arm()), np.array([0.8, 0.4]), [1e-3, 1e-3, 0.02, 0.02]  # [N m s]


def arm(x: Array, tau: Array, rho: Array) -> Array:
    return bare(x, tau - rho * x[:, 2:])


class Reach(Term):  # what the future is to be, besides the dynamics
    def state(self, graph: fg.Graph, x: fg.Selection, u: fg.Family) -> None:
        graph.minimize(fg.prior, x[1:], goal, sigma=[1.0, 1.0, 3.0, 3.0], name="reach")
        graph.bound(u, lower=-most, upper=most, name="limits")


motion, rho, results = rkmk.integrator(STATE, arm, "rk4"), ("friction",), {}
figure, axes = plt.subplots(1, 2, figsize=(8.0, 2.6), sharey=True, layout="constrained")
for coupling, ax in zip(COUPLINGS[1:], axes, strict=True):
    rng, robot = np.random.default_rng(1), Robot(STATE, fg.Rn(2), (Constant("friction", fg.Rn(2), [0.0, 0.0], 1.0),))
    angles = (Measurement(name, fg.prior, (1,), 0.01, component=name) for name in ("shoulder", "elbow"))
    window = Window(robot, 12, [*angles, Dynamics(motion, h, sigma=noise, constants=rho)], start=-goal, sigma=0.1)
    future = Dynamics(motion, h, constants=rho), Reach(), ControlCost(sigma=[20.0, 10.0], change=[10.0, 5.0])
    loop = RecedingHorizon(robot, 20, future, solver=SQP(), window=window, coupling=coupling, limits=(-most, most))
    truth = -goal[None] + [0.05, -0.05, 0.0, 0.0]
    for _ in range(60):
        q, fails = truth[-1, :2, None] + 0.01 * rng.normal(size=(2, 1)), rng.random() < 0.2
        plan = loop.tick(measured={"shoulder": q[0], "elbow": None if fails else q[1]})
        x = rkmk.rollout(STATE, arm, truth[-1], plan.control[None], friction[None], h=h)[-1]
        truth = np.vstack([truth, STATE.retract(x, rng.normal(scale=noise))])
    away, learnt = np.abs(STATE.local(goal, truth[-1])[:2]).max(), loop.constants["friction"][0]
    results[coupling] = away, learnt, loop.statuses[fg.Status.CONVERGED]
    print(f"{coupling:10} {away:.3f} rad from upright, friction {learnt.round(2)} of {friction}")
    ax.plot(h * np.arange(61), truth[:, :2])
folder = Path(*sys.argv[1:] or ["out"])
folder.mkdir(parents=True, exist_ok=True)
figure.supxlabel("angles of shoulder and elbow [rad] over time [s], sequential and joint", fontsize=9)
figure.savefig(folder / "own_robot_loop.png", dpi=80)
