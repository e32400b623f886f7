"""A figure eight past three spheres, flown by a plan that is made anew at every tick (Yang et al. 2025, IV-B).

Nodes are 50 ms apart, ticks 10 ms. All terms are written as a user would write them: plain functions, nothing by hand.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

import unifg as fg
from unifg.models import avoidance, barriers, keeping, quadrotor, rkmk
from unifg.typing import Array

PACE = 1.06  # of the figure eight [rad/s]
SPHERES = np.array(
    [[0.55, 0.60, 1.35, 0.35], [1.95, 0.40, 1.65, 0.35], [1.55, -1.00, 1.40, 0.35]]
)  # x, y, z, radius [m]
NAMES = ("left sphere", "far sphere", "right sphere")
VEHICLE = quadrotor.Parameters()
STAGE, END = np.repeat([20.0, 2.0, 2.0], 3), np.repeat([100.0, 10.0, 10.0], 3)  # of tangents: position, turn, velocity
EFFORT = np.array([0.1, 0.1, 0.1, 0.05])
LOWER, UPPER = np.array([-6.0, -6.0, -3.0, 2.0]), np.array([6.0, 6.0, 3.0, 20.0])
START = np.array([-0.5, 0.4, 1.2, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])


def figure_eight(t: Array) -> tuple[Array, Array]:
    """States (n, 10) and controls (n, 4) of the reference at times t [s]."""
    a = PACE * t
    states, controls = np.zeros((len(t), 10)), np.zeros((len(t), 4))
    states[:, :3] = np.column_stack([2.0 * np.sin(a), np.sin(2.0 * a), np.full_like(t, 1.5)])
    states[:, 7:9] = 2.0 * PACE * np.column_stack([np.cos(a), np.cos(2.0 * a)])
    force = np.column_stack(
        [-2.0 * PACE**2 * np.sin(a), -4.0 * PACE**2 * np.sin(2.0 * a), np.full_like(t, quadrotor.GRAVITY)]
    )
    length = np.linalg.norm(force, axis=1)
    half = np.column_stack([length + force[:, 2], -force[:, 1], force[:, 0], np.zeros_like(t)])  # the shortest turn
    states[:, 3:7] = half / np.linalg.norm(half, axis=1, keepdims=True)
    controls[:, 3] = VEHICLE.mass * length
    return states, controls


def gust(now: float) -> Array:
    """(6,) what the air does to rates [rad/s] and accelerations [m/s^2] at a time."""
    k = np.arange(6)
    return np.asarray(np.repeat([0.05, 0.5], 3) * np.sin((1.3 + 0.37 * k) * 7.0 * now + k))


def field_of(x: Array, u: Array) -> Array:
    """F of a quadrotor of mass one, written out."""
    lift = fg.SO3.act(x[:, 3:7], u[:, 3:] * np.array([0.0, 0.0, 1.0]))
    return np.concatenate([x[:, 7:], u[:, :3], lift - np.array([0.0, 0.0, quadrotor.GRAVITY])], axis=1)


@dataclass
class GuardedFlight:
    """The graph of one tick.

    Attributes:
        form: of the barriers; None without spheres.
        alpha: of their decay [1/s].
        intervals: N.
        tick, node: first interval and all others [s].
        weight: of hinge or slack; None for the default.
    """

    form: keeping.Form | None = "slack"
    alpha: float = 3.0
    intervals: int = 20
    tick: float = 0.01
    node: float = 0.05
    weight: float | None = None
    spheres: Array = field(default_factory=lambda: SPHERES)

    def __post_init__(self) -> None:
        """State it."""
        n = self.intervals
        begins, steps = keeping.grid(n, self.tick, self.node)
        self.times = np.append(begins, begins[-1] + steps[-1])
        self.graph = graph = fg.Graph()
        self.x, self.u = graph.variables("x", quadrotor.STATE, n + 1), graph.variables("u", quadrotor.CONTROL, n)
        x, u = self.x, self.u
        states, controls = figure_eight(self.times)
        self.start = graph.data("start", START)
        self.states, self.controls = (
            graph.data("states", states[1:], each=True),
            graph.data("controls", controls[:-1], each=True),
        )
        self.end = graph.data("last", states[-1])
        graph.fix(x[0], self.start)
        graph.minimize(fg.prior, x[1:], self.states, sigma=STAGE**-0.5, name="tracking")
        graph.minimize(fg.prior, x[-1], self.end, sigma=END**-0.5, name="end")
        graph.minimize(fg.prior, u, self.controls, sigma=EFFORT**-0.5, name="effort")
        motion = rkmk.integrator(quadrotor.STATE, field_of, "simplified trapezoid")
        graph.constrain(motion, x[:-1], u, x[1:], steps, lower=0.0, upper=0.0, name="motion")
        graph.bound(u, lower=LOWER, upper=UPPER, name="limits")
        self.kept: keeping.Kept | None = None
        if self.form is not None:
            barrier = barriers.decay(barriers.still(avoidance.sphere_clearance), self.alpha)
            args = x[:-1].p, x[1:].p, begins, steps, self.spheres[:, :3], self.spheres[:, 3]
            self.kept = keeping.keep(
                graph,
                barrier,
                *args,
                obstacles=NAMES[: len(self.spheres)],
                form=self.form,
                weight=self.weight,
                name="spheres",
            )

    def guess(self) -> dict[Any, Array]:
        """The reference itself, even through the spheres."""
        states, controls = figure_eight(self.times)
        states[0] = START
        return {self.x: states, self.u: controls[:-1], **({} if self.kept is None else self.kept.guess())}

    def data(self, state: Array, now: float) -> dict[fg.Data, Array]:
        """Of the tick at time ``now`` [s]."""
        states, controls = figure_eight(now + self.times)
        return {self.start: state, self.states: states[1:], self.controls: controls[:-1], self.end: states[-1]}

    def clearance(self, states: Array) -> Array:
        """(n,) least distance to the spheres [m]."""
        return np.asarray(
            avoidance.sphere_clearance(states[:, :3], self.spheres[:, :3], self.spheres[:, 3]).min(axis=1)
        )
