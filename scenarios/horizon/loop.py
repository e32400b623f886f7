"""One horizon solved tick after tick: warm starts, the plan that is kept, and when to begin anew."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

import unifg as fg
from unifg.typing import Array


@dataclass(frozen=True)
class Plan:
    """What a tick decided.

    Attributes:
        controls: (N, m), the first to be applied now.
        states: (N + 1, storage) predicted, the first being the present.
        status: of the solve.
        iterations: of the backend.
        source: "solved", or what is done instead of the solver's answer.
        excess: by how much the plan exceeded the limits of the controls before it was clipped.
        milliseconds: wall-clock time of the whole decision.
    """

    controls: Array
    states: Array
    status: fg.Status
    iterations: int
    source: str
    excess: float
    milliseconds: float

    @property
    def control(self) -> Array:
        """(m,) to be applied now."""
        first: Array = self.controls[0]
        return first

    @property
    def emergency(self) -> bool:
        """Whether the solve gave nothing that may be applied."""
        return self.source != "solved"


class Loop:
    """A compiled control graph that is warm-started with its shifted solution.

    A plan that the robot accepts is stored; while later solves fail, what is left of it is there to fall back on. Plans
    that end behind the reference for too long are caught in a dead end, where the warm start would keep them: the next
    solve begins anew.

    Attributes:
        warm, cold: the backend with and without a warm start, which may iterate longer.
        x, u: families of states (N + 1) and controls (N).
        guess: where the next solve begins; None for anew.
        failed: whether the last answer was refused.
        stored: (N, m) controls of the last plan that was accepted.
        age: ticks since then; N or more when nothing is left of it.
        least, most: limits (m,) of the controls.
        lagging: ticks for which plans have ended behind.
    """

    def __init__(
        self,
        graph: fg.Graph,
        x: fg.Family,
        u: fg.Family,
        warm: fg.Solver,
        cold: fg.Solver,
        limits: tuple[Array, Array],
        patience: int,
    ) -> None:
        """Prepare the backends.

        Args:
            graph: past, if any, and future.
            x: states.
            u: controls.
            warm: backend for a solve with a warm start.
            cold: for one without.
            limits: least and greatest controls (m,).
            patience: number of ticks after which being behind is for too long.
        """
        self.x, self.u = x, u
        self.least, self.most = limits
        self.warm, self.cold = warm.prepare(graph), cold.prepare(graph)
        self._patience = patience
        self.guess: fg.Guess | None = None
        self.failed, self.lagging = False, 0
        self.reset()

    def begin(
        self, along: Callable[[], fg.Guess], rest: Callable[[], fg.Guess] | None = None
    ) -> tuple[fg.Prepared, fg.Guess]:
        """Which backend solves next, and from where.

        Args:
            along: a guess along the reference, for a cold start.
            rest: a guess that stays, for a solve after one that failed; None to begin along the reference then, too.
        """
        if self.guess is not None:
            return self.warm, self.guess
        if self.failed and rest is not None:
            return self.warm, rest()
        return self.cold, along()

    def accept(self, solution: fg.Solution, *, behind: bool) -> None:
        """Store a plan, and begin the next solve from it; ``behind`` says whether it ends far from the reference."""
        self.stored, self.age, self.failed = solution[self.u], 0, False
        self.guess = None if self.stays_behind(behind) else solution.shifted(self.x, self.u)

    def refuse(self, guess: fg.Guess | None = None) -> None:
        """Keep the stored plan, which ages, and begin the next solve from ``guess``."""
        self.age += 1
        self.failed, self.guess = True, guess

    def left(self) -> Array:
        """(k, m) controls that are left of the stored plan."""
        rest: Array = self.stored[self.age :]
        return rest

    def within(self, controls: Array) -> Array:
        """Controls (k, m) clipped to their limits."""
        clipped: Array = np.clip(controls, self.least, self.most)
        return clipped

    @property
    def excess(self) -> float:
        """By how much the stored plan exceeds the limits of its controls."""
        return float(np.maximum(self.stored - self.most, self.least - self.stored).max(initial=0.0))

    def stays_behind(self, behind: bool) -> bool:
        """Count a tick; whether plans have ended behind for too long, after which the count begins anew."""
        self.lagging = self.lagging + 1 if behind else 0
        if self.lagging < self._patience:
            return False
        self.lagging = 0
        return True

    def forget(self) -> None:
        """Drop the warm start, as when a new reference makes it misleading."""
        self.guess = None
        self.failed = False

    def reset(self) -> None:
        """Forget the stored plan, too."""
        self.forget()
        self.stored = np.zeros((len(self.u), self.u.manifold.storage))
        self.age, self.lagging = len(self.u), 0
