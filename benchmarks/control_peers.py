"""The control problems for solvers of casadi, cold and in closed loop."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from benchmarks.casadi_peer import Staged
from problems.cart_pole import CART, LENGTH, POLE
from problems.control import Problem, Tick
from problems.twins.twin import quaternion_times
from unifg.models.quadrotor import GRAVITY
from unifg.typing import Array

WARM: dict[str, dict[str, Any]] = {
    "ipopt": {
        "mu_init": 1e-3,
        "warm_start_init_point": "yes",
        "warm_start_bound_push": 1e-6,
        "warm_start_bound_frac": 1e-6,
        "warm_start_slack_bound_push": 1e-6,
        "warm_start_slack_bound_frac": 1e-6,
        "warm_start_mult_bound_push": 1e-6,
    },
    "fatrop": {"mu_init": 1e-3},
}
"""Options with which a plugin begins at an answer."""


class ControlPeer(Staged):
    """A problem whose start and references are parameters.

    Attributes:
        problem: what it solves.
    """

    def __init__(self, problem: Problem, plugin: str, compiled: bool = False, **options: Any) -> None:
        """Build and differentiate the expressions; ``compiled`` and ``options`` as for any program."""
        import casadi as ca

        super().__init__(plugin, compiled, **options)
        self.problem = problem
        error, gap = MODELS[problem.robot]
        size, controls, n = len(problem.start), len(problem.effort), problem.horizon
        start, reference = ca.SX.sym("start", size), ca.SX.sym("reference", size, n + 1)
        cruise = ca.SX.sym("cruise", controls, n)

        def stage(k: int, x: Any, u: Any) -> tuple[Any, list[Any], list[Any]]:
            off = error(x, reference[:, k])
            cost = 0.5 * ca.dot(ca.DM(problem.stage if k < n else problem.terminal) * off, off)
            if k < n:
                effort = u - cruise[:, k]
                cost += 0.5 * ca.dot(ca.DM(problem.effort) * effort, effort)
            if k == 0:
                return cost, [x - start], []
            near = slice(0, problem.axes)
            # Squared distances: the plain ones have no derivative at a centre.
            return cost, [], [ca.sumsqr(x[near] - disc[near]) - disc[-1] ** 2 for disc in problem.discs]

        free = np.full(size, np.inf)
        limits = np.append(-free, problem.lower), np.append(free, problem.upper)
        given = ca.vertcat(start, ca.vec(reference), ca.vec(cruise))
        dynamics = partial(gap, dt=problem.dt)
        self.stages((size, controls, n), stage, dynamics, given, limits)

    def take(self, states: Array, controls: Array, state: Array | None = None, first: int = 0, **duals: Any) -> None:
        """Take closed-loop step ``first`` and a guess."""
        reference, cruise = self.problem.reference(first)
        start = self.problem.start if state is None else state
        self.begin(states, controls, np.concatenate([start, reference.ravel(), cruise.ravel()]), **duals)

    def control(self, state: Array, index: int) -> Tick:
        """One step of a closed loop: cold the first time, then from the shifted answer."""
        if self.answer:
            states, controls, duals = self.shifted()
            states[0] = state
            self.take(states, controls, state, index, **duals)
        else:
            self.take(*self.problem.guess(), state, index)
        elapsed = self.again()
        return Tick(self.trajectory[1][0], elapsed, self.iterations, self.status)


def difference(x: Any, wanted: Any) -> Any:
    """Error of a state of numbers; headings are not wrapped."""
    return x - wanted


def unicycle_gap(x: Any, u: Any, after: Any, dt: float) -> Any:
    """Defect of the midpoint rule."""
    import casadi as ca

    heading = x[2] + 0.5 * dt * u[1]
    moved = ca.vertcat(dt * u[0] * ca.cos(heading), dt * u[0] * ca.sin(heading), dt * u[1])
    return after - (x + moved)


def quadrotor_error(x: Any, wanted: Any) -> Any:
    """Position, rotation vector and velocity; unit quaternions keep their norm, as rates are integrated exactly."""
    import casadi as ca

    q = quaternion_times(ca.vertcat(wanted[3], -wanted[4:7]), x[3:7])
    length = ca.sqrt(ca.dot(q[1:], q[1:]) + 1e-8)
    return ca.vertcat(x[:3] - wanted[:3], 2 * ca.atan2(length, q[0]) / length * q[1:], x[7:] - wanted[7:])


def quadrotor_gap(x: Any, u: Any, after: Any, dt: float) -> Any:
    """Defect of the rotation's exponential and of the trapezoidal rule."""
    import casadi as ca

    def up(q: Any) -> Any:
        w, a, b, c = q[0], q[1], q[2], q[3]
        return ca.vertcat(2 * (a * c + w * b), 2 * (b * c - w * a), 1 - 2 * (a * a + b * b))

    # Series in the squared angle: square roots have no derivative at zero. |turn| is below 0.5.
    turn = dt * u[:3]
    s = ca.dot(turn, turn) / 4
    cosine = 1 - s / 2 * (1 - s / 12 * (1 - s / 30 * (1 - s / 56)))
    sinc = 1 - s / 6 * (1 - s / 20 * (1 - s / 42 * (1 - s / 72)))
    q = quaternion_times(x[3:7], ca.vertcat(cosine, 0.5 * sinc * turn))
    v = x[7:] + dt * (0.5 * u[3] * (up(x[3:7]) + up(q)) - ca.DM([0, 0, GRAVITY]))
    return after - ca.vertcat(x[:3] + 0.5 * dt * (x[7:] + v), q, v)


def cart_pole_gap(x: Any, u: Any, after: Any, dt: float) -> Any:
    """Defect of the Runge-Kutta method of order four."""
    import casadi as ca

    def velocity(state: Any) -> Any:
        sine, cosine = ca.sin(state[1]), ca.cos(state[1])
        total = POLE + CART
        push = (u[0] + POLE * LENGTH * state[3] ** 2 * sine) / total
        turn = (GRAVITY * sine - cosine * push) / (LENGTH * (4.0 / 3.0 - POLE * cosine**2 / total))
        return ca.vertcat(state[2], state[3], push - POLE * LENGTH * turn * cosine / total, turn)

    a = velocity(x)
    b = velocity(x + 0.5 * dt * a)
    c = velocity(x + 0.5 * dt * b)
    d = velocity(x + dt * c)
    return after - (x + dt / 6.0 * (a + 2.0 * b + 2.0 * c + d))


MODELS: dict[str, tuple[Callable[..., Any], Callable[..., Any]]] = {
    "unicycle": (difference, unicycle_gap),
    "quadrotor": (quadrotor_error, quadrotor_gap),
    "cart-pole": (difference, cart_pole_gap),
}
"""Error of a state and defect of the dynamics, by robot."""
