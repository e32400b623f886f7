"""The pilot of the joint graph: the past alone says what the readings mean, then past and future are solved as one."""

from __future__ import annotations

from unifg.models import quadrotor
from unifg.scenarios.quadrotor.estimator import Estimator, EstimatorSettings
from unifg.scenarios.quadrotor.joint import JointController, JointSettings
from unifg.scenarios.quadrotor.layouts import Layout
from unifg.scenarios.quadrotor.pilot import Pilot
from unifg.scenarios.quadrotor.plan import ControllerSettings, Plan
from unifg.scenarios.quadrotor.sensor import Reading
from unifg.typing import Array


class JointPilot(Pilot):
    """Believes what the joint solve says."""

    controller: JointController

    def tick(self, reading: Reading, control: Array | None) -> Plan:
        """Decide; see :meth:`Pilot.tick`."""
        plan = super().tick(reading, control)
        self.belief = self.controller.believed
        return plan


def joint_pilot(
    solver: str,
    layout: Layout,
    state: Array,
    nominal: quadrotor.Parameters,
    estimator: EstimatorSettings,
    controller: ControllerSettings,
    joint: JointSettings | None = None,
) -> JointPilot:
    """A pilot with one graph; arguments as of :func:`unifg.scenarios.quadrotor.coupling.make_pilot`."""
    past = Estimator(state, nominal, estimator, layout.corners)
    return JointPilot(past, JointController(past, layout, solver, controller, joint or JointSettings()))
