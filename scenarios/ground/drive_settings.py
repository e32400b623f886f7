"""Weights and limits of the driving controller, and its backends by name."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

import unifg as fg
from unifg.errors import ScenarioError
from unifg.models.footprint import Body, body_of
from unifg.models.planar import Base, base_of
from unifg.scenarios.options import (
    AboveZero,
    AtLeastOne,
    AtLeastTwo,
    Positive,
    Settings,
    Signed,
    checked,
    option,
    positive,
)
from unifg.solvers import names
from unifg.typing import Array

PENALTY = 3e4  # of the augmented Lagrangian; the automatic one is stiffer than a tick has time for

SECOND = "ipm"
"""Who is asked, from the way out, when a backend finds no plan. Its own failures it makes good from there itself, more
often than others, and within some 7 ms where an SQP takes 15 to 70 ms and an augmented Lagrangian 6 to 36 ms."""

AVOIDANCES = ("clearance", "barrier", "potential", "vortex")
FUTURES = ("worst", "likeliest", "tree")
SEARCH = 5  # iterations with the tangent vector


@dataclass(frozen=True)
class ControllerSettings(Settings):
    """Weights and limits of the controller.

    Attributes:
        horizon: steps N.
        dt: sampling time [s].
        speed: reference speed along the path [m/s]; the limit of velocity is at least as great.
        base: kind of base: "unicycle", "ackermann", also with its numbers as ackermann:WHEELBASE,STEERING,RATE
            [m, rad, rad/s], or "omnidirectional".
        body: hull: LENGTHxWIDTH, disc:R, polygon:X,Y;X,Y;... (convex) or discs:X,Y,R;X,Y,R [m], x ahead of the axis;
            without one, a disc of the robot's radius.
        limits: greatest |v| [m/s] and |omega| [rad/s].
        accelerations: greatest changes of both, by the data sheet of the base [m/s^2, rad/s^2].
        pose_sigma: (x, y, theta) of the stage cost [m, m, rad].
        terminal_sigma: the same at the end of the horizon.
        control_sigma: (v, omega) deviation from the reference control [m/s, rad/s].
        rate_sigma: (v, omega) change between samples [m/s, rad/s].
        control_weight: factor on all costs of the controller; matters where they meet those of the estimate.
        pull: most by which they may move a joint estimate from where the past puts it [m, m, rad].
        robot_radius: of the disc [m]; of a body, of its largest disc.
        wall_clearance: least distance of the hull to walls [m].
        disc_clearance: least distance of the hull to tracked discs [m].
        sigmas: by how many standard deviations of the estimate, along the normal, both distances are wider.
        mover_speed: at least this fast is a disc that has ever moved believed to be able to go on [m/s].
        mover_unseen: for so long such a disc may go elsewhere before the robot has decided what to do [s].
        mover_margin: added to the soft margin around such discs [m].
        approach: rate at which the gap to such a disc may close, alpha of its barrier [1/s].
        avoidance: of walls and discs: "clearance" as a constraint, with a barrier to discs that have ever moved;
            "barrier", the same with a barrier to everything; "potential" as a cost (Bazzana et al., eq. 9) and no
            constraint; "vortex", that potential, searched with his tangent vector.
        futures: of movers that a plan prepares for: "worst", all that they can do; "likeliest", one; "tree", a tail of
            the horizon for each of the likeliest and one for the worst. A potential knows the worst alone.
        tails: of such a tree.
        shared: steps before they part.
        potential_sigma: of the potential's error; its weight is the inverse square.
        squeeze: how much nearer than at rest a plan may pass a standing disc where the clearance is violated [m].
        margin: distance of the hull below which the soft costs begin [m].
        margin_sigma: [m].
        discs: tracked discs considered at once.
        tolerance: of the KKT test.
        step_tolerance: norm of a step over the whole horizon below which iterating on is of no use to the robot.
        feasible: largest violation of a plan that may be driven; negative where none may.
    """

    base: str = option("unicycle", text=checked(base_of), metavar="BASE")
    body: str = option("", text=checked(body_of), metavar="BODY")
    horizon: AtLeastTwo = 30
    dt: Positive[float] = 0.1
    speed: float = option(1.0, text=positive, metavar="M/S")
    limits: Positive[tuple[float, float]] = (1.0, 1.0)
    accelerations: AboveZero[tuple[float, float]] = (2.5, 3.2)
    pose_sigma: Positive[tuple[float, float, float]] = (0.3, 0.3, 0.6)
    terminal_sigma: Positive[tuple[float, float, float]] = (0.1, 0.1, 0.2)
    control_sigma: Positive[tuple[float, float]] = (1.0, 2.0)
    rate_sigma: Positive[tuple[float, float]] = (0.5, 1.0)
    control_weight: float = option(1.0, text=positive, metavar="W")
    pull: Positive[tuple[float, float, float]] = (0.01, 0.01, 0.01)
    robot_radius: float = option(0.17, text=positive, metavar="M")
    wall_clearance: float = 0.03
    disc_clearance: float = 0.06
    sigmas: float = 2.0
    mover_speed: float = 0.3
    mover_unseen: float = 0.1
    mover_margin: float = 0.3
    approach: Positive[float] = -math.log(0.88) / 0.1
    avoidance: str = option("clearance", choices=AVOIDANCES)
    futures: str = option("worst", choices=FUTURES)
    tails: int = 2
    shared: int = 5
    potential_sigma: Positive[float] = 0.2
    squeeze: float = 0.03
    margin: float = 0.2
    margin_sigma: Positive[float] = 0.1
    discs: AtLeastOne = 3
    tolerance: Positive[float] = 1e-4
    step_tolerance: float = 3e-3
    feasible: Signed[float] = 5e-4

    def __post_init__(self) -> None:
        """Refuse unknown bases, and ways of avoiding things that do not go."""
        super().__post_init__()
        base_of(self.base)
        if self.body:
            object.__setattr__(self, "robot_radius", self.hull.radius)
        if not self.hull.round and self.avoidance in ("potential", "vortex"):
            raise ScenarioError(f"avoidance '{self.avoidance}' is one of discs about their axis; leave --body out")
        if self.branches and not (self.tails >= 2 and 1 <= self.shared < self.horizon):
            raise ScenarioError(
                f"a tree has two tails or more, and shares 1 to {self.horizon - 1} of {self.horizon} steps: found "
                f"{self.tails} tails, {self.shared} shared"
            )

    @property
    def branches(self) -> bool:
        """True for a horizon that is a tree."""
        return self.futures == "tree" and self.avoidance in ("clearance", "barrier")

    @property
    def kind(self) -> Base:
        """The base."""
        return base_of(self.base)

    @cached_property
    def hull(self) -> Body:
        """The body."""
        return body_of(self.body) if self.body else Body.disc(self.robot_radius)

    @property
    def oriented(self) -> bool:
        """True where a way has to be searched with its headings: of a car, or a body that is no disc about its axis."""
        return self.kind.turning_radius > 0.0 or not self.hull.round

    def weighted(self, sigma: tuple[float, ...]) -> Array:
        """Standard deviations of costs of the controller, scaled by their common weight."""
        scaled: Array = np.array(sigma) / np.sqrt(self.control_weight)
        return scaled

    def every(self, sigma: tuple[float, float]) -> Array:
        """(m,) scaled standard deviations of all controls, from those of translation and of turning."""
        translation, turning = self.weighted(sigma).tolist()
        return self.kind.spread((translation, turning))

    @property
    def mover_surprise(self) -> float:
        """Time for which a disc that has ever moved may go anywhere before the robot can be at rest [s].

        What it travels in that time is kept off, too: a base that brakes at 1 m/s^2 needs more room than one of 2.5.
        """
        return self.mover_unseen + min(self.speed, float(self.box[1][0])) / self.accelerations[0]

    @property
    def pace(self) -> Array:
        """(N,) speeds at the ends of the steps of one who drives at full speed and comes to rest at the end [m/s]."""
        braking = float(self.most[0]) * np.arange(self.horizon, 0.0, -1.0)
        return np.minimum(braking, min(self.speed, self.box[1][0]))

    @property
    def stations(self) -> Array:
        """(N + 1,) how far he comes [m].

        He does not begin at the speed of now: from rest, a reference that first stays where it is, with the heading of
        the path, would let a robot beside its goal put off for ever the turn that it needs.
        """
        pace = self.pace
        means = 0.5 * (np.concatenate([pace[:1], pace[:-1]]) + pace)
        return np.concatenate([[0.0], np.cumsum(self.dt * means)])

    @property
    def most(self) -> Array:
        """(m,) greatest changes of the controls in a step [m/s, rad/s]; more than from end to end means nothing."""
        fastest = self.kind.spread(self.accelerations)
        if self.kind.steering is not None:
            fastest[-1] = self.kind.steering[1]
        return np.minimum(fastest * self.dt, 2.0 * self._greatest)

    @property
    def _greatest(self) -> Array:
        """(m,) greatest controls."""
        greatest = self.kind.spread((max(self.limits[0], self.speed), self.limits[1]))
        if self.kind.steering is not None:
            greatest[-1] = self.kind.steering[0]
        return greatest

    @property
    def box(self) -> tuple[Array, Array]:
        """Least and greatest controls (m,), from which the base comes to rest within the horizon."""
        limits: Array = np.minimum(self._greatest, self.horizon * self.most)
        return -limits, limits


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
    own: dict[str, dict[str, float | str]] = {
        "sqp": {**early, "max_iterations": 10 * patience},
        "alm": {**early, "max_iterations": 18 * patience, "penalty": PENALTY},
        "ipm": {**early, "max_iterations": 25 * patience, "hessian": "gauss-newton", "restoration": False},
    }
    search = SEARCH if settings.avoidance == "vortex" else 0
    return names.backend(name, tolerance=settings.tolerance, search_iterations=search, **own.get(name, {}))
