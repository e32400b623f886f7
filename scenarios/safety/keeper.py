"""Model-predictive flight along a path that keeps off things by barriers (FactorMPC, eq. 4, 7, 12 to 19).

The plan is a factor graph: states and controls of a quadrotor, N steps ahead; where the path is, as priors on the
manifold; the dynamics and the limits of the controls as hard constraints. For every obstacle and every step the
clearance h, measured from the distance that is to be kept, may shrink by no more than its share
(:func:`unifg.models.barriers.decay`, held by :func:`unifg.models.keeping.keep`),

    h(x_{k+1}, t_{k+1}) >= exp(-alpha dt_k) h(x_k, t_k) - s_k

and what a step takes beyond that, its slack, is dear. With gamma > 0 the velocity-extended barrier is held as well. As
published, instead, a hinge asks at every node for h' + alpha h >= 0, h in 1/m, of an obstacle that rests in h' (eq. 19,
and eq. 22 for gamma > 0).

Slack that is used says which obstacle could not be kept off, and by how much.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

import unifg as fg
from unifg.models import quadrotor
from unifg.models.barriers import Barrier, Flow, condition, decay, velocity_extended
from unifg.models.keeping import Form, Kept, grid, keep
from unifg.scenarios.safety.flatness import flat_flight
from unifg.scenarios.safety.weighing import Weighing
from unifg.scenarios.ways.flat_path import FlatPath
from unifg.scenarios.worlds.body_rate import Airframe
from unifg.solvers.names import backend
from unifg.typing import Array, BoolArray

__all__ = ["TRACKING", "Decision", "Keeper", "KeeperSettings", "Obstacles"]

Reading: TypeAlias = Literal["decay", "published"]

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
        gamma: of the velocity in a second barrier, none if zero [s]; as published [s/m^2].
        reading: "decay" from node to node, or the hinge on h' + alpha h as it is "published".
        form: of the barriers by decay.
        position, attitude, velocity: weights at each node [1/m^2, 1, s^2/m^2].
        rate, thrust: weights of the controls less those of the path in each step [s^2, 1/N^2].
        rate_change, thrust_change: weights of their changes from step to step.
        speed: greatest velocity along each axis of the world [m/s].
        slack: its weight; None for that of the form.
        hinge: weight of the squared hinge [s^2 m^2], as published without one.
        iterations: most of a solve with a warm start.
        budget: wall-clock time of a solve [s]; a finite one makes a flight depend on the machine.
    """

    horizon: int = 20
    step: float = 0.05
    slots: int = 3
    alpha: float = 1.2
    gamma: float = 0.0
    reading: Reading = "decay"
    form: Form = "slack"
    position: float = 20.0
    attitude: float = 2.0
    velocity: float = 2.0
    rate: float = 0.1
    thrust: float = 0.05
    rate_change: float = 0.02
    thrust_change: float = 0.01
    speed: float = 4.0
    slack: float | None = None
    hinge: float = 1e4
    iterations: int = 10
    budget: float = np.inf


TRACKING = KeeperSettings(
    position=60.0, attitude=5.4e-3, velocity=0.12, rate=2.5e-6, thrust=1.1e-5, rate_change=4e-5, thrust_change=2e-5
)
"""Weights for flights with nothing in the way; ``python -m benchmarks.flight_tuning --controller barrier`` finds them.

They make controls cheap, which is what following a path closely takes; among obstacles, where the path may lie inside
of things, they do harm.
"""


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

    def nearest(self, place: Array, count: int, later: float = 0.0) -> Obstacles:
        """The ``count`` nearest to a place (3,) some seconds later, with others far away if there are fewer."""
        away = self.at(np.array([later]))[0] - place
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


def clearance(p: Array, t: Array, centre: Array, velocity: Array, fall: Array, keep: Array, flat: Array) -> Array:
    """(n, M) distance beyond what is to be kept from what goes straight on, or falls [m].

    Args:
        p: (n, 3) positions [m].
        t: (n,) when, counted from when the obstacles were seen [s].
        centre: (M, 3) where they were then [m].
        velocity: (M, 3) [m/s].
        fall: (M, 3) acceleration of those that fall [m/s^2].
        keep: (M,) distance to be kept [m].
        flat: (M, 3) ones, with a zero at the height of upright cylinders.
    """
    s = np.reshape(t, (-1, 1, 1))
    away = (p[:, None, :] - centre - s * velocity - 0.5 * s * s * fall) * flat
    distance: Array = np.sqrt((away * away).sum(axis=2)) - keep
    return distance


