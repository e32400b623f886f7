"""Model-predictive flight along a path that keeps off things by barriers (FactorMPC, eq. 4, 7, 12 to 19).

The plan is a factor graph: states and controls of a quadrotor with its loops, N steps ahead; where the path is, as
priors on the manifold; the dynamics and the limits of the controls as hard constraints. For every obstacle and every
step the clearance h, measured from the distance that is to be kept, may shrink by no more than its share
(:func:`unifg.models.barriers.decay`, held by :func:`unifg.models.keeping.keep`),

    h(x_{k+1}, t_{k+1}) >= exp(-alpha dt_k) h(x_k, t_k) - s_k

and what a step takes beyond that, its slack, is dear. With gamma > 0 the velocity-extended barrier is held as well. As
published, instead, a hinge asks at every node for h' + alpha h >= 0, h in 1/m, of an obstacle that rests in h' (eq. 19,
and eq. 22 for gamma > 0).

Slack that is used says which obstacle could not be kept off, and by how much. The speed is limited with a slack, too:
a vehicle that a gust made faster than allowed still has a plan, in which it slows down. A solve that ends with
constraints violated has found no plan; then the last one is flown on, for a while, and after that the vehicle brakes.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

import unifg as fg
from unifg.models import quadrotor, quadrotor_loops
from unifg.models.barriers import Barrier, Flow, accelerated, condition, decay, velocity_extended
from unifg.models.keeping import Form, Kept, keep
from unifg.scenarios.planning.flat_path import Flown
from unifg.scenarios.safety.flatness import FlatnessController, Gains, flat_flight
from unifg.scenarios.safety.weighing import Weighing
from unifg.scenarios.simulation.body_rate import Airframe
from unifg.solvers.names import backend
from unifg.typing import Array, BoolArray, IntArray

__all__ = ["TRACKING", "CbfMpc", "Decision", "KeeperSettings", "Obstacles", "Terminal"]

Reading: TypeAlias = Literal["decay", "published"]
Terminal: TypeAlias = Literal["none", "rest"]

FAR = 1e3  # where obstacles are that are not there [m]
PRICE = 1e5  # of violation: multipliers of squared slacks that are used grow with them
SLOWING = 3.0  # deceleration of a vehicle that is faster than it may be [m/s^2]
SPEEDING = 1e4  # weight of the squared slack of the speed [s^2/m^2]
KEPT = 1e-3  # violation of constraints up to which an answer is a plan
TRIES = 3  # ticks in a row without a plan until the search begins anew
ON = 0.2  # how long the last plan is flown on [s]
INSIDE = 1e-3  # deeper than this within the distance to be kept is too near [m]
PULL = 0.02, 0.05  # how far a plan may move mass, relative, and drag [kg/s] from where the past alone puts them
FIERCE = 6.0  # greatest acceleration along each axis of the world in braking [m/s^2]


@dataclass(frozen=True)
class KeeperSettings:
    """Numbers of the controller. Weights multiply half the square of an error.

    Attributes:
        horizon: steps N.
        step: greatest length of a step [s].
        growth: how much longer a step is than the one before it, the first being as long as a tick; infinite where all
            but the first have the greatest length.
        slots: obstacles that are looked at: those that the last plan, or a vehicle that brakes, comes nearest to.
        alpha: rate at which a clearance may shrink [1/s].
        gamma: of the velocity in a second barrier, none if zero [s]; as published [s/m^2].
        reading: "decay" from node to node, or the hinge on h' + alpha h as it is "published".
        form: of the barriers by decay.
        terminal: where a plan has to end: anywhere, or at rest.
        position, attitude, velocity: weights at each node [1/m^2, 1, s^2/m^2], in proportion to the step before it and
            as they are for one of the greatest length.
        rate, thrust: weights of the controls less those of the path in each step [s^2, 1/N^2], alike.
        rate_change, thrust_change: weights of their changes from step to step.
        speed: greatest speed [m/s].
        slack: its weight; None for that of the form.
        hinge: weight of the squared hinge [s^2 m^2], as published without one.
        tolerance: of the KKT test.
        settled: whether every plan is solved to its tolerance; or one step of the interior point is made per tick, and
            more of them only while the plan violates the constraints.
        iterations: most of a solve with a warm start.
        budget: wall-clock time of a solve [s]; a finite one makes a flight depend on the machine.
    """

    horizon: int = 20
    step: float = 0.05
    growth: float = np.inf
    slots: int = 5
    alpha: float = 1.2
    gamma: float = 0.0
    reading: Reading = "decay"
    form: Form = "slack"
    terminal: Terminal = "none"
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
    tolerance: float = 1e-4
    settled: bool = False
    iterations: int = 10
    budget: float = np.inf


TRACKING = KeeperSettings(
    position=180.0, attitude=5e-3, velocity=2.7, rate=2.9e-5, thrust=8.3e-5, rate_change=1.3e-6, thrust_change=3.7e-5,
    tolerance=1e-5, settled=True,
)  # fmt: skip
"""Weights for flights with nothing in the way, found by a search on a flight that appears in no table.

