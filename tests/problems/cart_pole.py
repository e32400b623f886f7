"""A pole that is to stand upright on a cart: a model that does not ship, in NumPy and for one factor."""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

import unifg as fg
from problems.control import Problem, Stated
from unifg.models.quadrotor import GRAVITY
from unifg.typing import Array

CART, POLE, LENGTH = 1.0, 0.1, 0.5  # masses [kg], half the length of the pole [m]


def cart_pole(x: Array, u: Array) -> Array:
    """(n, 4) velocity of cart (position, speed) and pole (angle from upright, rate): state (p, angle, speed, rate)."""
    sine, cosine, total = np.sin(x[:, 1]), np.cos(x[:, 1]), CART + POLE
    push = (u[:, 0] + POLE * LENGTH * x[:, 3] ** 2 * sine) / total
    turn = (GRAVITY * sine - cosine * push) / (LENGTH * (4.0 / 3.0 - POLE * cosine**2 / total))
    return np.stack([x[:, 2], x[:, 3], push - POLE * LENGTH * turn * cosine / total, turn], axis=1)


def moved(x: Array, u: Array, dt: float) -> Array:
    """(n, 4) state after one step of the classical Runge-Kutta method."""
    a = cart_pole(x, u)
    b = cart_pole(x + 0.5 * dt * a, u)
    c = cart_pole(x + 0.5 * dt * b, u)
    d = cart_pole(x + dt * c, u)
    return x + dt / 6.0 * (a + 2.0 * b + 2.0 * c + d)


def cart_pole_dynamics(x: Array, u: Array, after: Array, dt: float) -> Array:
    """(n, 4) defect of a step."""
    return after - moved(x, u, dt)


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def velocity_of_one(p: Array, force: float, out: Array) -> None:
    """The velocity of one cart and pole."""
    sine, cosine, total = math.sin(p[1]), math.cos(p[1]), CART + POLE
    push = (force + POLE * LENGTH * p[3] ** 2 * sine) / total
    turn = (GRAVITY * sine - cosine * push) / (LENGTH * (4.0 / 3.0 - POLE * cosine**2 / total))
    out[0], out[1], out[2], out[3] = p[2], p[3], push - POLE * LENGTH * turn * cosine / total, turn


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def cart_pole_dynamics_of_one(x: Array, u: Array, after: Array, dt: float, r: Array) -> None:
    """The same for one factor."""
    a, b, c, d, point = np.empty(4), np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    velocity_of_one(x, u[0], a)
    for k in range(4):
        point[k] = x[k] + 0.5 * dt * a[k]
    velocity_of_one(point, u[0], b)
    for k in range(4):
        point[k] = x[k] + 0.5 * dt * b[k]
    velocity_of_one(point, u[0], c)
    for k in range(4):
        point[k] = x[k] + dt * c[k]
    velocity_of_one(point, u[0], d)
    for k in range(4):
        r[k] = after[k] - x[k] - dt / 6.0 * (a[k] + 2.0 * b[k] + 2.0 * c[k] + d[k])


class CartPole(Problem):
    """The cart is to stand at the origin, the pole upright; it begins leaning."""

    robot = "cart-pole"
    obstacles = ""
    manifold = fg.Rn(4)
    dt = 0.05
    stage, terminal, effort = np.array([1.0, 10.0, 0.1, 0.1]), np.array([10.0, 100.0, 1.0, 1.0]), np.array([0.01])
    lower, upper = np.full(1, -10.0), np.full(1, 10.0)
    axes = 1
    spread = np.full(4, 0.1), np.full(1, 1.0)

    @property
    def discs(self) -> Array:
        """None."""
        return np.zeros((0, 2))

    @property
    def start(self) -> Array:
        """Leaning by 0.4 rad."""
        return np.array([0.5, 0.4, 0.0, 0.0])

    def reference(self, first: int = 0) -> tuple[Array, Array]:
        """Upright, at rest, at the origin."""
        return np.zeros((self.horizon + 1, 4)), np.zeros((self.horizon, 1))

    def guess(self) -> tuple[Array, Array]:
        """At rest where it begins."""
        return np.tile(self.start, (self.horizon + 1, 1)), np.zeros((self.horizon, 1))

    def plant(self, state: Array, control: Array, index: int) -> Array:
        """(4,) next state, pushed."""
        push = 0.01 * np.sin(np.array([1.3, 1.7, 2.1, 2.9]) * index)
        return np.asarray(moved(state[None], control[None], self.dt)[0] + push)

    def error(self, state: Array, reference: Array) -> Array:
        """The difference."""
        return state - reference

    def formulation(self) -> Stated:
        """With a NumPy function."""
        return CartPoleGraph(self)


class CartPoleGraph(Stated):
    """The cart-pole's problem."""

    dynamics: Any = staticmethod(cart_pole_dynamics)

    def __init__(self, problem: Problem) -> None:
        """Build the graph."""
        super().__init__(problem)
        graph, x, u = self.graph, self.x, self.u
        graph.minimize(fg.prior, x[:-1], np.zeros(4), sigma=problem.stage**-0.5, name="stage")
        graph.minimize(fg.prior, x[-1], np.zeros(4), sigma=problem.terminal**-0.5, name="end")
        graph.minimize(fg.prior, u, np.zeros(1), sigma=problem.effort**-0.5, name="effort")
        graph.constrain(self.dynamics, x[:-1], u, x[1:], problem.dt, lower=0.0, upper=0.0, name="dynamics")
        graph.bound(u, lower=problem.lower, upper=problem.upper, name="limits")

    def data(self, state: Array, first: int) -> dict[fg.Data, Array]:
        """The first state."""
        return {self._start: state}
