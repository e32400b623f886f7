"""Twenty-four optimal control problems with known optima: a unicycle on SE(2) and a quadrotor on {p, R, v}.

minimise   sum_k 1/2 |x_k - xr_k|_W^2 + 1/2 |u_k - ur_k|_Wu^2  (+ 1/2 |x_N - xr_N|_WN^2)
subject to x_0 given, x_{k+1} = f(x_k, u_k), limits of the controls, and discs or spheres to be avoided at every node.

The listed optima were found by IPOPT 3.14 at tolerance 1e-9 from the same guess. Around the obstacles there are several
local optima, one for each choice of side, so a lower cost is another optimum and not a mistake.
"""

from __future__ import annotations

import itertools
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np

import unifg as fg
from unifg.lie import wrap_angle
from unifg.models import avoidance, obstacles, quadrotor, unicycle
from unifg.typing import Array

HORIZONS = (20, 50)
STARTS = {  # of the unicycle
    "straight": (0.0, 0.5, -0.4),
    "curve": (0.0, -0.4, 0.6),
    "ahead": (0.0, 0.0, 0.0),
    "behind": (0.0, 0.0, 0.3),
}
RING = ((0.6, 2.2), (1.3, 1.8), (2.2, 2.2), (3.2, 1.8), (4.2, 2.2))  # angle [rad] and distance [m] from (0, 2)
DISCS = {  # x, y, radius [m]
    "straight": ((1.6, -0.15, 0.4), (3.0, 0.25, 0.45), (5.0, -0.2, 0.5), (6.6, 0.3, 0.4), (8.2, -0.25, 0.4)),
    "curve": tuple((d * np.sin(a), 2.0 - d * np.cos(a), 0.35) for a, d in RING),
    "ahead": ((1.2, 0.55, 0.4), (2.1, 0.4, 0.35), (0.6, -0.5, 0.3), (3.6, 1.5, 0.3), (2.0, 1.6, 0.3)),
    "behind": ((-1.0, 0.25, 0.3), (-1.9, -0.2, 0.3), (0.7, 0.6, 0.3), (-0.4, -0.8, 0.3), (-3.0, 0.15, 0.3)),
}
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
UNIT_MASS = quadrotor.Parameters()  # the thrust of the problems is per mass; neither drag nor wind
# (instance, with obstacles, N): known local optima, the one reached by IPOPT from the cold guess first.
OPTIMA: dict[tuple[str, bool, int], tuple[float, ...]] = {
    ("straight", False, 20): (6.40874,),
    ("straight", False, 50): (6.40879,),
    ("straight", False, 100): (6.40879,),
    ("straight", True, 20): (9.56973,),
    ("straight", True, 50): (12.98617,),
    ("straight", True, 100): (19.66481,),
    ("curve", False, 20): (3.74998,),
    ("curve", False, 50): (3.74998,),
    ("curve", True, 20): (5.32781, 5.33182),
    ("curve", True, 50): (6.91008,),
    ("ahead", False, 20): (561.41452,),
    ("ahead", False, 50): (558.59179,),
    ("ahead", True, 20): (579.75063, 586.14768),
    ("ahead", True, 50): (608.83744, 580.25905),
    ("behind", False, 20): (54.47372,),
    ("behind", False, 50): (59.47520,),
    ("behind", False, 100): (59.47490,),
    ("behind", True, 20): (54.47522,),
    ("behind", True, 50): (63.46789, 63.46577, 79.43),
    ("behind", True, 100): (65.50045,),
    ("figure8", False, 20): (133.44694,),
    ("figure8", False, 50): (134.03147,),
    ("figure8", True, 20): (135.46369,),
    ("figure8", True, 50): (156.35144,),
    ("goto", False, 20): (3292.64495,),
    ("goto", False, 50): (3287.28806,),
    ("goto", True, 20): (3403.82537, 3438.70),
    ("goto", True, 50): (3399.72386, 3432.35, 3387.08409),
}