They make controls cheap, which is what following a path closely takes; among obstacles, where the path may lie inside
of things, they do harm. What they weigh are millimetres: a plan that is stopped after one step is off by a good part of
what noise and gusts leave.
"""


@dataclass(frozen=True)
class Obstacles:
    """What is seen of M obstacles at one time.

    Attributes:
        position, velocity: (M, 3) [m, m/s].
        keep: (M,) distance of the vehicle's centre to be kept from each centre or axis [m].
        upright: (M,) cylinders.
        falls: (M,) thrown balls.
        doubt: (M, 3) what k standard deviations of the distance are, squared: at once, times the time, and times its
            square [m^2, m^2/s, m^2/s^2]; None for obstacles whose place and velocity are known.
    """

    position: Array
    velocity: Array
    keep: Array
    upright: BoolArray
    falls: BoolArray
    doubt: Array | None = None

    @property
    def doubts(self) -> Array:
        """(M, 3) of :attr:`doubt`, zeros where there is none."""
        return np.zeros((len(self.keep), 3)) if self.doubt is None else self.doubt

    def off(self, later: Array) -> Array:
        """(n, M) distance to be kept ``later`` (n,) [s], with what is uncertain [m]."""
        t = later[:, None, None] ** np.arange(3)
        kept: Array = self.keep + np.sqrt(np.sum(self.doubts * t, axis=2))
        return kept

    def at(self, later: Array) -> Array:
        """(n, M, 3) where they are expected ``later`` (n,) [s]: at constant velocity, or falling."""
        t = later[:, None, None]
        down = np.array([0.0, 0.0, -quadrotor.GRAVITY]) * self.falls[:, None]
        found: Array = self.position + self.velocity * t + 0.5 * down * t * t
        return found

    def clearance(self, places: Array, later: Array) -> Array:
        """(n, M) distances of places (n, 3) from where they are expected ``later`` (n,), beyond what is to be kept."""
        away = places[:, None, :] - self.at(later)
        away[:, self.upright, 2] = 0.0
        beyond: Array = np.linalg.norm(away, axis=2) - self.off(later)
        return beyond

    def nearest(self, place: Array, count: int, later: float = 0.0) -> Obstacles:
        """The ``count`` nearest to a place (3,) some seconds later, with others far away if there are fewer."""
        order = np.argsort(self.clearance(place[None], np.array([later]))[0], kind="stable")[:count]
        return self.these(order, count)

    def these(self, order: IntArray, count: int) -> Obstacles:
        """Some of them, in an order; with others far away if there are fewer than ``count``."""
        every: tuple[Any, ...] = self.position, self.velocity, self.keep, self.upright, self.falls, self.doubts
        parts = [part[order] for part in every]
        missing = count - len(order)
        if not missing:
            return Obstacles(*parts)
        far, none, one = np.full((missing, 3), FAR), np.zeros((missing, 3)), np.ones(missing)
        blank = far, none, one, one < 0.0, one < 0.0, none
        return Obstacles(*(np.concatenate([p, b]) for p, b in zip(parts, blank, strict=True)))


@dataclass(frozen=True)
class Decision:
    """Of one tick.

    Attributes:
        control: (4,) to be told.
        plan: (k, 3) where the vehicle is expected to go [m].
        status: of the solve, in words; "too near" where the plan comes nearer to an obstacle than it is to, "last plan"
            and "braking" where the solve found none.
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


