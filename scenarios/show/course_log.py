"""An optimised flight past obstacles as the record that scenes and plots of flights read."""

from __future__ import annotations

import numpy as np

from unifg.scenarios.course import Course
from unifg.scenarios.log.columns import Recorder
from unifg.scenarios.log.flight_log import FlightLog
from unifg.scenarios.worlds.air import VEHICLE_RADIUS

__all__ = ["course_log"]

_FRAMES_PER_STEP = 4


def course_log(course: Course) -> FlightLog:
    """The flight as planned, in the form scenes and plots of flights read; nobody estimates anything in it."""
    c, s = course, course.settings
    settings: dict[str, object] = {
        "scenario": "quadrotor-obstacles", "solver": f"{s.solver}, {s.chosen_hessian} Hessian",
        "avoidance": s.avoidance, "guess": s.chosen_guess,
    }  # fmt: skip
    if s.seed is not None:
        settings["seed"] = s.seed
    states = c.between(_FRAMES_PER_STEP)
    clearance = c.layout.distance(states[:, :2]) - VEHICLE_RADIUS
    recorder = Recorder(
        FlightLog, layout=c.layout, settings=settings, dt=s.dt / _FRAMES_PER_STEP, parameters_true=s.vehicle.packed
    )
    nothing = (np.zeros(0), np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0))
    for tick, state in enumerate(states):
        node = min(tick // _FRAMES_PER_STEP, s.horizon - 1)
        ahead = np.concatenate([state[None, :3], c.states[node + 1 :, :3]])
        spread = np.linspace(0.0, len(ahead) - 1.0, s.horizon + 1)  # every row of the log has as many points
        plan = np.column_stack([np.interp(spread, np.arange(len(ahead)), axis) for axis in ahead.T])
        recorder.add(
            truth=state,
            believed=state,
            believed_sigma=np.zeros(9),
            controls=c.controls[node],
            plans=plan,
            pasts=np.zeros((0, 3)),
            landmarks=nothing,
            parameters=s.vehicle.packed,
            parameters_sigma=np.zeros(7),
            seen=np.zeros(0),
            movers=np.zeros((0, 3)),
            estimate_ms=0.0,
            plan_ms=0.0,
            statuses=c.solution.status.name,
            clearance=float(clearance[tick]),
            emergency=False,
        )
    return recorder.finish(collisions=0 if c.clear else 1, reached=c.arrived)
