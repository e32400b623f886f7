"""Past and future of a robot: a window of what was measured, a horizon of what to do, one graph or two.

from unifg.horizon import Loop, Measurement, Robot, Window

robot = Robot(STATE, CONTROL, predict=step)
past = [Dynamics(motion, h, sigma=noise), Measurement("position", position, (2,), 0.3)]
window = Window(robot, 10, past, start=x0, sigma=0.5)
loop = Loop(robot, 25, [Dynamics(motion, h), Parking()], solver=InteriorPoint(), window=window, coupling="joint")
plan = loop.tick(measured={"position": z})
"""

from unifg.horizon.control_loop import Loop, Starts
from unifg.horizon.coupled import COUPLINGS, Coupling
from unifg.horizon.decision import Choice, Judge, KeepThenBrake, Kept, Plan
from unifg.horizon.past import Arrival
from unifg.horizon.recorded import History
from unifg.horizon.robot import Robot, Static
from unifg.horizon.statements import ControlCost, Dynamics, Measurement, Now, Resetting, Term
from unifg.horizon.window import Window

__all__ = [
    "COUPLINGS",
    "Arrival",
    "Choice",
    "ControlCost",
    "Coupling",
    "Dynamics",
    "History",
    "Judge",
    "KeepThenBrake",
    "Kept",
    "Loop",
    "Measurement",
    "Now",
    "Plan",
    "Resetting",
    "Robot",
    "Starts",
    "Static",
    "Term",
    "Window",
]


def __dir__() -> list[str]:
    """List what is public."""
    return list(__all__)