def apart(p: Array, centre: Array, keep: Array, flat: Array) -> Array:
    """(n, M) distance of p (n, 3) from centres (M, 3) or (n, M, 3) beyond what is to be kept; see :func:`clearance`."""
    away = (p[:, None, :] - centre) * flat
    distance: Array = np.sqrt((away * away).sum(axis=2)) - keep
    return distance


_MOVING = accelerated(apart, many=True)


def expected(p: Array, t: Array, *seen: Array) -> Array:
    """(n, M) the same of :func:`clearance` where nothing is in doubt: how fast this grows is how fast they part."""
    return _MOVING(p, t, *seen[:-1])


def clearance(
    p: Array, t: Array, centre: Array, velocity: Array, fall: Array, keep: Array, flat: Array, doubt: Array
) -> Array:
    """(n, M) distance beyond what is to be kept from what goes straight on, or falls, and is not quite known [m].

    Args:
        p: (n, 3) positions [m].
        t: (n,) when, counted from when the obstacles were seen [s].
        centre: (M, 3) where they were then [m].
        velocity: (M, 3) [m/s].
        fall: (M, 3) acceleration of those that fall [m/s^2].
        keep: (M,) distance to be kept [m].
        flat: (M, 3) ones, with a zero at the height of upright cylinders.
        doubt: (M, 3) as :attr:`Obstacles.doubt`.
    """
    s = np.reshape(t, (-1, 1))
    unsure = np.sqrt(doubt[:, 0] + s * doubt[:, 1] + s * s * doubt[:, 2])
    left: Array = _MOVING(p, t, centre, velocity, fall, keep, flat) - unsure
    return left


def inverse_clearance(
    p: Array, t: Array, centre: Array, velocity: Array, fall: Array, keep: Array, *rest: Any
) -> Array:
    """(n, M) ``1/keep - 1/distance`` of the same [1/m] (eq. 15)."""
    found: Array = 1.0 / keep - 1.0 / (keep + clearance(p, t, centre, velocity, fall, keep, *rest))
    return found


def slower(v: Array, limit: Array) -> Array:
    """(n, 1) by how much a velocity (n, 3) is slower than a limit (n,), to first order near it [m/s]."""
    most = np.reshape(limit, (-1, 1))
    left: Array = (most * most - np.sum(v * v, axis=1, keepdims=True)) / (2.0 * most)
    return left


