"""Decision of a tick: a plan, its source, and the fallback after a failed solve."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from unifg.errors import GraphError, require_kinds
from unifg.horizon.robot import Robot, numbers
from unifg.horizon.terms import Context
from unifg.modeling.duplicates import doubles
from unifg.solution.solution import Solution
from unifg.solution.status import Status
from unifg.typing import Array


@dataclass(frozen=True)
class Plan:
    """Decision of a tick.

    Attributes:
        controls: (N, m), the first to be applied when the plan acts: now, or after the loop's delay.
        states: (N + 1, storage) predicted, the first being the present.
        status: of the solve.
        iterations: of the backend.
        source: "solved", or what is done instead of the solver's answer.
        excess: by how much the plan exceeded the limits of the controls before it was clipped.
        milliseconds: wall-clock time of the whole decision.
        rescued: whether the plan is that of the second backend, asked because the first had none.
    """

    controls: Array
    states: Array
    status: Status
    iterations: int
    source: str
    excess: float
    milliseconds: float
    rescued: bool = False

    @property
    def control(self) -> Array:
        """(m,) to be applied when the plan acts."""
        first: Array = self.controls[0]
        return first

    @property
    def emergency(self) -> bool:
        """True if the solve gave nothing that may be applied."""
        return self.source != "solved"


class LastPlan:
    """The last plan that was accepted, which ages while later solves fail.

    Attributes:
        controls: (N, m), within their limits.
        states: (N + 1, storage).
        times: (N + 1,) of the nodes of the horizon [s]; 0, 1, ..., N in ticks where it has none.
        planned: (N + 1,) the same when the plan was made.
        age: time since then, in the unit of ``times``; that of the last node when nothing is left of it.
        least, most: limits (m,) of the controls.
        excess: by how much the plan exceeded them.
    """

    def __init__(self, times: Array, robot: Robot, limits: tuple[Array, Array]) -> None:
        """Begin with nothing."""
        self.least, self.most = limits
        self.times = self.planned = times
        self.controls = np.zeros((len(times) - 1, robot.control.storage))
        self.states = np.tile(robot.state.identity(), (len(times), 1))
        self.clear()

    @property
    def lengths(self) -> Array:
        """(N,) lengths of the steps of the horizon, in the unit of ``times``."""
        return np.diff(self.times)

    def clear(self) -> None:
        """Let nothing be left."""
        self.controls[:] = 0.0
        self.age, self.excess = float(self.planned[-1]), 0.0

    def store(self, controls: Array, states: Array) -> None:
        """Keep a new plan (N, m), (N + 1, storage)."""
        self.excess = float(np.maximum(controls - self.most, self.least - controls).max(initial=0.0))
        self.controls, self.states, self.age, self.planned = controls.copy(), states.copy(), 0.0, self.times

    def left(self) -> Array:
        """(k, m) controls that are left of the plan, for the first k steps from now on."""
        begins = self.age + self.times[:-1] + 1e-9 * self.times[1]  # so much late that rounding chooses no earlier step
        acting = np.searchsorted(self.planned, begins[begins < self.planned[-1]], side="right") - 1
        rest: Array = self.controls[acting]
        return rest

    def within(self, controls: Array) -> Array:
        """Controls (k, m) clipped to their limits."""
        return np.clip(controls, self.least, self.most)


@dataclass(frozen=True)
class Decision:
    """Controls applied at a tick.

    Attributes:
        controls: (N, m).
        states: (N + 1, storage).
        source: "solved" for the solver's answer, which is then kept; what else it is otherwise.
        after: states (N + 1, storage) and controls (N, m) where the next solve begins after another source than
            "solved"; None for anew.
        behind: True if a plan that was accepted ends far from where it should.
        resumed: True if the next solve goes on from a refused one, multipliers included, instead of ``after``.
    """

    controls: Array
    states: Array
    source: str
    after: tuple[Array, Array] | None = None
    behind: bool = False
    resumed: bool = False


class AcceptancePolicy(Protocol):
    """Decides what is applied."""

    def __call__(
        self, solution: Solution, states: Array, controls: Array, now: Context[Any], kept: LastPlan
    ) -> Decision:
        """Judge a solve.

        Args:
            solution: of the graph of this tick.
            states: (N + 1, storage) its plan.
            controls: (N, m) its controls.
            now: what the terms were asked with.
            kept: the last plan that was accepted; its age counts this tick already.
        """


@dataclass(frozen=True)
class LastPlanThenBrake:
    """Apply a plan that keeps its constraints; else what is left of the last one, for a while; else brake.

    Attributes:
        robot: who moves.
        feasible: greatest violation of a plan that may be applied.
        keep: greatest age of an old plan that may be applied, in seconds, or in ticks of a horizon without node times;
            None for 8 ticks.
        brake: ``brake(now)`` gives controls (N, m), or (m,) for all steps, that bring the robot to rest; None: zero.

    Raises:
        GraphError: for parts of another kind, and where it brakes by what are no controls.
    """

    robot: Robot
    feasible: float = 1e-3
    keep: float | None = None
    brake: Callable[[Context[Any]], Array] | None = None

    def __post_init__(self) -> None:
        """Refuse parts of another kind before they are needed."""
        require_kinds("LastPlanThenBrake", GraphError, LastPlanThenBrake.__annotations__, vars(self), Robot)

    def __call__(
        self, solution: Solution, states: Array, controls: Array, now: Context[Any], kept: LastPlan
    ) -> Decision:
        """Judge a solve."""
        if solution.violation <= self.feasible and np.isfinite(states).all() and np.isfinite(controls).all():
            return Decision(kept.within(controls), states, "solved")
        return self.instead(now, kept)

    def instead(self, now: Context[Any], kept: LastPlan) -> Decision:
        """Fallback without a plan of this tick."""
        count = len(kept.controls)
        braking = kept.within(np.tile(np.zeros(kept.controls.shape[1]), (count, 1)))
        if self.brake is not None:
            given, shape = doubles("the controls that brake gives", self.brake(now)), kept.controls.shape
            given = np.broadcast_to(given, shape) if given.shape in ((), shape[1:]) else given
            braking = kept.within(numbers(given, shape, "the controls that brake gives"))
        left = kept.within(kept.left())
        tick = float(kept.times[1])
        keep = 8 * tick if self.keep is None else self.keep
        if kept.age <= keep + 1e-9 * tick and len(left):
            controls, source = np.concatenate([left, braking[: count - len(left)]]), "kept"
        else:
            controls, source = braking, "braking"
        return Decision(controls, self.robot.rollout(now.present, controls, kept.lengths), source)
