"""What the quadrotor's horizon says, part by part (Ta et al. 2014, section V)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import unifg as fg
from unifg.kernels.residuals import Residual
from unifg.lie import SO3
from unifg.models import avoidance, landmarks, quadrotor
from unifg.scenarios.flying.braking import stopping_height
from unifg.scenarios.flying.flight_settings import ControllerSettings
from unifg.scenarios.flying.guide import Reference
from unifg.scenarios.flying.slots import FAR_AWAY, SPARE, Obstacles
from unifg.scenarios.horizon.part import Given, Gives, Now, Part, known_present
from unifg.scenarios.horizon.past import GivenPast
from unifg.scenarios.seeing.belief import Belief
from unifg.typing import Array, BoolArray

UP = np.array([0.0, 0.0, 1.0])
SLOWING = 0.3  # [s] in which a speed above the limit is to fade


@dataclass(frozen=True)
class FlightNow(Now):
    """What the parts may ask for at a tick.

    Attributes:
        belief: state, parameters and landmarks.
        reference: where to be.
        obstacles: what fills the slots.
        others: the same without those that are variables of the graph.
        held: (M,) which of the slots these are.
        marks: the variables that stand for them, in the order of the slots.
    """

    belief: Belief
    reference: Reference
    obstacles: Obstacles
    others: Obstacles
    held: BoolArray
    marks: list[int]


class GivenFlight(GivenPast):
    """State and parameters are given, and move by the dynamics."""

    def __init__(self, settings: ControllerSettings) -> None:
        """Take the sampling time from the settings."""
        self._dt = settings.dt

    def state(self, graph: fg.Graph, x: fg.Family, u: fg.Family) -> Gives[FlightNow]:  # type: ignore[override]
        """Fix the first state, and add the dynamics."""
        start = known_present(graph, x, u)
        parameters = graph.data("parameters", quadrotor.Parameters().packed)
        motion = (x[:-1], u, x[1:], parameters, self._dt)
        graph.constrain(quadrotor.dynamics, *motion, lower=0, upper=0, name="dynamics")
        return lambda now: {**start(now), parameters: now.belief.parameters.packed}

    def split(self, obstacles: Obstacles) -> tuple[Obstacles, BoolArray, list[int]]:
        """All obstacles are data."""
        return obstacles, np.zeros(len(obstacles.names), dtype=bool), []

    def apart(self, squares: bool | None) -> tuple[()]:
        """Nothing else is kept clear of."""
        return ()

    def moving_with(self, solution: fg.Solution, now: FlightNow) -> quadrotor.Parameters:
        """Parameters with which a solution moves."""
        return now.belief.parameters

    def believed(self, given: Belief) -> Belief:
        """What was given."""
        return given


def limits(s: ControllerSettings) -> Part[Now]:
    """What the vehicle can do and where it may be."""

    def state(graph: fg.Graph, x: fg.Family, u: fg.Family) -> Gives[Now]:
        graph.bound(u, lower=s.box[0], upper=s.box[1], name="control limits")
        free, lean = np.inf, s.lean_limit
        box = np.full((s.horizon, 3), free)
        box[:, 2] = 1.0
        low, high = (graph.data(name, sign * box, each=True) for name, sign in (("low", -1), ("high", 1)))
        graph.bound(x.p[1:], lower=low, upper=high, name="height limits")
        graph.constrain(
            landmarks.tilt, x.R[1:], np.zeros(3), lower=[-lean, -lean, -free], upper=[lean, lean, free], name="lean"
        )

        def data(now: Now) -> Given:  # heights as far as a vehicle keeps them that stops climbing or sinking
            least, most = (np.full((s.horizon, 3), side * np.inf) for side in (-1.0, 1.0))
            stop = stopping_height(now.present[2], now.present[9], s.dt * np.arange(1.0, s.horizon + 1))
            least[:, 2] = np.minimum(s.height_limits[0], stop - SPARE)
            most[:, 2] = np.maximum(s.height_limits[1], stop + SPARE)
            return {low: least, high: most}

        return data

    return state


def leaning(s: ControllerSettings) -> Part[FlightNow]:
    """Cost of leaning otherwise than at hover."""

    def state(graph: fg.Graph, x: fg.Family, u: fg.Family) -> Gives[FlightNow]:
        upright = graph.data("upright", UP)
        graph.minimize(landmarks.tilt, x.R[1:], upright, sigma=s.weighted(s.level_sigma), name="level")
        return lambda now: {upright: SO3.act(SO3.inverse(level(now.belief)), UP)}

    return state


def level(belief: Belief) -> Array:
    """Attitude (4,) that hovers with the present heading."""
    nose = SO3.act(belief.state[3:7], np.array([1.0, 0.0, 0.0]))
    heading = SO3.exp(np.array([0.0, 0.0, np.arctan2(nose[1], nose[0])]))
    return SO3.compose(quadrotor.hover_attitude(belief.parameters), heading)


def following(s: ControllerSettings) -> Part[FlightNow]:
    """Costs of leaving the reference in position and velocity, others at its end."""

    def state(graph: fg.Graph, x: fg.Family, u: fg.Family) -> Gives[FlightNow]:
        n, last = s.horizon, np.sqrt(s.terminal_weight)
        positions = graph.data("reference positions", np.zeros((n - 1, 3)), each=True)
        velocities = graph.data("reference velocities", np.zeros((n - 1, 3)), each=True)
        end, leaving = graph.data("end of reference", np.zeros(3)), graph.data("velocity at the end", np.zeros(3))
        position, velocity = s.weighted(s.position_sigma), s.weighted(s.velocity_sigma)
        graph.minimize(fg.prior, x.p[1:-1], positions, sigma=position, name="way")
        graph.minimize(fg.prior, x.v[1:-1], velocities, sigma=velocity, name="pace")
        graph.minimize(fg.prior, x.p[-1], end, sigma=position / last, name="end of way")
        graph.minimize(fg.prior, x.v[-1], leaving, sigma=velocity / last, name="final pace")

        def data(now: FlightNow) -> Given:
            places, speeds = now.reference.positions, now.reference.velocities
            return {positions: places[1:-1], velocities: speeds[1:-1], end: places[-1], leaving: speeds[-1]}

        return data

    return state


def clearance(s: ControllerSettings, walls: Array) -> Part[FlightNow]:
    """Hard clearance from cylinders, moving discs and walls (W, 2, 2) [m]."""

    def state(graph: fg.Graph, x: fg.Family, u: fg.Family) -> Gives[FlightNow]:
        n, m, count = s.horizon, s.cylinders + s.movers, len(walls)
        centres, radii = slots(graph, s)
        least = graph.data("clearances", np.zeros((n, m)), each=True)
        discs = x.p[1:], centres, radii
        graph.constrain(avoidance.cylinder_clearance, *discs, lower=least, name="cylinders")
        beside = graph.data("wall clearances", np.zeros((n, count)), each=True) if count else None
        if beside is not None:
            segments = x.p[1:], walls, np.zeros(count)
            graph.constrain(avoidance.segment_clearance, *segments, lower=beside, name="walls")

        def data(now: FlightNow) -> Given:
            others = now.others
            found: Given = {centres: others.centres, radii: others.radii, least: others.limits}
            return found if beside is None else {**found, beside: others.wall_limits}

        return data

    return state


def potential(s: ControllerSettings, walls: Array, target: Array, squares: bool) -> Part[FlightNow]:
    """Ta's costs |p - l_g|^2 and 1/d, with d between the hull and what stands or moves (section V-A).

    Far from its target a vehicle would race: its speed is limited.

    Args:
        s: weights and limits.
        walls: (W, 2, 2) [m].
        target: (3,) [m].
        squares: whether 1/d is stated as a sum of squares.
    """

    def state(graph: fg.Graph, x: fg.Family, u: fg.Family) -> Gives[FlightNow]:
        n, most = s.horizon, s.guide.speed
        centres, radii = slots(graph, s)
        graph.minimize(fg.prior, x.p[1:], target, sigma=s.weighted(s.goal_sigma), name="goal")
        speed = graph.data("speed", np.full((n, 3), most), each=True)
        speed_back = graph.data("speed back", np.full((n, 3), -most), each=True)
        graph.bound(x.v[1:], lower=speed_back, upper=speed, name="speed")
        discs = x.p[1:], centres, radii
        repel(graph, s, squares, avoidance.cylinder_clearance, *discs, name="cylinders")
        if len(walls):
            hulls = x.p[1:], walls, np.full(len(walls), s.vehicle_radius)
            repel(graph, s, squares, avoidance.segment_clearance, *hulls, name="walls")

        def data(now: FlightNow) -> Given:
            times = s.dt * np.arange(1.0, n + 1)
            excess = np.maximum(np.abs(now.present[7:10]) - most, 0.0) + SPARE
            allowed = most + excess * np.exp(-times / SLOWING)[:, None]
            hulls = now.others.radii + s.vehicle_radius
            return {centres: now.others.centres, radii: hulls, speed: allowed, speed_back: -allowed}

        return data

    return state


def slots(graph: fg.Graph, settings: ControllerSettings) -> tuple[fg.Data, fg.Data]:
    """Data of the slots: centres and radii."""
    n, m = settings.horizon, settings.cylinders + settings.movers
    return graph.data("centres", np.full((n, m, 2), FAR_AWAY), each=True), graph.data("radii", np.zeros(m))


def repel(
    graph: fg.Graph,
    settings: ControllerSettings,
    squares: bool,
    clearance: Residual,
    *arguments: fg.Selection | fg.Data | Array,
    name: str,
    active: fg.Data | None = None,
) -> None:
    """Add 1/d of a clearance, as it is or as half the square of its root, where it is ``active``."""
    weight, name = settings.potential_weight * settings.control_weight, f"1/d, {name}"
    if squares:
        root = avoidance.inverse_distance_root(clearance)
        graph.minimize(root, *arguments, sigma=1.0 / np.sqrt(weight), active=active, name=name)
    else:
        inverse = avoidance.inverse_distance(clearance, weight=weight)
        graph.minimize_scalar(inverse, *arguments, active=active, name=name)
