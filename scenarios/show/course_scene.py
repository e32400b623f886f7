"""A flight as it is optimised: its iterates, one after the other."""

from __future__ import annotations

import numpy as np

from unifg.scenarios.course import CourseSettings
from unifg.solution.history import Iteration
from unifg.view import Frame, Scene

__all__ = ["course_iterate", "course_stage"]

_HEIGHT = 2.0  # up to which obstacles are drawn; they have no top [m]


def course_stage(settings: CourseSettings) -> Scene:
    """Obstacles, start and target."""
    layout = settings.layout()
    scene = Scene(f"unifg: {layout.name or 'a course'}, as it is solved", counts="iteration")
    scene.discs("cylinders", layout.cylinders, height=_HEIGHT, colour="fixed")
    foot = np.concatenate([layout.walls, np.zeros((*layout.walls.shape[:2], 1))], axis=2)
    edges = np.concatenate([foot, foot + np.array([0.0, 0.0, _HEIGHT])])
    scene.lines("walls", edges, width=0.05, colour="wall")
    scene.points("target", layout.target[None], pixels=12.0, colour="goal")
    scene.points("start", layout.start[None], pixels=12.0, colour="start")
    return scene


def course_iterate(frame: Frame, row: Iteration) -> None:
    """The flight of an iterate that keeps its values."""
    for family, values in (row.values or {}).items():
        if family.name == "state":
            frame.way("flight", values[:, :3], colour="horizon", legend="flight of this iterate")
            frame.poses("attitudes", values[::4, :7], legend="attitudes")
