"""Coupling of estimation and control: two graphs that share nothing, two that share a belief, or one graph."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from unifg.horizon import Plan
from unifg.models import quadrotor
from unifg.scenarios.perception.belief import Belief
from unifg.scenarios.perception.line_tracker import LineTracker
from unifg.scenarios.perception.readings import Reading
from unifg.scenarios.quadrotor.estimator import STILL, DeadReckoning, Dynamics, Estimator, EstimatorSettings
from unifg.scenarios.quadrotor.flight_control import Controller
from unifg.scenarios.quadrotor.flight_joint import BELIEVABLE, JointSettings, SharedFlight
from unifg.scenarios.quadrotor.flight_settings import ControllerSettings
from unifg.scenarios.simulation.layouts import Layout
from unifg.scenarios.stopwatch import Stopwatch
from unifg.typing import Array

COUPLINGS = ("separate", "sequential", "joint")


class Pilot:
    """Estimates, then plans on what is estimated.

    Attributes:
        estimator: of state, parameters and landmarks.
        controller: of the flight.
        tracker: of what moves.
        belief: after the last tick; that of the joint solve, if there is one.
        alone: what the estimator alone says of the last tick.
        pushed: the belief to plan with, of what is estimated: with what pushes just now and is in no model.
        clock: how long the stages of the last tick took: estimate, with the tracks, and plan.
    """

    def __init__(self, estimator: Estimator, controller: Controller) -> None:
        """Join what stands for itself."""
        self.estimator, self.controller = estimator, controller
        self.tracker = LineTracker(estimator.settings.association, estimator.settings.confirmation)
        self.belief: Belief = estimator.belief()
        self.alone = self.belief
        self.pushed: Callable[[Belief], Belief] = lambda belief: belief
        self.clock = Stopwatch()
        self.clock.seconds = {"estimate": 0.0, "plan": 0.0}

    def tick(self, reading: Reading, control: Array | None, push: Array = STILL) -> Plan:
        """Recognise, then decide.

        Args:
            reading: of now.
            control: (4,) applied since the last reading; None at the first one.
            push: (2,) what was felt meanwhile and no model holds [m/s^2].
        """
        return self.decide(self.recognise(reading, control, push))

    def recognise(self, reading: Reading, control: Array | None, push: Array = STILL) -> Reading:
        """Move on to a reading, arguments as of :meth:`tick`; it comes back with the names and flags known here."""
        self.clock.start()
        self.estimator.predict(reading, control, push)
        return self.tracker.told(reading, self.estimator.window.present)

    def decide(self, reading: Reading) -> Plan:
        """Estimate and plan with a reading that was recognised."""
        self.estimator.see(reading)
        self.belief = self.alone = self.estimator.estimate()
        movers = self.tracker.update(reading, self.alone.state)
        self.clock.split("estimate")
        given = self.pushed(self.alone)
        plan = self.controller.plan(given, movers)
        self.clock.split("plan")
        told = self.controller.belief
        self.belief = self.alone if told is given else told
        return plan


def make_pilot(
    coupling: str,
    solver: str,
    layout: Layout,
    state: Array,
    nominal: quadrotor.Parameters,
    estimator: EstimatorSettings,
    controller: ControllerSettings,
    joint: JointSettings | None = None,
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
        joint: how far the future may lean on the past, in one graph.

    Raises:
        BackendError: for an unknown solver.
    """
    model = (DeadReckoning if coupling == "separate" else Dynamics)(nominal)
    past = Estimator(state, nominal, estimator, layout.corners, model)
    if coupling == "joint":
        return Pilot(past, joint_controller(past, layout, solver, controller, joint or JointSettings()))
    return Pilot(past, Controller(layout.target, layout.walls, solver, controller, layout.size))


def joint_controller(
    estimator: Estimator, layout: Layout, solver: str, settings: ControllerSettings, joint: JointSettings
) -> Controller:
    """A controller whose first state, parameters and map are estimated in the same solve."""
    if solver == "alm":  # what its stop rule leaves is more than the past leaves open
        settings = replace(settings, tolerance=min(settings.tolerance, BELIEVABLE), step_tolerance=0.0)
    past = SharedFlight(estimator, settings, joint)
    return Controller(layout.target, layout.walls, solver, settings, layout.size, past)
