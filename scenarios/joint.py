"""One graph that localises and drives: the window of the past and the horizon of the future share the present.

The rules (what makes this more than gluing two graphs together):

- only costs of the past are marginalised when a pose leaves the window, at the point where it was last estimated;
- a control that has been applied becomes odometry: its cost and its limits leave with it;
- state and obstacle limits begin one step after the present;
- ``control_weight`` scales the costs of the future, which pull on the estimate;
- covariances of the estimate count the past's terms alone.
"""

from __future__ import annotations

import numpy as np

import unifg as fg
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.controller import Controller, ControllerSettings, Plan
from unifg.scenarios.perception import Tracks
from unifg.scenarios.window import Window, WindowTerms
from unifg.solvers import GaussNewton
from unifg.typing import Array

SETTLED = (fg.Status.CONVERGED, fg.Status.STOP_RULE)


class JointController(Controller):
    """A controller whose first pose is not given but estimated in the same solve.

    Attributes:
        window: the past.
    """

    def __init__(self, distance_map: DistanceMap, solver: str, settings: ControllerSettings, window: Window) -> None:
        """State the joint graph, and the past's graph alone for ticks on which no plan is found."""
        self.window = window
        self._beams = len(window.now.seen)
        self._map = distance_map
        super().__init__(distance_map, solver, settings)
        alone = fg.Graph()
        present = alone.variables("present", fg.SE2, 1)
        self._smoother = WindowTerms(alone, present[:], distance_map, window.length, self._beams)
        self._smooth = GaussNewton(max_iterations=12, step_tolerance=1e-5).prepare(alone)

    def plan(self, pose: Array, reference: Array, tracks: Tracks) -> Plan:
        """Estimate and decide in one solve; ``pose`` is the prediction from odometry."""
        if self._guess is None:  # a cold start localises first: a wrong pose would be planned around
            self._estimate_alone()
            pose = self.window.now.pose
        data = self._data(pose, reference, tracks)
        run, guess = self._beginning(pose, reference)
        values = {**guess.values, self._terms.past: self._terms.poses(self.window)}
        values[self._x] = np.concatenate([pose[None], guess.values[self._x][1:]])
        solution = run.solve(fg.Guess(values, guess.multipliers), data=data)
        plan = self._judge(solution, pose, reference, tracks)
        if plan.emergency or plan.status not in SETTLED:
            self._estimate_alone()
        else:
            self._terms.accept(self.window, solution)
        return plan

    def _estimate_alone(self) -> None:
        """Localise by the past's terms, where the joint solve did not settle."""
        terms = self._smoother
        guess = {terms.past: terms.poses(self.window), terms.present.family: self.window.now.pose[None]}
        terms.accept(self.window, self._smooth.solve(guess, data=terms.data(self.window)))

    def _anchor(self, graph: fg.Graph, x: fg.Family) -> None:
        self._terms = WindowTerms(graph, x[0], self._map, self.window.length, self._beams)

    def _anchored(self, pose: Array) -> dict[fg.Data, Array]:
        return self._terms.data(self.window)
