"""An arm on SO(2)^2 reaches up while it learns the friction of its joints: past and future share that, too."""

import numpy as np

import unifg as fg
from unifg.horizon import ControlCost, Dynamics, Loop, Measurement, Robot, Static, Window
from unifg.models import manipulator, rkmk
from unifg.solvers import SQP

ARM, H, PAST, AHEAD = manipulator.Arm(), 0.05, 12, 20  # [s] of a step; steps
STATE, TORQUES = manipulator.STATE, manipulator.TORQUES
GOAL, MOST = np.array([np.pi / 2, 0.0, 0.0, 0.0]), np.array([15.0, 8.0])  # upright, at rest; [N m]
FRICTION = np.array([0.8, 0.4])  # [N m s], which nobody tells the robot
NOISE, ENCODER = np.array([1e-3, 1e-3, 0.02, 0.02]), 0.01  # of a step; [rad]


def arm(x, tau, friction, bare=manipulator.field(ARM)):  # noqa: B008
    return bare(x, tau - friction * x[:, 2:])


motion = rkmk.integrator(STATE, arm, "rk4")


def move(x, tau, friction=(0.0, 0.0)):
    return rkmk.rollout(STATE, arm, x, tau[None], np.array([friction]), h=H)[-1]


class Reach:  # what the future is to be, besides the dynamics
    def state(self, graph, x, u):
        graph.minimize(fg.prior, x[1:], GOAL, sigma=[1.0, 1.0, 3.0, 3.0], name="reach")
        graph.bound(u, lower=-MOST, upper=MOST, name="limits")

    def data(self, now):
        return {}


def main(coupling="joint", solver=None, seed=0):
    rng = np.random.default_rng(seed)
    robot = Robot(STATE, TORQUES, statics=(Static("friction", fg.Rn(2), [0.0, 0.0], 1.0),), predict=move)
    angles = [Measurement(name, fg.prior, (1,), ENCODER, component=name) for name in ("shoulder", "elbow")]
    past = [Dynamics(motion, H, sigma=NOISE, statics=("friction",)), *angles]
    window = Window(robot, PAST, past, start=[-np.pi / 2, 0.0, 0.0, 0.0], sigma=0.1)
    effort = ControlCost(sigma=[20.0, 10.0], change=[10.0, 5.0])
    future = [Dynamics(motion, H, statics=("friction",)), Reach(), effort]
    solver = solver or SQP(tolerance=1e-4)
    loop = Loop(robot, AHEAD, future, solver=solver, window=window, coupling=coupling, limits=(-MOST, MOST))
    truth, errors = np.array([-np.pi / 2 + 0.05, -0.05, 0.0, 0.0]), []
    for _ in range(60):
        q = truth[:2, None] + ENCODER * rng.normal(size=(2, 1))
        plan = loop.tick(measured={"shoulder": q[0], "elbow": q[1] if rng.random() < 0.8 else None})
        errors.append(np.abs(STATE.local(truth, loop.estimate)[:2]).max())
        truth = STATE.retract(move(truth, plan.control, FRICTION), NOISE * rng.normal(size=4))
    return np.abs(STATE.local(GOAL, truth)[:2]).max(), np.mean(errors), loop.statics["friction"][0], loop.statuses


if __name__ == "__main__":
    away, error, friction, statuses = main()
    print(f"{away:.2f} rad from upright; estimate off by {error:.3f} rad; friction {friction.round(2)} of {FRICTION}")
    print({status.name: count for status, count in statuses.items()})
