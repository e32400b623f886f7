"""How estimation and control are coupled: two graphs one after the other, or one graph for both."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from unifg.errors import ScenarioError
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.driving.controller import Controller, ControllerSettings, Plan
from unifg.scenarios.driving.joint import JointController
from unifg.scenarios.driving.localiser import Localiser
from unifg.scenarios.driving.window import Window
from unifg.scenarios.seeing.readings import Scan
from unifg.scenarios.seeing.tracks import Tracks
from unifg.typing import Array

COUPLINGS = ("sequential", "joint")
WINDOW = 4  # past poses in the joint graph


class Pilot(Protocol):
    """What drives the robot.

    Attributes:
        controller: what plans.
    """

    controller: Controller

    @property
    def pose(self) -> Array:
        """(3,) present estimate [m, m, rad]."""
        ...

    @property
    def iterations(self) -> int:
        """Iterations of the last localisation."""
        ...

    def estimate(self, scan: Scan, odometry: Array | None, dt: float) -> None:
        """Take in a scan and the odometry (2,) since the last one, None on the first."""
        ...

    def plan(self, reference: Array, tracks: Tracks) -> Plan:
        """Decide the next control; the estimate may move."""
        ...

    def forget(self) -> None:
        """Drop the warm start."""
        ...


class SequentialPilot:
    """Estimate first, then control conditioned on the estimate."""

    def __init__(
        self,
        distance_map: DistanceMap,
        solver: str,
        settings: ControllerSettings,
        pose: Array,
        sigma: Array,
        beams: int,
    ) -> None:
        """Prepare both graphs."""
        self._localiser = Localiser(distance_map, pose, sigma, beams)
        self.controller = Controller(distance_map, solver, settings)

    @property
    def pose(self) -> Array:
        """(3,) estimate after the scan."""
        return self._localiser.pose

    @property
    def iterations(self) -> int:
        """Gauss-Newton iterations of the last localisation."""
        return self._localiser.iterations

    def estimate(self, scan: Scan, odometry: Array | None, dt: float) -> None:
        """Predict and correct."""
        if odometry is not None:
            self._localiser.predict(odometry, dt)
        self._localiser.correct(scan)

    def plan(self, reference: Array, tracks: Tracks) -> Plan:
        """Control from the estimate."""
        return self.controller.plan(self.pose, reference, tracks)

    def forget(self) -> None:
        """Drop the controller's warm start."""
        self.controller.forget()


class JointPilot:
    """One graph: the scan is used when the plan is made."""

    def __init__(
        self,
        distance_map: DistanceMap,
        solver: str,
        settings: ControllerSettings,
        pose: Array,
        sigma: Array,
        beams: int,
    ) -> None:
        """Prepare the joint graph."""
        self._window = Window(WINDOW, pose, np.diag(np.asarray(sigma) ** 2), beams)
        self._joint = JointController(distance_map, solver, settings, self._window)
        self.controller: Controller = self._joint
        self._iterations = 0

    @property
    def pose(self) -> Array:
        """(3,) registered pose before the plan, estimated pose after it."""
        return self._window.now.pose

    @property
    def iterations(self) -> int:
        """Gauss-Newton iterations of the last registration."""
        return self._iterations

    def estimate(self, scan: Scan, odometry: Array | None, dt: float) -> None:
        """Move the window by odometry, attach the scan and register it."""
        if odometry is not None:
            self._window.move(odometry, dt)
        self._window.look(scan)
        self._iterations = self._joint.register()

    def plan(self, reference: Array, tracks: Tracks) -> Plan:
        """Estimate and control at once."""
        return self.controller.plan(self.pose, reference, tracks)

    def forget(self) -> None:
        """Drop the warm start of the horizon; the past stays."""
        self.controller.forget()


def make_pilot(
    coupling: str,
    distance_map: DistanceMap,
    solver: str,
    settings: ControllerSettings,
    pose: Array,
    sigma: Array,
    beams: int,
) -> Pilot:
    """The pilot for a coupling.

    Raises:
        ScenarioError: for an unknown coupling.
    """
    if coupling == "sequential":
        return SequentialPilot(distance_map, solver, settings, pose, sigma, beams)
    if coupling == "joint":
        return JointPilot(distance_map, solver, settings, pose, sigma, beams)
    raise ScenarioError(f"unknown coupling '{coupling}': choose {' or '.join(COUPLINGS)}")
