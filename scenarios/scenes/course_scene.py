"""A flight as it is optimised: its iterates, one after the other."""

from __future__ import annotations

from unifg.scenarios.course import CourseSettings
from unifg.scenarios.scenes.parts import layout
from unifg.solution.history import Iteration
from unifg.view import Frame, Scene

__all__ = ["course_iterate", "course_stage"]

_HEIGHT = 2.0  # up to which obstacles are drawn; they have no top [m]


def course_stage(settings: CourseSettings) -> Scene:
    """Obstacles, start and target."""
    placed = settings.layout()
    scene = Scene(f"unifg: {placed.name or 'a course'}, as it is solved", counts="iteration")
    scene.ground = False
    layout(scene, placed, _HEIGHT)
    scene.discs("cylinders", placed.cylinders, height=_HEIGHT, colour="fixed")
    return scene


def course_iterate(frame: Frame, row: Iteration) -> None:
    """The flight of an iterate that keeps its values."""
    for family, values in (row.values or {}).items():
        if family.name == "state":
            frame.way("flight", values[:, :3], colour="horizon", legend="flight of this iterate")
            frame.poses("attitudes", values[::4, :7], legend="attitudes")