class CbfMpc:
    """Plans anew at each tick.

    Attributes:
        settings: the numbers.
        airframe: as it is believed.
        nodes: when the nodes of a plan are, from its begin [s].
        states: (N + 1, 17) of the last plan; None before there is one.
    """

    def __init__(
        self,
        settings: KeeperSettings,
        airframe: Airframe,
        dt: float,
        weighing: Weighing | None = None,
        solver: str = "ipm",
    ) -> None:
        """State the graph.

        Args:
            settings: the numbers.
            airframe: as it is believed; its mass and drag where they are not estimated. Loops of an infinite gain are
                none.
            dt: length of a tick [s].
            weighing: the past that says what the vehicle weighs, a part of the same graph; None to believe.
            solver: one of `unifg.solvers.names.CONSTRAINED`.
        """
        self.settings, self.airframe = settings, airframe
        s = settings
        self._weighing, self._dt = weighing, dt
        n = s.horizon
        steps = np.full(n, s.step)
        with np.errstate(over="ignore"):
            steps = np.minimum(steps, dt * s.growth ** np.arange(n))
        self.nodes = np.concatenate([[0.0], np.cumsum(steps)])
        graph = fg.Graph()
        self.x = x = graph.variables("state", quadrotor_loops.STATE, n + 1)
        self.u = u = graph.variables("control", quadrotor.CONTROL, n)
        self.mass, self.drag = graph.variables("mass", quadrotor.MASS, 1), graph.variables("drag", quadrotor.DRAG, 1)
        self._start = graph.data("start", quadrotor_loops.STATE.identity())
        graph.fix(x[0], self._start)
        self._by_the_past: tuple[fg.Data, ...] = ()
        if weighing is None:
            graph.fix(self.mass, [airframe.parameters.mass], name="given mass")
            graph.fix(self.drag, airframe.parameters.drag, name="given drag")
        else:
            weighing.state(graph, self.mass, self.drag)
            mass, drag = self._believed_numbers()
            self._by_the_past = graph.data("mass by the past", mass), graph.data("drag by the past", drag)
            mass_pull = PULL[0] * airframe.parameters.mass
            for what, past, pull in zip((self.mass, self.drag), self._by_the_past, (mass_pull, PULL[1]), strict=True):
                graph.constrain(fg.prior, what, past, lower=-pull, upper=pull, name=f"pull of {what.name}")
        ahead, share = x[1:], (steps / s.step)[:, None]
        weights = {"p": s.position, "R": s.attitude, "v": s.velocity}
        self._wanted = {}
        for part, weight in weights.items():
            rest = getattr(ahead, part)
            self._wanted[part] = data = graph.data(
                f"wanted {part}", np.tile(rest.manifold.identity(), (n, 1)), each=True
            )
            sigma = np.broadcast_to((weight * share) ** -0.5, (n, 3))
            graph.minimize(fg.prior, rest, data, sigma=sigma, name=f"path {part}")
        self._effort = graph.data("wanted controls", np.zeros((n, 4)), each=True)
        self._last = graph.data("last control", np.zeros(4))
        self._gust = graph.data("gust", np.zeros((n, 3)), each=True)
        effort, change = (
            np.array([a, a, a, b]) ** -0.5 for a, b in ((s.rate, s.thrust), (s.rate_change, s.thrust_change))
        )
        graph.minimize(fg.prior, u, self._effort, sigma=effort * share**-0.5, name="effort")
        graph.minimize(fg.prior, u[0], self._last, sigma=change, name="first change")
        graph.minimize(fg.difference, u[:-1], u[1:], sigma=change, name="change")
        loops = airframe.loops
        held = quadrotor_loops.held(loops.gain, loops.lag, steps)
        motion = x[:-1], u, self.mass, self.drag, self._gust, ahead, steps, held
        graph.constrain(quadrotor_loops.defect, *motion, lower=0.0, upper=0.0, name="dynamics")
        graph.bound(u, lower=airframe.least, upper=airframe.most, name="limits")
        self._allowed = graph.data("allowed speed", np.full(n, s.speed), each=True)
        self._speed = keep(graph, slower, ahead.v, self._allowed, obstacles=["speed"], weight=SPEEDING, name="speed")
        if s.terminal == "rest":
            graph.bound(x[-1].v, lower=0.0, upper=0.0, name="rest")
        self.kept: list[Kept] = []
        if s.slots:
            self._state_barriers(graph, steps)
        self.graph = graph
        early = {"step_tolerance": np.inf} if solver == "ipm" and not s.settled else {}
        dear = {"penalty": PRICE} if solver == "ipm" else {}
        self._cold = backend(solver, tolerance=s.tolerance, **dear, **early).prepare(graph)
        hurried = backend(
            solver, tolerance=s.tolerance, time_limit=s.budget, max_iterations=s.iterations, **dear, **early
        )
        self._warm = hurried.prepare(graph)
        self._guess: fg.Guess | None = None
        self._applied = quadrotor.hover(airframe.parameters)
        self.states: Array | None = None
        self._plan: tuple[Array, Array] | None = None  # places and controls of the last plan
        self._age = 0  # of it [ticks]
        self._looked_at: list[int] = []
        self._brakes = FlatnessController(Gains(), airframe.least, airframe.most)

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
            "doubt": blank,
        }
        self._seen = {name: graph.data(name, value) for name, value in things.items()}
        seen = tuple(self._seen.values())
        if s.reading == "published":
            h: Barrier = inverse_clearance
            lost = _of_states(h)
            held = velocity_extended(h, expected, s.gamma) if s.gamma > 0.0 else lost
            asked = condition(held, s.alpha, quadrotor_loops.STATE, _flow(self.airframe), as_published=True, lost=lost)
            self.kept = [
                keep(graph, asked, x[:-1], self.u, self._since, *seen, obstacles=m, form="hinge", weight=s.hinge)
            ]
            return
        ends = x[:-1].p, x[1:].p, self._since, steps, *seen
        self.kept = [keep(graph, decay(clearance, s.alpha), *ends, obstacles=m, form=s.form, weight=s.slack)]
        if s.gamma > 0.0:
            held = velocity_extended(clearance, expected, s.gamma)
            states = x[:-1], x[1:], self._since, steps, *seen
            name = "velocity barrier"
            self.kept.append(
                keep(graph, decay(held, s.alpha), *states, obstacles=m, form=s.form, weight=s.slack, name=name)
            )

    def decide(self, start: Array, flown: Flown, obstacles: Obstacles, later: float, gust: Array) -> Decision:
        """Plan.

        Args:
            start: (17,) state with loops in which the command of this tick begins to act.
            flown: the path at the nodes of the plan.
            obstacles: as they were seen.
            later: how much later the plan begins than they were [s].
            gust: (N, 3) acceleration by the air that is expected in each step [m/s^2].
        """
        begin = time.thread_time()
        s = self.settings
        states, controls = flat_flight(flown, self.believed)
        data: dict[fg.Data, Array] = {
            self._start: start, self._last: self._applied, self._effort: controls[:-1], self._gust: gust,
        }  # fmt: skip
        data[self._allowed] = np.maximum(s.speed, np.linalg.norm(start[7:10]) - SLOWING * self.nodes[1:])
        for name, place in (("p", slice(0, 3)), ("R", slice(3, 7)), ("v", slice(7, 10))):
            data[self._wanted[name]] = states[1:, place]
        if self._weighing is not None:
            data |= self._weighing.data() | dict(zip(self._by_the_past, self._believed_numbers(), strict=True))
        if s.slots:
            near = obstacles.these(self._nearest(start, obstacles, later), s.slots)
            flat = np.ones((s.slots, 3))
            flat[near.upright, 2] = 0.0
            fall = np.array([0.0, 0.0, -quadrotor.GRAVITY]) * near.falls[:, None]
            given = near.position, near.velocity, fall, near.keep, flat, near.doubts
            data |= {self._since: later + self.nodes[:-1], **dict(zip(self._seen.values(), given, strict=True))}
        first, guess = self._plan is None, self._guess
        if guess is None:
            if not first:
                states, controls = flat_flight(_braked(start, self.nodes), self.believed)
            guess = self._begun(start, states, controls)
        solution = (self._cold if first else self._warm).solve(guess, data=data)
        numbers = solution[self.x], solution[self.u]
        found = all(np.isfinite(part).all() for part in numbers) and solution.violation < KEPT
        status, slack = solution.status.name.lower(), 0.0
        if found:
            self.states = numbers[0]
            self._plan, self._age, self._guess = (
                (numbers[0][:, :3], numbers[1]),
                0,
                solution.shifted(self.x, self.u, by=0),
            )
            slack = max((use.amount for kept in self.kept for use in kept.used(solution)), default=0.0)
            if len(obstacles.keep) and obstacles.clearance(self._plan[0], later + self.nodes).min() < -INSIDE:
                status = "too near"
        else:
            self._age += 1
            # Nearer than before, or never: what was begun is ended in the next tick, and after a few begun anew.
            on = self._guess is not None and all(np.isfinite(part).all() for part in numbers) and self._age % TRIES
            self._guess = solution.shifted(self.x, self.u, by=0) if on else None
        control, plan = self._flown(start)
        if not found:
            status = "braking" if self._plan is None or self._age * self._dt > ON else "last plan"
        self._applied = control
        spent = 1e3 * (time.thread_time() - begin)
        p = self.believed if not found else None
        mass, drag = (p.mass, np.array(p.drag)) if p else (float(solution[self.mass][0, 0]), solution[self.drag][0])
        return Decision(control, plan, status, solution.iterations, slack, mass, drag, spent)

    def _nearest(self, start: Array, obstacles: Obstacles, later: float) -> IntArray:
        """Which obstacles are looked at; one that was looked at before keeps its place, and so its multipliers."""
        ways = [_braked(start, self.nodes).position, *([] if self._plan is None else [self._plan[0]])]
        near = np.min([obstacles.clearance(way, later + self.nodes).min(axis=0) for way in ways], axis=0)
        wanted = np.argsort(near, kind="stable")[: self.settings.slots]
        fresh = [k for k in wanted.tolist() if k not in self._looked_at]
        kept = [k if k in wanted else fresh.pop(0) for k in self._looked_at]
        self._looked_at = kept + fresh
        return np.array(self._looked_at, dtype=np.intp)

    def _flown(self, start: Array) -> tuple[Array, Array]:
        """Control and places of the last plan at its age; of braking where it is too old."""
        age = self._age * self._dt
        if self._plan is None or age > ON:
            level = np.clip(-np.array(Gains().velocity)[[0, 0, 1]] * start[7:10], -FIERCE, FIERCE)
            return self._brakes.steer(start[:10], level, np.zeros(3), self.believed), np.tile(
                start[:3], (len(self.nodes), 1)
            )
        step = int(np.searchsorted(self.nodes, age + 0.5 * self._dt)) - 1
        return np.clip(self._plan[1][step], self.airframe.least, self.airframe.most), self._plan[0]

    def _begun(self, start: Array, states: Array, controls: Array) -> fg.Guess:
        """A first guess: as if the vehicle flew like that (n, 10), (n, 4) from its second node on."""
        looped = np.concatenate([states, controls[:, :3], np.zeros((len(states), 3)), controls[:, 3:]], axis=1)
        looped[0] = start
        values = {self.x: looped, self.u: controls[:-1], **self._parameters(), **self._speed.guess()}
        for kept in self.kept:
            values |= kept.guess()
        return fg.Guess(values)

    @property
    def believed(self) -> quadrotor.Parameters:
        """Mass and drag as the past says."""
        return self.airframe.parameters if self._weighing is None else self._weighing.believed

    def _believed_numbers(self) -> tuple[Array, Array]:
        """(1,) mass and (3,) drag by the past alone."""
        p = self.believed
        return np.array([p.mass]), np.array(p.drag)

    def _parameters(self) -> dict[fg.Family, Array]:
        if self._weighing is None:
            return {}
        mass, drag = self._believed_numbers()
        return {self.mass: mass[None], self.drag: drag[None]}


def _braked(start: Array, times: Array) -> Flown:
    """The way of a vehicle that slows down evenly to rest."""
    place, velocity = start[:3], start[7:10]
    rest = max(float(np.linalg.norm(velocity)) / FIERCE, 1e-3)
    t = np.minimum(times, rest)[:, None]
    slowing = np.where(times[:, None] < rest, -velocity / rest, 0.0)
    return Flown(place + velocity * (t - 0.5 * t * t / rest), velocity * (1.0 - t / rest), slowing, 0.0 * slowing)


def _of_states(h: Barrier) -> Barrier:
    """A barrier on positions as one on states."""
    place = quadrotor.STATE.component("p").storage

    def of_states(x: Array, t: Any, *obstacle: Any) -> Array:
        return h(x[:, place], t, *obstacle)

    return of_states


def _flow(airframe: Airframe) -> Flow:
    """F of the vehicle without wind."""
    books, loops = airframe.parameters, airframe.loops
    mass, drag = np.array([[books.mass]]), np.array([books.drag])

    def flow(x: Array, u: Array) -> Array:
        return quadrotor_loops.field(x, u, mass, drag, np.zeros((1, 3)), loops.gain, loops.lag)

    return flow
