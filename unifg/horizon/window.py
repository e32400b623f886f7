"""A fixed-lag smoother of a robot's last steps: what enters, what it says, and what leaves as a prior."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from unifg.errors import GraphError, UnifgError, require_kinds
from unifg.horizon.history import History
from unifg.horizon.past import Arrival, MarginalPrior, Past, Place, Tangent
from unifg.horizon.robot import Robot, information_of
from unifg.horizon.spread import JointCovariance
from unifg.horizon.terms import Context, Dynamics, Recording, Term, looked_at, reset_all
from unifg.locks import ReentrantLock, synchronized
from unifg.modeling.duplicates import doubles
from unifg.modeling.elements import elements_of
from unifg.modeling.terms import Constraint
from unifg.modeling.variables import Data, Family, Selection
from unifg.solution.graph import Graph
from unifg.solution.solution import Solution
from unifg.solution.solver import Solver
from unifg.solution.status import Status
from unifg.solvers.interior_point.method import InteriorPoint
from unifg.solvers.least_squares import LevenbergMarquardt
from unifg.typing import Array, ArrayLike

logger = logging.getLogger("unifg")

USELESS = (Status.NOT_FINITE, Status.SINGULAR, Status.UNBOUNDED)


class Window:
    """The last L steps of a robot, and a solver for what they say by themselves.

    At a tick: :meth:`move` lets the next node enter, :meth:`record` attaches what was measured, :meth:`estimate`
    solves. :class:`unifg.horizon.RecedingHorizon` does all three.

    Attributes:
        robot: who moves.
        terms: what the past says.
        history: numbers of the nodes.
        left: what is known of what has left.
        solution: of the last estimate; None before.
        iterations: of the last estimate.
        run: the prepared solver.
        spread: what finds covariances.
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
        filled: bool = False,
        rounds: int = 1,
        steady: float = 0.0,
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
            filled: whether the places before the start are nodes, too, that steps of no duration have led away from:
                for dynamics that take the duration of a step from ``now.past.times``, and then say that nothing moved.
                The structure of the problem is that of a full window from the first tick on. Measurements with time
                stamps and inertial ones are not defined on such steps.
            rounds: how often at most, in one estimate, terms are asked for their data at what is believed and the
                window is solved: more than once where data depend on beliefs, as associations do.
            steady: a round that moves the present state by less, in every coordinate of its tangent space, is the last.

        Raises:
            GraphError: when sizes do not fit, or a term cannot stand in a window, as Dynamics in one that is filled.
        """
        given = {"robot": robot, "solver": solver, "rounds": rounds, "steady": steady}
        require_kinds("Window", GraphError, Window.__init__.__annotations__, given, Robot, Solver)
        if rounds < 1:
            raise GraphError(f"an estimate takes one round or more, found rounds={rounds}")
        self._lock = ReentrantLock()
        self.robot, self.terms, self.length = robot, looked_at(terms), length
        fixed = [term for term in self.terms if filled and isinstance(term, Dynamics)]
        if fixed:
            raise GraphError(
                f"term '{fixed[0].name}' has a step of {fixed[0].step} s, but a filled window begins with steps of no "
                "duration: take durations from now.past.times, as an exact motion, or give filled=False",
                term=fixed[0].name,
            )
        moving = [own.step for own in self.terms if isinstance(own, Dynamics) and not isinstance(own.step, Data | None)]
        self._step = float(np.mean(np.asarray(moving[0]))) if moving else 0.0
        self._arrival = arrival or Tangent()
        self._records: dict[str, tuple[int, ...]] = {}
        for term in self.terms:
            if isinstance(term, Recording):
                self._records.update(term.records)
        self._start = robot.point(start, "the start")
        self._sigma = _covariance(sigma, robot.state.dim)
        self.history = History(robot, length, self._start, self._records, filled)
        self.left = MarginalPrior(robot, self._start, self._sigma)
        graph = Graph()
        x = graph.variables("x", robot.state, length + 1)
        for static in robot.constants:
            static.family(graph)
        self._past = self.past_in(graph, x[:])
        for stated in graph.terms:
            for place, kind in elements_of(stated.residual).items():
                if isinstance(data := stated.arguments[place], Data) and data.name in self._records:
                    self.history.elements[data.name] = kind
        if solver is None:
            constrained = any(isinstance(term, Constraint) for term in graph.terms)
            solver = InteriorPoint() if constrained else LevenbergMarquardt()
        self.run = solver.prepare(graph)
        self._look = replace(solver, max_iterations=0).prepare(graph)
        self.spread = JointCovariance(self.run.program, x[-1], *self._past.constants)
        self.solution: Solution | None = None
        self._rehearse()
        self.statuses: Counter[Status] = Counter()
        self._given: Any = None
        self.iterations, self._rounds, self._steady = 0, rounds, steady
        self._covariance, self._due = self._prior_covariance(), False

    def _rehearse(self) -> None:
        """Call once what ticks call besides the solver: functions of manifolds are compiled when they are needed."""
        kinds = [self.robot.state, *self.robot.steps.values(), *(static.manifold for static in self.robot.constants)]
        for kind in kinds:
            here = kind.identity()
            kind.retract(here, kind.local(here, here))
            kind.retract(here[None], kind.local(here[None], here[None]))

    def past_in(self, graph: Graph, x: Selection) -> Past:
        """State the past on the nodes x (L + 1) of a graph that holds the robot's constants."""
        return Past(graph, x, self.robot, self.history, self.left, self.terms, self._arrival)

    @property
    def present(self) -> Array:
        """(storage,) present state as it is believed."""
        return self.history.present.copy()

    @property
    @synchronized
    def covariance(self) -> Array:
        """(D, D) of the present state and the constants side by side, from the past's terms alone.

        That of the last estimate for which there is one: constants that nothing has been measured of have none.
        """
        if self._due and self.solution is not None:
            self._due = False
            found = self.spread(self.solution.values)
            if found is None:
                logger.warning("the window's information is singular: the covariance stays as it was")
            else:
                self._covariance = found
        return self._covariance

    def place(self, name: str, member: int = 0) -> slice:
        """Columns of a static's member in :attr:`covariance`.

        Raises:
            GraphError: when the robot has no such static.
        """
        return self._member(name, member, self.robot.state.dim, "dim")

    def _member(self, name: str, member: int, at: int, size: str) -> slice:
        places = self.robot.places(size).get(name, ())
        if not 0 <= member < len(places):
            raise GraphError(f"the robot has no static '{name}' with a member {member}", family=name)
        own = places[member]
        return slice(at + int(own[0]), at + int(own[-1]) + 1)

    def _arriving(self, name: str, member: int) -> Place:
        """Position of a static's member in the arrival."""
        state, reach = self.robot.state, self._past.reach
        sizes = (reach * state.storage, "storage"), (reach * state.dim, "dim")
        reference, information = (self._member(name, member, at, size) for at, size in sizes)
        behind = reach * state.storage + sum(places.size for places in self.robot.places("storage").values())
        return reference, information, slice(behind + information.start, behind + information.stop)

    @synchronized
    def admit(self, name: str, member: int, value: ArrayLike, sigma: ArrayLike) -> None:
        """Let a member of a static stand for something new, of which nothing was known.

        Args:
            name: of the static.
            member: which of its members.
            value: (storage,) where it is believed to be.
            sigma: standard deviations of that belief, of any shape that fits (d,).

        Raises:
            GraphError: when the robot has no such static, or it is known.
        """
        manifold = {static.name: static for static in self.robot.constants if not static.known}
        place = self._arriving(name, member)
        if name not in manifold:
            raise GraphError(f"static '{name}' is known: nothing new can take its place", family=name)
        kind, array = manifold[name].manifold, np.asarray(value, dtype=np.float64)
        if array.shape != (kind.storage,) or not np.all(kind.is_valid(array)):
            raise GraphError(f"static '{name}': {array} is not on {kind.name}", family=name)
        weight = information_of(np.broadcast_to(np.asarray(sigma, dtype=np.float64), (kind.dim,)))
        self.left.admit(name, member, array, weight, place)
        self.history.constants[name][member] = array

    @synchronized
    def forget(self, name: str, member: int) -> None:
        """Marginalise a member of a static out of what has left.

        What was believed of it before it was measured goes with it, unused; its measurements in the window are the
        caller's to strike out.

        Raises:
            GraphError: when the robot has no such static.
        """
        self.left.forget(self._arriving(name, member)[1])

    @property
    def state_covariance(self) -> Array:
        """(d, d) of the present state."""
        dim = self.robot.state.dim
        return self.covariance[:dim, :dim].copy()

    @synchronized
    def move(
        self,
        control: ArrayLike,
        time: float | None = None,
        state: ArrayLike | None = None,
        steps: Mapping[str, ArrayLike] | None = None,
    ) -> None:
        """Let the next node enter; the oldest one leaves when the window is full.

        Args:
            control: (m,) applied since the last node.
            time: of the new node [s]; None for one step of the dynamics after the last, or the robot's tick, or 1 s.
                Another spacing than the step of dynamics is warned of.
            state: (storage,) a guess of the new node; None for where the robot's model expects it.
            steps: (storage,) guesses of the new step's unknowns, by name.

        Raises:
            GraphError: when the control is not finite, time runs backwards, or there is no such step or state; the
                window is as it was.
        """
        robot, history = self.robot, self.history
        applied, entering = robot.applicable(control), history.later(time, self._step or robot.tick or 1.0)
        expected = self._expected(applied) if state is None else robot.point(state, "the new node")
        for name, value in (steps or {}).items():
            if name not in robot.steps or np.shape(value) != (robot.steps[name].storage,):
                known = ", ".join(f"{name} ({kind.storage},)" for name, kind in robot.steps.items()) or "none"
                raise GraphError(f"the guess of '{name}' is none of the robot's steps: {known}", family=name)
        if history.full:
            if self.left.pending_prior is None:
                # Linearised where it is believed to be, without moving it.
                self._conclude(self._look.solve(self.guess(), data=self.data(self._given)))
            self.left.arrival, self.left.pending_prior = self.left.pending_prior, None
        if self._step and not 0.5 < (gap := entering - float(history.times[-1])) / self._step < 1.5:
            logger.warning(
                "the new node of the window is %g s after the last one, but a step of its dynamics is %g s: give the "
                "times of nodes in seconds, or dynamics that take durations from now.past.times", gap, self._step,
            )  # fmt: skip
        history.move(applied, expected, entering, steps or {})

    def _expected(self, applied: Array) -> Array:
        found = self.robot.predicted(self.history.present, applied)
        if not np.isfinite(found).all():
            raise GraphError(f"predict must give a finite state {found.shape}, found {found} at {self.history.present}")
        return found

    @synchronized
    def record(self, name: str, value: ArrayLike | None, node: int = -1) -> None:
        """Attach what was measured to a node, by default the present one; None where nothing was.

        Raises:
            GraphError: see :meth:`unifg.horizon.history.History.record`.
        """
        if value is not None:
            self.history.record(name, value, node)
            self.left.pending_prior = None  # it was found without this measurement

    def now(self, given: Any, last: Array | None = None) -> Context[Any]:
        """Context of terms; ``last`` (m,) is the control applied last."""
        history = self.history
        applied = history.controls[-1] if last is None else last
        constants = {name: values.copy() for name, values in history.constants.items()}
        return Context(given, self.present, applied.copy(), constants, history)

    def data(self, given: Any = None) -> dict[Data, ArrayLike]:
        """Data of the window's own graph."""
        return self._past.data(self.now(given))

    def guess(self) -> dict[Family, Array]:
        """Beliefs by the families of the window's own graph."""
        return {self._past.x.family: self._past.nodes(), **self._past.guess()}

    @synchronized
    def estimate(self, given: Any = None) -> Solution:
        """Solve the window and believe it, unless the answer is none; then the prediction is kept.

        Raises:
            UnifgError: for data of a term that do not fit, and a term that cannot stand on steps of no duration in a
                window that is filled.
        """
        try:
            return self._estimate(given)
        except UnifgError as error:
            if not (self.history.filled and np.any(np.diff(self.history.times) == 0.0)):
                raise
            raise GraphError(
                f"{error}; the window is filled, so steps of no duration lead to its start: terms that divide by a "
                "duration or integrate over it, as measurements with time stamps, need filled=False",
                term=error.term,
            ) from error

    def _estimate(self, given: Any) -> Solution:
        past, self.iterations, self._given = self._past, 0, given
        for left in reversed(range(self._rounds)):
            before, data = self.present, self.data(given)
            solution = self.run.solve(self.guess(), data=data)
            self.statuses[solution.status] += 1
            self.iterations += solution.iterations
            if solution.status in USELESS:
                solution = self._look.solve(self.guess(), data=data)
                break
            past.take(solution)
            if left and np.abs(self.robot.state.local(before, self.history.present)).max() < self._steady:
                break
        self._conclude(solution)
        return solution

    def _conclude(self, solution: Solution) -> None:
        self.solution, self._due = solution, True
        self._past.depart(solution)

    @synchronized
    def reset(self, start: ArrayLike | None = None, sigma: ArrayLike | None = None) -> None:
        """Forget everything, and begin anew; terms that keep something forget it, too.

        Args:
            start: (storage,) believed state; None for that of the beginning.
            sigma: (d,) or (d, d); None for that of the beginning.

        Raises:
            GraphError: when they do not fit; the window is as it was.
        """
        begin = self._start if start is None else self.robot.point(start, "the start")
        spread = self._sigma if sigma is None else _covariance(sigma, self.robot.state.dim)
        self.history.begin(begin)
        self.left.begin(begin, spread)
        self.solution, self._covariance, self._due = None, self._prior_covariance(), False
        reset_all(self.terms)

    def _prior_covariance(self) -> Array:
        present = np.linalg.inv(self.left.initial[1])
        variances = [np.ravel(np.square(static.sigma)) for static in self.robot.constants]
        covariance = np.diag(np.concatenate([np.diag(present), *variances]))
        covariance[: len(present), : len(present)] = present
        return covariance


def _covariance(sigma: ArrayLike, dim: int) -> Array:
    """(d, d) covariance of standard deviations (d,), or as it is."""
    array = doubles("the standard deviations at the start", sigma).copy()
    deviations = array.shape in ((), (1,), (dim,))
    covariance = np.diag(np.broadcast_to(array, (dim,)) ** 2) if deviations else array
    fits = covariance.shape == (dim, dim) and bool(np.isfinite(array).all())
    fits = fits and np.allclose(covariance, covariance.T, rtol=1e-9, atol=0.0)
    if not (fits and np.all((array if deviations else np.linalg.eigvalsh(array)) > 0.0)):
        raise GraphError(
            f"the standard deviations at the start must be ({dim},) positive, or a covariance; got {array}"
        )
    return covariance
