"""Where to go? A model-predictive controller as a factor graph (Bazzana et al. 2022, section V).

Costs: distance to reference poses along the path (eq. 8), control effort, control rate, soft margins to walls and
discs. Constraints: unicycle dynamics, velocity limits, hard clearance from walls and from tracked discs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import unifg as fg
from unifg.lie import wrap_angle
from unifg.models import obstacles, unicycle
from unifg.models.distance_map import DistanceMap
from unifg.models.smooth_field import SmoothField
from unifg.scenarios.options import option, positive
from unifg.scenarios.seeing.tracks import Tracks, nearest
from unifg.solvers import names
from unifg.typing import Array, BoolArray

FAR_AWAY = 1e3  # [m]; where an unused disc waits
PENALTY = 3e4  # of the augmented Lagrangian; the automatic one is stiffer than a tick has time for
COLD_PATIENCE = 3  # a tick without a warm start may iterate longer
YIELD_SPEED = 0.05  # [m/s] towards the robot
LEFT_BEHIND = 0.6  # [m] between the ends of plan and reference
BRAKING = 6  # ticks to come to rest when no new plan is found
PURSUIT = 0.3  # [m] ahead of the robot, where a guess aims at the reference
PURSUIT_TIME = 0.2  # [s] in which it would turn there
ARRIVED = 0.05  # [m] to the end of the reference, where it only turns
PATIENCE = 5  # ticks of being left behind before the plan starts over from the reference


@dataclass(frozen=True)
class ControllerSettings:
    """Weights and limits of the controller.

    Attributes:
        horizon: steps N.
        dt: sampling time [s].
        speed: reference speed along the path [m/s].
        limits: greatest |v| [m/s] and |omega| [rad/s].
        pose_sigma: (x, y, theta) of the stage cost [m, m, rad].
        terminal_sigma: the same at the end of the horizon.
        control_sigma: (v, omega) deviation from the reference control [m/s, rad/s].
        rate_sigma: (v, omega) change between samples [m/s, rad/s].
        control_weight: factor on all costs of the controller; matters where they meet those of the estimate.
        pull: most by which they may move a joint estimate from where the past puts it [m, m, rad].
        robot_radius: [m].
        wall_clearance: least distance of the hull to walls [m].
        disc_clearance: least distance of the hull to tracked discs [m].
        mover_speed: fastest walk of a mover [m/s].
        mover_allowance: most that is added to the clearance from discs that have ever moved [m].
        mover_margin: added to the soft margin around such discs [m].
        approach: share of the gap to such a disc that one step may close.
        squeeze: how much nearer than at rest a plan may pass a standing disc where the clearance is violated [m].
        courtesy: gap at which movers wait for a robot at rest [m].
        yield_distance: gap to a mover that closes in at which the robot rests [m].
        margin: distance of the hull below which the soft costs begin [m].
        margin_sigma: [m].
        discs: tracked discs considered at once.
        tolerance: of the KKT test.
        step_tolerance: norm of a step over the whole horizon below which iterating on is of no use to the robot.
        feasible: largest violation of a plan that may be driven.
    """

    horizon: int = 30
    dt: float = 0.1
    speed: float = 1.0
    limits: tuple[float, float] = (1.0, 1.0)
    pose_sigma: tuple[float, float, float] = (0.3, 0.3, 0.6)
    terminal_sigma: tuple[float, float, float] = (0.1, 0.1, 0.2)
    control_sigma: tuple[float, float] = (1.0, 2.0)
    rate_sigma: tuple[float, float] = (0.5, 1.0)
    control_weight: float = option(1.0, text=positive, metavar="W")
    pull: tuple[float, float, float] = (0.01, 0.01, 0.01)
    robot_radius: float = 0.17
    wall_clearance: float = 0.03
    disc_clearance: float = 0.06
    mover_speed: float = 0.3
    mover_allowance: float = 0.15
    mover_margin: float = 0.3
    approach: float = 0.12
    squeeze: float = 0.03
    courtesy: float = 0.1
    yield_distance: float = 0.3
    margin: float = 0.2
    margin_sigma: float = 0.1
    discs: int = 3
    tolerance: float = 1e-4
    step_tolerance: float = 3e-3
    feasible: float = 5e-4


def backend(name: str, settings: ControllerSettings, patience: int = 1) -> fg.Solver:
    """The backend of a control loop by its short name.

    Args:
        name: one of `unifg.solvers.names.CONSTRAINED`.
        settings: tolerances.
        patience: factor on the iterations of a warm-started tick.

    Raises:
        BackendError: for an unknown name.
    """
    early = {"step_tolerance": settings.step_tolerance, "violation_tolerance": 0.5 * settings.feasible}
    own: dict[str, dict[str, float]] = {
        "sqp": {**early, "max_iterations": 10 * patience},
        "alm": {**early, "max_iterations": 18 * patience, "penalty": PENALTY},
        "ipm": {"max_iterations": 25 * patience},
    }
    return names.backend(name, tolerance=settings.tolerance, **own.get(name, {}))


@dataclass(frozen=True)
class Plan:
    """What a tick decided.

    Attributes:
        control: (2,) to be applied now [m/s, rad/s].
        states: (N + 1, 3) predicted poses [m, m, rad].
        status: status of the solve.
        iterations: of the backend.
        bound_violation: of the plan that is driven, as the solver returned it, before any clipping.
        emergency: whether the stored plan is being driven instead.
    """

    control: Array
    states: Array
    status: fg.Status
    iterations: int
    bound_violation: float
    emergency: bool


class Controller:
    """A compiled control graph that is warm-started with its shifted solution."""

    def __init__(self, distance_map: DistanceMap, solver: str, settings: ControllerSettings) -> None:
        """State the graph and prepare the backend."""
        self.settings = s = settings
        n, m = s.horizon, s.discs
        graph = fg.Graph()

        def weighted(sigma: tuple[float, ...]) -> Array:
            scaled: Array = np.array(sigma) / np.sqrt(s.control_weight)
            return scaled

        self._x = x = graph.variables("pose", fg.SE2, n + 1)
        self._u = u = graph.variables("control", fg.Rn(2), n)
        self._reference = graph.data("reference", np.zeros((n - 1, 3)), each=True)
        self._end = graph.data("end of reference", np.zeros(3))
        self._cruise = graph.data("reference control", np.zeros((n, 2)), each=True)
        self._last = graph.data("last control", np.zeros(2))
        self._wall_limit = graph.data("wall clearance", np.zeros((n, 1)), each=True)
        self._disc_limit = graph.data("disc clearance", np.zeros((n, m)), each=True)
        self._centres = graph.data("disc centres", np.full((n, m, 2), FAR_AWAY), each=True)
        self._radii = graph.data("disc radii", np.zeros(m))
        self._shy_radii = graph.data("disc radii for the margin", np.zeros(m))
        self._anchor(graph, x)
        graph.minimize(unicycle.tracking, x[1:-1], self._reference, sigma=weighted(s.pose_sigma), name="path")
        graph.minimize(unicycle.tracking, x[-1], self._end, sigma=weighted(s.terminal_sigma), name="end of path")
        graph.minimize(fg.prior, u, self._cruise, sigma=weighted(s.control_sigma), name="effort")
        graph.minimize(fg.prior, u[0], self._last, sigma=weighted(s.rate_sigma), name="first change")
        graph.minimize(unicycle.rate, u[:-1], u[1:], sigma=weighted(s.rate_sigma), name="change")
        self._field = SmoothField(distance_map)
        walls = obstacles.wall_distance(self._field)
        wall_margin = obstacles.shortfall(walls, s.robot_radius + s.margin)
        disc_margin = obstacles.shortfall(obstacles.disc_clearance, s.robot_radius + s.margin)
        graph.minimize(wall_margin, x[1:], sigma=weighted((s.margin_sigma,))[0], name="wall margin")
        graph.minimize(
            disc_margin, x[1:], self._centres, self._shy_radii, sigma=weighted((s.margin_sigma,))[0], name="disc margin"
        )
        graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], s.dt, lower=0.0, upper=0.0, name="dynamics")
        graph.bound(u, lower=[-limit for limit in s.limits], upper=s.limits, name="limits")
        graph.constrain(walls, x[1:], lower=self._wall_limit, name="walls")
        graph.constrain(
            obstacles.disc_clearance, x[1:], self._centres, self._radii, lower=self._disc_limit, name="discs"
        )
        self._run = backend(solver, s).prepare(graph)
        self._cold = backend(solver, s, COLD_PATIENCE).prepare(graph)
        self._guess: fg.Guess | None = None
        self._applied = np.zeros(2)
        self._stored = np.zeros((n, 2))
        self._age = n
        self._lagging = 0
        self._failed = False

    def plan(self, pose: Array, reference: Array, tracks: Tracks) -> Plan:
        """Decide the next control.

        Args:
            pose: (3,) estimate [m, m, rad].
            reference: (N + 1, 3) poses along the path, the first beside the robot.
            tracks: discs the robot has seen.
        """
        data = self._data(pose, reference, tracks)
        run, guess = self._beginning(pose, reference)
        return self._judge(run.solve(guess, data=data), pose, reference, tracks)

    def _beginning(self, pose: Array, reference: Array) -> tuple[fg.Prepared, fg.Guess]:
        """The shifted solution; without one, rest after a failure, and the reference otherwise."""
        if self._guess is not None:
            return self._run, self._guess
        return (self._run, self._staying(pose)) if self._failed else (self._cold, self._along(pose, reference))

    def _anchor(self, graph: fg.Graph, x: fg.Family) -> None:
        """Tie the horizon to the estimate: here it is given, and its first pose fixed."""
        self._start = graph.data("start", np.zeros(3))
        graph.fix(x[0], self._start)

    def _anchored(self, pose: Array) -> dict[fg.Data, Array]:
        """Data of what :meth:`_anchor` stated."""
        return {self._start: pose}

    def _judge(self, solution: fg.Solution, pose: Array, reference: Array, tracks: Tracks) -> Plan:
        """Drive a plan that keeps the constraints; brake along the last one otherwise; rest where a mover nears.

        Of a solve that ended early this is where it stopped. The cheapest iterate it has passed that keeps the
        constraints was tried: such plans brush past obstacles and creep up to those that stand in the way.
        """
        s = self.settings
        if solution.violation <= s.feasible:
            self._stored, self._age = solution[self._u], 0
            emergency = self._failed = False
            states = solution[self._x]
            self._guess = None if self._left_behind(states, reference) else solution.shifted(self._x, self._u)
        else:
            self._age += 1
            self._guess = None
            emergency = self._failed = True
            states = unicycle.rollout(pose, self._braking(), s.dt)
        beyond = float(np.maximum(np.abs(self._stored) - s.limits, 0.0).max())
        control = self._braking()[0] if emergency else np.clip(self._stored[0], *_box(s))
        self._applied = np.zeros(2) if self._yields(pose, tracks) else control
        return Plan(self._applied, states, solution.status, solution.iterations, beyond, emergency)

    def forget(self) -> None:
        """Drop the warm start, as when a new route makes it misleading."""
        self._guess = None
        self._failed = False

    def _left_behind(self, states: Array, reference: Array) -> bool:
        """Whether plans have ended far from the reference for so long that they must be caught in a dead end."""
        far = float(np.hypot(*(states[-1] - reference[-1])[:2])) > LEFT_BEHIND
        self._lagging = self._lagging + 1 if far else 0
        if self._lagging < PATIENCE:
            return False
        self._lagging = 0
        return True

    def _braking(self) -> Array:
        """The stored plan slowed to rest; the path keeps its shape, and the robot rests well before its end."""
        controls = np.zeros((self.settings.horizon, 2))
        stages = np.arange(self._age, self.settings.horizon)
        fade = np.maximum(1.0 - stages / BRAKING, 0.0)
        stored = self._stored[stages] * fade[:, None]
        fastest = np.abs(stored[:, 0]).max(initial=0.0)
        slower = min(1.0, abs(float(self._applied[0])) / fastest) if fastest > 0.0 else 1.0
        controls[: len(stages)] = slower * stored
        return controls

    def _staying(self, pose: Array) -> fg.Guess:
        """Guess rest, which is feasible: from there a solver that failed finds the near side of what stopped it."""
        n = self.settings.horizon
        return fg.Guess({self._x: np.tile(pose, (n + 1, 1)), self._u: np.zeros((n, 2))})

    def _along(self, pose: Array, reference: Array) -> fg.Guess:
        """Guess how a simple pursuit would follow the reference, which leads around whatever the route leads around.

        It keeps limits and dynamics: it turns first where the reference begins behind the robot's back.
        """
        s = self.settings
        speeds, controls = self._cruising(reference), np.zeros((s.horizon, 2))
        states = np.tile(pose, (s.horizon + 1, 1))
        aim = 0
        for k in range(s.horizon):
            here = states[k]
            while aim < s.horizon and np.hypot(*(reference[aim] - here)[:2]) < PURSUIT:
                aim += 1
            ahead = reference[aim] - here
            distance = float(np.hypot(*ahead[:2]))
            bearing = np.arctan2(ahead[1], ahead[0]) if distance > ARRIVED else reference[aim, 2]
            turn = float(wrap_angle(bearing - here[2]))
            speed = min(speeds[k], distance / s.dt) * max(np.cos(turn), 0.0) ** 2 if distance > ARRIVED else 0.0
            controls[k] = np.clip([speed, turn / PURSUIT_TIME], *_box(s))
            states[k + 1] = unicycle.step(here[None], controls[k : k + 1], s.dt)[0]
        return fg.Guess({self._x: states, self._u: controls})

    def _cruising(self, reference: Array) -> Array:
        """(N,) speeds between reference poses [m/s]."""
        lengths: Array = np.hypot(*np.diff(reference[:, :2], axis=0).T)
        return lengths / self.settings.dt

    def _data(self, pose: Array, reference: Array, tracks: Tracks) -> dict[fg.Data, Array]:
        s = self.settings
        n, m = s.horizon, s.discs
        centres, radii, movers = np.full((n, m, 2), FAR_AWAY), np.zeros(m), np.zeros(m, dtype=bool)
        chosen = nearest(tracks, pose, m)
        k = len(chosen)
        centres[:, :k], radii[:k], movers[:k] = self._predicted(pose, chosen), chosen.radius, chosen.mover
        cruise = np.zeros((n, 2))
        cruise[:, 0] = self._cruising(reference)
        return {
            **self._anchored(pose),
            self._reference: reference[1:-1],
            self._end: reference[-1],
            self._cruise: cruise,
            self._last: self._applied,
            self._wall_limit: self._wall_limits(pose),
            self._disc_limit: self._disc_limits(pose, centres, radii, movers),
            self._centres: centres,
            self._radii: radii,
            self._shy_radii: radii + np.where(movers, s.mover_margin, 0.0),
        }

    def _wall_limits(self, pose: Array) -> Array:
        """(N, 1) least distances to walls; a robot found nearer may not come nearer still."""
        s = self.settings
        now = self._field.distance(pose[None, :2])
        return np.full((s.horizon, 1), min(s.robot_radius + s.wall_clearance, float(now[0])))

    def _predicted(self, pose: Array, tracks: Tracks) -> Array:
        """(N, k, 2) centres along the horizon.

        A mover goes straight on, but not into a robot at rest, for which it waits; and it is not trusted to go
        away, for it may turn round.
        """
        s = self.settings
        stages = s.dt * np.arange(1, s.horizon + 1)
        centres: Array = tracks.centre + stages[:, None, None] * tracks.expected_velocity(pose[:2])
        gap = np.hypot(*np.moveaxis(centres - pose[:2], 2, 0)) - tracks.radius - s.robot_radius
        blocked = np.maximum.accumulate(gap < s.courtesy, axis=0)
        last = np.maximum((~blocked).sum(axis=0) - 1, 0)  # the stage before the mover has to wait
        return np.where(blocked[:, :, None], centres[last, np.arange(len(tracks))], centres)

    def _disc_limits(self, pose: Array, centres: Array, radii: Array, movers: BoolArray) -> Array:
        """(N, M) least distances to discs, as far as a robot at rest keeps them: resting is always feasible.

        A disc that has ever moved is kept off by what it can travel in the meantime, up to a limit, and is not
        approached by more than a share of the gap each step, as a control barrier function demands.
        """
        s = self.settings
        stages = np.arange(1, s.horizon + 1)[:, None]
        at_rest = np.hypot(*np.moveaxis(pose[:2] - centres, 2, 0)) - radii
        allowance = np.minimum(s.mover_speed * s.dt * stages, s.mover_allowance)
        least = s.robot_radius + s.disc_clearance + np.where(movers, allowance, 0.0)
        spare = np.where(movers, np.maximum(at_rest[0] - least, 0.0), 0.0)
        # A little nearer is allowed, or a robot beside a disc could not even turn its nose past it; not so to a disc
        # that moves, for one that waits beside a robot at rest goes on as soon as the robot does.
        squeezed = np.minimum(at_rest, np.maximum(at_rest - s.squeeze, s.robot_radius + s.squeeze))
        kept = np.where(movers, at_rest, squeezed)
        limits: Array = np.minimum(least + spare * (1.0 - s.approach) ** stages, kept)
        return limits

    def _yields(self, pose: Array, tracks: Tracks) -> bool:
        """Whether a mover is so near and closing in that resting, which it respects, is the only safe answer."""
        s = self.settings
        offset = pose[:2] - tracks.centre
        distance = np.hypot(*offset.T)
        closing = np.einsum("ij,ij->i", offset, tracks.velocity) / np.maximum(distance, 1e-9)
        near = distance - tracks.radius - s.robot_radius < s.yield_distance
        return bool((tracks.mover & near & (closing > YIELD_SPEED)).any())


def _box(settings: ControllerSettings) -> tuple[Array, Array]:
    limits: Array = np.array(settings.limits)
    return -limits, limits