@dataclass(frozen=True)
class Problem(ABC):
    """The numbers of one problem, and its robot in closed loop.

    Attributes:
        instance: name.
        blocked: whether the obstacles are there.
        horizon: N.
        robot, obstacles: their names.
        manifold: of a state.
        dt: sampling time [s].
        stage, terminal, effort: weights of the errors of states and controls.
        lower, upper: limits of the controls.
        axes: of a position that obstacles keep free.
        spread: standard deviations of states (tangent) and controls of the random starts.
    """

    robot: ClassVar[str]
    obstacles: ClassVar[str]
    manifold: ClassVar[fg.Manifold]
    dt: ClassVar[float]
    stage: ClassVar[Array]
    terminal: ClassVar[Array]
    effort: ClassVar[Array]
    lower: ClassVar[Array]
    upper: ClassVar[Array]
    axes: ClassVar[int]
    spread: ClassVar[tuple[Array, Array]]

    instance: str
    blocked: bool
    horizon: int

    @property
    def name(self) -> str:
        """For the tables."""
        return f"{self.instance}{f', {self.obstacles}' if self.blocked else ''}, N = {self.horizon}"

    @property
    def title(self) -> str:
        """For tables of both robots."""
        return f"{self.robot} {self.name}"

    @property
    def optima(self) -> tuple[float, ...]:
        """Known optima."""
        return OPTIMA[self.instance, self.blocked, self.horizon]

    @property
    @abstractmethod
    def discs(self) -> Array:
        """(M, d + 1) centres and radii of the obstacles [m]."""

    @property
    @abstractmethod
    def start(self) -> Array:
        """First state."""

    @abstractmethod
    def reference(self, first: int = 0) -> tuple[Array, Array]:
        """Reference states (N + 1, ...) from step ``first`` on, and controls (N, m)."""

    def guess(self) -> tuple[Array, Array]:
        """The reference itself, even through obstacles; ``ahead`` and ``goto`` begin with the robot at rest."""
        states, controls = self.reference()
        if self.instance in ("ahead", "goto"):
            states[:] = self.start
        states[0] = self.start
        return states, controls

    @abstractmethod
    def plant(self, state: Array, control: Array, index: int) -> Array:
        """State after closed-loop step ``index``; disturbed only where nothing can be hit."""

    @abstractmethod
    def error(self, state: Array, reference: Array) -> Array:
        """Of a state, as the costs weigh it."""

    @abstractmethod
    def formulation(self) -> Stated:
        """As a factor graph."""

    def stage_cost(self, state: Array, control: Array, index: int) -> float:
        """Cost of one step of the closed loop."""
        states, controls = self.reference(index)
        error = self.error(state, states[0])
        return float(0.5 * self.stage @ error**2 + 0.5 * self.effort @ (control - controls[0]) ** 2)

    def penetration(self, state: Array) -> float:
        """Depth in the nearest obstacle [m]; negative is a clearance, minus infinity without obstacles."""
        near = slice(0, self.axes)
        depths = [disc[-1] - float(np.linalg.norm(state[near] - disc[near])) for disc in self.discs]
        return max(depths, default=-np.inf)

    def starts(self, count: int) -> Iterator[tuple[Array, Array]]:
        """Perturbed cold guesses: states and controls, every one by itself."""
        rng = np.random.default_rng(7)
        states, controls = self.guess()
        if self.manifold is fg.SE2:
            states[:, 2] = wrap_angle(states[:, 2])
        of_states, of_controls = self.spread
        for _ in range(count):
            moved = self.manifold.retract(states, of_states * rng.standard_normal((len(states), len(of_states))))
            yield moved, controls + of_controls * rng.standard_normal(controls.shape)


