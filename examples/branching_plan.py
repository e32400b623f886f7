"""Somebody may step into the road, or not: plans for the worst, for the likeliest, and for both with shared controls.

A car at 5 m/s sees 2.5 m before a line whether it has to stop, which takes 3.1 m. The first half second is shared.

    python examples/branching_plan.py [FOLDER]
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import unifg as fg
from unifg.horizon import Context, ControlCost, Dynamics, RecedingHorizon, Robot, Term, Tree, tree_of
from unifg.solvers import InteriorPoint
from unifg.typing import Array

dt, cruise, brake, line, sight = 0.1, 5.0, 4.0, 12.0, 2.5  # [s, m/s, m/s^2, m, m]
T, B = np.array([[1.0, dt], [0.0, 1.0]]), np.array([0.5 * dt**2, dt])
robot = Robot(fg.Rn(2), fg.Rn(1), predict=lambda x, u: T @ x + B * u)


class Crossing:  # cruise, and stop before the line in the tails in which somebody steps out
    def state(self, graph: fg.Graph, x: fg.Selection, u: fg.Family) -> None:
        graph.minimize(lambda x: x[:, 1:] - cruise, x[1:], sigma=1.0, name="cruise")
        graph.bound(u, lower=-brake, upper=1.0)
        places = graph.data("line", np.full((len(tree_of(x)), 1), 1e3), each=True)
        graph.constrain(lambda x, place: place - x[:, :1], x[1:], places, lower=0.0, name="stop")

    def data(self, now: Context[list[bool]]) -> dict[str, Array]:  # given: in which tails somebody steps out
        places = np.where(now.given[-1], line, 1e3) * np.ones(len(now.times))
        places[now.tree.paths[0] if now.tree else []] = line if now.given[0] else 1e3
        return {"line": places[1:, None]}


def driven(kind: str, steps_out: bool) -> Array:
    both, states, believed = kind == "both", [np.array([0.0, cruise])], [kind == "the worst", kind != "the likeliest"]
    motion = Dynamics(lambda x, u, y, h: y - x @ T.T - u * B, dt)
    terms: list[Term] = [motion, Crossing(), ControlCost(sigma=[1.0], change=[1.0])]
    chances, steps = ((lambda now: (0.9, 0.1)), Tree.branched(5, (25, 25))) if both else (None, 30)
    loop = RecedingHorizon(robot, steps, terms, solver=InteriorPoint(), probabilities=chances)
    while states[-1][0] < 20.0 and len(states) < 90:
        plan = loop.plan(states[-1], 2 * [steps_out] if states[-1][0] > line - sight else believed)
        control = [-brake] if plan.emergency else plan.control
        states.append(robot.predicted(states[-1], np.maximum(control, -states[-1][1] / dt)))
    return np.array(states)


figure, panels = plt.subplots(1, 2, figsize=(9.0, 2.6), sharey=True, layout="constrained")
for panel, steps_out in zip(panels, (False, True), strict=True):
    for kind in ("the worst", "the likeliest", "both"):
        panel.plot(*(drive := driven(kind, steps_out)).T, label=kind)
        print(f"plans for {kind}: {dt * len(drive):.1f} s, ends {drive[-1, 0] - line:+.2f} m from the line")
    panel.axvline(line, color="k", linestyle=":")
    panel.set(xlabel="way [m]", ylabel="speed [m/s]", title=f"{'somebody' if steps_out else 'nobody'} steps out")
panels[0].legend(fontsize=7, title="plans for")
(folder := Path(*sys.argv[1:] or ["out"])).mkdir(parents=True, exist_ok=True)
figure.savefig(folder / "branching_plan.png", dpi=80)
