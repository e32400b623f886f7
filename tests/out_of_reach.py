"""Control problems whose constraints contradict each other, stated once for every backend's tests."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

import unifg as fg
from problems.graphs import graph_of
from unifg.models import obstacles, unicycle
from unifg.typing import Array

Stated: TypeAlias = tuple[fg.Graph, dict[fg.Family, Array]]

DT = 0.1


def advance(x: Array, a: Array, y: Array, dt: float) -> Array:
    """A cart whose acceleration is held over the step: position and velocity."""
    v = x[:, 1:]
    return np.asarray(y - np.hstack([x[:, :1] + dt * v + 0.5 * dt**2 * a, v + dt * a]))


def cart(steps: int, speed: float, tracking: float, wanted: float) -> tuple[fg.Graph, fg.Family, fg.Family]:
    """A cart with |a| <= 1 m/s^2 that is to be near some place all the way.

    Args:
        steps: of 0.1 s.
        speed: at the start [m/s].
        tracking: weight of the distance to the place and of the speed.
        wanted: the place [m].
    """
    graph, x, a = graph_of(("x", fg.Rn(2), steps + 1), ("a", fg.Rn(1), steps))
    graph.fix(x[0], [0.0, speed])
    graph.minimize(fg.prior, a, [0.0], name="effort")
    if tracking:
        graph.minimize(fg.prior, x, [wanted, 0.0], sigma=tracking**-0.5, name="tracking")
    graph.constrain(advance, x[:-1], a, x[1:], DT, lower=0.0, upper=0.0, name="motion")
    graph.bound(a, lower=-1.0, upper=1.0, name="limits")
    return graph, x, a


def goal_too_far(share: float, steps: int = 20, tracking: float = 0.0, unit: float = 1.0) -> Stated:
    """A convex quadratic program: the goal is farther than full throttle leads, by a share of that way.

    Args:
        share: of the way.
        steps: of 0.1 s.
        tracking: weight of being near the goal before the end.
        unit: of the goal's row [m].
    """
    goal = (1.0 + share) * 0.5 * (steps * DT) ** 2
    graph, x, a = cart(steps, 0.0, tracking, goal)
    graph.constrain(lambda p: (p[:, :1] - goal) / unit, x[-1], lower=0.0, upper=0.0, name="goal")
    return graph, {x: np.zeros((steps + 1, 2)), a: np.zeros((steps, 1))}


def wall_too_close(speed: float, steps: int = 20, tracking: float = 0.0) -> Stated:
    """A wall at 1 m, which braking with 1 m/s^2 cannot keep from sqrt(2) m/s on."""
    graph, x, a = cart(steps, speed, tracking, 0.0)
    graph.bound(x[1:], upper=[1.0, np.inf], name="wall")
    states = np.column_stack([speed * DT * np.arange(steps + 1), np.full(steps + 1, speed)])
    return graph, {x: states, a: np.zeros((steps, 1))}


def blocked_corridor(goal: bool) -> Stated:
    """A unicycle in a corridor of 2 m that two discs close; the guess drives through them, perhaps to a goal."""
    graph, x, u = graph_of(("x", fg.SE2, 31), ("u", fg.Rn(2), 30))
    graph.fix(x[0], [0.0, 0.0, 0.0])
    graph.minimize(fg.prior, u, [0.0, 0.0])
    graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], 0.2, lower=0.0, upper=0.0, name="motion")
    graph.bound(u, lower=[-1.0, -1.5], upper=[1.0, 1.5], name="limits")
    graph.constrain(lambda pose: pose[:, 1:2], x[1:], lower=-1.0, upper=1.0, name="corridor")
    discs = np.array([[2.0, 0.6, 0.7], [2.0, -0.6, 0.7]])
    graph.constrain(obstacles.disc_clearance, x[1:], discs[:, :2], discs[:, 2], lower=0.0, name="discs")
    if goal:
        graph.constrain(lambda pose: pose[:, :2] - [4.0, 0.0], x[-1], lower=0.0, upper=0.0, name="goal")
    states = np.zeros((31, 3))
    states[:, 0] = np.linspace(0.0, 4.0, 31)
    return graph, {x: states, u: np.tile([4.0 / 6.0, 0.0], (30, 1))}
