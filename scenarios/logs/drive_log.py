"""Log of a drive."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from unifg.files.ros_map import OccupancyMap
from unifg.models.footprint import Body, body_of
from unifg.scenarios.logs.columns import column, ragged, words
from unifg.scenarios.logs.vehicle_log import VehicleLog
from unifg.typing import Array, BoolArray, IntArray

__all__ = ["Assumed", "EpisodeLog"]


@dataclass(frozen=True)
class Assumed:
    """Constant assumptions of a drive.

    Attributes:
        sigmas: standard deviations of the estimate that clearances are wider by.
        wall_gap, disc_gap: clearances beyond these [m].
        deceleration: of the brakes, by the data sheet [m/s^2].
        ahead: time for which a mover may do anything within its bound before the robot is at rest [s].
        unseen: "free": space that no beam has looked into, but for blind sectors, which are occupied.
    """

    sigmas: float
    wall_gap: float
    disc_gap: float
    deceleration: float
    ahead: float
    unseen: str = "free"


@dataclass(kw_only=True, eq=False)
class EpisodeLog(VehicleLog):
    """One episode of T ticks with a horizon of N steps, K true obstacles and G goals.

    Columns share the leading axis T. Row k holds what was true, estimated and decided at ``time[k]``;
    ``control[k]`` is held over ``[time[k], time[k] + dt]``. An episode that was interrupted is a shorter one.

    Attributes:
        occupancy: map the robot was given, without the unforeseen obstacles.
        walls: map of the true walls.
        assumed: constant assumptions of the robot.
        path: (P, 3) planned path over all goals, world frame [m, m, rad].
        goals: (G, 3) goal poses [m, m, rad].
        start: (3,) true start pose [m, m, rad].
        robot_radius: radius of the robot's disc, or of the largest disc of its body [m].
        solver: name of the backend, or of the planner in its place.
        coupling: how estimation and control were joined, such as ``"sequential"``.
        seed: seed of the episode.
        scan_angles: (B,) beam angles in the body frame [rad].
        reached: one flag per goal.
        obstacle_moves: (K,) True for obstacles that move.
        control_limits: greatest absolute values of the controls.
        scenario: name of the scenario.
        outcomes: what has become of every goal, in words.
        faults: what was made to go wrong.
        obstacles_wanted: unforeseen obstacles that were asked for; fewer may have found a place.
        base: kind of base of the robot.
        body: of the robot, as its option has it; "" for a disc.
    """

    KIND: ClassVar[str] = "unifg drive log 3"

    occupancy: OccupancyMap
    walls: OccupancyMap
    assumed: Assumed
    path: Array
    goals: Array
    start: Array
    robot_radius: float
    solver: str
    coupling: str
    seed: int
    scan_angles: Array
    reached: list[bool]
    obstacle_moves: BoolArray
    control_limits: tuple[float, ...] = (1.0, 1.0)
    scenario: str = "navigation"
    outcomes: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    obstacles_wanted: int = 0
    base: str = "unicycle"
    body: str = ""

    time: Array = column("s")
    true_pose: Array = column("m, m, rad", 3)
    estimate: Array = column("m, m, rad", 3)
    """Localised pose."""
    dead_reckoning: Array = column("m, m, rad", 3)
    """Pose integrated from the wheel odometry alone."""
    covariance: Array = column("m^2, m rad, rad^2", 3, 3)
    """Of the estimate, in its tangent space."""
    control: Array = column("m/s, rad/s", None)
    """Commanded controls: of a unicycle v and omega, of a car v and the steering angle, or v_x, v_y and omega."""
    route: list[Array] = ragged("m, m, rad", 3, lasting=True)
    """The path to the present goal, as repaired so far."""
    horizon: Array = column("m, m, rad", None, 3)
    """Predicted poses."""
    way_out: Array = column("m, m, rad", None, 3)
    """Predicted poses of the evasive trajectory, or of braking, that the tick could have driven without a plan."""
    scan: Array = column("m", None)
    """Lidar ranges; NaN is a dropout, +inf no return."""
    obstacles: Array = column("m", None, 3)
    """True unforeseen obstacles and people: x, y, radius."""
    detected: list[Array] = ragged("m", 3)
    """Tracked obstacles: x, y, radius."""
    expected: list[Array] = ragged("m, m, m/s, m", 4)
    """Assumed of each: place after ``assumed.ahead``, bound of its speed, and how far it may be off the place."""
    solve_ms: Array = column("ms")
    """Localise and plan together."""
    localise_ms: Array = column("ms")
    perceive_ms: Array = column("ms")
    """Update of the tracked obstacles."""
    route_ms: Array = column("ms")
    """Repair of the global route, most often nothing."""
    localisation_iterations: IntArray = column("iterations", dtype=np.intp)
    plan_iterations: IntArray = column("iterations", dtype=np.intp)
    status: list[str] = words()
    """Of the plan, ``"converged"`` when all is well."""
    bound_violation: Array = column()
    """Worst violation of a control bound by the plan that is driven, as the solver returned it, before any clipping."""
    contacts: IntArray = column("events", dtype=np.intp)
    """Contacts so far."""
    goal_index: IntArray = column(dtype=np.intp)
    """Goal being approached."""
    rescued: BoolArray = column(dtype=np.bool_)
    """True where the plan is that of the second backend, asked because the first had none."""
    cause: list[str] = words()
    """Why it is not well."""
    allowed: Array = column("share")
    """Of its speed that the robot may use."""
    explained: Array = column("share")
    """Of the beams of the last scan that ended near something on the map."""
    emergency_stop: BoolArray = column(dtype=np.bool_)
    """True where beams alone have slowed the robot below what was planned."""
    power_off: BoolArray = column(dtype=np.bool_)
    """True where the robot asks for the power of its motors to be cut."""

    @property
    def tick_ms(self) -> Array:
        """(T,) all that a tick takes [ms]."""
        return self.localise_ms + self.perceive_ms + self.route_ms + self.plan_ms

    @property
    def hull(self) -> Body:
        """Body of the robot."""
        return body_of(self.body) if self.body else Body.disc(self.robot_radius)

    @property
    def succeeded(self) -> bool:
        """True only if every goal was reached without a collision, in an episode run to its end."""
        return not self.interrupted and bool(self.reached) and all(self.reached) and self.collisions == 0
