"""Plans of a unicycle that knows how well it will know where it is, and what becomes of them in a closed loop.

Random layouts of discs and beacons, the graph, guesses around either side, and drives of the plan with a filter,
feedback on its estimate and noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

import unifg as fg
from unifg.lie import SE2
from unifg.models import uncertainty
from unifg.models.uncertainty import BeaconSensor, Forecast
from unifg.solvers import SQP
from unifg.typing import Array

Guess: TypeAlias = dict[Any, Any]

STEPS = 30
TOLERANCE = 1e-3  # of a plan: constraints are kept to a millimetre, and the time is its best to six digits
ROUNDS = 4  # of plans that keep the deviations of the plan before
SIDES = (-3.0, -1.2, 1.2, 3.0)  # of guesses [m]
ROBOT = 0.2  # radius [m]
SPEED, TURN = 1.0, 1.5  # limits of a plan [m/s, rad/s]; feedback may use a fifth more
SENSOR = BeaconSensor()
GAIN = np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 3.0]])  # feedback on the error in the plan's axes
DENSITY = np.diag([0.06, 0.06, 0.06]) ** 2  # of the motion noise [m^2/s, m^2/s, rad^2/s]
START = np.diag([0.15, 0.15, 0.05]) ** 2  # covariance at the start [m^2, m^2, rad^2]
LENGTH = 10.0  # from start to goal [m]
UNIT = 0.01  # of covariances as variables [m^2, m rad, rad^2]: a tolerance means something for them, too
BEGIN = np.append(uncertainty.packed(START[None])[0], np.zeros(6)) / UNIT


class Layout(NamedTuple):
    """Discs (m, 2) with radii (m,), and beacons (b, 2) [m]."""

    discs: Array
    radii: Array
    beacons: Array


def layout(seed: int, discs: int = 7, beacons: int = 3) -> Layout:
    """Discs between start and goal that leave gaps of 0.5 m and more, and beacons beside and among them."""
    rng = np.random.default_rng(seed)
    centres, radii = np.empty((0, 2)), np.empty(0)
    while len(radii) < discs:
        centre, radius = rng.uniform([2.0, -2.2], [8.3, 2.2]), rng.uniform(0.3, 0.7)
        if not len(radii) or np.min(np.hypot(*(centres - centre).T) - radii - radius) > 0.5:
            centres, radii = np.vstack([centres, centre]), np.append(radii, radius)
    sides = rng.choice([-1.0, 1.0], beacons)
    marks = np.stack([rng.uniform(1.5, 9.0, beacons), sides * rng.uniform(0.5, 4.0, beacons)], axis=1)
    return Layout(centres, radii, marks)


class Plan(NamedTuple):
    """Poses (n + 1, 3), controls (n, 2), packed beliefs (n + 1, 12) and the duration of a step [s]."""

    poses: Array
    controls: Array
    beliefs: Array
    step: float

    @property
    def duration(self) -> float:
        """From start to goal [s]."""
        return self.step * len(self.controls)

    @property
    def deviation(self) -> Array:
        """(n + 1,) root of the trace of the covariance of the position [m]."""
        both: Array = self.beliefs[:, 0] + self.beliefs[:, 2]
        return np.sqrt(both)


def arc(x: Array, u: Array, after: Array, h: Array) -> Array:
    """Defect of a step on an arc: (n, 3) [m, m, rad]."""
    twist = np.stack([h[:, 0] * u[:, 0], 0.0 * u[:, 0], h[:, 0] * u[:, 1]], axis=1)
    return SE2.local(SE2.compose(x, SE2.exp(twist)), after)


class Planner:
    """The graph of one layout, prepared; what is varied is data.

    Attributes:
        world: discs and beacons.
        graph: stated once.
        foresees: whether covariance and spread are variables; without them only margins can be chosen.
        via: whether a node can be told to be near a place.
        sensor: which sightings the plan counts on.
    """

    def __init__(self, world: Layout, foresees: bool = True, via: bool = False, sensor: BeaconSensor = SENSOR) -> None:
        """State the graph."""
        self.world, self.foresees, self.sensor = world, foresees, sensor
        graph = self.graph = fg.Graph()
        x = self.x = graph.variables("x", SE2, STEPS + 1)
        u = self.u = graph.variables("u", fg.Rn(2), STEPS)
        h = self.h = graph.variables("h", fg.Rn(1), 1)
        self.margin = graph.data("margin", np.zeros((STEPS, len(world.radii))), each=True)
        graph.fix(x[0], np.zeros(3))
        graph.constrain(lambda x: x[:, :2] - [LENGTH, 0.0], x[-1], lower=0, upper=0, name="goal")
        graph.constrain(arc, x[:-1], u, x[1:], h, lower=0, upper=0, name="motion")
        graph.bound(u, lower=[0.0, -TURN], upper=[SPEED, TURN])
        graph.bound(h, lower=0.5 * LENGTH / STEPS, upper=3.0 * LENGTH / STEPS)
        graph.minimize_scalar(lambda h: STEPS * h[:, 0], h, name="time")
        graph.minimize(lambda u: 0.05 * u[:, 1:], u, name="turning")
        discs = (world.discs, world.radii + ROBOT)
        if foresees:
            b = self.b = graph.variables("b", fg.Rn(12), STEPS + 1)
            self.k, self.arrival = graph.data("k", 0.0), graph.data("arrival", 0.0)
            graph.fix(b[0], BEGIN)
            known, defect = (DENSITY, GAIN, world.beacons), filtering(sensor)
            graph.constrain(defect, b[:-1], x[:-1], u, x[1:], b[1:], h, *known, lower=0, upper=0, name="filter")
            graph.constrain(scaled, x[1:], b[1:], *discs, self.k, self.margin, lower=0, name="clearance")
            graph.minimize_scalar(unsure, b[-1], self.arrival, name="arrival")
        else:
            graph.constrain(clear, x[1:], *discs, self.margin, lower=0, name="clearance")
        if via:
            self.place = graph.data("place", np.zeros(2))
            self.within = graph.data("within", np.full(STEPS, np.hypot(LENGTH, LENGTH)), each=True)
            graph.constrain(beyond, x[1:], self.place, self.within, upper=0, name="via")
        self.run = SQP(tolerance=TOLERANCE, max_iterations=50).prepare(graph)

    def guess(self, aside: float) -> Guess:
        """Around one side: ``aside`` is the greatest distance from the straight line [m]."""
        along = np.linspace(0.0, 1.0, STEPS + 1)
        return self.following(np.stack([LENGTH * along, aside * np.sin(np.pi * along)], axis=1))

    def past(self, place: Array) -> tuple[Guess, int]:
        """Straight to a place (2,) and on to the goal, and which node (from one on) is there."""
        corners = np.array([[0.0, 0.0], place, [LENGTH, 0.0]])
        length = np.append(0.0, np.cumsum(np.hypot(*np.diff(corners, axis=0).T)))
        node = int(np.clip(round(STEPS * length[1] / length[2]), 1, STEPS - 1))
        at = np.interp(np.arange(STEPS + 1), [0, node, STEPS], length)
        xy = np.stack([np.interp(at, length, corners[:, i]) for i in range(2)], axis=1)
        return self.following(xy), node

    def following(self, xy: Array) -> Guess:
        """Along a way (n + 1, 2) [m]."""
        step = np.diff(xy, axis=0)
        heading = np.arctan2(step[:, 1], step[:, 0])
        poses = np.column_stack([xy, np.append(heading, heading[-1])])
        poses[0] = 0.0
        h = 1.1 * float(np.hypot(*step.T).sum()) / STEPS / SPEED
        u = np.stack([np.hypot(*step.T) / h, np.diff(poses[:, 2]) / h], axis=1)
        return self.stated(Plan(poses, u, foreseen(self.world, poses, u, h, self.sensor), h))

    def stated(self, plan: Plan) -> Guess:
        """A plan as a guess."""
        guess: Guess = {self.x: plan.poses, self.u: plan.controls, self.h: [[plan.step]]}
        return guess | ({self.b: plan.beliefs / UNIT} if self.foresees else {})

    def solve(
        self, guess: Guess | fg.Solution, margin: float | Array, **chosen: float | Array
    ) -> tuple[fg.Solution, Plan | None]:
        """From one guess, with margins for all, or for each node and disc; no plan where constraints are not kept."""
        data: dict[Any, Any] = {getattr(self, name): value for name, value in chosen.items()}
        data[self.margin] = np.broadcast_to(margin, self.margin.value.shape)
        solution = self.run.solve(guess, data=data)
        if solution.violation > TOLERANCE:
            return solution, None
        x, u, h = solution[self.x].copy(), solution[self.u].copy(), float(solution[self.h][0, 0])
        return solution, Plan(x, u, foreseen(self.world, x, u, h, self.sensor), h)


def clear(x: Array, centre: Array, radius: Array, margin: Array) -> Array:
    """Clearance less a margin: (n, m) [m]."""
    distance: Array = np.linalg.norm(x[:, None, :2] - centre, axis=2)
    return distance - radius - margin


def beyond(x: Array, place: Array, within: Array) -> Array:
    """Excess of the distance of poses from a place over the permitted one: (n, 1) [m]."""
    offset = x[:, :2] - place
    distance: Array = np.sqrt(np.sum(offset * offset, axis=1) + uncertainty.NEAR**2)
    return distance[:, None] - within[:, None]


def confident(x: Array, b: Array, centre: Array, radius: Array, k: Array | float, margin: Array | float) -> Array:
    """The same less k standard deviations of the truth about the plan."""
    return uncertainty.confident_clearance(x, b[:, :6] + b[:, 6:], centre, radius, k) - margin


def scaled(x: Array, b: Array, centre: Array, radius: Array, k: Array, margin: Array) -> Array:
    """The same with beliefs in their unit."""
    return confident(x, UNIT * b, centre, radius, k, margin)


def filtering(sensor: BeaconSensor) -> Callable[..., Array]:
    """Defect of the recursion, (n, 12), in the unit of beliefs."""
    recursion = uncertainty.pose_recursion(sensor)

    def defect(b: Array, x: Array, u: Array, after: Array, b_after: Array, *known: Array) -> Array:
        return recursion(UNIT * b, x, u, after, UNIT * b_after, *known) / UNIT

    return defect


def unsure(b: Array, weight: Array) -> Array:
    """Weighted deviation of the position from the estimate: (n,)."""
    return weight * np.sqrt(UNIT * (b[:, 0] + b[:, 2]))


def foreseen(world: Layout, poses: Array, u: Array, h: float, sensor: BeaconSensor = SENSOR) -> Array:
    """(n + 1, 12) packed beliefs along poses (n + 1, 3) under controls (n, 2), step by step."""
    ahead = uncertainty.pose_forecast(sensor)
    found, duration = [Forecast(START[None], 0.0 * START[None])], np.array([[h]])
    for here, control, there in zip(poses[:-1, None], u[:, None], poses[1:, None], strict=True):
        found.append(ahead(found[-1], here, control, there, duration, DENSITY, GAIN, world.beacons))
    return np.concatenate([np.concatenate([uncertainty.packed(part) for part in step], axis=1) for step in found])


Solve: TypeAlias = Callable[[Guess | fg.Solution, float], tuple[fg.Solution, Plan | None]]
"""A plan from a guess and a value that is swept."""


def sweep(
    planner: Planner, solve: Solve, values: Sequence[float], starts: Sequence[Guess] | None = None
) -> list[Plan | None]:
    """The best plan for each value, rising, over guesses and the plans of the value before.

    Without guesses, these are around both sides.
    """
    starts = starts or [planner.guess(side) for side in SIDES]
    chains: list[Guess | fg.Solution] = [*starts]
    found = list[Plan | None]()
    for value in values:
        best: tuple[float, Plan | None] = (np.inf, None)
        for i, (chain, start) in enumerate(zip(chains, starts, strict=True)):
            solution, plan = solve(chain, value)
            if plan is None and chain is not start:
                solution, plan = solve(start, value)
            if plan is not None:
                chains[i] = solution
                if solution.cost < best[0]:
                    best = (solution.cost, plan)
        found.append(best[1])
    return found


def lagging(planner: Planner, guess: Guess | fg.Solution, k: float, reserve: float) -> tuple[fg.Solution, Plan | None]:
    """A plan that keeps k deviations without having them as variables: those of the plan before, a few times over.

    It counts where it keeps the deviations of its own, but for a centimetre.
    """
    world = planner.world
    discs, radii = world.discs, world.radii + ROBOT
    solution, plan = planner.solve(guess, reserve)
    for _ in range(ROUNDS):
        if plan is None:
            break
        b = plan.beliefs[1:]
        wide = reserve + k * uncertainty.deviations(b[:, :6] + b[:, 6:], plan.poses[1:], discs)
        solution, plan = planner.solve(solution, wide)
    if plan is not None and confident(plan.poses[1:], plan.beliefs[1:], discs, radii, k, reserve).min() < -0.01:
        return solution, None
    return solution, plan


# ---------------------------------------------------------------- what becomes of a plan


class Drives(NamedTuple):
    """Drives of one plan, one entry each.

    Attributes:
        clearance: least distance of the hull from a disc [m].
        arrival: distance of the estimate from the truth at the end [m].
        miss: of the truth from the goal [m].
        paths: (n + 1, drives, 3) true poses.
    """

    clearance: Array
    arrival: Array
    miss: Array
    paths: Array

    @property
    def collisions(self) -> float:
        """Share of drives that touched something."""
        return float(np.mean(self.clearance < 0.0))


def drive(plan: Plan, world: Layout, drives: int, seed: int) -> Drives:
    """Drive a plan many times with noise, a filter and feedback on what the filter believes.

    The same seed draws the same numbers for every plan. A beacon is sighted with the sensor's chance at the true
    distance; the filter's covariance is its own, not the plan's. Clearance is looked at between nodes, too.
    """
    rng = np.random.default_rng(seed)
    noise = np.linalg.cholesky(DENSITY)
    truth = SE2.retract(np.zeros((drives, 3)), rng.standard_normal((drives, 3)) @ np.linalg.cholesky(START).T)
    belief, P = np.zeros((drives, 3)), np.tile(START, (drives, 1, 1))
    radii = world.radii + ROBOT
    clearance, paths = np.full(drives, np.inf), [truth]
    for k in range(len(plan.controls)):
        error = SE2.local(plan.poses[k], belief)
        u = plan.controls[k] - error @ GAIN.T
        u = np.clip(u, [0.0, -1.2 * TURN], [1.2 * SPEED, 1.2 * TURN])
        for _ in range(2):  # half a step, and half a step
            twist = 0.5 * plan.step * np.stack([u[:, 0], 0.0 * u[:, 0], u[:, 1]], axis=1)
            jolt = np.sqrt(0.5 * plan.step) * rng.standard_normal((drives, 3)) @ noise.T
            truth = SE2.retract(SE2.retract(truth, twist), jolt)
            before, belief = belief, SE2.retract(belief, twist)
            P = uncertainty.predicted(P, uncertainty.pose_transition(before, belief), 0.5 * plan.step * DENSITY)
            gap = np.linalg.norm(truth[:, None, :2] - world.discs, axis=2) - radii
            clearance = np.minimum(clearance, gap.min(axis=1))
        for beacon in world.beacons:
            belief, P = sighted(truth, belief, P, beacon, rng)
        paths.append(truth)
    arrival, miss = (np.hypot(*(truth - other)[:, :2].T) for other in (belief, np.array([LENGTH, 0.0, 0.0])))
    return Drives(clearance, arrival, miss, np.array(paths))


def sighted(truth: Array, belief: Array, P: Array, beacon: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Poses believed and their covariances after one beacon was looked for."""
    noise, luck = rng.standard_normal((len(truth), 2)), rng.uniform(size=len(truth))
    far, ahead, aside = uncertainty.to_beacon(truth, beacon)
    seen = (luck < SENSOR.chance(far))[:, None]
    distance, front, side = uncertainty.to_beacon(belief, beacon)
    turned = np.arctan2(aside, ahead) - np.arctan2(side, front)
    innovation = np.stack(
        [
            (far - distance) / SENSOR.sigma_range,
            np.arctan2(np.sin(turned), np.cos(turned)) / SENSOR.sigma_bearing,
        ],
        axis=1,
    )
    H = np.stack(uncertainty.sighting_rows(belief, beacon, SENSOR), axis=1)
    across = P @ np.swapaxes(H, 1, 2)
    gain = across @ np.linalg.inv(np.eye(2) + H @ across)
    step = np.einsum("nij,nj->ni", gain, innovation + noise)
    after = P - gain @ np.swapaxes(across, 1, 2)
    return np.where(seen, SE2.retract(belief, step), belief), np.where(seen[:, :, None], after, P)