def inverse_clearance(
    p: Array, t: Array, centre: Array, velocity: Array, fall: Array, keep: Array, flat: Array
) -> Array:
    """(n, M) ``1/keep - 1/distance`` of the same [1/m] (eq. 15)."""
    found: Array = 1.0 / keep - 1.0 / (keep + clearance(p, t, centre, velocity, fall, keep, flat))
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
        n = s.horizon
        begins, steps = grid(n, dt, s.step)
        self.nodes = np.append(begins, begins[-1] + steps[-1])
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
        self.kept: list[Kept] = []
        if s.slots:
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
        s, x, m = self.settings, self.x, self.settings.slots
        self._since = graph.data("since", self.nodes[:-1], each=True)
        blank = np.zeros((m, 3))
        things = {
            "centre": np.full((m, 3), FAR),
            "velocity": blank,
            "fall": blank,
            "keep": np.ones(m),
            "flat": blank + 1.0,
        }
        self._seen = {name: graph.data(name, value) for name, value in things.items()}
        seen = tuple(self._seen.values())
        if s.reading == "published":
            h: Barrier = inverse_clearance
            lost = _of_states(h)
            held = velocity_extended(h, clearance, s.gamma) if s.gamma > 0.0 else lost
            flow = _flow(self.airframe.parameters)
            asked = condition(held, s.alpha, quadrotor.STATE, flow, as_published=True, lost=lost)
            self.kept = [
                keep(graph, asked, x[:-1], self.u, self._since, *seen, obstacles=m, form="hinge", weight=s.hinge)
            ]
            return
        ends = x[:-1].p, x[1:].p, self._since, steps, *seen
        self.kept = [keep(graph, decay(clearance, s.alpha), *ends, obstacles=m, form=s.form, weight=s.slack)]
        if s.gamma > 0.0:
            held = velocity_extended(clearance, clearance, s.gamma)
            states = x[:-1], x[1:], self._since, steps, *seen
            name = "velocity barrier"
            self.kept.append(
                keep(graph, decay(held, s.alpha), *states, obstacles=m, form=s.form, weight=s.slack, name=name)
            )

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
            near = obstacles.nearest(state[:3], s.slots, now - seen)
            flat = np.ones((s.slots, 3))
            flat[near.upright, 2] = 0.0
            fall = np.array([0.0, 0.0, -quadrotor.GRAVITY]) * near.falls[:, None]
            given = near.position, near.velocity, fall, near.keep, flat
            data |= {self._since: now - seen + self.nodes[:-1], **dict(zip(self._seen.values(), given, strict=True))}
        guess, run = self._guess, self._warm
        if guess is None:
            states[0] = state
            values = {self.x: states, self.u: controls[:-1], **self._parameters()}
            for kept in self.kept:
                values |= kept.guess()
            guess, run = fg.Guess(values), self._cold
        solution = run.solve(guess, data=data)
        usable = bool(np.isfinite(solution[self.u]).all())
        self._guess = solution.shifted(self.x, self.u, by=0) if usable else None
        control = np.clip(solution[self.u][0] if usable else self._applied, self.airframe.least, self.airframe.most)
        self._applied = control
        slack = max((use.amount for kept in self.kept for use in kept.used(solution)), default=0.0)
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


def _of_states(h: Barrier) -> Barrier:
    """A barrier on positions as one on states."""
    place = quadrotor.STATE.component("p").storage

    def of_states(x: Array, t: Any, *obstacle: Any) -> Array:
        return h(x[:, place], t, *obstacle)

    return of_states


def _flow(parameters: quadrotor.Parameters) -> Flow:
    """F of the vehicle without noise."""
    mass, *rest = parameters.packed.tolist()
    drag, wind, updraft = (np.array([part]) for part in (rest[:3], rest[3:5], rest[5:]))

    def flow(x: Array, u: Array) -> Array:
        return quadrotor.field(x, u, np.zeros((1, 6)), np.array([[mass]]), drag, wind, updraft)

    return flow
