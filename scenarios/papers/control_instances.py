"""Control problems of Bazzana's Table III, and a backend of unifg on one of them.

The paper gives six initial costs, six final ones, iterations and times, and neither goals nor weights, horizon, map or
guess. What is known is kept: the costs of eq. 8 to 11 (soft dynamics, potential field with his k, mu, rho), limits of
1, his stop test, a guess along a straight path. Such a guess fits every cost but the first step of the dynamics, where
the robot faces elsewhere, so that an initial cost is in effect a bearing of the goal: here it is chosen so that each
initial cost is the paper's. The hard form has the dynamics and the clearance as constraints.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, partial
from typing import Any, TypeAlias

import numpy as np
from scipy.optimize import brentq

import unifg as fg
from unifg.models import obstacles, potential, unicycle
from unifg.scenarios.papers.measuring import clocked, words
from unifg.scenarios.papers.printed import numbers
from unifg.typing import Array

Row: TypeAlias = tuple[float, tuple[float, int, float], tuple[float, int, float]]


def _rows() -> tuple[Row, ...]:
    """The paper's: initial cost; final cost, iterations and seconds of its solver; the same of IPOPT."""
    of = partial(numbers, "bazzana", "Table III")
    found = list(zip(of("final_cost"), map(int, of("iterations")), of("time"), strict=True))
    return tuple(zip(of("initial_cost"), found[::2], found[1::2], strict=True))


PAPER = _rows()
STEPS, DT, SPEED, HULL, CLEAR = 30, 0.1, 0.5, 0.17, 0.03
PATH, EFFORT, STIFF, PUSH = np.array([10.0, 10.0, 1.0]), np.array([0.1, 0.1]), 3000.0, 20.0
LIMIT = 1.0
ASIDE = ((0.45, 0.75, 0.25), (1.05, -0.7, 0.2))  # along and across the path, radius of two discs [m]
STOP = 1e-4
RHO = 1000.0  # of the loops with a constant one: of the powers of ten, the damped loop does best with it
LOOP: dict[str, Any] = {"penalty": RHO, "step_tolerance": STOP, "tolerance": 1e-18, "max_iterations": 1000}
Outcome: TypeAlias = tuple[str, float, int]
"""Outcome, cost, iterations."""


@dataclass(frozen=True)
class Instance:
    """One control problem.

    Attributes:
        bearing: of the goal, from the robot's heading [rad].
        hard: dynamics and clearance are constraints, and there is no potential.
        moved: by how much the start has moved since the problem was solved before, sideways [m].
    """

    bearing: float
    hard: bool = False
    moved: float = 0.0

    @property
    def start(self) -> Array:
        """(3,) pose of the robot."""
        return np.array([0.0, self.moved, 0.0])

    @property
    def reference(self) -> Array:
        """(N + 1, 3) along the path; headings are not wrapped."""
        way = SPEED * DT * np.arange(STEPS + 1.0)
        b = self.bearing
        return np.column_stack([way * np.cos(b), way * np.sin(b), np.full(len(way), b)])

    @property
    def discs(self) -> Array:
        """(M, 3) beside the path: x, y, radius [m]."""
        c, s = np.cos(self.bearing), np.sin(self.bearing)
        return np.array([(c * a - s * b, s * a + c * b, r) for a, b, r in ASIDE])

    @property
    def guess(self) -> tuple[Array, Array]:
        """Poses and controls of the path itself, after the true start."""
        states = self.reference
        states[0] = self.start
        return states, np.tile([SPEED, 0.0], (STEPS, 1))

    def stated(self) -> tuple[fg.Graph, fg.Family, fg.Family, fg.Guess]:
        """As a factor graph, whose cost is half of the paper's."""
        states, controls = self.guess
        graph = fg.Graph()
        x = graph.variables("pose", fg.SE2, STEPS + 1)
        u = graph.variables("control", fg.Rn(2), STEPS)
        graph.fix(x[0], self.start)
        wrapped = np.column_stack([self.reference[:, :2], np.angle(np.exp(1j * self.reference[:, 2]))])
        graph.minimize(unicycle.tracking, x[1:], wrapped[1:], information=np.diag(PATH), name="path")
        graph.minimize(fg.prior, u, controls[0], information=np.diag(EFFORT), name="effort")
        centres, radii = self.discs[:, :2], self.discs[:, 2] + HULL
        steps = x[:-1], u, x[1:], DT
        if self.hard:
            graph.constrain(unicycle.dynamics, *steps, lower=0.0, upper=0.0, name="dynamics")
            graph.constrain(obstacles.disc_clearance, x[1:], centres, radii, lower=CLEAR, name="discs")
        else:
            graph.minimize(unicycle.dynamics, *steps, information=STIFF * np.eye(3), name="dynamics")
            push = potential.potential(obstacles.disc_clearance)
            graph.minimize(push, x[1:], centres, radii, sigma=PUSH**-0.5, name="potential")
        graph.bound(u, lower=-LIMIT, upper=LIMIT, name="limits")
        return (
            graph,
            x,
            u,
            fg.Guess({x: np.column_stack([states[:, :2], np.angle(np.exp(1j * states[:, 2]))]), u: controls}),
        )


@cache
def bearings() -> tuple[float, ...]:
    """Of the goals whose guesses cost what the paper's cost."""

    def excess(bearing: float, wanted: float) -> float:
        instance = Instance(bearing)
        x, u = instance.guess
        defect = unicycle.dynamics(x[:-1], u, x[1:], DT)
        push = potential.potential(obstacles.disc_clearance)(x[1:], instance.discs[:, :2], instance.discs[:, 2] + HULL)
        return STIFF * float((defect**2).sum()) + PUSH * float((push**2).sum()) - wanted

    return tuple(float(brentq(excess, 0.3, np.pi - 1e-6, args=(row[0],))) for row in PAPER)


class Ours:
    """A backend of unifg on an instance."""

    def __init__(self, solver: fg.Solver) -> None:
        """Take a backend."""
        self.solver = solver

    def state(self, instance: Instance) -> None:
        """Prepare."""
        graph, self.x, self.u, self.guess = instance.stated()
        self.run = self.solver.prepare(graph)

    def __call__(self) -> float:
        """Solve from the guess; processor time [s]."""
        self.solution, spent = clocked(self.run.solve, self.guess)
        return spent

    @property
    def outcome(self) -> Outcome:
        """Of the last solve."""
        return words(self.solution.status), 2.0 * self.solution.cost, self.solution.iterations

    def move(self, instance: Instance) -> None:
        """Prepare a moved instance, with the last answer as its guess."""
        states, controls = self.solution[self.x], self.solution[self.u]
        self.state(instance)
        self.guess = fg.Guess({self.x: states, self.u: controls})
