"""Control problems in the air and in space, each stated twice: least time, landing, slew, snap, gates, hover, orbit."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

import unifg as fg
from problems.twins.twin import Twin, driven, quaternion_exp, quaternion_times
from unifg.typing import Array

GRAVITY = 9.81


def free_time(seed: int, equalities_only: bool = False) -> Twin:
    """A mass with a limited push reaches a place at rest as soon as may be, around a disc; the time is unknown."""
    rng = np.random.default_rng([21, seed])
    steps = 40
    start, goal = np.array([0.0, 0.0, 0.0, 0.0]), np.array([*rng.uniform([4.0, -1.0], [6.0, 1.0]), 0.0, 0.0])
    disc = np.append(0.5 * goal[:2] + rng.uniform(-0.4, 0.4, 2), rng.uniform(0.4, 0.8))
    twin, x, u = driven(
        "free final time", seed, equalities_only, np.linspace(start, goal, steps + 1), np.full((steps, 2), 0.01)
    )
    total = twin.variables("T", fg.Rn(1), [[5.0]])

    def motion(x: Array, u: Array, after: Array, total: Array) -> Array:
        middle = 0.5 * (x + after)
        return after - x - total / steps * np.hstack([middle[:, 2:], u - 0.1 * middle[:, 2:]])

    def motion_exact(x: Any, u: Any, after: Any, total: Any) -> Any:
        middle = (x + after) / 2
        return after - x - total / steps * ca.vertcat(middle[2:], u - 0.1 * middle[2:])

    twin.minimize(lambda t: t, lambda t: t, total, sigma=0.3, name="time")
    twin.minimize(lambda u: u, lambda u: u, u, sigma=10.0, name="effort")
    twin.equal(motion, motion_exact, x[:-1], u, x[1:], total, name="motion")
    twin.equal(lambda x: x - goal, lambda x: x - goal, x[-1], name="at rest there")
    twin.require(
        lambda x: ((x[:, :2] - disc[:2]) ** 2).sum(axis=1, keepdims=True), lambda x: ca.sumsqr(x[:2] - disc[:2]),
        x[1:-1], lower=disc[2] ** 2, name="disc",
    )  # fmt: skip
    twin.require(lambda u: (u**2).sum(axis=1, keepdims=True), ca.sumsqr, u, upper=1.0, name="push")
    twin.bound(total, lower=0.5, upper=30.0, name="duration")
    return twin


def landing(seed: int, equalities_only: bool = False) -> Twin:
    """A powered landing: thrust between two limits inside a cone, glide slope, losing mass; soft on the pad."""
    rng = np.random.default_rng([22, seed])
    steps, dt = 40, rng.uniform(0.35, 0.45)
    place, speed = rng.uniform([-40, -40, 80], [40, 40, 120]), rng.uniform([-6, -6, -15], [6, 6, -5])
    start = np.array([*place, *speed, 1.0])
    end = np.zeros(6)
    twin, x, u = driven(
        "thrust cone",
        seed,
        equalities_only,
        np.linspace(start, np.append(end, 0.9), steps + 1),
        np.tile([0.0, 0.0, GRAVITY], (steps, 1)),  # thrust over the first mass
    )
    down = np.array([0.0, 0.0, GRAVITY])

    def motion(x: Array, u: Array, after: Array) -> Array:
        middle = 0.5 * (x + after)
        burn = np.sqrt((u**2).sum(axis=1, keepdims=True) + 1e-6) / 2000.0
        return after - x - dt * np.hstack([middle[:, 3:6], u / middle[:, 6:] - down, -burn])

    def motion_exact(x: Any, u: Any, after: Any) -> Any:
        middle = (x + after) / 2
        burn = ca.sqrt(ca.sumsqr(u) + 1e-6) / 2000
        return after - x - dt * ca.vertcat(middle[3:6], u / middle[6] - down, -burn)

    twin.minimize(lambda u: u, lambda u: u, u, sigma=GRAVITY, name="effort")
    twin.equal(motion, motion_exact, x[:-1], u, x[1:], name="motion")
    twin.equal(lambda x: x[:, :6] - end, lambda x: x[:6] - end, x[-1], name="on the pad")
    twin.require(
        lambda u: (u**2).sum(axis=1, keepdims=True), ca.sumsqr, u, lower=4.0**2, upper=16.0**2, name="throttle"
    )
    cosine = np.cos(np.radians(20.0))
    twin.require(
        lambda u: u[:, 2:] - cosine * np.sqrt((u**2).sum(axis=1, keepdims=True) + 1e-6),
        lambda u: u[2] - cosine * ca.sqrt(ca.sumsqr(u) + 1e-6), u, lower=0.0, name="cone",
    )  # fmt: skip
    slope = np.tan(np.radians(70.0))
    twin.require(
        lambda x: slope * x[:, 2:3] - np.sqrt((x[:, :2] ** 2).sum(axis=1, keepdims=True) + 1e-2),
        lambda x: slope * x[2] - ca.sqrt(ca.sumsqr(x[:2]) + 1e-2), x[1:-1], lower=-0.2, name="glide slope",
    )  # fmt: skip
    return twin


INERTIA = np.diag([1.0, 1.6, 2.1])


def slew(seed: int, equalities_only: bool = False) -> Twin:
    """A satellite turns from rest to rest while its camera keeps away from the sun; the attitude lives on SO(3)."""
    rng = np.random.default_rng([23, seed])
    steps, dt = 30, 0.4
    camera = np.array([1.0, 0.0, 0.0])
    while True:
        axis = rng.normal(size=3) * [0.3, 1.0, 1.0]
        turn = rng.uniform(1.4, 2.4) * axis / np.linalg.norm(axis)
        goal = fg.SO3.exp(turn)
        # The sun stands beside the way of the camera at half the turn, less than the forbidden angle away.
        sun = fg.SO3.act(fg.SO3.exp(0.5 * turn), camera) + 0.15 * rng.normal(size=3)
        sun /= np.linalg.norm(sun)
        if max(camera @ sun, fg.SO3.act(goal, camera) @ sun) < np.cos(np.radians(30.0)):
            break
    twin = Twin("attitude slew", seed, equalities_only)
    q = twin.variables("attitude", fg.SO3, fg.SO3.exp(np.linspace(0.0, 1.0, steps + 1)[:, None] * turn))
    w = twin.variables("rate", fg.Rn(3), np.tile(turn / (steps * dt), (steps + 1, 1)))
    torque = twin.variables("torque", fg.Rn(3), np.zeros((steps, 3)))
    twin.fix(q[0], fg.SO3.identity())
    twin.fix(w[0], np.zeros(3))

    def turning(q: Array, w: Array, after: Array) -> Array:
        # Twice the product of scalar and vector part: the sine of the angle times the axis, blind to the sign of q.
        error = fg.SO3.between(fg.SO3.retract(q, dt * w), after)
        return 2.0 * error[:, :1] * error[:, 1:]

    def turning_exact(q: Any, w: Any, after: Any) -> Any:
        there = quaternion_times(q, quaternion_exp(dt * w))
        error = quaternion_times(ca.vertcat(there[0], -there[1:]), after)
        return 2 * error[0] * error[1:]

    def spin(w: Array, torque: Array, after: Array) -> Array:
        gyro = np.cross(w, w @ INERTIA)
        return after - w - dt * np.linalg.solve(INERTIA, (torque - gyro).T).T

    def spin_exact(w: Any, torque: Any, after: Any) -> Any:
        return after - w - dt * ca.DM(np.linalg.inv(INERTIA)) @ (torque - ca.cross(w, ca.DM(INERTIA) @ w))

    def arrived(q: Array) -> Array:
        error = fg.SO3.between(np.broadcast_to(goal, q.shape), q)
        return 2.0 * error[:, :1] * error[:, 1:]

    def arrived_exact(q: Any) -> Any:
        error = quaternion_times(ca.DM([goal[0], *(-goal[1:])]), q)
        return 2 * error[0] * error[1:]

    def towards_sun(q: Array) -> Array:
        return np.asarray((fg.SO3.act(q, camera) * sun).sum(axis=1, keepdims=True))

    def towards_sun_exact(q: Any) -> Any:
        # First column of the rotation matrix, as homogeneous polynomials of a unit quaternion.
        a, b, c, d = q[0], q[1], q[2], q[3]
        ahead = ca.vertcat(a * a + b * b - c * c - d * d, 2 * (b * c + a * d), 2 * (b * d - a * c))
        return ca.dot(ahead, sun)

    twin.minimize(lambda t: t, lambda t: t, torque, sigma=0.1, name="effort")
    twin.equal(turning, turning_exact, q[:-1], w[:-1], q[1:], name="attitude motion")
    twin.equal(spin, spin_exact, w[:-1], torque, w[1:], name="spin")
    twin.equal(arrived, arrived_exact, q[-1], name="arrived")
    twin.equal(lambda w: w, lambda w: w, w[-1], name="at rest")
    twin.require(towards_sun, towards_sun_exact, q[1:], upper=np.cos(np.radians(25.0)), name="sun")
    twin.bound(torque, lower=-0.25, upper=0.25, name="wheels")
    twin.bound(w[1:], lower=-0.4, upper=0.4, name="gyro range")
    return twin


def minimum_snap(seed: int, equalities_only: bool = False) -> Twin:
    """A chain of four integrators through way points, with limited speed and acceleration and a ball in the way."""
    rng = np.random.default_rng([24, seed])
    steps, dt = 40, 0.1
    points = np.cumsum(rng.uniform([0.8, -0.8, -0.5], [1.6, 0.8, 0.5], (3, 3)), axis=0)
    line = np.zeros((steps + 1, 12))
    knots = [0, 13, 26, 40]
    for k in range(3):
        line[:, k] = np.interp(np.arange(steps + 1), knots, [0.0, *points[:, k]])
    twin, x, u = driven("minimum snap", seed, equalities_only, line, np.zeros((steps, 3)))
    powers = [dt**k / f for k, f in enumerate((1.0, 1.0, 2.0, 6.0, 24.0))]

    def motion(x: Array, u: Array, after: Array) -> Array:
        parts = [*np.split(x, 4, axis=1), u]
        ahead = [sum(powers[j - k] * parts[j] for j in range(k, 5)) for k in range(4)]
        return np.asarray(after - np.hstack(ahead))

    def motion_exact(x: Any, u: Any, after: Any) -> Any:
        p, v, a, j = x[:3], x[3:6], x[6:9], x[9:]
        return after - ca.vertcat(
            p + dt * v + dt**2 / 2 * a + dt**3 / 6 * j + dt**4 / 24 * u,
            v + dt * a + dt**2 / 2 * j + dt**3 / 6 * u,
            a + dt * j + dt**2 / 2 * u,
            j + dt * u,
        )

    ball, size = 0.5 * (points[0] + points[1]) + 0.1 * rng.normal(size=3), 0.35
    twin.minimize(lambda u: u, lambda u: u, u, sigma=100.0, name="snap")
    twin.equal(motion, motion_exact, x[:-1], u, x[1:], name="motion", moves=True)
    for k, point in zip(knots[1:-1], points, strict=False):
        twin.equal(lambda x, p=point: x[:, :3] - p, lambda x, p=point: x[:3] - p, x[k : k + 1], name=f"through {k}")
    end = np.append(points[-1], np.zeros(9))
    twin.equal(lambda x: x - end, lambda x: x - end, x[-1], name="at rest")
    for name, first, limit in (("speed", 3, 3.0), ("acceleration", 6, 9.0)):
        twin.require(
            lambda x, at=first: (x[:, at : at + 3] ** 2).sum(axis=1, keepdims=True) / 9.0,
            lambda x, at=first: ca.sumsqr(x[at : at + 3]) / 9, x[1:-1], upper=limit**2 / 9.0, name=name,
        )  # fmt: skip
    twin.require(
        lambda x: ((x[:, :3] - ball) ** 2).sum(axis=1, keepdims=True), lambda x: ca.sumsqr(x[:3] - ball), x[1:-1],
        lower=size**2, name="ball",
    )  # fmt: skip
    return twin


def gates(seed: int, equalities_only: bool = False) -> Twin:
    """Two walls with one opening each: superellipses on both sides of it. Acceleration and speed are limited."""
    rng = np.random.default_rng([25, seed])
    steps, dt = 40, 0.15
    start, goal = np.array([0.0, rng.uniform(-1, 1), 0.0, 0.0]), np.array([6.0, rng.uniform(-1, 1), 0.0, 0.0])
    openings = rng.uniform(-1.0, 1.0, 2)
    thick, tall, width = 0.35, 2.0, 0.9
    walls = np.array([[2.0 + 2.0 * k, c + s * (tall + width / 2)] for k, c in enumerate(openings) for s in (-1, 1)])
    size = np.array([thick, tall])
    twin, x, u = driven("gates", seed, equalities_only, np.linspace(start, goal, steps + 1), np.zeros((steps, 2)))
    move = np.array([[1, 0, dt, 0], [0, 1, 0, dt], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    push = np.array([[dt**2 / 2, 0], [0, dt**2 / 2], [dt, 0], [0, dt]])
    twin.minimize(lambda u: u, lambda u: u, u, sigma=2.0, name="effort")
    twin.minimize(lambda x: x - goal, lambda x: x - goal, x[-1], sigma=0.05, name="goal")
    twin.equal(
        lambda x, u, y: y - x @ move.T - u @ push.T, lambda x, u, y: y - ca.DM(move) @ x - ca.DM(push) @ u,
        x[:-1], u, x[1:], name="motion", moves=True,
    )  # fmt: skip
    for k, wall in enumerate(walls):
        twin.require(
            lambda x, w=wall: (((x[:, :2] - w) / size) ** 4).sum(axis=1, keepdims=True),
            lambda x, w=wall: ca.sum1(((x[:2] - w) / size) ** 4), x[1:-1], lower=1.0, name=f"wall {k}",
        )  # fmt: skip
    twin.require(lambda x: (x[:, 2:] ** 2).sum(axis=1, keepdims=True), lambda x: ca.sumsqr(x[2:]), x[1:], upper=4.0,
                 name="speed")  # fmt: skip
    twin.bound(u, lower=-2.5, upper=2.5, name="push")
    return twin


def hover(seed: int, equalities_only: bool = False) -> Twin:
    """A planar drone holds a place in a gust with quadratic drag, starting thrown; two rotors that only push."""
    rng = np.random.default_rng([26, seed])
    steps, dt, drag = 40, 0.06, rng.uniform(0.1, 0.4)
    wind = rng.uniform(-5.0, 5.0, 2) * [1.0, 0.3]
    start = np.array([*rng.uniform(-1, 1, 2), rng.uniform(-1.0, 1.0), *rng.uniform(-3, 3, 2), rng.uniform(-2, 2)])
    twin, x, u = driven(
        "hover with drag",
        seed,
        equalities_only,
        np.linspace(start, np.zeros(6), steps + 1),
        np.full((steps, 2), 0.5 * GRAVITY),
    )

    def motion(x: Array, u: Array, after: Array) -> Array:
        m = 0.5 * (x + after)
        air = m[:, 3:5] - wind
        pull = -drag * np.sqrt((air**2).sum(axis=1, keepdims=True) + 1e-4) * air
        thrust = u.sum(axis=1)
        pull = pull + np.stack([-np.sin(m[:, 2]) * thrust, np.cos(m[:, 2]) * thrust - GRAVITY], axis=1)
        return after - x - dt * np.hstack([m[:, 3:], pull, 8.0 * (u[:, 1:] - u[:, :1])])

    def motion_exact(x: Any, u: Any, after: Any) -> Any:
        m = (x + after) / 2
        air = m[3:5] - wind
        pull = -drag * ca.sqrt(ca.sumsqr(air) + 1e-4) * air
        pull += (u[0] + u[1]) * ca.vertcat(-ca.sin(m[2]), ca.cos(m[2])) - ca.DM([0, GRAVITY])
        return after - x - dt * ca.vertcat(m[3:], pull, 8 * (u[1] - u[0]))

    weight = [0.5, 0.5, 1.0, 1.0, 1.0, 2.0]
    twin.minimize(lambda x: x, lambda x: x, x[1:], sigma=weight, name="stay")
    twin.minimize(lambda u: u - 0.5 * GRAVITY, lambda u: u - GRAVITY / 2, u, sigma=4.0, name="effort")
    twin.equal(motion, motion_exact, x[:-1], u, x[1:], name="motion")
    twin.bound(u, lower=0.5, upper=10.0, name="rotors")
    twin.bound(x[1:], lower=[-9, -1.5, -1.2, -9, -9, -9], upper=[9, 9, 1.2, 9, 9, 9], name="room")
    return twin


def orbit(seed: int, equalities_only: bool = False) -> Twin:
    """From a circular orbit to a higher one with a small thrust: radius, radial and tangential speed; hard end."""
    rng = np.random.default_rng([27, seed])
    steps, high = 40, rng.uniform(1.3, 1.6)
    dt = rng.uniform(5.0, 7.0) / steps
    start, goal = np.array([1.0, 0.0, 1.0]), np.array([high, 0.0, high**-0.5])
    twin, x, u = driven("orbit", seed, equalities_only, np.linspace(start, goal, steps + 1), np.full((steps, 2), 0.01))

    def rate(x: Array, u: Array) -> Array:
        r, a, b = x.T
        return np.stack([a, b**2 / r - 1.0 / r**2 + u[:, 0], -a * b / r + u[:, 1]], axis=1)

    def rate_exact(x: Any, u: Any) -> Any:
        return ca.vertcat(x[1], x[2] ** 2 / x[0] - 1 / x[0] ** 2 + u[0], -x[1] * x[2] / x[0] + u[1])

    twin.minimize(lambda u: u, lambda u: u, u, sigma=0.1, name="effort")
    twin.equal(
        lambda x, u, y: y - x - 0.5 * dt * (rate(x, u) + rate(y, u)),
        lambda x, u, y: y - x - dt / 2 * (rate_exact(x, u) + rate_exact(y, u)),
        x[:-1], u, x[1:], name="motion",
    )  # fmt: skip
    twin.equal(lambda x: x - goal, lambda x: x - goal, x[-1], name="new orbit")
    twin.require(lambda u: (u**2).sum(axis=1, keepdims=True), ca.sumsqr, u, upper=0.16**2, name="thrust")
    return twin
