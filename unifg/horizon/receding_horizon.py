"""One prepared graph solved tick after tick: warm starts, a deadline, the plan that is kept, and when to begin anew."""

from __future__ import annotations

import time as clocks
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import chain, islice
from typing import Any

import numpy as np

from unifg.errors import BackendError, GraphError, NotFiniteError, require_kinds, require_positive
from unifg.horizon.coupling import COUPLINGS, Coupling, couple, weigh
from unifg.horizon.decision import AcceptancePolicy, Decision, LastPlan, LastPlanThenBrake, Plan
from unifg.horizon.history import instant
from unifg.horizon.initial_guesses import InitialGuesses
from unifg.horizon.margins import Margins
from unifg.horizon.multistart import LEAST_TIME, Jumps, cheapest
from unifg.horizon.node_times import node_times
from unifg.horizon.robot import Robot, control_limits, numbers, require_steps
from unifg.horizon.terms import Context, Guessing, Term, handles_of, looked_at, reset_all, values_of
from unifg.horizon.tree import BranchedSelection, ExpectedCost, Tree
from unifg.horizon.window import Window
from unifg.locks import ReentrantLock
from unifg.modeling.variables import Data
from unifg.solution.graph import Graph
from unifg.solution.guess import Guess
from unifg.solution.history import subproblems
from unifg.solution.solution import Solution
from unifg.solution.solver import Prepared, Solver
from unifg.solution.status import Status
from unifg.typing import Array, ArrayLike

TIMES = 100_000  # ticks whose times are kept
CLOSE = 1e-4  # a plan may bend constraints more, but noise of the past is as small as that
FORGOTTEN = 0.95  # of the time of an iteration, until a slower one
RESERVE = 0.1  # share of the deadline that more starts leave free


