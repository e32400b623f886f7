"""One graph that localises and drives: the window of the past and the horizon of the future share the present.

The rules (what makes this more than gluing two graphs together):

- only costs of the past are marginalised when a pose leaves the window, at the point where it was last estimated;
- a control that has been applied becomes odometry: its cost and its limits leave with it;
- state and obstacle limits begin one step after the present;
- ``control_weight`` scales the costs of the future, which pull on the estimate;
- ``pull`` bounds how far they may move it from where the past alone puts it;
- covariances of the estimate count the past's terms alone.
"""

from __future__ import annotations

import numpy as np

import unifg as fg
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.driving.drive_window import PoseTerms, PoseWindow
from unifg.scenarios.horizon.part import Gives, Now
from unifg.scenarios.horizon.past import joined
from unifg.scenarios.seeing.readings import Scan
from unifg.solvers import GaussNewton
from unifg.typing import Array

ROUNDS = 8  # of choosing the beams that count and moving the estimate
STEADY = 0.01  # [m, rad]; an estimate that moves less has found its beams
SETTLED = (fg.Status.CONVERGED, fg.Status.STOP_RULE)


class Smoother:
    """The window's terms alone, a fixed-lag smoother, which registers a scan on the map.

    What has to be decided before a joint solve needs a pose: which beams count, where obstacles stand, from where to
    guess.

    Attributes:
        window: the past.
        terms: its terms in a graph of their own.
        solution: of the last registration.
        iterations: Gauss-Newton iterations that took.
    """

    def __init__(self, distance_map: DistanceMap, window: PoseWindow) -> None:
        """State the graph."""
        self.window, self.distance_map = window, distance_map
        self.iterations = 0
        graph = fg.Graph()
        present = graph.variables("present", fg.SE2, 1)
        self.terms = self.terms_in(graph, present[:])
        self.run = GaussNewton(max_iterations=12, step_tolerance=1e-3).prepare(graph)

    def terms_in(self, graph: fg.Graph, present: fg.Selection) -> PoseTerms:
        """The window's terms in a graph that has the present."""
        return PoseTerms(graph, present, self.distance_map, self.window.length, self.window.seen.shape[1])

    @property
    def pose(self) -> Array:
        """(3,) present pose as it is believed [m, m, rad]."""
        return self.window.present.copy()

    def update(self, scan: Scan, odometry: Array | None, dt: float) -> None:
        """Move the window by odometry (2,), None for none, attach the scan and register it."""
        if odometry is not None:
            self.window.move(odometry, dt)
        self.window.look(scan)
        self.register()

    def register(self) -> None:
        """Put the window where its own terms want it."""
        terms, window = self.terms, self.window
        self.iterations = 0
        for _ in range(ROUNDS):
            before = self.pose
            guess = {terms.past: window.guess(), terms.present.family: before[None]}
            self.solution = self.run.solve(guess, data=terms.data(window))
            terms.move(window, self.solution)
            self.iterations += self.solution.iterations
            if np.abs(fg.SE2.between(before, window.present)).max() < STEADY:
                break

    def accept(self) -> None:
        """Believe the past alone."""
        self.terms.accept(self.window, self.solution)


class SharedPast:
    """The past's terms in the graph of the horizon: the first pose is not given but estimated in the same solve.

    Attributes:
        smoother: of the past alone; its window is the joint graph's past.
    """

    def __init__(self, smoother: Smoother, pull: tuple[float, float, float]) -> None:
        """Bound how far the plan may ``pull`` the estimate [m, m, rad]."""
        self.smoother, self._pull = smoother, np.array(pull)

    def state(self, graph: fg.Graph, x: fg.Family, u: fg.Family) -> Gives[Now]:
        """Add the past's terms on the first pose, and the bound."""
        self._x, window = x, self.smoother.window
        self._terms = terms = self.smoother.terms_in(graph, x[0])
        past_says = graph.data("estimate of the past alone", np.zeros(3))
        graph.constrain(fg.prior, x[0], past_says, lower=-self._pull, upper=self._pull, name="pull")
        return lambda now: {**terms.data(window), past_says: now.present}

    def begin(self, guess: fg.Guess, now: Now) -> fg.Guess:
        """The horizon's guess, begun at the estimate, and the window's poses."""
        return joined(guess, self._x, now.present, {self._terms.past: self.smoother.window.guess()})

    def take(self, solution: fg.Solution, now: Now, source: str) -> None:
        """Believe a solve that ended and whose plan is driven; else the past alone."""
        if source == "solved" and solution.status in SETTLED:
            self._terms.accept(self.smoother.window, solution)
        else:
            self.smoother.accept()
