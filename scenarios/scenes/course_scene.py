"""A flight as it is optimised: its iterates, one after the other."""

from __future__ import annotations

import numpy as np

from unifg.scenarios.course import Course, CourseSettings
from unifg.scenarios.scenes.parts import layout
from unifg.scenarios.simulation.air import VEHICLE_RADIUS
from unifg.solution.history import Iteration
from unifg.typing import Array
from unifg.view import Scene
from unifg.view.canvas import Frame

__all__ = ["HEIGHT", "course_iterate", "course_stage", "iterate_scene"]

HEIGHT = 2.0
"""Height up to which obstacles are drawn, which have no top [m]."""

_APART = 0.75  # two quadrotors are drawn at least so far apart [m]


def course_stage(settings: CourseSettings) -> Scene:
    """Obstacles, start and target."""
    placed = settings.layout()
    scene = Scene(f"unifg: {placed.name or 'a course'}, as it is solved", counts="iteration")
    scene.ground = False
    layout(scene, placed, HEIGHT)
    scene.discs("cylinders", placed.cylinders, height=HEIGHT, colour="fixed")
    return scene


def iterate_scene(course: Course, number: int) -> Scene:
    """One iterate of a solved course, the quadrotor at its start or, of the last one, along it."""
    nodes, scene = course.iterates[number], course_stage(course.settings)
    scene.way("way", nodes[:, :3], width=0.06, colour="horizon", legend="planned way and its nodes")
    frame = scene.frame()
    for k, node in enumerate(_apart(nodes) if number == len(course.iterates) - 1 else nodes[:1]):
        words = "" if k else "quadrotor, to scale"
        scene.body(f"quadrotor {k}", "quadrotor", size=VEHICLE_RADIUS, colour="robot", legend=words)
        frame.place(f"quadrotor {k}", node[:7])
    return scene


def _apart(nodes: Array) -> Array:
    """Nodes far enough apart to draw a quadrotor at each, first and last among them."""
    kept = [nodes[0]]
    for node in nodes[1:]:
        if np.linalg.norm(node[:3] - kept[-1][:3]) >= _APART:
            kept.append(node)
    if np.linalg.norm(nodes[-1, :3] - kept[-1][:3]) > 0.5 * _APART or len(kept) == 1:
        kept.append(nodes[-1])
    return np.array(kept)


def course_iterate(frame: Frame, row: Iteration) -> None:
    """The flight of an iterate that keeps its values."""
    for family, values in (row.values or {}).items():
        if family.name == "state":
            frame.way("flight", values[:, :3], colour="horizon", legend="flight of this iterate")
            frame.poses("attitudes", values[::4, :7], legend="attitudes")
