"""Control problems on the ground, each stated twice: parking, two robots, a relay, lanes, pendulum, cart-pole, arm.

All numbers that a seed draws are drawn by the generator it seeds; the residuals of some are batched NumPy, of others
Numba functions of one factor, of others shipped kernels.
"""

from __future__ import annotations

import math
from typing import Any

import casadi as ca
import numba
import numpy as np

import unifg as fg
from problems.twins.twin import Twin, driven
from unifg.models import unicycle
from unifg.typing import Array

# ---------------------------------------------------------------- parking a kinematic bicycle

WHEELBASE, LENGTH, HULL = 2.7, 5.0, 0.9  # [m]; the hull is four discs of that radius along the axis
DISCS = np.array([-0.25, 0.8, 1.85, 2.9])  # of the hull, ahead of the rear axle [m]
STREET = 3.5  # width of the lane beside the parked cars [m]
PARK_DT, PARK_STEPS = 0.25, 40


def bicycle(x: Array, u: Array, x_next: Array) -> Array:
    """Rear-axle kinematics over (px, py, heading, speed, steering); controls are their rates. Midpoint rule."""

    def rate(x: Array) -> Array:
        v, h = x[:, 3], x[:, 2]
        return np.stack([v * np.cos(h), v * np.sin(h), v * np.tan(x[:, 4]) / WHEELBASE, u[:, 0], u[:, 1]], axis=1)

    return x_next - x - PARK_DT * rate(x + 0.5 * PARK_DT * rate(x))


def bicycle_exact(x: Any, u: Any, x_next: Any) -> Any:
    """The same."""

    def rate(x: Any) -> Any:
        forward = ca.vertcat(x[3] * ca.cos(x[2]), x[3] * ca.sin(x[2]))
        return ca.vertcat(forward, x[3] * ca.tan(x[4]) / WHEELBASE, u)

    return x_next - x - PARK_DT * rate(x + PARK_DT / 2 * rate(x))


