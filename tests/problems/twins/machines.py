"""Control problems of machines, each stated twice: a crane with its load, an arm of two links."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from problems.twins.twin import Twin, driven
from unifg.typing import Array

GRAVITY = 9.81


def payload(seed: int, equalities_only: bool = False) -> Twin:
    """A crane carries a swinging load over a box: trolley, rope, load; the load must clear the box and end at rest."""
    rng = np.random.default_rng([28, seed])
    steps, dt = 40, 0.12
    distance, rope = rng.uniform(3.0, 4.5), rng.uniform(1.5, 2.2)
    start = np.array([0.0, 0.0, rope, 0.0, 0.0, 0.0])  # trolley, swing, rope, and their rates
    goal = np.array([distance, 0.0, rope, 0.0, 0.0, 0.0])
    box = np.array([0.5 * distance, rope + 0.1])  # its top is above the load's way
    half = np.array([0.4, rng.uniform(0.3, 0.6)])
    twin, x, u = driven(
        "payload", seed, equalities_only, np.linspace(start, goal, steps + 1), np.zeros((steps, 2))
    )  # accelerations of trolley and rope

    def motion(x: Array, u: Array, after: Array) -> Array:
        m = 0.5 * (x + after)
        swing, length = m[:, 1], m[:, 2]
        bend = -(u[:, 0] * np.cos(swing) + GRAVITY * np.sin(swing) + 2.0 * m[:, 5] * m[:, 4]) / length
        return after - x - dt * np.column_stack([m[:, 3:], u[:, 0], bend, u[:, 1]])

    def motion_exact(x: Any, u: Any, after: Any) -> Any:
        m = (x + after) / 2
        bend = -(u[0] * ca.cos(m[1]) + GRAVITY * ca.sin(m[1]) + 2 * m[5] * m[4]) / m[2]
        return after - x - dt * ca.vertcat(m[3:], u[0], bend, u[1])

    twin.minimize(lambda u: u, lambda u: u, u, sigma=[1.0, 0.7], name="effort")
    twin.minimize(lambda x: x[:, 1:2], lambda x: x[1], x[1:], sigma=0.3, name="swing")
    twin.equal(motion, motion_exact, x[:-1], u, x[1:], name="motion")
    twin.equal(lambda x: x - goal, lambda x: x - goal, x[-1], name="set down")
    twin.require(
        lambda x: (
            ((x[:, :1] + x[:, 2:3] * np.sin(x[:, 1:2]) - box[0]) / half[0]) ** 4
            + ((x[:, 2:3] * np.cos(x[:, 1:2]) - box[1]) / half[1]) ** 4
        ),
        lambda x: ((x[0] + x[2] * ca.sin(x[1]) - box[0]) / half[0]) ** 4
        + ((x[2] * ca.cos(x[1]) - box[1]) / half[1]) ** 4,
        x[1:-1], lower=1.0, name="box",
    )  # fmt: skip
    twin.bound(x[1:], lower=[-1, -1.2, 0.6, -3, -5, -1.5], upper=[6, 1.2, 3.0, 3, 5, 1.5], name="crane")
    twin.bound(u, lower=[-3.0, -2.0], upper=[3.0, 2.0], name="drives")
    return twin


def arm(seed: int, equalities_only: bool = False) -> Twin:
    """Two links in a vertical plane move from rest to rest; the hand keeps off a disc, torques are limited."""
    rng = np.random.default_rng([29, seed])
    steps, dt = 40, 0.04
    start = np.array([rng.uniform(-0.4, 0.2), rng.uniform(0.2, 0.8), 0.0, 0.0])
    goal = np.array([rng.uniform(1.2, 1.9), rng.uniform(-0.6, 0.6), 0.0, 0.0])
    twin, x, u = driven(
        "two-link arm", seed, equalities_only, np.linspace(start, goal, steps + 1), np.zeros((steps, 2))
    )
    middle = 0.5 * (start + goal)
    both = np.array([middle[0], middle[0] + middle[1]])
    disc = np.array([np.cos(both).sum(), np.sin(both).sum()]) * rng.uniform(0.95, 1.08)

    def motion(x: Array, u: Array, after: Array) -> Array:
        m = 0.5 * (x + after)
        c, s = np.cos(m[:, 1]), np.sin(m[:, 1])
        a, b, d = 1.67 + c, 0.33 + 0.5 * c, 0.33  # inertia matrix [[a, b], [b, d]], links of 1 kg and 1 m
        first = u[:, 0] + 0.5 * s * (2 * m[:, 2] * m[:, 3] + m[:, 3] ** 2)
        first -= GRAVITY * (1.5 * np.cos(m[:, 0]) + 0.5 * np.cos(m[:, 0] + m[:, 1]))
        second = u[:, 1] - 0.5 * s * m[:, 2] ** 2 - 0.5 * GRAVITY * np.cos(m[:, 0] + m[:, 1])
        det = a * d - b * b
        return (
            after - x - dt * np.column_stack([m[:, 2:], (d * first - b * second) / det, (a * second - b * first) / det])
        )

    def motion_exact(x: Any, u: Any, after: Any) -> Any:
        m = (x + after) / 2
        p, q, v, w = m[0], m[1], m[2], m[3]
        inertia = ca.vertcat(ca.horzcat(1.67 + ca.cos(q), 0.33 + ca.cos(q) / 2), ca.horzcat(0.33 + ca.cos(q) / 2, 0.33))
        weight = GRAVITY * ca.vertcat(1.5 * ca.cos(p) + ca.cos(p + q) / 2, ca.cos(p + q) / 2)
        fling = ca.sin(q) / 2 * ca.vertcat(-2 * v * w - w**2, v**2)
        return after - x - dt * ca.vertcat(v, w, ca.solve(inertia, u - fling - weight))

    twin.minimize(lambda u: u, lambda u: u, u, sigma=10.0, name="effort")
    twin.equal(motion, motion_exact, x[:-1], u, x[1:], name="motion")
    twin.equal(lambda x: x - goal, lambda x: x - goal, x[-1], name="at rest")
    twin.require(
        lambda x: (np.cos(x[:, :1]) + np.cos(x[:, :1] + x[:, 1:2]) - disc[0]) ** 2
        + (np.sin(x[:, :1]) + np.sin(x[:, :1] + x[:, 1:2]) - disc[1]) ** 2,
        lambda x: (ca.cos(x[0]) + ca.cos(x[0] + x[1]) - disc[0]) ** 2
        + (ca.sin(x[0]) + ca.sin(x[0] + x[1]) - disc[1]) ** 2,
        x[1:-1], lower=0.2**2, name="hand",
    )  # fmt: skip
    twin.bound(u, lower=[-60.0, -25.0], upper=[60.0, 25.0], name="torques")
    twin.bound(x[1:], lower=[-3.1, -2.8, -8.0, -8.0], upper=[3.1, 2.8, 8.0, 8.0], name="joints")
    return twin