class Stated(ABC):
    """A problem as a factor graph whose start and references are data.

    Attributes:
        problem: that is stated.
        graph: the problem.
        x, u: states and controls.
        guess: the cold guess.
    """

    def __init__(self, problem: Problem) -> None:
        """Begin with variables and the first state."""
        self.problem = problem
        self.graph = fg.Graph()
        self.x = self.graph.variables("state", problem.manifold, problem.horizon + 1)
        self.u = self.graph.variables("control", fg.Rn(len(problem.effort)), problem.horizon)
        self._start = self.graph.data("start", problem.start)
        self.graph.fix(self.x[0], self._start)
        states, controls = problem.guess()
        self.guess = fg.Guess({self.x: states, self.u: controls})

    @abstractmethod
    def data(self, state: Array, first: int) -> dict[fg.Data, Array]:
        """The data of closed-loop step ``first``, begun at ``state``."""


class Unicycle(Problem):
    """Poses (x, y, heading), controls [m/s, rad/s]; five discs."""

    robot = "unicycle"
    obstacles = "discs"
    manifold = fg.SE2
    dt = 0.1
    stage, terminal, effort = np.array([10.0, 10.0, 1.0]), np.array([50.0, 50.0, 5.0]), np.array([0.1, 0.1])
    lower, upper = np.full(2, -1.0), np.full(2, 1.0)
    axes = 2
    spread = np.array([0.3, 0.3, 0.5]), np.array([0.3, 0.3])

    @property
    def discs(self) -> Array:
        """(M, 3) x, y, radius [m]."""
        return np.array(DISCS[self.instance] if self.blocked else np.zeros((0, 3)), dtype=np.float64)

    @property
    def start(self) -> Array:
        """(3,) first pose."""
        return np.array(STARTS[self.instance])

    def reference(self, first: int = 0) -> tuple[Array, Array]:
        """Reference states (N + 1, 3) from step ``first`` on, headings not wrapped, and controls (N, 2)."""
        t = self.dt * np.arange(first, first + self.horizon + 1)
        zero = np.zeros_like(t)
        states, control = {
            "straight": ((0.8 * t, zero, zero), (0.8, 0.0)),
            "curve": ((2.0 * np.sin(0.35 * t), 2.0 - 2.0 * np.cos(0.35 * t), 0.35 * t), (0.7, 0.35)),
            "ahead": ((zero + 3.0, zero + 1.0, zero), (0.0, 0.0)),
            "behind": ((-0.5 * t, zero, zero + np.pi), (0.5, 0.0)),
        }[self.instance]
        return np.column_stack(states), np.tile(control, (self.horizon, 1))

    def plant(self, state: Array, control: Array, index: int) -> Array:
        """(3,) pose after closed-loop step ``index``, heading not wrapped."""
        moved = unicycle.step(state[None], control[None], self.dt)[0]
        moved[2] = state[2] + self.dt * control[1]
        push = 0.01 * np.array([np.sin(1.7 * index), np.cos(2.3 * index), np.sin(3.1 * index)])
        return np.asarray(moved if self.blocked else moved + push)

    def error(self, state: Array, reference: Array) -> Array:
        """The difference: headings are not wrapped."""
        return state - reference

    def formulation(self) -> UnicycleGraph:
        """As a factor graph."""
        return UnicycleGraph(self)


