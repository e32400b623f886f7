"""A drive past a disc whose unknowns and rows may be stated in any units, with exact Jacobians."""

from __future__ import annotations

import numpy as np

import unifg as fg
from problems.graphs import graph_of
from problems.known import Guess
from unifg.typing import Array

DT = 0.2
GOAL = np.array([3.0, 0.1, 0.0])
CENTRE = np.array([1.5, -0.1])
SIGMA = np.array([0.1, 0.1, 0.3])
COST = 1.704109  # past the disc on the far side; 1.699471 on the near one
OTHER_COST = 1.699471


def drive(
    position: float = 1.0,
    angle: float = 1.0,
    control: float = 1.0,
    dynamics: float = 1.0,
    clearance: float = 1.0,
    cost: float = 1.0,
    count: int = 20,
    radius: float = 0.4,
    blocked: bool = False,
) -> tuple[fg.Graph, Guess]:
    """A unicycle on R^3, in steps of 0.2 s, to a goal behind a disc.

    Args:
        position, angle, control: metres, radians, and units of the controls that one of the unknown is worth.
        dynamics, clearance: what the rows of the dynamics and of the disc are multiplied with.
        cost: what the residuals of the costs are multiplied with.
        count: steps.
        radius: of the disc.
        blocked: whether the goal must be reached exactly though the speed does not suffice.
    """
    state, input_ = np.array([position, position, angle]), np.array([control, control])

    def motion(a: Array, u: Array, b: Array) -> Array:
        a, u, b = a * state, u * input_, b * state
        heading = a[:, 2] + 0.5 * DT * u[:, 1]
        along = np.stack([u[:, 0] * np.cos(heading), u[:, 0] * np.sin(heading), u[:, 1]], axis=1)
        return np.asarray(dynamics * (b - a - DT * along))

    def motion_slopes(a: Array, u: Array, b: Array) -> list[Array]:
        a, u = a * state, u * input_
        heading = a[:, 2] + 0.5 * DT * u[:, 1]
        cos, sin, speed = np.cos(heading), np.sin(heading), u[:, 0]
        before, by = np.tile(-np.eye(3), (len(a), 1, 1)), np.zeros((len(a), 3, 2))
        before[:, 0, 2], before[:, 1, 2] = DT * speed * sin, -DT * speed * cos
        by[:, 0] = np.stack([-DT * cos, 0.5 * DT**2 * speed * sin], axis=1)
        by[:, 1] = np.stack([-DT * sin, -0.5 * DT**2 * speed * cos], axis=1)
        by[:, 2, 1] = -DT
        after = np.tile(np.eye(3), (len(a), 1, 1))
        return [dynamics * before * state, dynamics * by * input_, dynamics * after * state]

    def room(a: Array) -> Array:
        squared: Array = ((a[:, :2] * position - CENTRE) ** 2).sum(axis=1, keepdims=True)
        return np.asarray(clearance * (squared - radius**2))

    def room_slope(a: Array) -> list[Array]:
        slope = np.zeros((len(a), 1, 3))
        slope[:, 0, :2] = 2.0 * clearance * position * (a[:, :2] * position - CENTRE)
        return [slope]

    graph, x, u = graph_of(("x", fg.Rn(3), count + 1), ("u", fg.Rn(2), count))
    graph.fix(x[0], np.zeros(3))
    pull, effort, change = cost * np.diag(state / SIGMA), cost * np.diag(input_ / 2.0), cost * np.diag(input_)

    def tracking(a: Array) -> Array:
        return np.asarray(a @ pull - cost * GOAL / SIGMA)

    graph.minimize(fg.residual(tracking, jacobian=lambda a: [np.tile(pull, (len(a), 1, 1))]), x[-1], name="goal")
    graph.minimize(fg.residual(lambda a: a @ effort, jacobian=lambda a: [np.tile(effort, (len(a), 1, 1))]), u)
    rates = fg.residual(
        lambda a, b: (b - a) @ change,
        jacobian=lambda a, b: [np.tile(-change, (len(a), 1, 1)), np.tile(change, (len(a), 1, 1))],
    )
    graph.minimize(rates, u[:-1], u[1:], name="rates")
    moves = fg.residual(motion, jacobian=motion_slopes)
    graph.constrain(moves, x[:-1], u, x[1:], lower=0.0, upper=0.0, name="dynamics")
    graph.bound(u, lower=-1.2 / input_, upper=1.2 / input_, name="limits")
    graph.constrain(fg.residual(room, jacobian=room_slope), x[1:], lower=0.0, name="disc")
    if blocked:  # 1.2 m/s for four seconds do not make five metres
        ends = fg.residual(
            lambda a: dynamics * (a * state - 5.0)[:, :1],
            jacobian=lambda a: [np.tile(dynamics * state * np.eye(3)[:1], (len(a), 1, 1))],
        )
        graph.constrain(ends, x[-1], lower=0.0, upper=0.0, name="end")
    way = np.linspace(0.0, 1.0, count + 1)
    path = np.stack([3.0 * way, 0.0 * way, 0.0 * way], axis=1)
    return graph, {x: path / state, u: np.tile([0.75, 0.0], (count, 1)) / input_}
