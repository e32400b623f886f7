"""How estimation and control are coupled: two graphs that share nothing, two that share a belief, or one graph."""

from __future__ import annotations

import time

from unifg.scenarios.flying.controller import Controller
from unifg.scenarios.flying.estimator import Estimator
from unifg.scenarios.flying.plan import Plan
from unifg.scenarios.seeing.belief import Belief
from unifg.scenarios.seeing.line_tracker import LineTracker
from unifg.scenarios.seeing.readings import Reading
from unifg.typing import Array

__all__ = ["Pilot"]


class Pilot:
    """Estimates, then plans on what is estimated.

    Attributes:
        estimator: of state, parameters and landmarks.
        controller: of the flight.
        tracker: of what moves.
        belief: after the last tick.
        estimate_ms: wall-clock time of the last estimate, tracks included [ms].
        plan_ms: wall-clock time of the last decision [ms].
    """

    def __init__(self, estimator: Estimator, controller: Controller) -> None:
        """Join two graphs that stand for themselves."""
        self.estimator, self.controller = estimator, controller
        self.tracker = LineTracker(association=estimator.settings.association)
        self.belief: Belief = estimator.belief()
        self.estimate_ms = self.plan_ms = 0.0

    def tick(self, reading: Reading, control: Array | None) -> Plan:
        """Decide.

        Args:
            reading: of now.
            control: (4,) applied since the last reading; None at the first one.
        """
        begin = time.perf_counter()
        self.belief = self.estimator.update(reading, control)
        movers = self.tracker.update(reading, self.belief.state)
        estimated = time.perf_counter()
        self.estimate_ms = 1e3 * (estimated - begin)
        plan = self.controller.plan(self.belief, movers)
        self.plan_ms = 1e3 * (time.perf_counter() - estimated)
        return plan
