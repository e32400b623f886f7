"""A car parks by noisy positions: past and future in one graph.

What it has measured over the last two seconds and what it will do in the next five share the present state.
"""

import numpy as np

import unifg as fg
from unifg.horizon import ControlCost, Dynamics, Loop, Measurement, Robot, Window
from unifg.models import bicycle, rkmk
from unifg.solvers import InteriorPoint

CAR, H, PAST, AHEAD = bicycle.Bicycle(), 0.2, 10, 25  # [s] of a step; steps
GOAL, LIMITS = np.array([6.0, 3.0, 0.0, 0.0]), np.array([1.0, 0.5])  # pose and speed; [m/s^2, rad]
NOISE, GPS = np.array([0.01, 0.01, 0.005, 0.02]), 0.1  # of a step; [m] of a position
motion = bicycle.dynamics(CAR)


def position(x, measured):
    return x[:, :2] - measured


class Parking:  # what the future is to be, besides the dynamics
    def state(self, graph, x, u):
        goal = graph.data("goal", GOAL)
        graph.minimize(fg.prior, x[1:], goal, sigma=[3.0, 1.0, 1.0, 2.0], name="approach")
        graph.minimize(fg.prior, x[-1], goal, sigma=[0.1, 0.1, 0.05, 0.1], name="park")
        graph.bound(u, lower=-LIMITS, upper=LIMITS, name="limits")
        graph.bound(x.speed[1:], lower=-1.5, upper=1.5, name="speed")

    def data(self, now):
        return {"goal": now.given}


def main(coupling="joint", solver=None, seed=0):
    rng = np.random.default_rng(seed)
    move = lambda x, u: rkmk.rollout(bicycle.STATE, bicycle.field(CAR), x, u[None], h=H)[-1]  # noqa: E731
    robot = Robot(bicycle.STATE, bicycle.CONTROL, predict=move)
    past = [Dynamics(motion, H, sigma=NOISE), Measurement("gps", position, (2,), GPS)]
    window = Window(robot, PAST, past, start=np.zeros(4), sigma=[0.3, 0.3, 0.1, 0.1])
    future = [Dynamics(motion, H), Parking(), ControlCost(sigma=[1.0, 0.5], change=[0.5, 0.2])]
    loop = Loop(robot, AHEAD, future, solver=solver or InteriorPoint(), window=window, coupling=coupling)
    truth, errors = np.array([0.2, -0.2, 0.05, 0.0]), []
    for tick in range(60):
        seen = {"gps": truth[:2] + GPS * rng.normal(size=2)} if tick % 4 != 3 else {}  # one in four is missing
        plan = loop.tick(GOAL, seen)
        errors.append(np.linalg.norm((loop.estimate - truth)[:2]))
        truth = bicycle.STATE.retract(move(truth, plan.control), NOISE * rng.normal(size=4))
    return np.linalg.norm((truth - GOAL)[:2]), np.mean(errors), loop.statuses


if __name__ == "__main__":
    away, error, statuses = main()
    print(f"parked {away:.2f} m from the goal; estimate off by {error:.2f} m on average")
    print({status.name: count for status, count in statuses.items()})
