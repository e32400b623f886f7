"""How estimation and control are coupled: two graphs that share nothing, two that share a belief, or one graph."""

from __future__ import annotations

import time

from unifg.errors import ScenarioError
from unifg.models import quadrotor
from unifg.scenarios.quadrotor.belief import Belief
from unifg.scenarios.quadrotor.controller import Controller
from unifg.scenarios.quadrotor.estimator import DeadReckoningEstimator, Estimator, EstimatorSettings
from unifg.scenarios.quadrotor.layouts import Layout
from unifg.scenarios.quadrotor.plan import ControllerSettings, Plan
from unifg.scenarios.quadrotor.sensor import Reading
from unifg.scenarios.quadrotor.tracker import Tracker
from unifg.typing import Array

__all__ = ["COUPLINGS", "Pilot", "make_pilot"]

COUPLINGS = ("separate", "sequential", "joint")


class Pilot:
    """Estimates, then plans on what is estimated.

    Attributes:
        estimator: of state, parameters and landmarks.
        controller: of the flight.
        tracker: of what moves.
        belief: after the last tick.
        estimate_ms: wall-clock time of the last estimate, tracks included [ms].
        plan_ms: wall-clock time of the last decision [ms].
    """

    def __init__(self, estimator: Estimator, controller: Controller) -> None:
        """Join two graphs that stand for themselves."""
        self.estimator, self.controller = estimator, controller
        self.tracker = Tracker(association=estimator.settings.association)
        self.belief: Belief = estimator.belief()
        self.estimate_ms = self.plan_ms = 0.0

    def tick(self, reading: Reading, control: Array | None) -> Plan:
        """Decide.

        Args:
            reading: of now.
            control: (4,) applied since the last reading; None at the first one.
        """
        begin = time.perf_counter()
        self.belief = self.estimator.update(reading, control)
        movers = self.tracker.update(reading, self.belief.state)
        estimated = time.perf_counter()
        self.estimate_ms = 1e3 * (estimated - begin)
        plan = self.controller.plan(self.belief, movers)
        self.plan_ms = 1e3 * (time.perf_counter() - estimated)
        return plan


def make_pilot(
    coupling: str,
    solver: str,
    layout: Layout,
    state: Array,
    nominal: quadrotor.Parameters,
    estimator: EstimatorSettings,
    controller: ControllerSettings,
) -> Pilot:
    """The pilot of one flight.

    Args:
        coupling: "separate", an estimator without dynamics and a controller that keeps the nominal parameters;
            "sequential", an estimator with the controller's dynamics that hands on state, parameters and landmarks;
            "joint", one graph of past and future.
        solver: of the controller.
        layout: of which start, target and walls are known, not the cylinders.
        state: (10,) believed at the start.
        nominal: parameters believed at the start.
        estimator: settings of the past.
        controller: settings of the future.

    Raises:
        ScenarioError: for an unknown coupling, solver, association or avoidance.
    """
    if coupling == "joint":
        from unifg.scenarios.quadrotor.joint_pilot import joint_pilot

        return joint_pilot(solver, layout, state, nominal, estimator, controller)
    kinds: dict[str, type[Estimator]] = {"separate": DeadReckoningEstimator, "sequential": Estimator}
    if coupling not in kinds:
        raise ScenarioError(f"unknown coupling '{coupling}': choose {', '.join(COUPLINGS)}")
    return Pilot(
        kinds[coupling](state, nominal, estimator, layout.corners),
        Controller(layout.target, layout.walls, solver, controller, layout.size),
    )
