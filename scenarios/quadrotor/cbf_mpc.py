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
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

import numpy as np

import unifg as fg
from unifg import horizon
from unifg.horizon import (
    Context,
    ControlCost,
    InitialGuesses,
    LastPlan,
    LastPlanThenBrake,
    RecedingHorizon,
    Robot,
    Term,
)
from unifg.models import quadrotor, quadrotor_loops
from unifg.models.barriers import Barrier, Flow, accelerated, condition, decay, velocity_extended
from unifg.models.keeping import Form, Kept, keep
from unifg.scenarios.options import AboveZero, AtLeastOne, Positive, Settings
from unifg.scenarios.planning.flat_path import Flown
from unifg.scenarios.planning.reference_cost import ReferenceCost
from unifg.scenarios.quadrotor.flatness import FlatnessController, Gains, flat_flight
from unifg.scenarios.quadrotor.slots import reassigned
from unifg.scenarios.quadrotor.weighing import Weighing
from unifg.scenarios.simulation.body_rate import Airframe
from unifg.solvers.names import backend
from unifg.typing import Array, ArrayLike, BoolArray, IntArray

__all__ = ["TRACKING", "WHOLE", "CbfMpc", "Decision", "KeeperSettings", "Obstacles", "Terminal"]

Reading: TypeAlias = Literal["decay", "published"]
Terminal: TypeAlias = Literal["none", "rest"]

FAR = 1e3  # where obstacles are that are not there [m]
PENALTY = 1e5  # of violation: multipliers of squared slacks that are used grow with them
SLOWING = 3.0  # deceleration of a vehicle that is faster than it may be [m/s^2]
SPEEDING = 1e4  # weight of the squared slack of the speed [s^2/m^2]
FEASIBLE = 1e-3  # violation of constraints up to which an answer is a plan
WHOLE = 10  # iterations of a solve that cannot be made in portions
TRIES = 3  # ticks in a row without a plan until the search begins anew
KEEP = 0.2  # how long the last plan is flown on [s]
INSIDE = 1e-3  # deeper than this within the distance to be kept is too near [m]
PULL = 0.02, 0.05  # how far a plan may move mass, relative, and drag [kg/s] from where the past alone puts them
BRAKING = 6.0  # greatest acceleration along each axis of the world in braking [m/s^2]


@dataclass(frozen=True)
class KeeperSettings(Settings):
    """Numbers of the controller. Weights multiply half the square of an error.

    Attributes:
        horizon: steps N.
        step: length of a step [s]; the first is no longer than a tick.
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
        portion: iterations of a tick; a solve that needs more goes on in the next ticks, which fly the last plan. None
            where every solve ends in its tick.
        iterations: most of a solve with a warm start.
        decide_ms: processor time of a decision [ms]; of ``portion`` as many iterations are made as fit. A tick in which
            none fits, or whose plan comes later, has the status "late": it flies the last plan, or brakes where that is
            too old. A finite one makes a flight depend on the machine.
    """

    horizon: AtLeastOne = 20
    step: Positive[float] = 0.05
    slots: int = 5
    alpha: Positive[float] = 1.2
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
    speed: Positive[float] = 4.0
    slack: Positive[float] | None = None
    hinge: float = 1e4
    tolerance: Positive[float] = 1e-4
    settled: bool = False
    portion: AtLeastOne | None = 4
    iterations: AtLeastOne = 20
    decide_ms: AboveZero[float] = np.inf


TRACKING = KeeperSettings(
    position=180.0, attitude=5e-3, velocity=2.7, rate=2.9e-5, thrust=8.3e-5, rate_change=1.3e-6, thrust_change=3.7e-5,
    tolerance=1e-6, settled=True, portion=None, iterations=10,
)  # fmt: skip
"""Weights for flights with nothing in the way, found by a search on a flight that appears in no table.

They make controls cheap, which is what following a path closely takes; among obstacles, where the path may lie inside
of things, they do harm. What they weigh are millimetres: a plan that is stopped after one step is off by a good part of
what noise and gusts leave.
"""


