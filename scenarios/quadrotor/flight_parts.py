"""Terms of the quadrotor's horizon (Ta et al. 2014, section V)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

import unifg as fg
from unifg.factors.residuals import Residual
from unifg.horizon import Context, RecedingHorizon, Robot, Term, Window
from unifg.lie import SO3
from unifg.models import avoidance, landmarks, quadrotor
from unifg.scenarios.perception.belief import Belief
from unifg.scenarios.planning.reference_cost import ReferenceCost
from unifg.scenarios.quadrotor.braking import stopping_height
from unifg.scenarios.quadrotor.flight_settings import ControllerSettings
from unifg.scenarios.quadrotor.guide import Reference
from unifg.scenarios.quadrotor.slots import FAR_AWAY, SPARE, SlotObstacles
from unifg.typing import Array, ArrayLike, BoolArray

SLOWING = 0.3  # [s] in which a speed above the limit is to fade


@dataclass(frozen=True)
class FlightInput:
    """Context of the terms at a tick.

    Attributes:
        belief: state, parameters and landmarks.
        hover: (4,) control that hovers.
        reference: where to be.
        obstacles: what fills the slots.
        others: the same without those that are variables of the graph.
        held: (M,) which of the slots these are.
        marks: the variables that stand for them, in the order of the slots.
    """

    belief: Belief
    hover: Array
    reference: Reference
    obstacles: SlotObstacles
    others: SlotObstacles
    held: BoolArray
    marks: list[int]


@dataclass(frozen=True)
class GivenMotion:
    """The dynamics with parameters that are given."""

    settings: ControllerSettings

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        """Add the dynamics."""
        parameters = graph.data("parameters", quadrotor.Parameters().packed)
        motion = (x[:-1], u, x[1:], parameters, self.settings.dt)
        graph.constrain(quadrotor.dynamics, *motion, lower=0, upper=0, name="dynamics")

    def data(self, now: Context[FlightInput]) -> Mapping[str, ArrayLike]:
        """Parameters as believed."""
        return {"parameters": now.given.belief.parameters.packed}


class GivenFlight:
    """Coupling of a flight to its past: state, parameters and map are given, or estimated by a subclass.

    Attributes:
        settings: weights and limits.
        robot: of the horizon.
        window: of the past, in one graph with the horizon; None where its belief is given.
        pull: see :class:`unifg.horizon.coupling.JointPresent`.
    """

    def __init__(
        self,
        settings: ControllerSettings,
        robot: Robot | None = None,
        window: Window | None = None,
        pull: float = np.inf,
    ) -> None:
        """Keep what is given."""
        self.robot = robot or Robot(quadrotor.STATE, quadrotor.CONTROL)
        self.settings, self.window, self.pull = settings, window, pull

    def motion(self) -> list[Term]:
        """Terms of the motion."""
        return [GivenMotion(self.settings)]

    def apart(self) -> list[Term]:
        """Terms that keep clear of variables."""
        return []

    def split(self, obstacles: SlotObstacles) -> tuple[SlotObstacles, BoolArray, list[int]]:
        """Obstacles without those that are variables; which (M,) these are, and the variables."""
        return obstacles, np.zeros(len(obstacles.names), dtype=bool), []

    def carry(self, multipliers: dict[str, Array], now: Context[FlightInput]) -> dict[str, Array]:
        """Shifted multipliers that still hold."""
        return multipliers

    def moving_with(self, solution: fg.Solution, now: Context[FlightInput]) -> quadrotor.Parameters:
        """Parameters with which a solution moves."""
        return now.given.belief.parameters

    def believed(self, given: Belief, loop: RecedingHorizon) -> Belief:
        """Belief after a solve for which a belief was given."""
        return given


@dataclass(frozen=True)
class Limits:
    """Limits of controls, heights and attitude."""

    settings: ControllerSettings

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        """Bound controls, heights and attitude."""
        s = self.settings
        graph.bound(u, lower=s.box[0], upper=s.box[1], name="control limits")
        free, lean = np.inf, s.lean_limit
        box = np.full((s.horizon, 3), free)
        box[:, 2] = 1.0
        low, high = (graph.data(name, sign * box, each=True) for name, sign in (("low", -1), ("high", 1)))
        graph.bound(x.p[1:], lower=low, upper=high, name="height limits")
        graph.constrain(
            landmarks.tilt, x.R[1:], np.zeros(3), lower=[-lean, -lean, -free], upper=[lean, lean, free], name="lean"
        )

    def data(self, now: Context[FlightInput]) -> Mapping[str, ArrayLike]:
        """Heights as far as a vehicle keeps them that stops climbing or sinking."""
        s = self.settings
        least, most = (np.full((s.horizon, 3), side * np.inf) for side in (-1.0, 1.0))
        stop = stopping_height(now.present[2], now.present[9], s.dt * np.arange(1.0, s.horizon + 1))
        least[:, 2] = np.minimum(s.height_limits[0], stop - SPARE)
        most[:, 2] = np.maximum(s.height_limits[1], stop + SPARE)
        return {"low": least, "high": most}


def upright(now: Context[FlightInput]) -> Array:
    """(3,) vertical axis in the body at hover."""
    return SO3.act(SO3.inverse(level(now.given.belief)), quadrotor.UP)


def level(belief: Belief) -> Array:
    """Attitude (4,) that hovers with the present heading."""
    nose = SO3.act(belief.state[3:7], np.array([1.0, 0.0, 0.0]))
    heading = SO3.exp(np.array([0.0, 0.0, np.arctan2(nose[1], nose[0])]))
    return SO3.compose(quadrotor.hover_attitude(belief.parameters), heading)


def following(settings: ControllerSettings) -> list[Term]:
    """Costs of leaving the reference in position and velocity, others at its end."""
    s = settings
    last = np.sqrt(s.terminal_weight)
    position, velocity = s.weighted(s.position_sigma), s.weighted(s.velocity_sigma)
    return [
        ReferenceCost("way", position, lambda now: now.given.reference.positions[1:-1], "p", ends=False),
        ReferenceCost("pace", velocity, lambda now: now.given.reference.velocities[1:-1], "v", ends=False),
        ReferenceCost("end of way", position / last, lambda now: now.given.reference.positions[-1], "p", ends=True),
        ReferenceCost("final pace", velocity / last, lambda now: now.given.reference.velocities[-1], "v", ends=True),
    ]


@dataclass(frozen=True)
class Clearance:
    """Hard clearance from cylinders, moving discs and walls (W, 2, 2) [m]."""

    settings: ControllerSettings
    walls: Array

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        """Add the constraints."""
        s = self.settings
        n, m, count = s.horizon, s.cylinders + s.movers, len(self.walls)
        centres, radii = slots(graph, s)
        least = graph.data("clearances", np.zeros((n, m)), each=True)
        discs = x.p[1:], centres, radii
        graph.constrain(avoidance.cylinder_clearance, *discs, lower=least, name="cylinders")
        if count:
            beside = graph.data("wall clearances", np.zeros((n, count)), each=True)
            segments = x.p[1:], self.walls, np.zeros(count)
            graph.constrain(avoidance.segment_clearance, *segments, lower=beside, name="walls")

    def data(self, now: Context[FlightInput]) -> Mapping[str, ArrayLike]:
        """Contents of the slots."""
        others = now.given.others
        found: dict[str, ArrayLike] = {"centres": others.centres, "radii": others.radii, "clearances": others.limits}
        return found | ({"wall clearances": others.wall_limits} if len(self.walls) else {})


@dataclass(frozen=True)
class Potential:
    """Ta's costs |p - l_g|^2 and 1/d, with d between the hull and what stands or moves (section V-A).

    Far from its target a vehicle would race: its speed is limited.

    Attributes:
        settings: weights and limits.
        walls: (W, 2, 2) [m].
        target: (3,) [m].
    """

    settings: ControllerSettings
    walls: Array
    target: Array

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        """Add the costs, and bound the speed."""
        s = self.settings
        n, most = s.horizon, s.guide.speed
        centres, radii = slots(graph, s)
        graph.minimize(fg.prior, x.p[1:], self.target, sigma=s.weighted(s.goal_sigma), name="goal")
        speed = graph.data("speed", np.full((n, 3), most), each=True)
        speed_back = graph.data("speed back", np.full((n, 3), -most), each=True)
        graph.bound(x.v[1:], lower=speed_back, upper=speed, name="speed")
        discs = x.p[1:], centres, radii
        repel(graph, s, avoidance.cylinder_clearance, *discs, name="cylinders")
        if len(self.walls):
            hulls = x.p[1:], self.walls, np.full(len(self.walls), s.vehicle_radius)
            repel(graph, s, avoidance.segment_clearance, *hulls, name="walls")

    def data(self, now: Context[FlightInput]) -> Mapping[str, ArrayLike]:
        """Contents of the slots, and a speed that the vehicle can come down to."""
        s, others = self.settings, now.given.others
        times, most = s.dt * np.arange(1.0, s.horizon + 1), s.guide.speed
        excess = np.maximum(np.abs(now.present[7:10]) - most, 0.0) + SPARE
        allowed = most + excess * np.exp(-times / SLOWING)[:, None]
        hulls = others.radii + s.vehicle_radius
        return {"centres": others.centres, "radii": hulls, "speed": allowed, "speed back": -allowed}


def slots(graph: fg.Graph, settings: ControllerSettings) -> tuple[fg.Data, fg.Data]:
    """Data of the slots: centres and radii."""
    n, m = settings.horizon, settings.cylinders + settings.movers
    return graph.data("centres", np.full((n, m, 2), FAR_AWAY), each=True), graph.data("radii", np.zeros(m))


def repel(
    graph: fg.Graph,
    settings: ControllerSettings,
    clearance: Residual,
    *arguments: fg.Selection | fg.Data | Array,
    name: str,
    active: fg.Data | None = None,
) -> None:
    """Add 1/d of a clearance, as half the square of its root, where it is ``active``."""
    sigma = 1.0 / np.sqrt(settings.potential_weight * settings.control_weight)
    root = avoidance.inverse_distance_root(clearance)
    graph.minimize(root, *arguments, sigma=sigma, active=active, name=f"1/d, {name}")
