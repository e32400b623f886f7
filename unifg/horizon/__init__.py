"""Past and future of a robot: a window of what was measured, a horizon of what to do, one graph or two.

from unifg.horizon import Dynamics, Measurement, RecedingHorizon, Robot, Window

robot = Robot(STATE, CONTROL, predict=step)
past = [Dynamics(motion, h, sigma=noise), Measurement("position", position, (2,), 0.3)]
window = Window(robot, 10, past, start=x0, sigma=0.5)
terms = [Dynamics(motion, h), Parking()]
loop = RecedingHorizon(robot, 25, terms, solver=InteriorPoint(), window=window, coupling="joint")
plan = loop.tick(measured={"position": z})
"""

from unifg.horizon.coupling import COUPLINGS
from unifg.horizon.decision import Decision, LastPlan, LastPlanThenBrake, Plan
from unifg.horizon.initial_guesses import InitialGuesses
from unifg.horizon.mesh import plan_on_mesh
from unifg.horizon.multistart import cheapest
from unifg.horizon.receding_horizon import RecedingHorizon
from unifg.horizon.robot import Constant, Robot
from unifg.horizon.terms import Context, ControlCost, Dynamics, Measurement, Term
from unifg.horizon.tree import Tree, tree_of
from unifg.horizon.window import Window

__all__ = [
    "COUPLINGS",
    "Constant",
    "Context",
    "ControlCost",
    "Decision",
    "Dynamics",
    "InitialGuesses",
    "LastPlan",
    "LastPlanThenBrake",
    "Measurement",
    "Plan",
    "RecedingHorizon",
    "Robot",
    "Term",
    "Tree",
    "Window",
    "cheapest",
    "plan_on_mesh",
    "tree_of",
]


__dir__ = __all__.copy
