"""Obstacle courses of Ta et al. 2014, section V-A: one method on one layout, and the outcome."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cache

import numpy as np

from unifg.scenarios.course import (
    Avoidance,
    Course,
    CourseSettings,
    Hessian,
    Start,
    backend,
    course_guess,
    state_problem,
)
from unifg.scenarios.papers.measuring import clocked, words
from unifg.scenarios.simulation.layouts import Layout, obstacle_course


@dataclass(frozen=True)
class Method:
    """One way to solve a layout."""

    avoidance: Avoidance
    guess: Start
    solver: str
    hessian: Hessian

    @property
    def words(self) -> tuple[str, str, str]:
        """For tables."""
        return self.avoidance, self.guess, f"{self.solver}, {self.hessian}"


@dataclass(frozen=True)
class Outcome:
    """Result on one layout.

    Attributes:
        status: of the solver.
        converged: whether the KKT test passed.
        arrived: whether the end is near the target.
        clear: whether nothing is touched, at nodes and between them.
        flyable: whether states follow from controls within the limits.
        cost: the objective.
        distance: from the end to the target [m].
        clearance: least one of the hull on the way [m].
        iterations: of the solver.
        milliseconds: of the processor, for the solve.
    """

    status: str
    converged: bool
    arrived: bool
    clear: bool
    flyable: bool
    cost: float
    distance: float
    clearance: float
    iterations: int
    milliseconds: float

    @property
    def safe(self) -> bool:
        """True if it can be flown to the target without a collision, optimal or not."""
        return self.arrived and self.clear and self.flyable

    @property
    def minimum(self) -> bool:
        """True for a local minimum of the problem."""
        return self.converged and self.flyable


def attempt(method: Method, layout: Layout) -> Outcome:
    """Solve one layout cold; the processor's time is counted, without that of building the graph."""
    settings = CourseSettings(
        avoidance=method.avoidance, guess=method.guess, solver=method.solver, hessian=method.hessian
    )
    graph, x, u = state_problem(settings, layout)
    run = backend(settings).prepare(graph)
    states, controls = course_guess(settings, layout)
    solution, elapsed = clocked(run.solve, {x: states, u: controls}, by=time.process_time)
    course = Course(settings, layout, solution, solution[x], solution[u], iterates=np.zeros((0, *states.shape)))
    return Outcome(
        words(solution.status),
        solution.converged,
        course.arrived,
        course.clear,
        course.flyable,
        float(solution.cost),
        course.target_distance,
        course.clearance_between,
        solution.iterations,
        1e3 * elapsed,
    )


def attempted(method: Method, seed: int) -> Outcome:
    """Outcome on a random layout."""
    _compiled(method)
    return attempt(method, obstacle_course(seed))


@cache
def _compiled(method: Method) -> None:
    """The first solve of a method in a process compiles: the nominal course, which is no result."""
    attempt(method, obstacle_course())
