"""``unifg run quadrotor-obstacles``: what an optimised flight leaves in its folder, and the table for people."""

from __future__ import annotations

from typing import Any

import numpy as np

from unifg.scenarios import course as courses
from unifg.scenarios.commands.outcome import Outcome, Progress, Writer
from unifg.scenarios.commands.watching import Announce, watching_iterates
from unifg.scenarios.course import Course
from unifg.scenarios.logs.metrics import of_solution, table, write_metrics
from unifg.scenarios.scenes.course_log import course_log
from unifg.scenarios.scenes.course_plot import picture
from unifg.scenarios.scenes.course_scene import course_iterate, course_stage
from unifg.scenarios.scenes.flight_scene import flight_scene
from unifg.solution.status import Status
from unifg.style.figures import write_figure

__all__ = ["SETTINGS", "course_metrics", "run", "summary"]

SETTINGS = courses.CourseSettings


def run(settings: courses.CourseSettings, progress: Progress, announce: Announce | None = None) -> Outcome:
    """Optimise the flight that was asked for."""
    with watching_iterates(announce, course_stage(settings), course_iterate, progress) as watch:
        course = courses.run_course(settings, progress=watch)
    progress(1.0, "solved")
    interrupted = course.solution.status is Status.INTERRUPTED
    numbers = course_metrics(course)
    flown = course_log(course)
    files: dict[str, Writer] = {
        "metrics.json": lambda path: write_metrics(path, numbers),
        "iterates.png": lambda path: write_figure(path, picture(course), 90),
        "scene.html": lambda path: flight_scene(flown).save(path),
    }
    return Outcome(course.succeeded, interrupted, summary(course), numbers, files, {"flight": flown})


def course_metrics(course: Course) -> dict[str, Any]:
    """The numbers of a flight; ``costs`` and ``violations`` are those of every iterate, the guess first.

    Only ``solve_ms`` depends on the clock.
    """
    c, s, solution = course, course.settings, course.solution
    w, x, y, z = c.states[:, 3:7].T
    upright = w * w - x * x - y * y + z * z  # how much of the thrust points up
    return {
        "scenario": "quadrotor-obstacles",
        "layout": c.layout.name,
        "solver": s.solver,
        "hessian": s.hessian,
        "avoidance": s.avoidance,
        "guess": s.guess,
        "general_cost": s.general,
        "succeeded": c.succeeded,
        **of_solution(solution),
        "arrived": c.arrived,
        "clear": c.clear,
        "flyable": c.flyable,
        "costs": [float(row.cost) for row in solution.history],
        "violations": [float(row.violation) for row in solution.history],
        "target_distance_m": c.target_distance,
        "min_clearance_m": float(c.clearance.min()),
        "min_clearance_between_nodes_m": c.clearance_between,
        "widest_way_m": c.layout.widest_way(),
        "drift_m": c.drift,
        "path_length_m": float(np.linalg.norm(np.diff(c.states[:, :3], axis=0), axis=1).sum()),
        "max_speed_m_per_s": float(np.linalg.norm(c.states[:, 7:], axis=1).max()),
        "max_tilt_rad": float(np.arccos(np.clip(upright, -1.0, 1.0)).max()),
        "min_thrust_n": float(c.controls[:, 3].min()),
        "max_thrust_n": float(c.controls[:, 3].max()),
        "max_rate_rad_per_s": float(np.abs(c.controls[:, :3]).max()),
    }


def summary(course: Course) -> str:
    """The outcome for people, as a table of two columns."""
    m = course_metrics(course)
    rows = {
        "layout": f"{m['layout']}, widest way {m['widest_way_m']:.2f} m to either side",
        "solver": f"{m['solver']}, {m['hessian']} Hessian, guess: {m['guess']}",
        "avoidance": m["avoidance"] + (" as a general cost" if m["general_cost"] else ""),
        "status": m["status"].replace("_", " "),
        "iterations": f"{m['iterations']} in {m['solve_ms']:.0f} ms",
        "cost": f"{m['cost']:.4f}",
        "stationarity, violation": f"{m['stationarity']:.1e}, {m['violation']:.1e}",
        "end": f"{m['target_distance_m']:.3f} m from the target, " + ("arrived" if m["arrived"] else "NOT ARRIVED"),
        "least clearance of hull": f"{m['min_clearance_m']:.3f} m at nodes, "
        f"{m['min_clearance_between_nodes_m']:.3f} m on the way, " + ("clear" if m["clear"] else "COLLISION"),
        "flown": f"{m['path_length_m']:.2f} m, at most {m['max_speed_m_per_s']:.2f} m/s, tilt "
        f"{np.degrees(m['max_tilt_rad']):.0f} deg, thrust {m['min_thrust_n']:.1f} to {m['max_thrust_n']:.1f} N",
        "can be flown as planned": "yes" if m["flyable"] else "NO",
    }
    return table(rows.items())
