"""A fixed-lag smoother of a robot's last steps: what enters, what it says, and what leaves as a prior."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from unifg.answers.graph import Graph
from unifg.answers.solution import Solution
from unifg.answers.solver import Solver
from unifg.answers.status import Status
from unifg.errors import GraphError
from unifg.horizon.past import Arrival, Left, Past, Tangent
from unifg.horizon.recorded import History
from unifg.horizon.robot import Robot
from unifg.horizon.spread import JointCovariance
from unifg.horizon.statements import Now, Recording, Term
from unifg.language.terms import Constraint
from unifg.language.variables import Selection
from unifg.solvers.interior_point.method import InteriorPoint
from unifg.solvers.least_squares import LevenbergMarquardt
from unifg.typing import Array, ArrayLike

USELESS = (Status.NOT_FINITE, Status.SINGULAR, Status.UNBOUNDED)


class Window:
    """The last L steps of a robot, and a solver for what they say by themselves.

    At a tick: :meth:`move` lets the next node enter, :meth:`record` attaches what was measured, :meth:`estimate`
    solves. :class:`unifg.horizon.Loop` does all three.

    Attributes:
        robot: who moves.
        terms: what the past says.
        history: numbers of the nodes.
        left: what is known of what has left.
        covariance: (D, D) of the present state and the statics, from the past's terms alone.
        solution: of the last estimate; None before.
        statuses: how often estimates ended in what way.
    """

    def __init__(
        self,
        robot: Robot,
        length: int,
        terms: Sequence[Term],
        *,
        start: ArrayLike,
        sigma: ArrayLike,
        solver: Solver | None = None,
        arrival: Arrival | None = None,
    ) -> None:
        """State the graph and prepare its solver.

        Args:
            robot: who moves.
            length: number of steps L that are kept.
            terms: what is said of the nodes of the past, of the present too.
            start: (storage,) believed state at the start.
            sigma: (d,) standard deviations of that belief in the tangent space, or its covariance (d, d).
            solver: of the window's graph; by default Levenberg-Marquardt, where terms of the past constrain the
                interior point.
            arrival: coordinates of the prior of what has left; by default the variables' own tangent spaces.

        Raises:
            GraphError: when sizes do not fit, or a term cannot stand in a window.
        """
        self.robot, self.terms, self.length = robot, tuple(terms), length
        self._arrival = arrival or Tangent()
        self._records: dict[str, tuple[int, ...]] = {}
        for term in terms:
            if isinstance(term, Recording):
                self._records.update(term.records)
        self._start = np.array(start, dtype=np.float64)
        self._sigma = _covariance(sigma, robot.state.dim)
        self.history = History(robot, length, self._start, self._records)
        self.left = Left(robot, self._start, self._sigma)
        graph = Graph()
        x = graph.variables("x", robot.state, length + 1)
        for static in robot.statics:
            static.family(graph)
        self._past = self.past_in(graph, x[:])
        if solver is None:
            constrained = any(isinstance(term, Constraint) for term in graph.terms)
            solver = InteriorPoint() if constrained else LevenbergMarquardt()
        self._run = solver.prepare(graph)
        self._look = replace(solver, max_iterations=0).prepare(graph)
        self._spread = JointCovariance(self._run.program, x[-1], *self._past.statics)
        self.solution: Solution | None = None
        self.statuses: Counter[Status] = Counter()
        self.covariance = self._prior_covariance()

    def past_in(self, graph: Graph, x: Selection) -> Past:
        """State the past on the nodes x (L + 1) of a graph that holds the robot's statics."""
        return Past(graph, x, self.robot, self.history, self.left, self.terms, self._arrival)

    @property
    def present(self) -> Array:
        """(storage,) present state as it is believed."""
        return self.history.present.copy()

    @property
    def state_covariance(self) -> Array:
        """(d, d) of the present state."""
        dim = self.robot.state.dim
        return self.covariance[:dim, :dim].copy()

    def move(self, control: ArrayLike, time: float | None = None) -> None:
        """Let the next node enter, where the robot's model expects it; the oldest one leaves when the window is full.

        Args:
            control: (m,) applied since the last node.
            time: of the new node [s]; None for one more than that of the last.

        Raises:
            GraphError: when the control is not finite or time runs backwards.
        """
        applied = np.asarray(control, dtype=np.float64)
        if applied.shape != (self.robot.control.storage,) or not np.isfinite(applied).all():
            raise GraphError(f"the control that was applied must be ({self.robot.control.storage},) finite: {applied}")
        history = self.history
        if history.full:
            if self.left.departure is None:
                self.estimate_nothing()
            self.left.arrival, self.left.departure = self.left.departure, None
        expected = self.robot.predicted(history.present, applied)
        history.move(applied, expected, history.times[-1] + 1.0 if time is None else time)

    def record(self, name: str, value: ArrayLike | None, node: int = -1) -> None:
        """Attach what was measured to a node, by default the present one; None where nothing was.

        Raises:
            GraphError: see :meth:`unifg.horizon.recorded.History.record`.
        """
        if value is not None:
            self.history.record(name, value, node)

    def now(self, given: Any, last: Array | None = None) -> Now[Any]:
        """What terms may ask for now; ``last`` (m,) is the control applied last."""
        history = self.history
        applied = history.controls[-1] if last is None else last
        statics = {name: values.copy() for name, values in history.statics.items()}
        return Now(given, self.present, applied.copy(), statics, history)

    def estimate(self, given: Any = None) -> Solution:
        """Solve the window and believe it, unless the answer is none; then the prediction is kept."""
        now, past = self.now(given), self._past
        data = past.data(now)
        solution = self._run.solve({past.x.family: past.nodes(), **past.guess()}, data=data)
        self.statuses[solution.status] += 1
        if solution.status in USELESS:
            solution = self._look.solve({past.x.family: past.nodes(), **past.guess()}, data=data)
        else:
            past.take(solution)
        self._conclude(solution)
        return solution

    def estimate_nothing(self, given: Any = None) -> None:
        """Look at the window where it is believed to be, without moving it."""
        past = self._past
        self._conclude(self._look.solve({past.x.family: past.nodes(), **past.guess()}, data=past.data(self.now(given))))

    def _conclude(self, solution: Solution) -> None:
        self.solution = solution
        covariance = self._spread(solution.values)
        if covariance is not None:
            self.covariance = covariance
        self._past.depart(solution)

    def reset(self, start: ArrayLike | None = None, sigma: ArrayLike | None = None) -> None:
        """Forget everything, and begin anew.

        Args:
            start: (storage,) believed state; None for that of the beginning.
            sigma: (d,) or (d, d); None for that of the beginning.
        """
        begin = self._start if start is None else np.asarray(start, dtype=np.float64)
        spread = self._sigma if sigma is None else _covariance(sigma, self.robot.state.dim)
        self.history.begin(begin)
        self.left.begin(begin, spread)
        self.solution, self.covariance = None, self._prior_covariance()

    def _prior_covariance(self) -> Array:
        blocks = [np.linalg.inv(self.left.initial[1])]
        for static in self.robot.statics:
            for information in static.information:
                with np.errstate(divide="ignore"):
                    blocks.append(np.diag(1.0 / np.diag(information)))
        size = sum(len(block) for block in blocks)
        covariance, at = np.zeros((size, size)), 0
        for block in blocks:
            covariance[at : at + len(block), at : at + len(block)] = block
            at += len(block)
        return covariance


def _covariance(sigma: ArrayLike, dim: int) -> Array:
    """(d, d) covariance of standard deviations (d,), or as it is."""
    array = np.asarray(sigma, dtype=np.float64)
    if array.ndim < 2:
        array = np.diag(np.broadcast_to(array, (dim,)) ** 2)
    covariance: Array = array.copy()
    if covariance.shape != (dim, dim) or not np.all(np.linalg.eigvalsh(covariance) > 0.0):
        raise GraphError(
            f"the standard deviations at the start must be ({dim},) positive, or a covariance; got {array}"
        )
    return covariance
