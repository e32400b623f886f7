"""The couplings by name: two graphs that share nothing, two that share a belief, or one graph."""

from __future__ import annotations

from unifg.errors import ScenarioError
from unifg.models import quadrotor
from unifg.scenarios.flying.controller import Controller
from unifg.scenarios.flying.estimator import DeadReckoningEstimator, Estimator, EstimatorSettings
from unifg.scenarios.flying.joint_pilot import joint_pilot
from unifg.scenarios.flying.pilot import Pilot
from unifg.scenarios.flying.plan import ControllerSettings
from unifg.scenarios.worlds.layouts import Layout
from unifg.typing import Array

__all__ = ["COUPLINGS", "make_pilot"]

COUPLINGS = ("separate", "sequential", "joint")


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
        return joint_pilot(solver, layout, state, nominal, estimator, controller)
    kinds: dict[str, type[Estimator]] = {"separate": DeadReckoningEstimator, "sequential": Estimator}
    if coupling not in kinds:
        raise ScenarioError(f"unknown coupling '{coupling}': choose {', '.join(COUPLINGS)}")
    return Pilot(
        kinds[coupling](state, nominal, estimator, layout.corners),
        Controller(layout.target, layout.walls, solver, controller, layout.size),
    )