@dataclass(frozen=True)
class Obstacles:
    """Sightings of M obstacles at one time.

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

    @property
    def fall(self) -> Array:
        """(M, 3) acceleration of those that fall [m/s^2]."""
        return np.array([0.0, 0.0, -quadrotor.GRAVITY]) * self.falls[:, None]

    def off(self, later: Array) -> Array:
        """(n, M) distance to be kept ``later`` (n,) [s], with what is uncertain [m]."""
        t = later[:, None, None] ** np.arange(3)
        kept: Array = self.keep + np.sqrt(np.sum(self.doubts * t, axis=2))
        return kept

    def at(self, later: Array) -> Array:
        """(n, M, 3) where they are expected ``later`` (n,) [s]: at constant velocity, or falling."""
        t = later[:, None, None]
        return self.position + self.velocity * t + 0.5 * self.fall * t * t

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
            and "braking" where the solve found none, "late" where the time for a decision was over before.
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
    return _MOVING(p, t, centre, velocity, fall, keep, flat) - unsure


def inverse_clearance(
    p: Array, t: Array, centre: Array, velocity: Array, fall: Array, keep: Array, *rest: Any
) -> Array:
    """(n, M) ``1/keep - 1/distance`` of the same [1/m] (eq. 15)."""
    return 1.0 / keep - 1.0 / (keep + clearance(p, t, centre, velocity, fall, keep, *rest))


def slower(v: Array, limit: Array) -> Array:
    """(n, 1) by how much a velocity (n, 3) is slower than a limit (n,), to first order near it [m/s]."""
    most = np.reshape(limit, (-1, 1))
    left: Array = (most * most - np.sum(v * v, axis=1, keepdims=True)) / (2.0 * most)
    return left


class CbfMpc:
    """Plans anew at each tick, on a `RecedingHorizon` whose first step is a tick and whose others are longer.

    Attributes:
        settings: the numbers.
        airframe: as it is believed.
        nodes: times of the nodes of a plan, from its begin [s].
        loop: the prepared graph.
    """

    def __init__(
        self,
        settings: KeeperSettings,
        airframe: Airframe,
        dt: float,
        weighing: Weighing | None = None,
        solver: str = "ipm",
    ) -> None:
        """Prepare the graph.

        Args:
            settings: the numbers.
            airframe: as it is believed; its mass and drag where they are not estimated. Loops of an infinite gain are
                none.
            dt: length of a tick [s].
            weighing: the past that estimates mass and drag, a part of the same graph; None for given ones.
            solver: one of `unifg.solvers.names.CONSTRAINED`.
        """
        self.settings, self.airframe = settings, airframe
        s = settings
        self._weighing = weighing
        steps = np.full(s.horizon, s.step)
        steps[0] = min(s.step, dt)
        self.nodes = np.concatenate([[0.0], np.cumsum(steps)])
        share = (steps / s.step)[:, None]
        self._barriers = Barriers(s, airframe, self.nodes, steps)
        self._speed = SpeedLimit(s, self.nodes)
        effort, change = (
            np.array([a, a, a, b]) ** -0.5 for a, b in ((s.rate, s.thrust), (s.rate_change, s.thrust_change))
        )
        terms: list[Term] = [
            MassAndDrag(weighing, airframe), *along_path(s, share),
            ControlCost(effort * share**-0.5, change, wanted=lambda now: now.given.controls),
            Motion(airframe, steps), self._speed,
        ]  # fmt: skip
        terms += [self._barriers] if s.slots else []
        early = {"step_tolerance": np.inf} if solver == "ipm" and not s.settled else {}
        numbers = {"tolerance": s.tolerance, **({"penalty": PENALTY} if solver == "ipm" else {}), **early}
        # Solves in portions take one compiled loop.
        self._parted = s.portion is not None and solver == "ipm" and s.gamma == 0.0
        most = s.iterations if self._parted or s.portion is None else min(s.iterations, WHOLE)
        robot = Robot(quadrotor_loops.STATE, quadrotor.CONTROL)
        self._brakes = FlatnessController(Gains(), airframe.least, airframe.most)
        self._policy, self._refused = LastPlanThenBrake(robot, FEASIBLE, KEEP, self.brake), 0
        self.loop = RecedingHorizon(
            robot, s.horizon, terms, times=self.nodes,
            solver=backend(solver, max_iterations=most, **numbers),
            cold=backend(solver, **numbers), limits=(airframe.least, airframe.most), judge=self,
            starts=InitialGuesses(cold=self._along, after_failure=self._braking),
            portion=s.portion if self._parted else None, deadline=1e-3 * s.decide_ms, clock=time.thread_time,
        )  # fmt: skip
        self.loop.applied = quadrotor.hover(airframe.parameters)
        self._looked_at = [-1] * s.slots

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
        given = None if self.loop.goes_on else self._given(start, flown, obstacles, later, gust)
        plan = self.loop.plan(start, given)
        solution = self.loop.solution
        assert solution is not None
        status, slack, p = "last plan" if plan.source == "kept" else plan.source, 0.0, self.believed
        mass, drag, places = p.mass, np.array(p.drag), plan.states[:, :3]
        if plan.source in ("kept", "solved"):
            places = self.loop.kept.states[:, :3]
        if not plan.emergency:
            status, mass, drag = plan.status.name.lower(), float(solution["mass"][0, 0]), solution["drag"][0]
            slack = max((use.amount for kept in self._barriers.kept for use in kept.used(solution)), default=0.0)
            nodes = self.nodes - self.loop.waited * self.nodes[1]  # from now on
            if len(obstacles.keep) and obstacles.clearance(places, later + nodes).min() < -INSIDE:
                status = "too near"
        spent = 1e3 * (time.thread_time() - begin)
        return Decision(plan.control, places, status, plan.iterations, slack, mass, drag, spent)

    def _given(self, start: Array, flown: Flown, obstacles: Obstacles, later: float, gust: Array) -> Guarded:
        """Input of the terms where a solve begins; arguments as of :meth:`decide`."""
        states, controls = flat_flight(flown, self.believed)
        near = obstacles
        if self.settings.slots:
            near = obstacles.these(self._nearest(start, obstacles, later), self.settings.slots)
        return Guarded(states, controls[:-1], near, later, gust)

    def __call__(
        self, solution: fg.Solution, states: Array, controls: Array, now: Context[Guarded], kept: LastPlan
    ) -> horizon.Decision:
        """Fly a plan that keeps the constraints; else the last one for a while; else brake."""
        decision = self._policy(solution, states, controls, now, kept)
        if decision.source != "solved" and self._parted and self.loop.warm.unfinished:
            return decision
        # A solve that was begun goes on with the next one's numbers; after a few solves it begins anew.
        self._refused = 0 if decision.source == "solved" else self._refused + 1
        begun = np.isfinite(states).all() and np.isfinite(controls).all() and self.loop.guess is not None
        return replace(decision, resumed=bool(begun) and self._refused % TRIES > 0)

    def brake(self, now: Context[Guarded]) -> Array:
        """(4,) control that takes the velocity away."""
        level = np.clip(-np.array(Gains().velocity)[[0, 0, 1]] * now.present[7:10], -BRAKING, BRAKING)
        return self._brakes.steer(now.present[:10], level, np.zeros(3), self.believed)

    def _nearest(self, start: Array, obstacles: Obstacles, later: float) -> IntArray:
        """Obstacles that are nearest to the plan or to braking; one that was chosen before keeps its place."""
        ways = [_braked(start, self.nodes).position, *([] if self.states is None else [self.states[:, :3]])]
        near = np.min([obstacles.clearance(way, later + self.nodes).min(axis=0) for way in ways], axis=0)
        wanted = np.argsort(near, kind="stable")[: self.settings.slots]
        self._looked_at = reassigned(self._looked_at, wanted.tolist())
        return np.array([k for k in self._looked_at if k >= 0], dtype=np.intp)

    def _along(self, now: Context[Guarded]) -> tuple[Array, Array]:
        """Guess a flight on the path from the second node on."""
        return _with_loops(now.present, now.given.states, now.given.controls)

    def _braking(self, now: Context[Guarded]) -> tuple[Array, Array]:
        """Guess a flight that slows down to rest."""
        states, controls = flat_flight(_braked(now.present, self.nodes), self.believed)
        return _with_loops(now.present, states, controls[:-1])

    @property
    def states(self) -> Array | None:
        """(N + 1, 17) of the last plan; None before there is one."""
        return self.loop.kept.states if "solved" in self.loop.sources else None

    @property
    def believed(self) -> quadrotor.Parameters:
        """Mass and drag by the past alone."""
        return self.airframe.parameters if self._weighing is None else self._weighing.believed


@dataclass(frozen=True)
class Guarded:
    """Input of the terms at a tick.

    Attributes:
        states: (N + 1, 10) of a flight on the path.
        controls: (N, 4) of it.
        obstacles: in the slots, as they were seen.
        later: how much later the plan begins than they were [s].
        gust: (N, 3) acceleration by the air that is expected in each step [m/s^2].
    """

    states: Array
    controls: Array
    obstacles: Obstacles
    later: float
    gust: Array


@dataclass(frozen=True)
class MassAndDrag:
    """Mass and drag as unknowns: given, or estimated by the past in the same graph."""

    weighing: Weighing | None
    airframe: Airframe

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        """Add the unknowns; how far a plan may move them from where the past alone puts them is bounded."""
        p = self.airframe.parameters
        mass, drag = graph.variables("mass", quadrotor.MASS, 1), graph.variables("drag", quadrotor.DRAG, 1)
        if self.weighing is None:
            graph.fix(mass, [p.mass], name="given mass")
            graph.fix(drag, p.drag, name="given drag")
            return
        self.weighing.state(graph, mass, drag)
        for what, believed, pull in zip((mass, drag), self._believed, (PULL[0] * p.mass, PULL[1]), strict=True):
            past = graph.data(f"{what.name} by the past", believed)
            graph.constrain(fg.prior, what, past, lower=-pull, upper=pull, name=f"pull of {what.name}")

    @property
    def _believed(self) -> tuple[Array, Array]:
        """(1,) mass and (3,) drag by the past alone."""
        p = self.airframe.parameters if self.weighing is None else self.weighing.believed
        return np.array([p.mass]), np.array(p.drag)

    def data(self, now: Context[Guarded]) -> Mapping[str, ArrayLike]:
        """Data of the past."""
        if self.weighing is None:
            return {}
        mass, drag = self._believed
        return {**self.weighing.data(), "mass by the past": mass, "drag by the past": drag}

    def guess(self, now: Context[Guarded]) -> Mapping[str, ArrayLike]:
        """Mass and drag by the past alone."""
        return {name: value[None] for name, value in zip(("mass", "drag"), self._believed, strict=True)}


def along_path(settings: KeeperSettings, share: Array) -> list[Term]:
    """Costs of leaving the path in position, attitude and velocity; ``share`` (N, 1) of steps in the longest."""

    def cost(part: str, weight: float) -> Term:
        columns = quadrotor.STATE.component(part).storage
        sigma = np.broadcast_to((weight * share) ** -0.5, (len(share), 3))
        return ReferenceCost(f"path {part}", sigma, lambda now: now.given.states[1:, columns], part)

    weights = {"p": settings.position, "R": settings.attitude, "v": settings.velocity}
    return [cost(part, weight) for part, weight in weights.items()]


@dataclass(frozen=True)
class Motion:
    """Dynamics with the loops of the airframe in steps (N,) [s], and limits of the controls."""

    airframe: Airframe
    steps: Array

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        """Add the constraints."""
        loops, families = self.airframe.loops, graph.families
        held = quadrotor_loops.held(loops.gain, loops.lag, self.steps)
        gust = graph.data("gust", np.zeros((len(self.steps), 3)), each=True)
        motion = x[:-1], u, families["mass"], families["drag"], gust, x[1:], self.steps, held
        graph.constrain(quadrotor_loops.defect, *motion, lower=0.0, upper=0.0, name="dynamics")
        graph.bound(u, lower=self.airframe.least, upper=self.airframe.most, name="limits")

    def data(self, now: Context[Guarded]) -> Mapping[str, ArrayLike]:
        """The gust."""
        return {"gust": now.given.gust}


class Held:
    """Base of terms with slack.

    Attributes:
        kept: barriers of the graph.
    """

    kept: list[Kept]

    def guess(self, now: Context[Guarded]) -> Mapping[str, ArrayLike]:
        """No slack."""
        return {family.name: value for kept in self.kept for family, value in kept.guess().items()}


class SpeedLimit(Held):
    """Limit of the speed, with a slack, and rest at the end where it is wanted."""

    def __init__(self, settings: KeeperSettings, nodes: Array) -> None:
        """Take the numbers."""
        self.settings, self.nodes, self.kept = settings, nodes, []

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        """Add the constraints."""
        s = self.settings
        allowed = graph.data("allowed speed", np.full(s.horizon, s.speed), each=True)
        names, weight = ["speed"], SPEEDING
        self.kept = [keep(graph, slower, x[1:].v, allowed, obstacles=names, weight=weight, name="speed")]
        if s.terminal == "rest":
            graph.bound(x[-1].v, lower=0.0, upper=0.0, name="rest")

    def data(self, now: Context[Guarded]) -> Mapping[str, ArrayLike]:
        """A speed that a vehicle can come down to."""
        fast = np.linalg.norm(now.present[7:10])
        return {"allowed speed": np.maximum(self.settings.speed, fast - SLOWING * self.nodes[1:])}


class Barriers(Held):
    """Clearance from the obstacles in the slots."""

    def __init__(self, settings: KeeperSettings, airframe: Airframe, nodes: Array, steps: Array) -> None:
        """Take the numbers."""
        self.settings, self.airframe, self.nodes, self.steps, self.kept = settings, airframe, nodes, steps, []

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        """Add the barriers."""
        s, m, steps = self.settings, self.settings.slots, self.steps
        since = graph.data("since", self.nodes[:-1], each=True)
        blank = np.zeros((m, 3))
        far = np.full((m, 3), FAR)
        things = {"centre": far, "velocity": blank, "fall": blank, "keep": np.ones(m), "flat": blank + 1.0}
        seen = [graph.data(name, value) for name, value in {**things, "doubt": blank}.items()]
        if s.reading == "published":
            h: Barrier = inverse_clearance
            lost = _of_states(h)
            held = velocity_extended(h, expected, s.gamma) if s.gamma > 0.0 else lost
            asked = condition(held, s.alpha, quadrotor_loops.STATE, _flow(self.airframe), as_published=True, lost=lost)
            self.kept = [keep(graph, asked, x[:-1], u, since, *seen, obstacles=m, form="hinge", weight=s.hinge)]
            return
        ends = x[:-1].p, x[1:].p, since, steps, *seen
        self.kept = [keep(graph, decay(clearance, s.alpha), *ends, obstacles=m, form=s.form, weight=s.slack)]
        if s.gamma > 0.0:
            held = velocity_extended(clearance, expected, s.gamma)
            states = x[:-1], x[1:], since, steps, *seen
            name = "velocity barrier"
            self.kept.append(
                keep(graph, decay(held, s.alpha), *states, obstacles=m, form=s.form, weight=s.slack, name=name)
            )

    def data(self, now: Context[Guarded]) -> Mapping[str, ArrayLike]:
        """Contents of the slots."""
        near = now.given.obstacles
        flat = np.ones((self.settings.slots, 3))
        flat[near.upright, 2] = 0.0
        return {
            "since": now.given.later + self.nodes[:-1], "centre": near.position, "velocity": near.velocity,
            "fall": near.fall, "keep": near.keep, "flat": flat, "doubt": near.doubts,
        }  # fmt: skip


def _with_loops(start: Array, states: Array, controls: Array) -> tuple[Array, Array]:
    """States (N + 1, 17) with loops at rest, from ``start`` (17,) on, of states (N + 1, 10) and controls (N, 4)."""
    told = np.concatenate([controls, controls[-1:]])
    looped = np.concatenate([states, told[:, :3], np.zeros((len(states), 3)), told[:, 3:]], axis=1)
    looped[0] = start
    return looped, controls


def _braked(start: Array, times: Array) -> Flown:
    """The way of a vehicle that slows down evenly to rest."""
    place, velocity = start[:3], start[7:10]
    rest = max(float(np.linalg.norm(velocity)) / BRAKING, 1e-3)
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