class RecedingHorizon:
    """Estimates, plans and decides, tick after tick, with graphs that are stated and prepared once.

    A plan that the robot may apply is kept; while later solves fail, what is left of it is there to fall back on.
    Plans that end behind where they should for too long are caught in a dead end, where the warm start would keep
    them: the next solve begins anew.

    Attributes:
        robot: who moves.
        steps: N of the future.
        tree: order of its nodes.
        path: (K + 1,) nodes whose plan is applied and kept: all, or those that lead to the end of the last tail.
        times: (N + 1,) of its nodes from the present on [s]; 0, 1, ..., N in ticks where none were given.
        probabilities: (N + 1,) of its nodes in the last tick.
        coupling: of estimation and control.
        window: of the past; None where the present is given to :meth:`plan`.
        tie: what ties the horizon to the past.
        x, u: nodes (N + 1) of the future, and the family of controls (N).
        warm, cold: the prepared backend for solves with and without a warm start.
        second: another one, asked when the plan of the first is refused; None for none.
        guess: where the next solve begins; None for anew.
        failed: whether the last plan was refused.
        kept: the last plan that was accepted.
        lagging: ticks for which plans have ended behind.
        applied: (m,) control that acts until the next tick: that of the last plan, unless plans act later.
        delay: ticks between the present of a plan and when it acts.
        sent: (delay, m) controls that have been decided and act from the next tick on, the next one first.
        estimate: (storage,) present state as it is believed after the last tick.
        constants: (count, storage) constants as they are believed after the last tick, by name.
        believed: whether both are what a joint solve says, and not the past alone.
        solution: of the last tick; None before.
        statuses: how often solves ended in what way.
        sources: how often what was applied; "late" counts plans that came after the deadline.
        goes_on: True if the next tick goes on with a solve that has begun, and looks at no ``given``.
        waited: ticks between the begin of the last plan's solve and its end.
        rescues: how often the second backend had a plan when the first had none.
        subproblems: how many quadratic programs of plans each solver has solved, where the backend has such.
        more_starts: how many were tried beside the first of a tick.
        milliseconds: wall-clock times of the last ticks [ms].
    """

    def __init__(
        self,
        robot: Robot,
        steps: int | Tree,
        terms: Sequence[Term],
        *,
        probabilities: Callable[[Context[Any]], ArrayLike] | None = None,
        times: ArrayLike | None = None,
        solver: Solver,
        cold: Solver | None = None,
        second: Solver | None = None,
        window: Window | None = None,
        coupling: Coupling = "sequential",
        pull: float | Sequence[float] | Array = 0.5,
        control_weight: float = 1.0,
        limits: tuple[ArrayLike, ArrayLike] | None = None,
        judge: AcceptancePolicy | None = None,
        starts: InitialGuesses | None = None,
        believable: Callable[[Solution, Decision], bool] | None = None,
        deadline: float = np.inf,
        delay: int = 0,
        patience: int = 10,
        portion: int | None = None,
        sigmas: float | Mapping[str, float] | None = None,
        clock: Callable[[], float] = clocks.perf_counter,
    ) -> None:
        """State the graph and prepare the backends; ticks compile nothing.

        Args:
            robot: who moves.
            steps: N of the future, or a tree of its nodes. The plan that is applied and kept is then that of its last
                tail: let that be the one that holds whatever happens. The others are in ``solution``.
            terms: of the nodes and controls of the future.
            probabilities: ``probabilities(now)`` gives those of the tails (L,), by which costs are weighted, by 1e-3 at
                least; prices of soft constraints are not. They are constants of a solve. None: costs count fully.
            times: (N + 1,) of the nodes from the present on [s], from zero and of any spacing, the first step being as
                long as a tick. Warm starts, kept plans and rollouts go by them. None: every step is a tick.
            solver: for a solve with a warm start.
            cold: for one without, which may iterate longer; None for the same.
            second: asked in the same tick when the plan of the first is refused, from where solves begin after a
                failure; None for none.
            window: of the past.
            coupling: "separate", "sequential" or "joint".
            pull: see :class:`unifg.horizon.coupling.JointPresent`.
            control_weight: factor on all costs of the future; matters where they meet those of the past.
            limits: least and greatest controls (m,), to which plans are clipped, infinite where there are none; one
                number holds for all, None for no limits.
            judge: decides what is applied; by default :class:`unifg.horizon.LastPlanThenBrake`.
            starts: where solves begin that have no last answer to go on from, and what is tried beside the warm start
                when the goal has moved. The cheapest feasible plan is kept; what the deadline leaves no time for is
                tried in the next tick.
            believable: test of what a joint solve says of the present; None: its plan is used, violated by ``CLOSE``.
            deadline: for a tick [s]: the solver is given what is left of it; a plan that comes later is not applied.
            delay: ticks after which a plan acts, because solving takes time. The horizon begins where the controls
                that have been sent until then lead by the robot's model, and the first control of a plan acts there;
                ``applied`` is what acts in the meantime, at first zero.
            patience: ticks of ending behind before a solve begins anew.
            portion: iterations of a tick; a solve that needs more goes on in the next ticks, with its numbers, and what
                the judge has instead of a plan is applied meanwhile. Its plan is then followed from where it should be.
                With a deadline as many are made as fit by the time that they took before; where none fits, the tick is
                late and what is left of the last plan is applied. None: every solve ends in its tick.
            sigmas: standard deviations of the estimate by which inequality constraints on states are tightened, all or
                those named (:class:`unifg.horizon.margins.Margins`); None for no margin.
            clock: seconds of the wall.

        Raises:
            GraphError: for options of another kind, an unknown coupling, a joint one without a window, sizes and limits
                that do not fit, a term that cannot be stated, dynamics without a step where nodes have no times, or
                with another step than between them, times that do not grow or begin with another step than a tick, or a
                delay of a joint coupling or of a robot without a model; portions of what begins anew with every tick.
        """
        given = dict(locals())
        stated = RecedingHorizon.__init__.__annotations__ | {"judge": "Callable | None"}
        require_kinds("RecedingHorizon", GraphError, stated, given, Robot, Solver, Window, InitialGuesses)
        if patience < 1:
            raise GraphError(f"patience={patience}: one tick or more, after which a solve begins anew")
        if portion is not None and (portion < 1 or coupling == "joint" or delay):
            raise GraphError(f"portion={portion}: one iteration or more, of a plan that acts at once and is not joint")
        if coupling not in COUPLINGS:
            raise GraphError(f"unknown coupling '{coupling}': choose {', '.join(COUPLINGS)}")
        if not isinstance(steps, Tree):
            require_steps("a horizon", "steps", steps)
        tree = steps if isinstance(steps, Tree) else Tree(tuple(range(steps)))
        require_positive("RecedingHorizon", GraphError, finite=False, **{"the deadline [s]": deadline})
        require_positive("RecedingHorizon", GraphError, control_weight=control_weight)
        if delay < 0 or (delay and (coupling == "joint" or robot.predict is None)):
            raise GraphError(
                f"delay={delay}: a plan acts now or later; later takes a robot that predicts, and not the coupling "
                "'joint', where the future begins at the present"
            )
        self._lock = ReentrantLock()
        self._terms, self.tree, self.path = looked_at(terms), tree, tree.paths[-1]
        self.times = node_times(times, tree, robot, self._terms, window)
        self.robot, self.steps, self.coupling, self.window, self.delay = robot, len(tree), coupling, window, delay
        self._deadline, self._clock, self._patience = deadline, clock, patience
        between = control_limits((-np.inf, np.inf) if limits is None else limits, robot.control.storage)
        graph = Graph()
        self.tie = couple(self.coupling, graph, robot, self.window, self.steps, pull)
        self.x, self.u = self.tie.ahead, graph.variables("u", robot.control, self.steps)
        before, tied = len(graph.terms), handles_of(graph)
        branches = len(tree.paths) > 1
        nodes = (BranchedSelection(self.x, tree), BranchedSelection(self.u[:], tree)) if branches else (self.x, self.u)
        for term in self._terms:
            term.state(graph, *nodes)
        weigh(graph.terms[before:], control_weight)
        self._handles, self._families = handles_of(graph), dict(graph.families)
        self._expected: ExpectedCost | None = None
        self.probabilities, self._branches = np.ones(self.steps + 1), tree if branches else None
        if probabilities is not None:
            self._expected = ExpectedCost(graph, graph.terms[before:], tree, self.x, self.u)
        self._probabilities = probabilities
        self._margins = Margins(graph, graph.terms[before:], sigmas, robot, self.x, window)
        self._said = [handle for name, handle in self._handles.items() if name not in tied]
        backends = solver, cold or solver, second or solver
        most = deadline if portion is None else np.inf
        timed = [replace(own, time_limit=min(own.time_limit, most)) for own in backends]
        self._limits = [own.time_limit for own in timed]
        self.warm, self.cold = (own.prepare(graph) for own in timed[:2])
        self.second = None if second is None else timed[2].prepare(graph)
        self.kept = LastPlan(self.times[self.path], robot, between)
        self.judge: AcceptancePolicy = judge or LastPlanThenBrake(robot)
        self.starts: InitialGuesses = starts or InitialGuesses()
        self._believable = believable or _close
        self.statuses: Counter[Status] = Counter()
        self.sources: Counter[str] = Counter()
        self.rescues = self.more_starts = 0
        self._jumps = Jumps()
        self._tried: int | None = None  # of the starts of a search that has not ended
        self.milliseconds: deque[float] = deque(maxlen=TIMES)
        self.guess: Guess | None = None
        self.solution: Solution | None = None
        self.subproblems: Counter[str] = Counter()
        self._counting = any(asked is not None and asked.states_subproblems for asked in (solver, second))
        self._solved_by: Prepared | None = self.warm
        self._verification_time = 0.0
        self.sent: Array = np.zeros((delay, robot.control.storage))
        self.lagging, self.failed = 0, False
        self._portion, self.goes_on, self._step_time = portion, False, 0.0
        self.waited = 0
        self._believe_nothing()

    def tick(
        self,
        given: Any = None,
        measured: Mapping[str, ArrayLike | None] | None = None,
        *,
        applied: ArrayLike | None = None,
        time: float | None = None,
    ) -> Plan:
        """Let the past move on by what was applied, take in what was measured, estimate and plan.

        Args:
            given: what terms ask for in ``now.given``.
            measured: values at the present node, by name; what is missing or None was not measured.
            applied: (m,) since the last tick; None for what the last plan said.
            time: of the present [s]; None for one step after the last tick, as :meth:`Window.move` has it.

        Raises:
            GraphError: without a window; for a measurement, a control or a time that does not fit, which leaves
                everything as it was; for data of a term that do not. Not for a hard problem.
            BackendError: while another thread ticks.
        """
        if self.window is None:
            raise GraphError("a tick needs a window; without one, give the present to plan()")
        with self._alone():
            return self._tick(self.window, given, measured, applied, time)

    def _tick(
        self,
        window: Window,
        given: Any,
        measured: Mapping[str, ArrayLike | None] | None,
        applied: ArrayLike | None,
        time: float | None,
    ) -> Plan:
        begin = self._clock()
        if not isinstance(measured, Mapping | None):
            raise GraphError(f"measured: values by name are expected, found {f'{measured!r}'[:80]}")
        seen = {name: value for name, value in (measured or {}).items() if value is not None}
        for name, value in seen.items():
            window.history.readable(name, value)
        last = self.applied if applied is None else self.robot.applicable(applied)
        if window.solution is not None:
            window.move(last, time)
        elif time is not None:
            window.history.times[:] = instant(time)
        for name, value in seen.items():
            window.record(name, value)
        window.estimate(given)
        return self._plan(replace(window.now(given, last), times=self.times, tree=self._branches), begin)

    def plan(
        self,
        present: ArrayLike,
        given: Any = None,
        constants: Mapping[str, Array] | None = None,
        covariance: ArrayLike | None = None,
    ) -> Plan:
        """Plan from a present state (storage,) that is estimated elsewhere.

        Args:
            present: state.
            given: what terms ask for in ``now.given``.
            constants: (count, storage) by name; by default those of the window, without one those at the start.
            covariance: (D, D) of state and constants side by side, for ``sigmas``; by default that of the window.

        Raises:
            GraphError: for constants that there are not, data of a term and a covariance that do not fit.
            BackendError: while another thread plans.
        """
        with self._alone():
            begin = self._clock()
            return self._plan(self.now(present, given, constants), begin, covariance)

    def idle(self, seconds: float = np.inf) -> dict[str, str]:
        """Verify the last solution by the functions as written, while nothing is due: after the control was applied.

        Nothing is done without a solution, for a verified one, for one of several starts, and where the last
        verification took longer than ``seconds``.

        Args:
            seconds: until the next tick.

        Returns:
            Reasons by the names of terms whose traces differ; from the next tick on they are evaluated by Python.

        Raises:
            BackendError: while another thread plans.
        """
        with self._alone():
            run = self._solved_by
            if self.solution is None or run is None or self.solution.checked or self._verification_time > seconds:
                return {}
            begin = self._clock()
            found = run.verify(self.solution)
            self._verification_time = self._clock() - begin
            return found

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """Refuse what another thread asks for meanwhile: it would not be in time."""
        if not self._lock.acquire(blocking=False):
            raise BackendError("this loop is at work in another thread: a loop has one thread at a time")
        try:
            yield
        finally:
            self._lock.release()

    def now(self, present: ArrayLike, given: Any = None, constants: Mapping[str, Array] | None = None) -> Context[Any]:
        """Context for the terms; arguments as of :meth:`plan`."""
        if constants is not None:
            require_kinds("plan", GraphError, RecedingHorizon.now.__annotations__, {"constants": constants}, Mapping)
        history = None if self.window is None else self.window.history
        known = (
            {static.name: static.values for static in self.robot.constants} if history is None else history.constants
        )
        stated = {name: self._constant(name, value, known) for name, value in (constants or {}).items()}
        known = {name: values.copy() for name, values in known.items()} | stated
        here = self.robot.point(present, "the present state")
        return Context(given, here, self.applied.copy(), known, history, self.times, self._branches)

    def _constant(self, name: str, value: ArrayLike, known: Mapping[str, Array]) -> Array:
        """A value (count, storage) of a static."""
        if name not in known:
            raise GraphError(f"the robot has no static '{name}' (there are: {', '.join(known) or 'none'})", family=name)
        return numbers(value, known[name].shape, f"static '{name}'", family=name)

    def data(self, now: Context[Any]) -> dict[Data, ArrayLike]:
        """Data of the whole graph."""
        found = self.tie.data(now) | values_of(self._terms, now, self._handles)
        if self._probabilities is not None and self._expected is not None:
            self.probabilities = self.tree.probabilities(self._probabilities(now))
            found |= self._expected.data(self.probabilities)
        return found

    def _plan(self, present: Context[Any], begin: float, covariance: ArrayLike | None = None) -> Plan:
        """Solve, judge, and remember."""
        now = self._acting(present)
        if self.goes_on:
            self.waited += 1
            if not self._fits(begin):
                return self._late(now, present, begin)
            return self._decided(self._timed(self.warm.proceed), now, present, begin)
        self.waited = 0
        data = self.data(now)
        run, guess = self.begin(now)
        if run is self.warm and not self._fits(begin):
            return self._late(now, present, begin)
        start = self.tie.begin(guess, now)
        if self._margins:
            data = self._margins.data(run.program, start, covariance, data)
        if np.isfinite(self._deadline) and self._portion is None:
            limit = self._limits[0 if run is self.warm else 1]
            run.solver.time_limit = max(LEAST_TIME, min(limit, self._deadline - (self._clock() - begin)))
        try:
            first, rescued = self._timed(lambda: run.solve(start, data=data)), False
        except NotFiniteError:  # at a warm start that data have moved away from
            warm, self.guess = self.guess, None
            if warm is None:
                raise
            try:
                return self._plan(present, begin, covariance)
            except NotFiniteError:
                self.guess = warm
                raise
        solution = self._search(first, now, data, begin)
        if self.second is not None and self._refuses(solution, now):
            solution, rescued = self._ask(self.second, solution, now, data, begin)
        self._solved_by = self.second if rescued else run if solution is first else None
        return self._decided(solution, now, present, begin, rescued)

    def _fits(self, begin: float) -> bool:
        """Choose as many iterations of a portion as the deadline leaves time for; False for none."""
        if self._portion is None:
            return True
        left, count = (1.0 - RESERVE) * self._deadline - (self._clock() - begin), self._portion
        if np.isfinite(left) and self._step_time > 0.0:
            count = min(count, int(left / self._step_time))
        self.warm.portioned(max(count, 1))
        return count > 0

    def _timed(self, solve: Callable[[], Solution]) -> Solution:
        """Solve, and learn how long an iteration takes."""
        if self._portion is None or not np.isfinite(self._deadline):
            return solve()
        before, begun = self._clock(), self.solution.iterations if self.goes_on and self.solution else 0
        solution = solve()
        took = (self._clock() - before) / max(solution.iterations - begun, 1)
        self._step_time = max(took, FORGOTTEN * self._step_time) if self._step_time else took
        return solution

    def _late(self, now: Context[Any], present: Context[Any], begin: float) -> Plan:
        """Apply what is left of the last plan, or brake; nothing is solved."""
        self.kept.age += float(self.times[1])
        choice = replace(self._instead(now), source="late")
        self.sources["late"] += 1
        self._step_time *= FORGOTTEN
        self._believe(None, choice, present)
        return self._applied(choice, Status.TIME_LIMIT, 0, begin, False)

    def _instead(self, now: Context[Any]) -> Decision:
        """Rest of the last plan, or braking as the judge does."""
        return LastPlanThenBrake(self.robot, brake=getattr(self.judge, "brake", None)).instead(now, self.kept)

    def _decided(
        self, solution: Solution, now: Context[Any], present: Context[Any], begin: float, rescued: bool = False
    ) -> Plan:
        """Judge, and remember."""
        self.solution = solution
        self.statuses[solution.status] += 1
        if self._counting:
            self.subproblems.update(subproblems(solution.history))
        choice = self.decide(solution, now, late=self._clock() - begin > self._deadline)
        self._believe(solution, choice, present)
        return self._applied(choice, solution.status, solution.iterations, begin, rescued)

    def _applied(self, choice: Decision, status: Status, iterations: int, begin: float, rescued: bool) -> Plan:
        """Plan of a tick, whose first control is applied."""
        decided = np.concatenate([self.sent, choice.controls[:1]])
        self.applied, self.sent = decided[0], decided[1:]
        elapsed = 1e3 * (self._clock() - begin)
        self.milliseconds.append(elapsed)
        return Plan(
            choice.controls, choice.states, status, iterations, choice.source, self.kept.excess,
            elapsed, rescued,
        )  # fmt: skip

    def _search(self, first: Solution, now: Context[Any], data: dict[Data, ArrayLike], begin: float) -> Solution:
        """Cheapest answer of the first start and of more, in ticks that are worth them."""
        others = self.starts.others
        if others is None:
            return first
        jumped = self._jumps({handle: data[handle] for handle in self._said if handle in data}, first, self.solution)
        if self.guess is None:  # the cold start was the first one, unless that of a failure was
            self._tried = 0 if self.failed and self.starts.after_failure is not None else 1
        elif jumped:
            self._tried = 0
        left = (1.0 - RESERVE) * self._deadline - (self._clock() - begin)
        if self._tried is None or left <= 0.0:
            return first
        self.cold.solver.time_limit = self._limits[1]
        more = others(now)
        require_kinds("InitialGuesses", GraphError, {"others(now)": "Iterable"}, {"others(now)": more}, Iterable)
        starts = self._untried(chain([(self.starts.cold or self._stay)(now)], more), now)
        return cheapest(self.cold, starts, data=data, seconds=left, incumbent=first, clock=self._clock)

    def _untried(self, starts: Iterable[tuple[Array, Array]], now: Context[Any]) -> Iterator[Guess]:
        """Starts of a search that have not been tried yet."""
        for start in islice(starts, self._tried, None):
            self._tried = (self._tried or 0) + 1
            self.more_starts += 1
            yield self.tie.begin(self._guess_from(start, now), now)
        self._tried = None

    def _refuses(self, solution: Solution, now: Context[Any]) -> bool:
        """Test whether the judge would have something else applied than the plan."""
        return self._judged(solution, *self._planned(solution), now).source != "solved"

    def _judged(self, solution: Solution, states: Array, controls: Array, now: Context[Any]) -> Decision:
        """Decision of the judge."""
        choice = self.judge(solution, states, controls, now, self.kept)
        if not isinstance(choice, Decision):
            raise GraphError(f"judge: must return a Decision, found {f'{choice!r}'[:80]}")
        return choice

    def _planned(self, solution: Solution) -> tuple[Array, Array]:
        """States (K + 1, storage) and controls (K, m) of the path that is applied."""
        states, controls = solution[self.x], solution[self.u]
        return (states, controls) if self._branches is None else (states[self.path], controls[self.path[1:] - 1])

    def _ask(
        self, other: Prepared, first: Solution, now: Context[Any], data: dict[Data, ArrayLike], begin: float
    ) -> tuple[Solution, bool]:
        """Solution of another backend and True, if the acceptance policy takes it; else the first and False."""
        left = self._deadline - (self._clock() - begin)
        if left <= 0.0:
            return first, False
        if np.isfinite(left):
            other.solver.time_limit = min(self._limits[2], left)
        start = self.starts.after_failure or self.starts.cold or self._stay
        found = other.solve(self.tie.begin(self._guess_from(start(now), now), now), data=data)
        if self._refuses(found, now):
            return first, False
        self.rescues += 1
        return found, True

    def decide(self, solution: Solution, now: Context[Any], *, late: bool = False) -> Decision:
        """Judge a solve, keep its plan if it may be applied, and say where the next one begins.

        Args:
            solution: of this tick.
            now: what the terms were asked with.
            late: whether the deadline has passed, so that the plan serves the next tick only.
        """
        states, controls = self._planned(solution)
        self.kept.age += float(self.times[1])
        choice = self._judged(solution, states, controls, now)
        ours = self._portion is not None and self._solved_by is not self.cold  # begun in this tick or gone on with
        self.goes_on = choice.source != "solved" and ours and self.warm.unfinished
        if late and choice.source == "solved":
            instead = self._instead(now)
            self._accept(solution, states, controls, choice)
            choice = replace(instead, source="late")
        elif choice.source == "solved":
            self._accept(solution, states, controls, choice)
            if self.waited and len(self.kept.left()):
                begun = self.times[self.path]
                ahead, acting = self.robot.between(begun, states, controls, begun + self.kept.age)
                choice = replace(choice, controls=self.kept.within(acting), states=ahead)
            elif self.waited:  # it was over before it was found
                choice = self._instead(now)
        elif not self.goes_on:
            self.failed = True
            if choice.resumed:
                self.guess = self.shifted(solution)
            else:
                self.guess = None if choice.after is None else self.guess_of(*choice.after, now)
        self.sources[choice.source] += 1
        return choice

    def _acting(self, now: Context[Any]) -> Context[Any]:
        """Context for the terms at the time the plan acts."""
        if not self.delay:
            return now
        return replace(now, present=self.robot.rollout(now.present, self.sent)[-1], last=self.sent[-1].copy())

    def begin(self, now: Context[Any]) -> tuple[Prepared, Guess]:
        """Backend of the next solve, and its guess."""
        if self.guess is not None:
            carry = self.starts.carry
            return self.warm, self.guess if carry is None else carry(self.guess, now)
        if self.failed and self.starts.after_failure is not None:
            return self.warm, self._guess_from(self.starts.after_failure(now), now)
        return self.cold, self._guess_from((self.starts.cold or self._stay)(now), now)

    def _guess_from(self, start: tuple[Array, Array], now: Context[Any]) -> Guess:
        """A guess of what a function of :class:`InitialGuesses` gives."""
        if not (isinstance(start, tuple | list) and len(start) == 2):
            raise GraphError(f"an initial guess is two arrays, states and controls, found {f'{start!r}'[:80]}")
        return self.guess_of(*start, now)

    def _stay(self, now: Context[Any]) -> tuple[Array, Array]:
        """States and controls of staying with the control zero."""
        return np.tile(now.present, (self.steps + 1, 1)), np.zeros((self.steps, self.robot.control.storage))

    def guess_of(self, states: Array, controls: Array, now: Context[Any]) -> Guess:
        """A guess for the graph, from states and controls of all nodes, or of the path that is applied."""
        x = self.x.family
        if len(controls) < self.steps and len(controls) == len(self.path) - 1:
            path, begins = self.times[self.path], np.append(self.times[self.tree.begins], 0.0)
            acting = self.robot.between(path, states, controls, begins)[1]
            states, controls = self.robot.between(path, states, controls, self.times)[0], acting
        nodes = np.tile(now.present, (len(x), 1))
        count, kinds = self.steps, self.robot
        nodes[len(x) - count - 1 :] = numbers(states, (count + 1, kinds.state.storage), "the states of a guess")
        values = {x: nodes, self.u: numbers(controls, (count, kinds.control.storage), "the controls of a guess")}
        for term in self._terms:
            if isinstance(term, Guessing):
                for name, value in term.guess(now).items():
                    values[self._families[name]] = np.asarray(value, dtype=np.float64)
        return Guess(values)

    def _accept(self, solution: Solution, states: Array, controls: Array, choice: Decision) -> None:
        """Keep a plan, and begin the next solve from it."""
        self.kept.store(controls, states)
        self.kept.age = self.waited * float(self.times[1])
        self.failed = False
        self.guess = None if self.stays_behind(choice.behind) else self.shifted(solution)

    def shifted(self, solution: Solution) -> Guess:
        """A solution moved on to the next tick, for the solve there.

        Between nodes states are interpolated on their manifold; beyond the last one it repeats. Multipliers move by
        whole steps: by those that a tick is nearest to, on average over the horizon.
        """
        along, ticks = (*self.tie.along, self.u), self.waited + 1
        later = self.times + ticks * self.times[1]
        if self._branches is not None:
            guess = solution.shifted(*along, by=0)
            return self._resampled(guess, solution[self.x], solution[self.u], later)
        if np.ptp(self.kept.lengths) <= 1e-9 * self.times[1]:
            return solution.shifted(*along, by=ticks) if self.waited else solution.shifted(*along)
        joint = len(self.x.family) > self.steps + 1
        whole = 1 if joint else round(self.steps * ticks * self.times[1] / self.times[-1])
        moved = solution.shifted(*along, by=whole)
        return self._resampled(moved, solution[self.x], solution[self.u], later)

    def _resampled(self, guess: Guess, states: Array, controls: Array, at: Array) -> Guess:
        """A guess with the states and controls of a plan on the nodes of now at other times (N + 1,)."""
        nodes, acting = guess.values[self.x.family].copy(), np.empty_like(controls)
        ahead = nodes[len(nodes) - self.steps - 1 :]
        for path in sorted(self.tree.paths, key=lambda path: self.probabilities[path[-1]]):  # the likeliest last
            steps = path[1:] - 1
            ahead[path], acting[steps] = self.robot.between(self.times[path], states[path], controls[steps], at[path])
        return replace(guess, values={**guess.values, self.x.family: nodes, self.u: acting})

    def set_times(self, times: ArrayLike) -> None:
        """Move the nodes of the future, from the next tick on; nothing is compiled or analysed again.

        The warm start is interpolated; the plan that is kept stays as it was planned; a solve that goes on is dropped.
        ``Dynamics`` without a step follow; other terms find the times in ``now.times``.

        Args:
            times: (N + 1,) from the present on [s], as at the beginning: the first step is as long as a tick.

        Raises:
            GraphError: when they do not fit; everything is as it was.
            BackendError: while another thread plans.
        """
        with self._alone():
            found = node_times(times, self.tree, self.robot, self._terms, self.window)
            if self.guess is not None:
                states = self.guess.values[self.x.family][-self.steps - 1 :]
                self.guess = self._resampled(self.guess, states, self.guess.values[self.u], found)
            self.times, self.kept.times = found, found[self.path]
            self.goes_on = False  # what a solve that has begun finds is on the old nodes

    def _believe(self, solution: Solution | None, choice: Decision, now: Context[Any]) -> None:
        """Take what a joint solve says of the present, or what is known without a solve."""
        said = self.tie.believed(solution) if solution and self._believable(solution, choice) else None
        self.believed = said is not None
        self.estimate, self.constants = said or (now.present, dict(now.constants))

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
        self.failed = self.goes_on = False

    def abandon(self) -> None:
        """Drop the warm start and the plan that is kept."""
        self.forget()
        self.kept.clear()
        self._jumps.clear()
        self.lagging, self._tried = 0, None

    def reset(self, start: ArrayLike | None = None, sigma: ArrayLike | None = None) -> None:
        """Forget the plan that is kept, the past, and what terms keep; counts of statuses and times stay.

        Args:
            start: (storage,) believed state; None for that of the beginning.
            sigma: (d,) its standard deviations, or its covariance; None for those of the beginning.

        Raises:
            GraphError: when a beginning is given to a loop without a window, which believes none.
            BackendError: while another thread ticks.
        """
        with self._alone():
            if self.window is not None:
                self.window.reset(start, sigma)
            elif start is not None or sigma is not None:
                raise GraphError("reset: a beginning needs a window; without one, give the present to plan()")
            behind = () if self.window is None else self.window.terms
            reset_all(term for term in self._terms if not any(term is other for other in behind))
            self.abandon()
            self._believe_nothing()

    def _believe_nothing(self) -> None:
        """Beliefs before the first tick."""
        self.applied = np.zeros(self.robot.control.storage)
        self.sent = np.zeros_like(self.sent)
        self.solution = None
        self.estimate = self.robot.state.identity() if self.window is None else self.window.present
        self.constants, self.believed = {static.name: static.values for static in self.robot.constants}, False


def _close(solution: Solution, choice: Decision) -> bool:
    """A dynamics that gives by a millimetre says as little about the past as one that is not there."""
    return choice.source == "solved" and solution.violation <= CLOSE