@numba.njit  # type: ignore[untyped-decorator]
def hull_clearance(x: Any, centres: Any, r: Any) -> None:
    """Squared distances of the hull's discs from discs (M, 3) given one after the other, less the squared reach."""
    row = 0
    for k in range(4):
        px = x[0] + (-0.25 + 1.05 * k) * math.cos(x[2])
        py = x[1] + (-0.25 + 1.05 * k) * math.sin(x[2])
        for j in range(len(centres) // 3):
            reach = centres[3 * j + 2] + HULL
            r[row] = (px - centres[3 * j]) ** 2 + (py - centres[3 * j + 1]) ** 2 - reach * reach
            row += 1


def hull_clearance_exact(x: Any, centres: Any) -> Any:
    """The same."""
    rows = []
    for along in DISCS:
        p = x[:2] + along * ca.vertcat(ca.cos(x[2]), ca.sin(x[2]))
        rows += [ca.sumsqr(p - c[:2]) - (c[2] + HULL) ** 2 for c in centres.reshape(-1, 3)]
    return ca.vertcat(*rows)


def kerb_and_lane(x: Array) -> Array:
    """Height of the hull's first and last disc [m]."""
    return np.asarray(x[:, 1:2] + np.sin(x[:, 2:3]) * DISCS[[0, 3]])


HULL_RESIDUAL = fg.residual(hull_clearance, rows=24)


def parking(seed: int, equalities_only: bool = False) -> Twin:
    """Parallel parking from rest beside the front car: gap, place and heading are drawn, the goal is hard.

    Gaps of 1.1 to 1.9 lengths: the narrow ones may have no solution in the time given.
    """
    rng = np.random.default_rng([11, seed])
    gap = LENGTH * rng.uniform(1.1, 1.9)
    start = np.array([rng.uniform(3.0, 6.0), rng.uniform(2.3, 2.9), rng.uniform(-0.15, 0.15), 0.0, 0.0])
    goal = np.array([-DISCS.mean(), 0.0, 0.0, 0.0, 0.0])
    # Parked cars: three discs each, before and behind the gap, in its line.
    ends = gap / 2.0 + np.array([0.95, 2.3, 3.6])
    cars = np.array([[side * end, 0.0, 0.95] for side in (1.0, -1.0) for end in ends])
    twin, x, u = driven(
        "parking", seed, equalities_only, np.linspace(start, goal, PARK_STEPS + 1), np.zeros((PARK_STEPS, 2))
    )
    twin.minimize(lambda u: u, lambda u: u, u, sigma=[1.0, 0.5], name="effort")
    twin.minimize(
        lambda x: x[:, 3:], lambda x: x[3:], x[1:], sigma=[3.0, 2.0], name="speed and steering",
    )  # fmt: skip
    twin.equal(bicycle, bicycle_exact, x[:-1], u, x[1:], name="bicycle", moves=True)
    twin.require(HULL_RESIDUAL, hull_clearance_exact, x[1:], cars.ravel(), lower=0.0, name="parked cars")
    twin.require(
        kerb_and_lane,
        lambda x: ca.vertcat(x[1] + DISCS[0] * ca.sin(x[2]), x[1] + DISCS[3] * ca.sin(x[2])),
        x[1:], lower=-0.3, upper=STREET, name="kerb and lane",
    )  # fmt: skip
    twin.equal(lambda x: x - goal, lambda x: x - goal, x[-1], name="parked")
    twin.bound(x[1:], lower=[-20.0, -5.0, -2.0, -2.5, -0.6], upper=[20.0, 5.0, 2.0, 2.5, 0.6], name="state limits")
    twin.bound(u, lower=[-2.0, -0.8], upper=[2.0, 0.8], name="control limits")
    return twin


# ---------------------------------------------------------------- two unicycles that cross


@numba.njit  # type: ignore[untyped-decorator]
def separation(a: Any, b: Any, least: Any, r: Any) -> None:
    """Squared distance of two poses less the least one."""
    r[0] = (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 - least * least


SEPARATION = fg.residual(separation, rows=1)


def _unicycle_exact(x: Any, u: Any, x_next: Any, dt: Any) -> Any:
    middle = x[2] + dt * u[1] / 2
    ahead = x_next[:2] - x[:2] - dt * u[0] * ca.vertcat(ca.cos(middle), ca.sin(middle))
    turn = x_next[2] - x[2] - dt * u[1]
    return ca.vertcat(ahead, ca.atan2(ca.sin(turn), ca.cos(turn)))


def _tracking_exact(x: Any, reference: Any) -> Any:
    turn = x[2] - reference[2]
    return ca.vertcat(x[:2] - reference[:2], ca.atan2(ca.sin(turn), ca.cos(turn)))


def two_robots(seed: int, equalities_only: bool = False) -> Twin:
    """Two unicycles on crossing straight lines keep apart; dynamics and tracking are the shipped kernels."""
    rng = np.random.default_rng([12, seed])
    steps, dt = 40, 0.15
    twin = Twin("two robots", seed, equalities_only)
    families = []
    for name, heading in (("a", rng.uniform(-0.4, 0.4)), ("b", rng.uniform(1.0, 2.8))):
        along = np.array([np.cos(heading), np.sin(heading)])
        begin = np.append(-2.5 * along + rng.uniform(-0.15, 0.15, 2), heading)
        line = np.linspace(begin, np.append(2.5 * along, heading), steps + 1)
        x = twin.variables(f"{name} pose", fg.SE2, line)
        u = twin.variables(f"{name} control", fg.Rn(2), np.tile([5.0 / (steps * dt), 0.0], (steps, 1)))
        twin.fix(x[0], begin)
        twin.minimize(unicycle.tracking, _tracking_exact, x[1:], line[1:], sigma=[1.0, 1.0, 2.0], name=f"{name} line")
        twin.minimize(lambda u: u, lambda u: u, u, sigma=[2.0, 1.0], name=f"{name} effort")
        twin.equal(unicycle.dynamics, _unicycle_exact, x[:-1], u, x[1:], dt, name=f"{name} motion")
        twin.bound(u, lower=[-0.3, -1.2], upper=[1.2, 1.2], name=f"{name} limits")
        families.append(x)
    a, b = families
    twin.require(
        SEPARATION, lambda a, b, least: ca.sumsqr(a[:2] - b[:2]) - least**2, a[1:], b[1:], 0.9, lower=0.0, name="apart"
    )
    return twin


# ---------------------------------------------------------------- range-limited relay


@numba.njit  # type: ignore[untyped-decorator]
def reach(p: Any, q: Any, limit: Any, r: Any) -> None:
    """Squared distance of two places over the squared limit."""
    r[0] = ((p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2) / (limit * limit)


REACH = fg.residual(reach, rows=1)


def relay(seed: int, equalities_only: bool = False) -> Twin:
    """An explorer circles a goal beyond the range of the base; a relay must stay within reach of both."""
    rng = np.random.default_rng([13, seed])
    steps, dt, limit = 40, 0.25, rng.uniform(2.4, 3.0)
    base, goal = np.zeros(2), rng.uniform([3.5, -2.0], [6.5, 2.0])
    mast = np.array([0.5 * goal[0], 0.5 * goal[1] + rng.uniform(-0.3, 0.3)])  # neither may come near
    phase = np.linspace(0.0, 2.0 * np.pi, steps + 1)
    wanted = goal + 0.6 * np.stack([np.cos(phase), np.sin(phase)], axis=1)
    twin = Twin("relay", seed, equalities_only)
    places, moves = [], []
    for name, guess in (("explorer", wanted * np.linspace(0.1, 1.0, steps + 1)[:, None]), ("relay", None)):
        line = np.linspace(base + 0.1, 0.5 * goal, steps + 1) if guess is None else guess
        p = twin.variables(name, fg.Rn(2), line)
        v = twin.variables(f"{name} speed", fg.Rn(2), np.zeros((steps, 2)))
        twin.fix(p[0], line[0])
        twin.minimize(lambda v: v, lambda v: v, v, sigma=1.5, name=f"{name} effort")
        twin.minimize(lambda a, b: b - a, lambda a, b: b - a, v[:-1], v[1:], sigma=0.5, name=f"{name} smooth")
        twin.equal(
            lambda p, v, q: q - p - dt * v, lambda p, v, q: q - p - dt * v, p[:-1], v, p[1:],
            name=f"{name} motion",
        )  # fmt: skip
        twin.require(lambda v: (v**2).sum(axis=1, keepdims=True), ca.sumsqr, v, upper=1.44, name=f"{name} speed limit")
        twin.require(
            SEPARATION, lambda p, m, least: ca.sumsqr(p - m) - least**2, p[1:], mast, 0.5, lower=0.0,
            name=f"{name} mast",
        )  # fmt: skip
        places.append(p)
        moves.append(v)
    twin.minimize(lambda p, w: p - w, lambda p, w: p - w, places[0][1:], wanted[1:], sigma=0.5, name="circle")
    twin.require(
        REACH, lambda p, q, limit: ca.sumsqr(p - q) / limit**2, places[1][1:], base, limit, upper=1.0, name="base"
    )
    twin.require(
        REACH, lambda p, q, limit: ca.sumsqr(p - q) / limit**2, places[0][1:], places[1][1:], limit, upper=1.0,
        name="link",
    )  # fmt: skip
    return twin


# ---------------------------------------------------------------- lane change with jerk limits


def lane_change(seed: int, equalities_only: bool = False) -> Twin:
    """A car between two others changes its lane; jerk and steering rate are limited. All NumPy."""
    rng = np.random.default_rng([14, seed])
    steps, dt, speed = 40, 0.15, rng.uniform(12.0, 20.0)
    start = np.array([0.0, 0.0, 0.0, speed, 0.0, 0.0])  # x, y, heading, speed, acceleration, curvature
    line = np.tile(start, (steps + 1, 1))
    line[:, 0] += speed * dt * np.arange(steps + 1)
    line[:, 1] = np.linspace(0.0, 3.5, steps + 1)
    twin, x, u = driven("lane change", seed, equalities_only, line, np.zeros((steps, 2)))

    def motion(x: Array, u: Array, after: Array) -> Array:
        def rate(x: Array) -> Array:
            v, h = x[:, 3], x[:, 2]
            return np.stack([v * np.cos(h), v * np.sin(h), v * x[:, 5], x[:, 4], u[:, 0], u[:, 1]], axis=1)

        return after - x - dt * rate(x + 0.5 * dt * rate(x))

    def motion_exact(x: Any, u: Any, after: Any) -> Any:
        def rate(x: Any) -> Any:
            return ca.vertcat(x[3] * ca.cos(x[2]), x[3] * ca.sin(x[2]), x[3] * x[5], x[4], u)

        return after - x - dt * rate(x + 0.5 * dt * rate(x))

    # The other cars, in the old lane ahead and in the new lane ahead: ellipses that move.
    times = dt * np.arange(1, steps + 1)
    ahead = np.stack([rng.uniform(14.0, 20.0) + 0.8 * speed * times, np.zeros(steps)], axis=1)
    beside = np.stack([rng.uniform(25.0, 32.0) + 0.9 * speed * times, np.full(steps, 3.5)], axis=1)
    size = np.array([5.5, 2.0])
    wanted = np.array([3.5, 0.0, speed])
    twin.minimize(
        lambda x: x[:, [1, 2, 3]] - wanted, lambda x: ca.vertcat(x[1], x[2], x[3]) - wanted, x[1:],
        sigma=[1.0, 0.2, 2.0], name="lane",
    )  # fmt: skip
    twin.minimize(lambda u: u, lambda u: u, u, sigma=[2.0, 0.02], name="jerk")
    twin.equal(motion, motion_exact, x[:-1], u, x[1:], name="motion", moves=True)
    for name, other in (("ahead", ahead), ("beside", beside)):
        twin.require(
            lambda x, c: ((((x[:, :2] - c) / size) ** 2).sum(axis=1, keepdims=True)),
            lambda x, c: ca.sumsqr((x[:2] - c) / size), x[1:], other, lower=1.0, name=name,
        )  # fmt: skip
    twin.require(
        lambda x: x[:, 3:4] ** 2 * x[:, 5:6], lambda x: x[3] ** 2 * x[5], x[1:], lower=-3.0, upper=3.0, name="lateral"
    )
    twin.bound(x[1:], lower=[-10, -1, -0.5, 0, -4, -0.2], upper=[500, 4.5, 0.5, 25, 2.5, 0.2], name="state limits")
    twin.bound(u, lower=[-6.0, -0.1], upper=[6.0, 0.1], name="jerk limits")
    return twin


# ---------------------------------------------------------------- pendulum and cart-pole: compiled, Runge-Kutta

SWING_DT = 0.1


@numba.njit  # type: ignore[untyped-decorator]
def pendulum_step(x: Any, u: Any, after: Any, r: Any) -> None:
    """Explicit Runge-Kutta 4 for angle'' = u - 9.81 sin(angle) - 0.1 angle'."""
    h = SWING_DT
    a, b = x[0], x[1]
    ka, kb = np.zeros(4), np.zeros(4)
    for k in range(4):
        part = 0.0 if k == 0 else (h if k == 3 else 0.5 * h)
        qa, qb = (a, b) if k == 0 else (a + part * ka[k - 1], b + part * kb[k - 1])
        ka[k], kb[k] = qb, u[0] - 9.81 * math.sin(qa) - 0.1 * qb
    r[0] = after[0] - a - h * (ka[0] + 2 * ka[1] + 2 * ka[2] + ka[3]) / 6
    r[1] = after[1] - b - h * (kb[0] + 2 * kb[1] + 2 * kb[2] + kb[3]) / 6


PENDULUM = fg.residual(pendulum_step, rows=2)


def runge_kutta_4(rate: Any, x: Any, u: Any, dt: Any) -> Any:
    """The classical method, for casadi."""
    a = rate(x, u)
    b = rate(x + dt / 2 * a, u)
    c = rate(x + dt / 2 * b, u)
    d = rate(x + dt * c, u)
    return x + dt / 6 * (a + 2 * b + 2 * c + d)


def pendulum(seed: int, equalities_only: bool = False) -> Twin:
    """Swing up with a motor too weak to lift; the end is hard."""
    rng = np.random.default_rng([15, seed])
    steps, torque = 50, rng.uniform(2.5, 5.0)
    start, goal = np.array([rng.uniform(-0.3, 0.3), 0.0]), np.array([np.pi, 0.0])
    twin, x, u = driven("pendulum", seed, equalities_only, np.linspace(start, goal, steps + 1), np.zeros((steps, 1)))

    def rate(x: Any, u: Any) -> Any:
        return ca.vertcat(x[1], u - 9.81 * ca.sin(x[0]) - 0.1 * x[1])

    twin.minimize(lambda u: u, lambda u: u, u, name="effort")
    twin.equal(
        PENDULUM, lambda x, u, after: after - runge_kutta_4(rate, x, u, SWING_DT), x[:-1], u, x[1:], name="swing",
        moves=True,
    )  # fmt: skip
    twin.equal(lambda x: x - goal, lambda x: x - goal, x[-1], name="upright")
    twin.bound(u, lower=-torque, upper=torque, name="torque")
    return twin


CART_DT = 0.06


@numba.njit  # type: ignore[untyped-decorator]
def cart_pole_rate(x: Any, u: Any, out: Any) -> None:
    """Cart of 1 kg, pole of 0.3 kg and 0.5 m: position, angle from hanging, and their rates."""
    s, c = math.sin(x[1]), math.cos(x[1])
    down = 1.0 + 0.3 * s * s
    out[0], out[1] = x[2], x[3]
    out[2] = (u + 0.3 * s * (0.5 * x[3] * x[3] + 9.81 * c)) / down
    out[3] = -(u * c + 0.15 * x[3] * x[3] * c * s + 1.3 * 9.81 * s) / (0.5 * down)


@numba.njit  # type: ignore[untyped-decorator]
def cart_pole_step(x: Any, u: Any, after: Any, r: Any) -> None:
    """The explicit midpoint rule."""
    middle, rate = np.empty(4), np.empty(4)
    cart_pole_rate(x, u[0], rate)
    for k in range(4):
        middle[k] = x[k] + 0.5 * CART_DT * rate[k]
    cart_pole_rate(middle, u[0], rate)
    for k in range(4):
        r[k] = after[k] - x[k] - CART_DT * rate[k]


CART_POLE = fg.residual(cart_pole_step, rows=4)


def cart_pole(seed: int, equalities_only: bool = False) -> Twin:
    """Swing-up on a short rail with limited force; the end is hard."""
    rng = np.random.default_rng([16, seed])
    steps, force, rail = 50, rng.uniform(8.0, 20.0), rng.uniform(1.0, 2.0)
    start, goal = np.array([rng.uniform(-0.5, 0.5), 0.0, 0.0, 0.0]), np.array([0.0, np.pi, 0.0, 0.0])
    twin, x, u = driven("cart-pole", seed, equalities_only, np.linspace(start, goal, steps + 1), np.zeros((steps, 1)))

    def rate(x: Any, u: Any) -> Any:
        s, c, w = ca.sin(x[1]), ca.cos(x[1]), x[3]
        down = 1 + 0.3 * s**2
        push = (u + 0.3 * s * (0.5 * w**2 + 9.81 * c)) / down
        turn = -(u * c + 0.15 * w**2 * c * s + 1.3 * 9.81 * s) / (0.5 * down)
        return ca.vertcat(x[2], x[3], push, turn)

    def exact(x: Any, u: Any, after: Any) -> Any:
        return after - x - CART_DT * rate(x + CART_DT / 2 * rate(x, u), u)

    twin.minimize(lambda u: u, lambda u: u, u, sigma=5.0, name="effort")
    twin.equal(CART_POLE, exact, x[:-1], u, x[1:], name="motion", moves=True)
    twin.equal(lambda x: x - goal, lambda x: x - goal, x[-1], name="upright")
    twin.bound(x[1:], lower=[-rail, -9.0, -20.0, -30.0], upper=[rail, 9.0, 20.0, 30.0], name="rail")
    twin.bound(u, lower=-force, upper=force, name="force")
    return twin
