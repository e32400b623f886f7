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
from unifg.scenarios.driving.controller import Controller, ControllerSettings, Plan
from unifg.scenarios.driving.window import Window, WindowTerms
from unifg.scenarios.seeing.tracks import Tracks
from unifg.solvers import GaussNewton
from unifg.typing import Array

ROUNDS = 8  # of choosing the beams that count and moving the estimate
STEADY = 0.01  # [m, rad]; an estimate that moves less has found its beams
SETTLED = (fg.Status.CONVERGED, fg.Status.STOP_RULE)


class JointController(Controller):
    """A controller whose first pose is not given but estimated in the same solve.

    Attributes:
        window: the past.
    """

    def __init__(self, distance_map: DistanceMap, solver: str, settings: ControllerSettings, window: Window) -> None:
        """State the joint graph, and the past's graph alone, which registers the scan beforehand."""
        self.window = window
        self._beams = len(window.now.seen)
        self._map = distance_map
        super().__init__(distance_map, solver, settings)
        alone = fg.Graph()
        present = alone.variables("present", fg.SE2, 1)
        self._smoother = WindowTerms(alone, present[:], distance_map, window.length, self._beams)
        self._smooth = GaussNewton(max_iterations=12, step_tolerance=1e-3).prepare(alone)

    def register(self) -> int:
        """Put the window where its own terms want it; returns the iterations that took.

        What has to be decided before the joint solve needs a pose: which beams count, where obstacles stand, from
        where to guess.
        """
        terms, window = self._smoother, self.window
        iterations = 0
        for _ in range(ROUNDS):
            before = window.now.pose
            guess = {terms.past: terms.poses(window), terms.present.family: before[None]}
            self._registered = self._smooth.solve(guess, data=terms.data(window))
            terms.move(window, self._registered)
            iterations += self._registered.iterations
            if np.abs(fg.SE2.between(before, window.now.pose)).max() < STEADY:
                break
        return iterations

    def plan(self, pose: Array, reference: Array, tracks: Tracks) -> Plan:
        """Estimate and decide in one solve; ``pose`` is that of :meth:`register`."""
        data = self._data(pose, reference, tracks)
        run, guess = self._beginning(pose, reference)
        values = {**guess.values, self._terms.past: self._terms.poses(self.window)}
        values[self._x] = np.concatenate([pose[None], guess.values[self._x][1:]])
        solution = run.solve(fg.Guess(values, guess.multipliers, guess.penalties), data=data)
        plan = self._judge(solution, pose, reference, tracks)
        if plan.emergency or plan.status not in SETTLED:
            self._smoother.accept(self.window, self._registered)
        else:
            self._terms.accept(self.window, solution)
        return plan

    def _anchor(self, graph: fg.Graph, x: fg.Family) -> None:
        self._terms = WindowTerms(graph, x[0], self._map, self.window.length, self._beams)
        self._past_says = graph.data("estimate of the past alone", np.zeros(3))
        pull = np.array(self.settings.pull)
        graph.constrain(fg.prior, x[0], self._past_says, lower=-pull, upper=pull, name="pull")

    def _anchored(self, pose: Array) -> dict[fg.Data, Array]:
        return {**self._terms.data(self.window), self._past_says: pose}
