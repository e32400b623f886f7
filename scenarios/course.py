"""One flight past three walls and a cylinder, optimised as a whole (Ta et al. 2014, section V-A and Fig. 3).

A quadrotor stands on the ground and is to be at a target after a fixed number of steps. Nobody tells it where to pass:
either obstacles repel it by Ta's potential 1/d, or they must not come nearer than the hull allows. Every iterate is
kept for the picture.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

import unifg as fg
from unifg.models import avoidance, landmarks, quadrotor
from unifg.scenarios.options import AtLeastOne, Positive, Settings, option
from unifg.scenarios.planning.polyline import arc_lengths, at_stations
from unifg.scenarios.planning.visibility import Ways
from unifg.scenarios.simulation.air import VEHICLE_RADIUS
from unifg.scenarios.simulation.layouts import Layout, obstacle_course
from unifg.solution.solve_state import Callback
from unifg.solvers import names
from unifg.typing import Array

__all__ = [
    "AVOIDANCES",
    "GUESSES",
    "HESSIANS",
    "Course",
    "CourseSettings",
    "backend",
    "course_guess",
    "run_course",
    "solve_course",
    "state_problem",
]

Avoidance = Literal["potential", "hard"]
Start = Literal["hover", "line", "way"]
Hessian = Literal["exact", "gauss-newton"]

AVOIDANCES: tuple[Avoidance, ...] = get_args(Avoidance)
GUESSES: tuple[Start, ...] = get_args(Start)
HESSIANS: tuple[Hessian, ...] = get_args(Hessian)

SUBSTEPS = 10  # looks at the way between two nodes
CONTACT = 1e-3  # a hull deeper than this in something is a collision [m]
FLYABLE = 1e-4  # largest violation of dynamics and bounds with which states still follow from controls
_CLEARANCES = (0.6, 0.5, 0.4, 0.3)  # of the centre line of a guess along a way, the one to be preferred first [m]


@dataclass(frozen=True)
class CourseSettings(Settings):
    """Numbers of the problem. Weights multiply half the square of an error.

    Attributes:
        horizon: steps N.
        dt: sampling time [s].
        solver: one of `unifg.solvers.names.SECOND_ORDER`.
        hessian: of the Lagrangian.
        avoidance: "potential" is Ta's cost 1/d for the cylinder and every wall, d from the hull; "hard" keeps the hull
            clear at every node.
        guess: "hover" stays at the start, "line" flies straight to the target through whatever stands there, "way"
            follows a shortest way around it, the only one that begins outside of obstacles in every layout, so that it
            is the default.
        general: state 1/d as a general cost (`minimize_scalar`) instead of as its least-squares twin. It is the same
            objective.
        seed: of a random layout; without one, the layout of the documentation.
        goal: weight of the distance to the target at each node [1/m^2].
        end: the same at the last node, in addition.
        rest: weight of the velocity at the last node [s^2/m^2].
        level: weight of the tilt at each node.
        rate: weight of the body rates in each step [s^2].
        thrust: weight of the thrust less that of hover in each step [1/N^2].
        near: weight of 1/d at each node [m].
        nearest: distance of the hull below which 1/d is continued by its parabola [m].
        clearance: least distance of the hull at the nodes [m], of hard clearance. Between nodes the hull may come
            nearer by the sagitta of one step around a wall's end, 0.035 m at these limits.
        rate_limit: greatest body rate about each axis [rad/s].
        thrust_limit: greatest thrust [N]; the least is none.
        speed_limit: greatest velocity along each axis of the world [m/s]. Times ``dt`` it must be too little to pass
            a wall between two nodes, see :func:`unifg.models.avoidance.segment_clearance`.
        arrival: greatest distance from the target at the end that counts as arrived [m].
        vehicle: its mass, drag and wind.
        tolerance: of the KKT test.
    """

    horizon: AtLeastOne = 60
    dt: Positive[float] = 0.1
    solver: str = "sqp"
    hessian: Hessian = option("exact")
    avoidance: Avoidance = option("potential")
    guess: Start = option("way")
    general: bool = option(False)
    seed: int | None = option(None, metavar="S")
    goal: Positive[float] = 0.04
    end: Positive[float] = 100.0
    rest: Positive[float] = 0.5
    level: Positive[float] = 1.0
    rate: Positive[float] = 1.0
    thrust: Positive[float] = 0.1
    near: Positive[float] = 0.3
    nearest: Positive[float] = 0.2
    clearance: float = 0.05
    rate_limit: Positive[float] = 4.0
    thrust_limit: Positive[float] = 20.0
    speed_limit: Positive[float] = 2.0
    arrival: Positive[float] = 0.3
    vehicle: quadrotor.Parameters = field(default_factory=quadrotor.Parameters)
    tolerance: Positive[float] = 1e-6

    def __post_init__(self) -> None:
        """Check the fields; only a potential can be stated as a general cost."""
        super().__post_init__()
        if self.general and self.avoidance == "hard":
            raise fg.ScenarioError("general: a general cost states the potential, and avoidance 'hard' has none")

    def layout(self) -> Layout:
        """Start, target and obstacles."""
        return obstacle_course(self.seed)


def backend(settings: CourseSettings, *, keep_values: bool = False) -> fg.Solver:
    """The solver the settings ask for.

    Raises:
        BackendError: for an unknown solver.
    """
    options = {"tolerance": settings.tolerance, "hessian": settings.hessian, "keep_values": keep_values}
    return names.backend(settings.solver, **options)


def state_problem(settings: CourseSettings, layout: Layout) -> tuple[fg.Graph, fg.Family, fg.Family]:
    """The control graph of a layout: the graph, states (N + 1) and controls (N)."""
    s, walls, cylinders = settings, layout.walls, layout.cylinders
    graph = fg.Graph()
    x = graph.variables("state", quadrotor.STATE, s.horizon + 1)
    u = graph.variables("control", quadrotor.CONTROL, s.horizon)
    ahead = x[1:]
    graph.fix(x[0], _standing(layout))
    graph.minimize(fg.prior, ahead.p, layout.target, sigma=s.goal**-0.5, name="goal")
    graph.minimize(fg.prior, x[-1].p, layout.target, sigma=s.end**-0.5, name="end")
    graph.minimize(fg.prior, x[-1].v, np.zeros(3), sigma=s.rest**-0.5, name="rest")
    graph.minimize(landmarks.tilt, ahead.R, quadrotor.UP, sigma=s.level**-0.5, name="level")
    effort = np.array([s.rate, s.rate, s.rate, s.thrust]) ** -0.5
    graph.minimize(fg.prior, u, quadrotor.hover(s.vehicle), sigma=effort, name="effort")
    motion = (x[:-1], u, ahead, s.vehicle.packed, s.dt)
    graph.constrain(quadrotor.dynamics, *motion, lower=0.0, upper=0.0, name="dynamics")
    graph.bound(ahead.p, lower=[-np.inf, -np.inf, 0.0], name="ground")
    graph.bound(ahead.v, lower=-s.speed_limit, upper=s.speed_limit, name="speed limit")
    rates = np.full(3, s.rate_limit)
    graph.bound(u, lower=[*-rates, 0.0], upper=[*rates, s.thrust_limit], name="control limits")

    hull = VEHICLE_RADIUS + (s.clearance if s.avoidance == "hard" else 0.0)
    obstacles = (
        ("cylinder", avoidance.cylinder_clearance, cylinders[:, :2], cylinders[:, 2] + hull),
        ("walls", avoidance.segment_clearance, walls, np.full(len(walls), hull)),
    )
    for name, distance, places, margins in obstacles:
        if s.avoidance == "hard":
            graph.constrain(distance, ahead.p, places, margins, lower=0.0, name=name)
        elif s.general:
            potential = avoidance.inverse_distance(distance, s.nearest, s.near)
            graph.minimize_scalar(potential, ahead.p, places, margins, name=name)
        else:
            root = avoidance.inverse_distance_root(distance, s.nearest)
            graph.minimize(root, ahead.p, places, margins, sigma=s.near**-0.5, name=name)
    return graph, x, u


def course_guess(settings: CourseSettings, layout: Layout) -> tuple[Array, Array]:
    """States (N + 1, 10) and controls (N, 4) to begin with: hovering, at the start or along a path that is given.

    Raises:
        ScenarioError: for a guess along a way where there is none.
    """
    s, kind = settings, settings.guess
    states = np.tile(_standing(layout), (s.horizon + 1, 1))
    controls = np.tile(quadrotor.hover(s.vehicle), (s.horizon, 1))
    if kind != "hover":
        path = _way(layout) if kind == "way" else np.stack([layout.start[:2], layout.target[:2]])
        arc, share = arc_lengths(path), np.linspace(0.0, 1.0, s.horizon + 1)
        states[:, :2] = at_stations(path, arc, share * arc[-1])
        states[:, 2] = layout.start[2] + share * (layout.target[2] - layout.start[2])
        states[1:, 7:] = np.diff(states[:, :3], axis=0) / s.dt
    return states, controls


@dataclass(frozen=True)
class Course:
    """One optimised flight.

    Attributes:
        settings: the numbers.
        layout: start, target and obstacles.
        solution: with its history.
        states: (N + 1, 10) of the solution.
        controls: (N, 4) of the solution, body rates [rad/s] and thrust [N].
        iterates: (iterations + 1, N + 1, 10) states of every iterate, the guess first; without `keep_values` none.
    """

    settings: CourseSettings
    layout: Layout
    solution: fg.Solution
    states: Array
    controls: Array
    iterates: Array

    @property
    def target_distance(self) -> float:
        """Distance from the end to the target [m]."""
        return float(np.linalg.norm(self.states[-1, :3] - self.layout.target))

    @property
    def clearance(self) -> Array:
        """(N + 1,) distance from the hull to the nearest obstacle at each node [m]; negative in a collision."""
        return self.layout.distance(self.states[:, :2]) - VEHICLE_RADIUS

    def between(self, substeps: int = SUBSTEPS) -> Array:
        """(N substeps + 1, 10) states at the nodes and at equal times between them."""
        s = self.settings
        pauses = s.dt * np.arange(substeps) / substeps
        parts = [quadrotor.step(self.states[:-1], self.controls, pause, s.vehicle) for pause in pauses]
        return np.concatenate([np.stack(parts, axis=1).reshape(-1, self.states.shape[1]), self.states[-1:]])

    @property
    def clearance_between(self) -> float:
        """Least distance of the hull to the obstacles on the whole way [m], also between nodes."""
        return float(self.layout.distance(self.between()[:, :2]).min()) - VEHICLE_RADIUS

    @property
    def arrived(self) -> bool:
        """True if the end is near enough to the target."""
        return self.target_distance <= self.settings.arrival

    @property
    def clear(self) -> bool:
        """True if nothing is touched, neither at nodes nor between them."""
        return self.clearance_between >= -CONTACT

    @property
    def flyable(self) -> bool:
        """True if states follow from controls and limits are kept. Hard clearance is judged by :attr:`clear`."""
        s, x, u = self.settings, self.states, self.controls
        gaps = quadrotor.dynamics(x[:-1], u, x[1:], s.vehicle.packed, s.dt)
        over = max(
            np.abs(x[:, 7:]).max() - s.speed_limit, np.abs(u[:, :3]).max() - s.rate_limit,
            u[:, 3].max() - s.thrust_limit, -u[:, 3].min(), -x[:, 2].min(),
        )  # fmt: skip
        return bool(np.abs(gaps).max() <= FLYABLE and over <= FLYABLE)

    @property
    def safe(self) -> bool:
        """True if the course can be flown to the target without a collision, converged or not."""
        return self.arrived and self.clear and self.flyable

    @property
    def succeeded(self) -> bool:
        """True if it is safe and the solver converged."""
        return self.safe and self.solution.converged

    @property
    def drift(self) -> float:
        """Distance from the planned end to where the reference integrator leads in one piece [m]."""
        state, s = self.states[0], self.settings
        for control in self.controls:
            state = quadrotor.fly(state, control, s.dt, s.vehicle)
        return float(np.linalg.norm(state[:3] - self.states[-1, :3]))


def solve_course(
    settings: CourseSettings, layout: Layout, solver: fg.Solver, progress: Callback | None = None
) -> Course:
    """Solve the problem of a layout by a solver that has been made already.

    Args:
        settings: the numbers.
        layout: start, target and obstacles.
        solver: any that takes the graph.
        progress: called with every row of the history; returning True ends the solve.
    """
    graph, x, u = state_problem(settings, layout)
    states, controls = course_guess(settings, layout)
    solution = solver.solve(graph, {x: states, u: controls}, callback=progress)
    kept = [row.values[x] for row in solution.history if row.values is not None]
    if kept:
        kept[-1] = solution[x]  # where a solver ends at a point of least violation, the row before it is its last
    iterates = np.stack(kept) if kept else np.zeros((0, *states.shape))
    return Course(settings, layout, solution, solution[x], solution[u], iterates)


def run_course(settings: CourseSettings | None = None, progress: Callback | None = None) -> Course:
    """Solve the problem and keep every iterate.

    Args:
        settings: None for the defaults.
        progress: called with every row of the history; returning True ends the solve.

    Raises:
        ScenarioError: for an unknown guess.
        BackendError: for an unknown solver, an option it does not have, or a cost it does not take.
    """
    settings = settings or CourseSettings()
    return solve_course(settings, settings.layout(), backend(settings, keep_values=True), progress)


def _standing(layout: Layout) -> Array:
    """(10,) level and at rest at the start."""
    return np.concatenate([layout.start, [1.0, 0.0, 0.0, 0.0], np.zeros(3)])


def _way(layout: Layout) -> Array:
    """A shortest way (P, 2) from start to target at the greatest clearance that leaves one [m]."""
    for clearance in _CLEARANCES:
        way = Ways(layout.target[:2], layout.cylinders, layout.walls, clearance).way(layout.start[:2])
        if way is not None:
            return way
    raise fg.ScenarioError(
        f"layout {layout.name!r} has no way of clearance {_CLEARANCES[-1]:g} m to begin with (its widest has "
        f"{layout.widest_way():.2f} m): choose another guess"
    )