class UnicycleGraph(Stated):
    """The unicycle's problem with shipped kernels, or with residuals in their place.

    Attributes:
        tracking, dynamics, clearance: of the terms of those names.
    """

    tracking: Any = unicycle.tracking
    dynamics: Any = unicycle.dynamics
    clearance: Any = obstacles.disc_clearance

    def __init__(self, problem: Unicycle) -> None:
        """Build the graph."""
        super().__init__(problem)
        graph, x, u = self.graph, self.x, self.u
        reference, cruise = problem.reference()
        self._stages = graph.data("stages", reference[:-1], each=True)
        self._end = graph.data("end", reference[-1])
        effort = graph.data("effort", cruise, each=True)
        graph.minimize(self.tracking, x[:-1], self._stages, sigma=problem.stage**-0.5, name="tracking")
        graph.minimize(self.tracking, x[-1], self._end, sigma=problem.terminal**-0.5, name="terminal")
        graph.minimize(fg.prior, u, effort, sigma=problem.effort**-0.5, name="effort")
        graph.constrain(self.dynamics, x[:-1], u, x[1:], problem.dt, lower=0.0, upper=0.0, name="dynamics")
        graph.bound(u, lower=problem.lower, upper=problem.upper, name="limits")
        if problem.blocked:
            discs = problem.discs
            graph.constrain(self.clearance, x[1:], discs[:, :2], discs[:, 2], lower=0.0, name="discs")

    def data(self, state: Array, first: int) -> dict[fg.Data, Array]:
        """The data of closed-loop step ``first``, begun at a pose."""
        reference, _ = self.problem.reference(first)
        start = np.array([state[0], state[1], wrap_angle(state[2])])
        return {self._start: start, self._stages: reference[:-1], self._end: reference[-1]}


class Quadrotor(Problem):
    """Position, quaternion (w, x, y, z), velocity; controls are rates [rad/s] and thrust per mass [m/s^2]; spheres."""

    robot = "quadrotor"
    obstacles = "spheres"
    manifold = quadrotor.STATE
    dt = 0.05
    stage, terminal = np.repeat([20.0, 2.0, 2.0], 3), np.repeat([100.0, 10.0, 10.0], 3)
    effort = np.array([0.1, 0.1, 0.1, 0.05])
    lower, upper = np.array([-6.0, -6.0, -3.0, 2.0]), np.array([6.0, 6.0, 3.0, 20.0])
    axes = 3
    spread = np.repeat([0.3, 0.3, 0.5], 3), np.array([0.5, 0.5, 0.5, 1.0])

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

    def plant(self, state: Array, control: Array, index: int) -> Array:
        """(10,) state after closed-loop step ``index``."""
        moved: Array = quadrotor.step(state[None], control[None], self.dt, UNIT_MASS)[0]
        if self.blocked:
            return moved
        s = np.arange(9)
        push = np.repeat([0.005, 0.01, 0.03], 3) * np.sin((1.3 + 0.37 * s) * index + s)
        return np.asarray(quadrotor.STATE.retract(moved[None], push[None])[0])

    def error(self, state: Array, reference: Array) -> Array:
        """(9,) in the tangent space."""
        return np.asarray(quadrotor.STATE.local(reference[None], state[None])[0])

    def formulation(self) -> QuadrotorGraph:
        """As a factor graph."""
        return QuadrotorGraph(self)


class QuadrotorGraph(Stated):
    """The quadrotor's problem with shipped kernels; costs are priors of the parts of its state.

    Attributes:
        dynamics: of the term of that name.
    """

    dynamics: Any = quadrotor.dynamics

    def __init__(self, problem: Quadrotor) -> None:
        """Build the graph."""
        super().__init__(problem)
        graph, x, u = self.graph, self.x, self.u
        states, controls = problem.reference()
        self._references: dict[str, tuple[fg.Data, slice]] = {}
        for where, chosen, weights in (("stage", x[:-1], problem.stage), ("end", x[-1:], problem.terminal)):
            rows = states[:-1] if where == "stage" else states[-1:]
            for part, storage, place in (("p", slice(0, 3), 0), ("R", slice(3, 7), 3), ("v", slice(7, 10), 6)):
                name = f"{where} {part}"
                data = graph.data(name, rows[:, storage], each=True)
                self._references[name] = data, storage
                sigma = weights[place : place + 3] ** -0.5
                graph.minimize(fg.prior, getattr(chosen, part), data, sigma=sigma, name=name)
        self._cruise = graph.data("cruise", controls, each=True)
        graph.minimize(fg.prior, u, self._cruise, sigma=problem.effort**-0.5, name="effort")
        motion = x[:-1], u, x[1:], UNIT_MASS.packed, problem.dt
        graph.constrain(self.dynamics, *motion, lower=0.0, upper=0.0, name="dynamics")
        graph.bound(u, lower=problem.lower, upper=problem.upper, name="limits")
        if problem.blocked:
            clearance = avoidance.sphere_clearance if problem.axes == 3 else avoidance.cylinder_clearance
            discs = problem.discs
            away = x[1:].p, discs[:, : problem.axes], discs[:, 3]
            graph.constrain(clearance, *away, lower=0.0, name=problem.obstacles)

    def data(self, state: Array, first: int) -> dict[fg.Data, Array]:
        """The data of closed-loop step ``first``, begun at ``state``."""
        states, controls = self.problem.reference(first)
        given = {self._start: state, self._cruise: controls}
        for name, (data, storage) in self._references.items():
            given[data] = (states[:-1] if name.startswith("stage") else states[-1:])[:, storage]
        return given


