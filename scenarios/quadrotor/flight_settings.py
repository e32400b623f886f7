"""Weights and limits of the flying controller, and its backends by name."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np

import unifg as fg
from unifg.scenarios.options import AtLeastTwo, Positive, Settings, Signed, option
from unifg.scenarios.quadrotor.guide import GuideSettings
from unifg.solvers import names
from unifg.typing import Array, ArrayLike

Avoidance: TypeAlias = Literal["clearance", "potential"]


@dataclass(frozen=True)
class ControllerSettings(Settings):
    """Weights and limits of the controller.

    Attributes:
        horizon: steps N.
        dt: sampling time [s].
        position_sigma: deviation from the reference along x, y, z [m].
        velocity_sigma: the same [m/s].
        terminal_weight: factor on the weight of both at the end of the horizon.
        level_sigma: entries of R'e3 against those at hover.
        control_sigma: body rates [rad/s] and thrust [N] against hover.
        rate_sigma: their change from one step to the next.
        control_weight: factor on all costs of the controller; matters where they meet those of the estimate.
        rate_limits: greatest |omega| about each axis [rad/s].
        thrust_limits: least and greatest [N].
        lean_limit: greatest |entry| of R'e3 along the horizontal axes of the body: sine of roll or pitch.
        height_limits: least and greatest z [m].
        vehicle_radius: [m].
        margin: distance of the hull from everything [m].
        sigmas: of a landmark's position that are added to its margin.
        margin_limit: most that they add [m].
        cylinders: slots for cylinders.
        movers: slots for moving discs.
        mover_margin: added to the margin around moving discs [m].
        mover_growth: by which that grows with the time to a node [m/s].
        avoidance: "clearance", hard, or "potential", Ta's cost 1/d as half the square of its root.
        goal_sigma: of Ta's cost |p - l_g|^2 [m].
        potential_weight: factor on Ta's cost 1/d [m].
        guide: of the reference.
        tolerance: of the KKT test.
        step_tolerance: norm of a step over the horizon below which iterating on is of no use to the vehicle.
        feasible: largest defect of the dynamics of a plan that may be flown; negative where none may.
        give: largest violation of a clearance in such a plan [m]; less than the margin.
    """

    horizon: AtLeastTwo = 30
    dt: Positive[float] = 0.05
    position_sigma: Positive[tuple[float, float, float]] = (0.5, 0.5, 0.3)
    velocity_sigma: Positive[tuple[float, float, float]] = (0.7, 0.7, 0.7)
    terminal_weight: float = 5.0
    level_sigma: Positive[float] = 0.3
    control_sigma: Positive[tuple[float, float, float, float]] = (1.5, 1.5, 0.7, 3.0)
    rate_sigma: Positive[tuple[float, float, float, float]] = (1.0, 1.0, 0.5, 2.0)
    control_weight: Positive[float] = 1.0
    rate_limits: Positive[tuple[float, float, float]] = (4.0, 4.0, 2.0)
    thrust_limits: Positive[tuple[float, float]] = (2.0, 20.0)
    lean_limit: Positive[float] = 0.6
    height_limits: Signed[tuple[float, float]] = (0.3, 3.0)
    vehicle_radius: Positive[float] = 0.25
    margin: float = 0.05
    sigmas: float = 1.0
    margin_limit: float = 0.1
    cylinders: int = 5
    movers: int = 2
    mover_margin: float = 0.25
    mover_growth: float = 0.25
    avoidance: Avoidance = option("clearance")
    goal_sigma: Positive[float] = 1.0
    potential_weight: float = 1.0
    guide: GuideSettings = field(default_factory=GuideSettings)
    tolerance: Positive[float] = 1e-3
    step_tolerance: float = 1e-2
    feasible: Signed[float] = 1e-2
    give: float = 0.04

    def __post_init__(self) -> None:
        """Refuse heights that leave no room.

        Raises:
            ScenarioError: naming the field.
        """
        super().__post_init__()
        low, high = self.height_limits
        if not low < high:
            raise fg.ScenarioError(f"height_limits: the first must be below the second, found {low:g} and {high:g} m")

    def weighted(self, sigma: ArrayLike) -> Array:
        """Standard deviations of costs of the controller, scaled by their common weight."""
        scaled: Array = np.asarray(sigma) / np.sqrt(self.control_weight)
        return scaled

    @property
    def box(self) -> tuple[Array, Array]:
        """Least and greatest controls (4,) [rad/s, N]."""
        least, most = self.thrust_limits
        return np.array([*(-limit for limit in self.rate_limits), least]), np.array([*self.rate_limits, most])


def backend(name: str, settings: ControllerSettings, cold: bool = False) -> fg.Solver:
    """The backend of a control loop by its short name.

    Args:
        name: one of `unifg.solvers.names.CONSTRAINED`.
        settings: tolerances.
        cold: whether there is no warm start, so that a tick may iterate longer.

    Raises:
        BackendError: for an unknown name.
    """
    early = {"step_tolerance": settings.step_tolerance, "violation_tolerance": 0.5 * settings.feasible}
    own: dict[str, dict[str, float]] = {
        "ipm": {"max_iterations": 40 if cold else 25},
        "sqp": {**early, "max_iterations": 20 if cold else 5},
        "alm": {**early, "max_iterations": 60 if cold else 20},
    }
    return names.backend(name, tolerance=settings.tolerance, **own.get(name, {}))
