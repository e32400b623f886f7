"""Twenty-four optimal control problems with known optima: a unicycle on SE(2) and a quadrotor on {p, R, v}.

minimise   sum_k 1/2 |x_k - xr_k|_W^2 + 1/2 |u_k - ur_k|_Wu^2  (+ 1/2 |x_N - xr_N|_WN^2)
subject to x_0 given, x_{k+1} = f(x_k, u_k), limits of the controls, and discs or spheres to be avoided at every node.

The unicycle's numbers are those of :mod:`benchmarks.reference_problems`; optima were found by IPOPT at tolerance 1e-9
from the same guesses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, TypeAlias

import numpy as np

import unifg as fg
from benchmarks import closed_loop, unicycle_problems
from unifg.models import avoidance, quadrotor
from unifg.typing import Array

STAGE, TERMINAL = np.repeat([20.0, 2.0, 2.0], 3), np.repeat([100.0, 10.0, 10.0], 3)
EFFORT = np.array([0.1, 0.1, 0.1, 0.05])
UNIT_MASS = quadrotor.Parameters()  # the thrust of the problems is per mass; neither drag nor wind
SPHERES = {  # x, y, z, radius [m]
    "figure8": (
        (0.55, 0.60, 1.35, 0.35), (1.95, 0.40, 1.65, 0.35), (1.55, -1.00, 1.40, 0.35), (-0.55, 0.35, 1.65, 0.35),
        (-2.00, 0.15, 1.35, 0.35),
    ),
    "goto": (
        (1.2, 0.35, 1.10, 0.40), (2.2, 0.25, 1.30, 0.45), (3.0, 0.95, 1.20, 0.40), (3.8, 0.65, 1.50, 0.40),
        (2.2, 1.05, 0.90, 0.35),
    ),
}  # fmt: skip
# (instance, blocked, N): known local optima, the one reached by IPOPT from the cold guess first.
OPTIMA: dict[tuple[str, bool, int], tuple[float, ...]] = {
    **unicycle_problems.OPTIMA,
    ("straight", False, 100): (6.40879,),
    ("straight", True, 100): (19.66481,),
    ("behind", False, 100): (59.47490,),
    ("behind", True, 100): (65.50045,),
    ("figure8", False, 20): (133.44694,),
    ("figure8", False, 50): (134.03147,),
    ("figure8", True, 20): (135.46369,),
    ("figure8", True, 50): (156.35144,),
    ("goto", False, 20): (3292.64495,),
    ("goto", False, 50): (3287.28806,),
    ("goto", True, 20): (3403.82537, 3438.70),
    ("goto", True, 50): (3399.72386, 3432.35),
}


class Unicycle(unicycle_problems.Problem):
    """A problem of the table of sixteen, at any horizon."""

    robot: ClassVar[str] = "unicycle"

    @property
    def optima(self) -> tuple[float, ...]:
        """Known optima."""
        return OPTIMA[self.instance, self.blocked, self.horizon]

    def formulation(self) -> closed_loop.Formulation:
        """As a factor graph."""
        return closed_loop.Formulation(self)


@dataclass(frozen=True)
class Quadrotor:
    """The numbers of one problem of the quadrotor.

    Attributes:
        instance: name.
        blocked: whether the spheres are there.
        horizon: N.
        dt: sampling time [s].
        lower, upper: limits of the controls [rad/s, m/s^2].
    """

    robot: ClassVar[str] = "quadrotor"
    dt: ClassVar[float] = 0.05
    lower: ClassVar[Array] = np.array([-6.0, -6.0, -3.0, 2.0])
    upper: ClassVar[Array] = np.array([6.0, 6.0, 3.0, 20.0])
    upright: ClassVar[bool] = False  # whether the obstacles have no top

    instance: str
    blocked: bool
    horizon: int

    @property
    def name(self) -> str:
        """For the tables."""
        return f"{self.instance}{', spheres' if self.blocked else ''}, N = {self.horizon}"

    @property
    def optima(self) -> tuple[float, ...]:
        """Known optima."""
        return OPTIMA[self.instance, self.blocked, self.horizon]

    @property
    def discs(self) -> Array:
        """(M, 4) x, y, z, radius of the spheres [m]."""
        return np.array(SPHERES[self.instance] if self.blocked else np.zeros((0, 4)), dtype=np.float64)

    @property
    def start(self) -> Array:
        """(10,) first state: position, quaternion (w, x, y, z), velocity."""
        position = (-0.5, 0.4, 1.2) if self.instance == "figure8" else (0.0, 0.0, 1.0)
        return np.array([*position, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])

    def reference(self, first: int = 0) -> tuple[Array, Array]:
        """Reference states (N + 1, 10) from step ``first`` on, and controls (N, 4)."""
        t = self.dt * np.arange(first, first + self.horizon + 1)
        states, controls = np.zeros((len(t), 10)), np.zeros((len(t), 4))
        if self.instance == "goto":
            states[:, :4] = 5.0, 1.0, 1.5, 1.0
            controls[:, 3] = quadrotor.GRAVITY
            return states, controls[:-1]
        c = 1.06  # [1/s]
        states[:, :3] = np.column_stack([2.0 * np.sin(c * t), np.sin(2.0 * c * t), np.full_like(t, 1.5)])
        states[:, 7:9] = np.column_stack([2.0 * c * np.cos(c * t), 2.0 * c * np.cos(2.0 * c * t)])
        force = np.column_stack(
            [-2.0 * c * c * np.sin(c * t), -4.0 * c * c * np.sin(2.0 * c * t), np.full_like(t, quadrotor.GRAVITY)]
        )
        up = force / np.linalg.norm(force, axis=1, keepdims=True)
        left = np.cross(up, [1.0, 0.0, 0.0])
        left /= np.linalg.norm(left, axis=1, keepdims=True)
        attitude = np.stack([np.cross(left, up), left, up], axis=2)
        w = 0.5 * np.sqrt(1.0 + np.trace(attitude, axis1=1, axis2=2))
        skew = attitude - np.swapaxes(attitude, 1, 2)
        states[:, 3], states[:, 4:7] = (
            w,
            np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1) / (4 * w[:, None]),
        )
        controls[:, 3] = np.linalg.norm(force, axis=1)
        return states, controls[:-1]

    def guess(self) -> tuple[Array, Array]:
        """The reference itself, even through the spheres; ``goto`` begins with hovering at the start."""
        states, controls = self.reference()
        if self.instance == "goto":
            states[:] = self.start
        states[0] = self.start
        return states, controls

    def plant(self, state: Array, control: Array, index: int) -> Array:
        """(10,) state after closed-loop step ``index``; disturbed only where no sphere can be hit."""
        moved: Array = quadrotor.step(state[None], control[None], self.dt, UNIT_MASS)[0]
        if self.blocked:
            return moved
        s = np.arange(9)
        push = np.repeat([0.005, 0.01, 0.03], 3) * np.sin((1.3 + 0.37 * s) * index + s)
        return np.asarray(quadrotor.STATE.retract(moved[None], push[None])[0])

    def stage_cost(self, state: Array, control: Array, index: int) -> float:
        """Cost of one step of the closed loop."""
        states, controls = self.reference(index)
        error = quadrotor.STATE.local(states[:1], state[None])[0]
        return float(0.5 * STAGE @ error**2 + 0.5 * EFFORT @ (control - controls[0]) ** 2)

    def formulation(self) -> QuadrotorGraph:
        """As a factor graph."""
        return QuadrotorGraph(self)


class QuadrotorGraph:
    """The problem as a factor graph whose start and references are data.

    Attributes:
        graph: the problem.
        x, u: states and controls.
        guess: the cold guess.
    """

    def __init__(self, problem: Quadrotor) -> None:
        """Build the graph."""
        n = problem.horizon
        states, controls = problem.reference()
        self.problem = problem
        self.graph = graph = fg.Graph()
        self.x = x = graph.variables("state", quadrotor.STATE, n + 1)
        self.u = u = graph.variables("control", quadrotor.CONTROL, n)
        self._start = graph.data("start", problem.start)
        graph.fix(x[0], self._start)
        self._references: dict[str, tuple[fg.Data, slice]] = {}
        for where, chosen, weights in (("stage", x[:-1], STAGE), ("end", x[-1:], TERMINAL)):
            rows = states[:-1] if where == "stage" else states[-1:]
            for part, storage, place in (("p", slice(0, 3), 0), ("R", slice(3, 7), 3), ("v", slice(7, 10), 6)):
                name = f"{where} {part}"
                data = graph.data(name, rows[:, storage], each=True)
                self._references[name] = data, storage
                sigma = weights[place : place + 3] ** -0.5
                graph.minimize(fg.prior, getattr(chosen, part), data, sigma=sigma, name=name)
        self._cruise = graph.data("cruise", controls, each=True)
        graph.minimize(fg.prior, u, self._cruise, sigma=EFFORT**-0.5, name="effort")
        motion = x[:-1], u, x[1:], UNIT_MASS.packed, problem.dt
        graph.constrain(quadrotor.dynamics, *motion, lower=0.0, upper=0.0, name="dynamics")
        graph.bound(u, lower=problem.lower, upper=problem.upper, name="limits")
        if problem.blocked:
            self.keep_off()
        first, efforts = problem.guess()
        self.guess = fg.Guess({x: first, u: efforts})

    def keep_off(self) -> None:
        """Add the clearance from every obstacle at every node."""
        spheres = self.problem.discs
        away = self.x[1:].p, spheres[:, :3], spheres[:, 3]
        self.graph.constrain(avoidance.sphere_clearance, *away, lower=0.0, name="spheres")

    def data(self, state: Array, first: int) -> dict[fg.Data, Array]:
        """The data of closed-loop step ``first``, begun at ``state``."""
        states, controls = self.problem.reference(first)
        given = {self._start: state, self._cruise: controls}
        for name, (data, storage) in self._references.items():
            given[data] = (states[:-1] if name.startswith("stage") else states[-1:])[:, storage]
        return given


Problem: TypeAlias = Unicycle | Quadrotor


def problems() -> list[Problem]:
    """All twenty-four."""
    long, short = ("straight", "behind"), ("curve", "ahead")
    found: list[Problem] = [Unicycle(i, b, n) for i in long for b in (False, True) for n in (20, 50, 100)]
    found += [Unicycle(i, b, 50) for i in short for b in (False, True)]
    return found + [Quadrotor(i, b, n) for i in SPHERES for b in (False, True) for n in (20, 50)]