class Tick(NamedTuple):
    """One step of a closed loop.

    Attributes:
        control: the first of the plan.
        milliseconds: processor time of the solve.
        iterations: of the solve.
        status: in words.
    """

    control: Array
    milliseconds: float
    iterations: int
    status: str


class Driver:
    """A backend in closed loop: every solve begins at its own last answer, moved by one stage."""

    def __init__(self, stated: Stated, solver: fg.Solver, multipliers: bool = True, penalties: bool = True) -> None:
        """Prepare the graph; the first solve is to the end for a backend that is stopped early in the others.

        Args:
            stated: problem to be driven.
            solver: the backend.
            multipliers: whether they go from step to step.
            penalties: whether those of an augmented Lagrangian do, too.
        """
        self._stated = stated
        self._cold = type(solver)(tolerance=solver.tolerance).prepare(self._stated.graph)
        self._warm = solver.prepare(self._stated.graph)
        self._kept = multipliers, penalties
        self._last: fg.Solution | None = None

    def control(self, state: Array, index: int) -> Tick:
        """Solve for step ``index``: cold the first time, then from the shifted primal-dual answer."""
        x, u = self._stated.x, self._stated.u
        run, start = self._cold, self._stated.guess
        if self._last is not None:
            run, start = self._warm, self._last.shifted(x, u, by=1)
        multipliers, penalties = self._kept
        if not multipliers:
            start = replace(start, multipliers={})
        if not penalties:
            start = replace(start, penalties={})
        self._call = run, start, self._stated.data(state, index)
        solution, milliseconds = self._solve()
        self._last = solution
        words = solution.status.name.lower().replace("_", " ")
        return Tick(solution[u][0], milliseconds, solution.iterations, words)

    def again(self) -> float:
        """Processor time of the same solve, when everything it needs is in the caches [ms]."""
        return self._solve()[1]

    def _solve(self) -> tuple[fg.Solution, float]:
        run, start, data = self._call
        begin = time.thread_time()
        solution = run.solve(start, data=data)
        return solution, 1e3 * (time.thread_time() - begin)


def sixteen() -> list[Unicycle]:
    """Those of the unicycle with horizons of 20 and 50."""
    return [Unicycle(*numbers) for numbers in itertools.product(STARTS, (False, True), HORIZONS)]


def problems() -> list[Problem]:
    """All twenty-four."""
    long, short = ("straight", "behind"), ("curve", "ahead")
    found: list[Problem] = [Unicycle(i, b, n) for i in long for b in (False, True) for n in (20, 50, 100)]
    found += [Unicycle(i, b, 50) for i in short for b in (False, True)]
    return found + [Quadrotor(i, b, n) for i in SPHERES for b in (False, True) for n in HORIZONS]


def blocked() -> list[Problem]:
    """The twelve with obstacles."""
    return [problem for problem in problems() if problem.blocked]
