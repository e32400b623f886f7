"""Model-predictive flight along a path that keeps off things by barriers (FactorMPC, eq. 4, 7, 12 to 19).

The plan is a factor graph: states and controls of a quadrotor, N steps ahead; where the path is, as priors on the
manifold; the dynamics and the limits of the controls as hard constraints. For every obstacle and every step the
clearance h, measured from the distance that is to be kept, may shrink by no more than its share,

    h(x_{k+1}) >= exp(-alpha dt_k) h(x_k) - s_k,    s_k >= 0

and what a step takes beyond that, its slack, is dear. The obstacle's own motion is in h, for h is taken at the node's
time. Ticks are shorter than steps: were the first step as long as the others, all it may lose could be lost in the
first tick, and again in the next; so the first step is one tick long.

Slack that is used says which obstacle could not be kept off, and by how much.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

import unifg as fg
from unifg.models import quadrotor
from unifg.scenarios.safety.flatness import flat_flight
from unifg.scenarios.safety.weighing import Weighing
from unifg.scenarios.ways.flat_path import FlatPath
from unifg.scenarios.worlds.body_rate import Airframe
from unifg.solvers.names import backend
from unifg.typing import Array, BoolArray

__all__ = ["Decision", "Keeper", "KeeperSettings", "Obstacles"]

Price: TypeAlias = Literal["squared", "exact"]

TOLERANCE = 1e-4  # of the KKT test, in a loop that goes on
FAR = 1e3  # where obstacles are that are not there [m]


@dataclass(frozen=True)
class KeeperSettings:
    """Numbers of the controller. Weights multiply half the square of an error.

    Attributes:
        horizon: steps N.
        step: length of all steps but the first [s].
        slots: obstacles that are looked at, the nearest first.
        alpha: rate at which a clearance may shrink [1/s].
        position, attitude, velocity: weights at each node [1/m^2, 1, s^2/m^2].
        rate, thrust: weights of the controls less those of the path in each step [s^2, 1/N^2].
        rate_change, thrust_change: weights of their changes from step to step.
        speed: greatest velocity along each axis of the world [m/s].
        price: of slack: "squared", or "exact", which is a multiple of the slack itself.
        slack: weight of its square [1/m^2], or the multiple [1/m].
        iterations: most of a solve with a warm start.
        budget: wall-clock time of a solve [s]; a finite one makes a flight depend on the machine.
    """

    horizon: int = 20
    step: float = 0.05
    slots: int = 3
    alpha: float = 1.2
    position: float = 20.0
    attitude: float = 2.0
    velocity: float = 2.0
    rate: float = 0.1
    thrust: float = 0.05
    rate_change: float = 0.02
    thrust_change: float = 0.01
    speed: float = 4.0
    price: Price = "squared"
    slack: float = 1e6
    iterations: int = 10
    budget: float = np.inf


@dataclass(frozen=True)
class Obstacles:
    """What is seen of M obstacles at one time.

    Attributes:
        position, velocity: (M, 3) [m, m/s].
        keep: (M,) distance of the vehicle's centre to be kept from each centre or axis [m].
        upright: (M,) cylinders.
        falls: (M,) thrown balls.
    """

    position: Array
    velocity: Array
    keep: Array
    upright: BoolArray
    falls: BoolArray

    def at(self, later: Array) -> Array:
        """(n, M, 3) where they are expected ``later`` (n,) [s]: at constant velocity, or falling."""
        t = later[:, None, None]
        down = np.array([0.0, 0.0, -quadrotor.GRAVITY]) * self.falls[:, None]
        found: Array = self.position + self.velocity * t + 0.5 * down * t * t
        return found

    def nearest(self, place: Array, count: int) -> Obstacles:
        """The ``count`` nearest to a place (3,), with others far away if there are fewer."""
        away = self.position - place
        away[self.upright, 2] = 0.0
        order = np.argsort(np.linalg.norm(away, axis=1) - self.keep, kind="stable")[:count]
        parts = self.position[order], self.velocity[order], self.keep[order], self.upright[order], self.falls[order]
        missing = count - len(order)
        if not missing:
            return Obstacles(*parts)
        blank = np.full((missing, 3), FAR), np.zeros((missing, 3)), np.ones(missing), np.zeros(missing, dtype=bool)
        return Obstacles(*(np.concatenate([p, b]) for p, b in zip(parts, (*blank, blank[3]), strict=True)))


@dataclass(frozen=True)
class Decision:
    """Of one tick.

    Attributes:
        control: (4,) to be told.
        plan: (k, 3) where the vehicle is expected to go [m].
        status: of the solve, in words.
        iterations: of it.
        slack: greatest slack in the plan [m].
        mass: as it is believed [kg].
        drag: as it is believed [kg/s].
        milliseconds: processor time of the decision.
    """

    control: Array
    plan: Array
    status: str
    iterations: int
    slack: float
    mass: float
    drag: Array
    milliseconds: float


def barrier(
    p: Array, after: Array, slack: Array, here: Array, there: Array, keep: Array, flat: Array, left: Array
) -> Array:
    """(n, M) what is left of clearances after a step, less what must be, plus slack [m].

    Args:
        p: (n, 3) positions at the beginning [m].
        after: (n, 3) at the end [m].
        slack: (n, M) [m].
        here: (n, M, 3) where the obstacles are at the beginning [m].
        there: (n, M, 3) at the end [m].
        keep: (M,) distance to be kept [m].
        flat: (M, 3) ones, with a zero at the height of upright cylinders.
        left: (n,) share of the clearance that must be left.
    """

    def clearance(p: Array, c: Array) -> Array:
        away = (p[:, None, :] - c) * flat
        distance: Array = np.sqrt((away * away).sum(axis=2)) - keep
        return distance

    found: Array = clearance(after, there) - left[:, None] * clearance(p, here) + slack
    return found


class Keeper:
    """Plans anew at each tick.

    Attributes:
        settings: the numbers.
        airframe: as it is believed.
        path: to be followed.
    """

    def __init__(
        self,
        settings: KeeperSettings,
        airframe: Airframe,
        path: FlatPath,
        dt: float,
        weighing: Weighing | None = None,
        solver: str = "ipm",
    ) -> None:
        """State the graph.

        Args:
            settings: the numbers.
            airframe: as it is believed; its mass and drag where they are not estimated.
            path: to be followed.
            dt: length of a tick [s].
            weighing: the past that says what the vehicle weighs, a part of the same graph; None to believe.
            solver: one of `unifg.solvers.names.CONSTRAINED`.
        """
        self.settings, self.airframe, self.path = settings, airframe, path
        s = settings
        self._weighing = weighing
        n, m = s.horizon, s.slots
        steps = np.full(n, s.step)
        steps[0] = dt
        self.nodes = np.concatenate([[0.0], np.cumsum(steps)])
        graph = fg.Graph()
        self.x = x = graph.variables("state", quadrotor.STATE, n + 1)
        self.u = u = graph.variables("control", quadrotor.CONTROL, n)
        self.mass, self.drag = graph.variables("mass", quadrotor.MASS, 1), graph.variables("drag", quadrotor.DRAG, 1)
        self._start = graph.data("start", quadrotor.STATE.identity())
        graph.fix(x[0], self._start)
        if weighing is None:
            graph.fix(self.mass, [airframe.parameters.mass], name="given mass")
            graph.fix(self.drag, airframe.parameters.drag, name="given drag")
        else:
            weighing.state(graph, self.mass, self.drag)
        ahead = x[1:]
        weights = {"p": s.position, "R": s.attitude, "v": s.velocity}
        self._wanted = {}
        for part, weight in weights.items():
            rest = getattr(ahead, part)
            self._wanted[part] = data = graph.data(
                f"wanted {part}", np.tile(rest.manifold.identity(), (n, 1)), each=True
            )
            graph.minimize(fg.prior, rest, data, sigma=weight**-0.5, name=f"path {part}")
        self._effort = graph.data("wanted controls", np.zeros((n, 4)), each=True)
        self._last = graph.data("last control", np.zeros(4))
        effort, change = (
            np.array([a, a, a, b]) ** -0.5 for a, b in ((s.rate, s.thrust), (s.rate_change, s.thrust_change))
        )
        graph.minimize(fg.prior, u, self._effort, sigma=effort, name="effort")
        graph.minimize(fg.prior, u[0], self._last, sigma=change, name="first change")
        graph.minimize(fg.difference, u[:-1], u[1:], sigma=change, name="change")
        motion = x[:-1], u, np.zeros((n, 6)), self.mass, self.drag, np.zeros(2), np.zeros(1), ahead, steps
        graph.constrain(quadrotor.disturbed_dynamics, *motion, lower=0.0, upper=0.0, name="dynamics")
        graph.bound(u, lower=airframe.least, upper=airframe.most, name="limits")
        graph.bound(ahead.v, lower=-s.speed, upper=s.speed, name="speed")
        self.slack: fg.Family | None = None
        if m:
            self._state_barriers(graph, steps)
        self.graph = graph
        # One step of the interior point a tick, and more of them only while the plan violates the constraints.
        early = {"step_tolerance": np.inf} if solver == "ipm" else {}
        self._cold = backend(solver, tolerance=TOLERANCE).prepare(graph)
        hurried = backend(solver, tolerance=TOLERANCE, time_limit=s.budget, max_iterations=s.iterations, **early)
        self._warm = hurried.prepare(graph)
        self._guess: fg.Guess | None = None
        self._applied = quadrotor.hover(airframe.parameters)

    def _state_barriers(self, graph: fg.Graph, steps: Array) -> None:
        s, n, m = self.settings, self.settings.horizon, self.settings.slots
        self.slack = slack = graph.variables("slack", fg.Rn(m), n)
        far = np.full((n, m, 3), FAR)
        self._here, self._there = graph.data("here", far, each=True), graph.data("there", far, each=True)
        self._keep, self._flat = graph.data("keep", np.ones(m)), graph.data("flat", np.ones((m, 3)))
        left = np.exp(-s.alpha * steps)
        moved = self.x[:-1].p, self.x[1:].p, slack, self._here, self._there, self._keep, self._flat, left
        graph.constrain(barrier, *moved, lower=0.0, name="barrier")
        graph.bound(slack, lower=0.0, name="slack is positive")
        if s.price == "squared":
            graph.minimize(fg.prior, slack, np.zeros(m), sigma=s.slack**-0.5, name="slack")
        else:
            price = s.slack
            graph.minimize_scalar(lambda given: price * given.sum(axis=1), slack, name="slack")

    def decide(self, state: Array, now: float, obstacles: Obstacles, seen: float) -> Decision:
        """Plan.

        Args:
            state: (10,) in which the command of this tick begins to act.
            now: when that is [s].
            obstacles: as they were seen.
            seen: when that was [s].
        """
        begin = time.thread_time()
        s = self.settings
        states, controls = flat_flight(self.path.at(now + self.nodes), self.believed)
        data: dict[fg.Data, Array] = {self._start: state, self._last: self._applied, self._effort: controls[:-1]}
        for part, place in (("p", slice(0, 3)), ("R", slice(3, 7)), ("v", slice(7, 10))):
            data[self._wanted[part]] = states[1:, place]
        if self._weighing is not None:
            data |= self._weighing.data()
        if s.slots:
            near = obstacles.nearest(state[:3], s.slots)
            places = near.at(now - seen + self.nodes)
            flat = np.ones((s.slots, 3))
            flat[near.upright, 2] = 0.0
            data |= {self._here: places[:-1], self._there: places[1:], self._keep: near.keep, self._flat: flat}
        guess, run = self._guess, self._warm
        if guess is None:
            states[0] = state
            values = {self.x: states, self.u: controls[:-1], **self._parameters()}
            if self.slack is not None:
                values[self.slack] = np.full((s.horizon, s.slots), 1e-3)
            guess, run = fg.Guess(values), self._cold
        solution = run.solve(guess, data=data)
        usable = bool(np.isfinite(solution[self.u]).all())
        self._guess = solution.shifted(self.x, self.u, by=0) if usable else None
        control = np.clip(solution[self.u][0] if usable else self._applied, self.airframe.least, self.airframe.most)
        self._applied = control
        slack = float(solution[self.slack].max()) if self.slack is not None else 0.0
        spent = 1e3 * (time.thread_time() - begin)
        return Decision(
            control, solution[self.x][:, :3], solution.status.name.lower(), solution.iterations, slack,
            float(solution[self.mass][0, 0]), solution[self.drag][0], spent,
        )  # fmt: skip

    @property
    def believed(self) -> quadrotor.Parameters:
        """Mass and drag as the past says."""
        return self.airframe.parameters if self._weighing is None else self._weighing.believed

    def _parameters(self) -> dict[fg.Family, Array]:
        if self._weighing is None:
            return {}
        p = self.airframe.parameters
        return {self.mass: np.array([[p.mass]]), self.drag: np.array([p.drag])}
