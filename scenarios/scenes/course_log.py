"""An optimised flight past obstacles as the record that scenes and plots of flights read."""

from __future__ import annotations

import numpy as np

from unifg.scenarios.course import Course
from unifg.scenarios.logs.flight_log import LANDMARK, FlightLog
from unifg.scenarios.simulation.air import VEHICLE_RADIUS

__all__ = ["course_log"]

_FRAMES_PER_STEP = 4


def course_log(course: Course) -> FlightLog:
    """The flight as planned, in the form scenes and plots of flights read; nothing is estimated in it."""
    c, s = course, course.settings
    settings: dict[str, object] = {
        "scenario": "quadrotor-obstacles", "solver": f"{s.solver}, {s.hessian} Hessian",
        "avoidance": s.avoidance, "guess": s.guess,
    }  # fmt: skip
    if s.seed is not None:
        settings["seed"] = s.seed
    states = c.between(_FRAMES_PER_STEP)
    count = len(states)
    nodes = np.minimum(np.arange(count) // _FRAMES_PER_STEP, s.horizon - 1)
    plans = []
    for state, node in zip(states, nodes.tolist(), strict=True):
        ahead = np.concatenate([state[None, :3], c.states[node + 1 :, :3]])
        spread = np.linspace(0.0, len(ahead) - 1.0, s.horizon + 1)  # every row of the log has as many points
        plans.append(np.column_stack([np.interp(spread, np.arange(len(ahead)), axis) for axis in ahead.T]))
    return FlightLog(
        layout=c.layout,
        settings=settings,
        dt=s.dt / _FRAMES_PER_STEP,
        collisions=0 if c.clear else 1,
        reached=c.arrived,
        truth=states,
        believed=states,
        believed_sigma=np.zeros((count, 9)),
        controls=c.controls[nodes],
        plans=np.array(plans),
        pasts=[np.zeros((0, 3))] * count,
        landmarks=[np.zeros(0, dtype=LANDMARK)] * count,
        parameters=np.tile(s.vehicle.packed, (count, 1)),
        parameters_sigma=np.zeros((count, 7)),
        parameters_true=np.tile(s.vehicle.packed, (count, 1)),
        seen=[np.zeros(0, dtype=np.intp)] * count,
        movers=np.zeros((count, 0, 3)),
        estimate_ms=np.zeros(count),
        plan_ms=np.zeros(count),
        compiled=np.zeros(count, dtype=np.intp),
        statuses=[c.solution.status.name] * count,
        emergency=np.zeros(count, dtype=bool),
        clearance=c.layout.distance(states[:, :2]) - VEHICLE_RADIUS,
        health=[""] * count,
        causes=[""] * count,
        fault=[""] * count,
    )
