"""A manoeuvre as a scene: the robot drives what was found, beside the guess it was found from."""

from __future__ import annotations

import numpy as np

from unifg.scenarios.manoeuvres import Case, Manoeuvre, ManoeuvreSettings
from unifg.scenarios.scenes.numbers import Number, declare, show
from unifg.solution.history import Iteration
from unifg.view import Scene
from unifg.view.canvas import Frame

__all__ = ["manoeuvre_iterate", "manoeuvre_scene", "manoeuvre_stage"]


def _control(m: Manoeuvre, k: int, column: int) -> float:
    """Control held from a node on; at the last one, that which led to it."""
    return float(m.controls[min(k, len(m.controls) - 1), column])


def _away(m: Manoeuvre, k: int) -> float:
    """Distance from the path [m]."""
    return float(np.hypot(*(m.states[k] - m.case.reference(m.settings)[k])[:2]))


NUMBERS = (
    Number("drives", lambda m, k: "backward" if _control(m, k, 0) < 0.0 else "forward"),
    Number("speed", lambda m, k: f"{_control(m, k, 0):.2f} m/s"),
    Number("turn", lambda m, k: f"{_control(m, k, 1):.2f} rad/s"),
    Number("forward speed", None, lambda m, k: _control(m, k, 0), plot={"unit": "m/s", "limit": 0.0}),
    Number(
        "turning speed", None, lambda m, k: _control(m, k, 1),
        plot={"unit": "rad/s", "limit": 0.0, "colour": "estimate"},
    ),
    Number("from the path", lambda m, k: f"{_away(m, k):.2f} m", _away, plot={"unit": "m", "colour": "goal"}),
)  # fmt: skip
"""Lines and curves of a manoeuvre."""


def _clearance(wanted: float) -> Number:
    """Line and curve of the clearance, with the one that is kept [m]."""
    plot = {"unit": "m", "limit": wanted, "colour": "horizon"}
    return Number("clearance", lambda m, k: f"{m.clearance[k]:.3f} m", lambda m, k: m.clearance[k], plot=plot)


def manoeuvre_scene(manoeuvre: Manoeuvre) -> Scene:
    """The scene of one solved case, over the time of its plan."""
    m, s = manoeuvre, manoeuvre.settings
    scene = Scene(f"unifg: manoeuvre '{m.case.name}'", dt=s.dt)
    scene.speeds = (0.25, 0.5, 1, 2)
    reference = m.case.reference(s)
    width = 0.012 * float(np.ptp(np.concatenate([m.states, reference])[:, :2], axis=0).max())
    scene.way("path", reference[:, :2], width=width, colour="goal", legend="path it is asked to follow")
    scene.layer("trail", "line", "trail", "driven so far", width=1.6 * width)
    scene.way("plan", m.states[:, :2], width=0.6 * width, colour="horizon", legend="plan that was found")
    cusps = m.states[m.cusps, :2]
    scene.points("cusps", cusps, pixels=9.0, colour="ink", legend="cusp: it passes from backward to forward")
    if m.case.discs:
        discs = np.array(m.case.discs)
        scene.discs("discs", discs, colour="fixed", legend="unforeseen disc")
    scene.body("robot", "disc", size=s.robot_radius, colour="robot")
    scene.body("wanted", "arrow", size=1.5 * s.robot_radius, colour="goal", legend="where the path would have it now")
    scene.label("robot", follows="robot", above=True)
    scene.view("above", "From above", (0.0, -1e-4, 1.0))
    scene.view("follow", "Follow robot", (0.0, -0.5, 0.9), follows="robot", distance=20.0 * s.robot_radius)
    numbers = [*NUMBERS, *([_clearance(s.clearance)] if m.case.discs else [])]
    declare(scene, numbers)
    for tick, (pose, asked) in enumerate(zip(m.states, reference, strict=True)):
        frame = scene.frame()
        frame.place("robot", pose)
        frame.place("wanted", asked)
        frame.trail("trail", pose[:2])
        show(frame, m, tick, numbers)
    scene.outcome, scene.good = m.solution.status.value, m.succeeded
    scene.facts |= {
        "asked": m.case.title,
        "solver": m.solver,
        "iterations": f"{m.solution.iterations}, from a guess that cannot be driven",
        "cost": f"{m.solution.cost:.5g}",
        "limits": "kept" if m.within_limits else "BROKEN",
    }
    return scene


def manoeuvre_stage(case: Case) -> Scene:
    """Static parts of a manoeuvre's scene, for the iterates of a solve."""
    scene = Scene(f"unifg: manoeuvre '{case.name}', as it is solved", counts="iteration")
    scene.way("path", case.reference(ManoeuvreSettings())[:, :2], colour="goal", legend="path it is asked to follow")
    if case.discs:
        scene.discs("discs", np.array(case.discs), colour="fixed", legend="unforeseen disc")
    scene.layer("plan", "line", "horizon", "plan of this iterate")
    scene.layer("poses", "arrow", "horizon", "plan of this iterate")
    return scene


def manoeuvre_iterate(frame: Frame, row: Iteration) -> None:
    """The plan of an iterate that keeps its values."""
    for family, values in (row.values or {}).items():
        if family.name == "pose":
            frame.way("plan", values[:, :2])
            frame.poses("poses", values)
