"""The pilot of the joint graph: the past alone says what the readings mean, then past and future are solved as one."""

from __future__ import annotations

from unifg.models import quadrotor
from unifg.scenarios.flying.estimator import Estimator, EstimatorSettings
from unifg.scenarios.flying.joint import JointController, JointSettings
from unifg.scenarios.flying.pilot import Pilot
from unifg.scenarios.flying.plan import ControllerSettings, Plan
from unifg.scenarios.seeing.readings import Reading
from unifg.scenarios.worlds.layouts import Layout
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
    """A pilot with one graph; arguments as of :func:`unifg.scenarios.flying.coupling.make_pilot`."""
    past = Estimator(state, nominal, estimator, layout.corners)
    return JointPilot(past, JointController(past, layout, solver, controller, joint or JointSettings()))
