"""Frame that every iterative backend runs in, and a backend bound to one graph: checks before, verification after."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from weakref import ReferenceType, ref

import numpy as np

from unifg.errors import BackendError, GraphError, NotFiniteError, require_kinds
from unifg.locks import ReentrantLock
from unifg.modeling.model import Model
from unifg.modeling.soft import SLACK
from unifg.modeling.variables import Data
from unifg.problem.by_term import ByTerm
from unifg.problem.columns import Values
from unifg.problem.compiled_problem import CompiledProblem, idle_problem
from unifg.problem.hessian import require_second
from unifg.problem.kinks import beside_a_kink
from unifg.problem.linearization import all_finite
from unifg.solution.batch import SAMPLED, Batch, Outcomes, solve_batch
from unifg.solution.export import Exported, export
from unifg.solution.guess import Guess
from unifg.solution.solution import AnyGuess, NotConverged, Solution, values_of
from unifg.solution.solve_state import Backend, Callback, IterativeMethod, SolveState, hand_over
from unifg.solution.status import Status
from unifg.solution.warmup_run import rehearse
from unifg.typing import Array, Numbers

__all__ = ["Backend", "Prepared", "SolveState", "Solver"]

logger = logging.getLogger("unifg")

KEPT = 4  # workspaces of single solves, for each graph
EVERY = 100  # solves of a loop after which answers are verified, besides the 1st, 2nd, 4th, ... and new branches
AT_ONCE, LATER = 4, 256  # verifications of new branches: so many without delay, then one in so many solves
AT_REST = (Status.CONVERGED, Status.HARDLY_DETERMINED, Status.UNDETERMINED)  # where costs are stationary


class Prepared:
    """A backend bound to one compiled graph; solves repeatedly without rebuilding structure.

    It solves the graph as it was when it was prepared: terms that are added, removed or replaced later need another
    :meth:`Solver.prepare`. The first solve after such a change says so, in a warning of the logger ``unifg``.

    It belongs to one thread at a time. Others prepare their own: those of one graph wait for each other, those of
    graphs that were stated twice do not.

    Answers are verified by evaluating traced functions as written. Values: in solves 1, 2, 4, ..., in every 100th, and
    after solves in which comparisons of a trace come out as at no verified answer: four times at once, then once in
    256 solves. Derivatives: in solves 1, 2, 4, ... A term whose trace differs is left to Python, and the solve is
    repeated from there. Where the time limit has passed, the next answer is verified instead.

    Attributes:
        solver: the backend and its options.
        program: the compiled graph.
        single: whether it is for one solve, whose workspace later ones of the graph take over.
    """

    def __init__(self, solver: IterativeMethod, program: CompiledProblem, graph: Model | None = None) -> None:
        """Made by :meth:`Solver.prepare`, for the graph that the program was made of."""
        self.solver = solver
        self.program = program
        self._graph = graph or program.graph
        self._edition = self._graph.edition
        self.single = False
        self._workspace: Any = None
        self._solves, self._owed, self._of_branches, self._bound = 0, False, 0, 0
        self._verifying = 0.0  # seconds of the last verification
        self._last: ReferenceType[Solution] | None = None
        self._begun: tuple[Array, Array, dict[Data, Array]]  # start and data of a solve in portions
        self._lock = ReentrantLock()
        self._twins: list[Prepared] = []
        self._constraints = {
            t.name: (t, rows) for t, rows in zip(program.constraint_terms, program.slices, strict=True)
        }

    def solve(
        self,
        guess: AnyGuess,
        *,
        data: Mapping[Data, Numbers] | None = None,
        duals: Mapping[str, Numbers] | None = None,
        check: bool = False,
        callback: Callback | None = None,
    ) -> Solution:
        """Solve from ``guess``; arguments and errors as for :meth:`Solver.solve`.

        Raises:
            BackendError: while another thread solves with this object, or this thread is in the midst of a solve.
            Exception: of a function of the user's. It is passed on with notes on term, factor and variable; where an
                iterate had been reached, its attribute ``reached`` is the solution until then.
        """
        self._enter()
        try:
            return self._solve(guess, data, duals, check, callback)
        finally:
            self._leave()

    def proceed(self) -> Solution:
        """Go on with the last solve, which is :attr:`unfinished`, with its data, for another portion of iterations.

        Raises:
            BackendError: it is finished, or as of :meth:`solve`.
        """
        self._enter()
        try:
            if not self.unfinished:
                raise BackendError(f"this prepared {self.solver.name} has no unfinished solve to proceed with")
            values, multipliers, data = self._begun
            self.program.bind(data)  # of which other solves of the graph may have left their own
            start = self.program.stored_from(values), multipliers.copy(), self.program.no_penalties
            solution = self._answered(*start, None, time.perf_counter())
            self._last, self._bound = ref(solution), self.program.binding.edition
            return solution
        finally:
            self._leave()

    @property
    def unfinished(self) -> bool:
        """True if the last solve has ended with its portion of iterations, and not with all that it may make."""
        return getattr(self._workspace, "unfinished", False)

    def portioned(self, count: int | None) -> None:
        """Let solves return after so many iterations, to :meth:`proceed` later; for backends that can.

        Raises:
            BackendError: no iteration is left to a portion.
        """
        require_kinds("portioned", BackendError, Prepared.portioned.__annotations__, {"count": count})
        if count is not None and count < 1:
            raise BackendError(f"portioned: count must be at least 1, or None for whole solves, found {count}")
        if hasattr(self._workspace, "portion"):
            self._workspace.portion = count

    def solve_many(
        self, guesses: AnyGuess | Sequence[AnyGuess], *, data: Mapping[Data, Numbers] | None = None, threads: int = 1
    ) -> Batch:
        """Solve many instances of the graph, with the statuses that :meth:`solve` has.

        Args:
            guesses: one for all, or one for each.
            data: (K, ...) one value for each instance of every datum named; others keep their defaults.
            threads: solve at once; each but the first compiles the graph for itself, once.

        Raises:
            GraphError: numbers of instances or shapes do not fit, and as of :meth:`solve`.
        """
        require_kinds("solve_many", GraphError, Prepared.solve_many.__annotations__, {"threads": threads})
        if threads < 1:
            raise GraphError(f"solve_many: threads must be at least 1, found {threads}")
        portion = getattr(self._workspace, "portion", None)
        self.portioned(None)  # an instance that returned early would have no one to proceed with it
        try:
            return solve_batch(self, guesses, data or {}, threads)
        finally:
            self.portioned(portion)

    def export(self, folder: str | Path, *, name: str = "solver", target: str = "") -> list[Path]:
        """Write the solver as a C function for programs without Python: header, object file and shared object.

        The function takes no memory but the workspace of its caller, and gives the bits of a solve in Python that needs
        one attempt. It verifies no answer by the functions as written: solve here first.

        Args:
            folder: to be made where there is none.
            name: of the files, and what all names in C begin with.
            target: triple of another processor, as "aarch64-unknown-linux-gnu": an object file that is not linked.

        Returns:
            The files; without the shared object where there is no C compiler, which is logged with what to do.

        Raises:
            BackendError: the backend or a part of the graph needs Python, which is named; no solve has been made; or
                the compiler has failed, with what it says.
        """
        options = {"name": name, "target": target}
        require_kinds("export", BackendError, Prepared.export.__annotations__, options, str)
        self._enter()
        try:
            return export(self, Path(folder), name, target)
        finally:
            self._leave()

    def entry(self) -> Exported:
        """The backend's loop, for :func:`unifg.solution.export.export`.

        Raises:
            BackendError: there is none.
        """
        reason = "solve once, so that answers are verified, and export then"
        if type(self.solver).entry is IterativeMethod.entry:
            reason = "its loop is Python's: prepare InteriorPoint()"
        elif self.program.least_squares:
            reason = "without constraints or general costs Python judges every step: add a bound"
        elif getattr(self.solver, "time_limit", math.inf) < math.inf:
            reason = "it has a time limit: limit its iterations"
        elif self._solves > 0 and self._bound != self.program.binding.edition:
            reason = "other solves have replaced the data of its last one: solve once more, and export then"
        elif self._workspace is not None and self._solves > 0:
            return self.solver.entry(self._workspace)
        raise BackendError(f"this prepared {self.solver.name} is not exported: {reason}")

    @property
    def solves_each(self) -> bool:
        """True if :meth:`solve_part` may be asked."""
        return self.solver.solves_each(self.program)

    def twins(self, count: int) -> list[Prepared]:
        """Prepared solvers of the same graph that belong to other threads; made once."""
        while len(self._twins) < count:
            twin = Prepared(self.solver, CompiledProblem(self.program.graph), self._graph)
            require_second(twin.program)
            self._twins.append(twin)
        return self._twins[:count]

    def solve_part(self, guesses: tuple[Array, Array], data: Mapping[Data, Array], count: int) -> Outcomes | None:
        """Some instances in one compiled call; None where single solves have to look at their data or answers."""
        self._enter()
        try:
            rows = self.program.rows(data, count)
            if rows is None:
                return None
            self.program.bind({handle: value[0] for handle, value in data.items()})
            self.program.values_from(guesses[0][0].copy())  # functions are traced again that have changed since
            if not self.solves_each:
                return None
            self.allocate()
            found = self.solver.solve_each(self._workspace, rows, *guesses)
            for k in range(SAMPLED - 1, count, SAMPLED):
                self.program.binding.forget()
                self.program.bind({handle: value[k] for handle, value in data.items()})
                if self.program.mistraced(self.program.columns.view(found.values[k]), False, k):
                    return None
            return found
        finally:
            self.program.binding.forget()
            self._leave()

    def _enter(self) -> None:
        """Take the locks of this solver and of its graph; refuse other threads, and calls from within a solve."""
        if not self._lock.acquire(False):
            raise BackendError(f"this prepared {self.solver.name} is at work in another thread: prepare one for each")
        try:
            if self.program.lock.mine:
                raise BackendError(
                    f"this prepared {self.solver.name} is asked for a solve from within a solve of its graph, whose "
                    f"data and memory it shares: call {self.solver.name}.solve(graph, ...) there"
                )
            self.program.lock.__enter__()
        except BaseException:
            self._lock.release()
            raise

    def _leave(self) -> None:
        """Let others have the locks."""
        self.program.lock.__exit__()
        self._lock.release()

    def _solve(
        self,
        guess: AnyGuess,
        data: Mapping[Data, Numbers] | None,
        duals: Mapping[str, Numbers] | None,
        check: bool,
        callback: Callback | None,
    ) -> Solution:
        program = self.program
        program.bind(data or {})
        self._say_if_stale()
        if self.unfinished:
            self._workspace.unfinished = False
        values, multipliers, penalties = self.read(guess, duals)
        began = time.perf_counter()
        if getattr(self._workspace, "portion", None) is not None:
            present = {handle: value.copy() for handle, value in program.binding.present.items()}
            self._begun = values.copy(), multipliers.copy(), present
        solution = self._verified(self._answered(values, multipliers, penalties, callback, began), began, callback)
        self._last, self._bound = ref(solution), program.binding.edition
        if check and not solution.converged:
            raise NotConverged(solution)
        return solution

    def _answered(
        self, values: Array, multipliers: Array, penalties: Array, callback: Callback | None, began: float
    ) -> Solution:
        """The solution of a solve from there: by one compiled call, if the backend has one and it succeeds."""
        program, solver = self.program, self.solver
        first = self._workspace is None or callback is not None or self.single
        found = False if first else solver.at_once(self._workspace, values, multipliers)
        if not isinstance(found, bool):
            solution = Solution(
                program, found.lin, found.multipliers, penalties, found.status, found.measured, found.history,
                found.iterations, time.perf_counter() - began, solver.name, found.iterations,
            )  # fmt: skip
            solution._parts, solution.tolerance, solution._edition = (
                found.parts,
                solver.tolerance,
                program.binding.edition,
            )
            return solution
        run = SolveState(solver, program, program.columns.view(values), multipliers, callback)
        run._started, run.penalties, run.begun = began, penalties, found
        return self._finished(run)

    def read(self, guess: AnyGuess, duals: Mapping[str, Numbers] | None = None) -> tuple[Array, Array, Array]:
        """Stored values, multipliers (M,) and penalties (M,) of a guess, checked; fixed variables have their values."""
        program = self.program
        stored = guess.flat(program) if isinstance(guess, Guess | Solution) and not duals else None
        if stored is not None:
            flat, multipliers, penalties = stored
            self._require_finite("multipliers", multipliers)
            if penalties is not program.no_penalties:
                self._require_finite("penalties", penalties)
            return program.stored_from(flat), self._pressing(multipliers.copy()), penalties
        values = program.values_from(guess if isinstance(guess, Mapping) else values_of(guess))
        if duals is not None:
            require_kinds("solve", GraphError, {"duals": "Mapping"}, {"duals": duals}, Mapping)
        carried: Mapping[str, Numbers] = {}
        penalties = program.no_penalties
        if not isinstance(guess, Mapping):
            carried = guess.multipliers
            penalties = self._stacked("penalties", guess.penalties) if guess.penalties else penalties
        multipliers = self._stacked("multipliers", {**carried, **duals} if duals else carried)
        return values.flat, self._pressing(multipliers), penalties

    def _pressing(self, multipliers: Array) -> Array:
        """Multipliers without those of rows that have no limit, as of factors that have been switched off."""
        if len(self.program.unlimited):
            multipliers[self.program.unlimited] = 0.0
        return multipliers

    def _verified(self, solution: Solution, began: float, callback: Callback | None) -> Solution:
        """Evaluate traced functions as written at an answer, and solve again without the traces that differ."""
        program = self.program
        self._solves += 1
        slopes = self._solves.bit_count() == 1
        if slopes and solution.status in AT_REST:
            beside = beside_a_kink(program, solution._lin, solution._multipliers)
            if beside is not None:
                logger.info("every step from an answer at a kink lowers the cost: the solve goes on beside it")
                solution = self._continued(solution, beside, began, callback)
        solution.checked = not program.verifications
        if solution.checked or not solution.finite or solution.status is Status.INTERRUPTED:
            return solution
        lin = solution._lin
        broken = bool(program.demanding) and self._broken(solution)
        due = slopes or self._solves % EVERY == 0 or self._owed or broken
        if not due and self._of_branches < AT_ONCE + self._solves // LATER and program.new_branches(lin.stored, False):
            due = True
            self._of_branches += 1
        late = time.perf_counter() - began + self._verifying > self.solver.time_limit
        self._owed = due and late and not broken  # verified after the next solve that leaves time for it
        if not due or self._owed:
            return solution
        program.new_branches(lin.stored, True)
        mistraced: dict[str, str] = {}
        while solution.finite:
            looked = time.perf_counter()
            found = program.mistraced(lin.values, slopes, self._solves)
            self._verifying = time.perf_counter() - looked
            if not found:
                break
            mistraced |= found
            solution = self._continued(solution, program.columns.values(solution.values), began, callback)
            lin = solution._lin
            if solution.finite:
                self._broken(solution)
        solution.checked, solution.mistraced = solution.finite, mistraced
        solution.seconds = time.perf_counter() - began
        return solution

    def _continued(self, before: Solution, values: Values, began: float, callback: Callback | None) -> Solution:
        """The solution of another solve, from values and the multipliers of one before."""
        run = SolveState(self.solver, self.program, values, before._multipliers, callback)
        run._started, run.penalties = began, before._penalties
        return self._finished(run)

    def _broken(self, solution: Solution) -> bool:
        """Test what traced functions assert; the exception of one that fails is passed on as within a solve."""
        try:
            return self.program.broken(solution._lin.values)
        except Exception as error:
            solution.status = Status.INTERRUPTED  # the KKT test would pass: it knows no assertions
            hand_over(error, solution)
            raise

    def verify(self, solution: Solution) -> dict[str, str]:
        """Evaluate traced functions as written at the last answer, with the data of that solve.

        For the idle time of a control loop. Sets ``solution.checked``, and ``solution.mistraced`` where a term differs.

        Args:
            solution: returned by the last :meth:`solve`.

        Returns:
            Reasons by the names of terms whose traces differ; from the next solve on they are evaluated by Python.

        Raises:
            BackendError: while another thread solves with this object, within a solve, for an older solution, or once
                another solve of the graph has brought other data.
        """
        self._enter()
        try:
            if self._last is None or solution is not self._last() or self._bound != self.program.binding.edition:
                raise BackendError("only the last solution can be verified: the data of others are not kept")
            found = self.program.mistraced(solution._lin.values, True, self._solves)
        finally:
            self._leave()
        solution.checked, solution.mistraced, self._owed = not found, {**solution.mistraced, **found}, False
        return found

    def _finished(self, run: SolveState) -> Solution:
        """The solution of a solve that has begun."""
        self._refuse_not_finite(run)
        if not run.alone:  # who runs alone looks for itself
            run.look_at_fixed(run.lin.constraints)
        reason = None
        if run.status is None:
            self.allocate()
            try:
                if self.solver.search_iterations:
                    run.search(self._workspace)
                reason = self.solver.iterate(run, self._workspace)
            except KeyboardInterrupt:
                if not run.incumbents:
                    raise  # there is nothing to return
                run.status = Status.INTERRUPTED
            except Exception as error:
                run.keep_with(error)
                raise
            if run.alone and not run.iterations:
                self._refuse_not_finite(run)
            if self.single:  # it may have compiled, and loaded what was
                run.parts = None
        return run.finish(reason)

    @property
    def stale(self) -> bool:
        """True if the graph has been changed since."""
        return self._graph.edition != self.program.graph.edition

    def _say_if_stale(self) -> None:
        """Say once of every change that it does not reach this solver."""
        if self._graph.edition != self._edition:
            self._edition = self._graph.edition
            logger.warning(
                "a prepared %s solves the graph as it was when it was prepared, and the graph has changed since: "
                "prepare it again", self.solver.name,
            )  # fmt: skip

    def allocate(self) -> None:
        """Make the backend's workspace, unless there is one, or an earlier single solve has left its own."""
        if self._workspace is not None:
            return
        kept = self.program.workspaces
        for solver, options, workspace in kept if self.single else ():
            if solver is type(self.solver) and _same(options, vars(self.solver)):
                self._workspace = workspace
                return
        self._workspace = self.solver.workspace(self.program)
        if self.single:
            kept.append((type(self.solver), dict(vars(self.solver)), self._workspace))
            del kept[:-KEPT]

    def __getstate__(self) -> dict[str, Any]:
        """Workspaces hold compiled objects that do not pickle; they are rebuilt on first use."""
        return {**self.__dict__, "_workspace": None, "_last": None, "_twins": []}

    def _stacked(self, what: str, given: Mapping[str, Numbers]) -> Array:
        """(M,) multipliers or penalties, zero where none are given."""
        if isinstance(given, ByTerm) and given.places is self.program.places and given.intact:
            result = given.flat.copy()
        else:
            result = self._read(what, given)
        if given:
            self._require_finite(what, result)
        return result

    def _require_finite(self, what: str, given: Array) -> None:
        if not all_finite(given):
            name = self.program.row_name(int(np.flatnonzero(~np.isfinite(given))[0]))[0]
            raise GraphError(f"{what} of '{name}' are not finite", term=name)

    def _read(self, what: str, given: Mapping[str, Numbers]) -> Array:
        """The same of arrays from anywhere."""
        result = np.zeros(self.program.constraints.count)
        for name, value in given.items():
            if name not in self._constraints and str(name).endswith(SLACK):  # of a constraint that was soft
                continue
            if name not in self._constraints:
                known = ", ".join(self._constraints) or "none"
                raise GraphError(f"{what} given for '{name}', which is no constraint (there are: {known})", term=name)
            term, rows = self._constraints[name]
            array = np.asarray(value, dtype=np.float64)
            if array.shape != (term.count, term.size):
                raise GraphError(
                    f"{what} of '{name}' have shape {array.shape}, expected {(term.count, term.size)}", term=name
                )
            result[rows] = array.ravel()
        return result

    def _refuse_not_finite(self, run: SolveState) -> None:
        if run.status is not Status.NOT_FINITE:
            return
        for term in self.program.terms:
            with np.errstate(all="ignore"):
                value = term.residual(run.values)
                bad = ~np.isfinite(value.reshape(len(value), -1)).all(axis=1)
            if bad.any():
                index = int(np.flatnonzero(bad)[0])
                selection = term.gathers[0].selection
                raise NotFiniteError(
                    f"term '{term.name}': the residual of factor {index} is not finite at the guess "
                    f"(its first variable is {selection.family.name}[{selection.indices[index % len(selection)]}]); "
                    + term.remedy(index),
                    term=term.name,
                    family=selection.family.name,
                    index=index,
                )
        raise NotFiniteError("a Jacobian is not finite at the guess: run graph.check(guess) to find the term")


class Solver(IterativeMethod):
    """Iterative backend: solves once, or prepares a graph for repeated solves."""

    def solve(
        self,
        graph: Model,
        guess: AnyGuess,
        *,
        data: Mapping[Data, Numbers] | None = None,
        duals: Mapping[str, Numbers] | None = None,
        check: bool = False,
        callback: Callback | None = None,
    ) -> Solution:
        """Solve as :class:`Backend`; a control loop uses :meth:`prepare` and keeps structure and workspaces.

        ``duals`` are multipliers by term name, overriding those of the guess.
        """
        prepared = self.bound(graph)
        prepared.single = True
        return prepared.solve(guess, data=data, duals=duals, check=check, callback=callback)

    def prepare(self, graph: Model) -> Prepared:
        """Compile the graph, and everything that its solves can reach, for repeated solves.

        Solves in a loop then neither compile anything nor read compiled functions from the disk, however they end.
        """
        prepared = self.bound(graph)
        prepared.allocate()
        prepared.program.watch_conditions()
        if self.rehearses:
            rehearse(self)
        return prepared

    def bound(self, graph: Model) -> Prepared:
        """Compile the graph alone: a single solve compiles what it comes to need."""
        program = idle_problem(graph)
        self.require(program)
        if not program.least_squares:  # there, curvature is asked for in rare cases only
            require_second(program)
        return Prepared(self, program, graph)


def _same(options: Mapping[str, Any], others: Mapping[str, Any]) -> bool:
    """Test whether options are the same numbers and words, or the same objects."""
    plain = bool | int | float | str
    return options.keys() == others.keys() and all(
        value is others[name]
        or (isinstance(value, plain) and isinstance(others[name], plain) and value == others[name])
        for name, value in options.items()
    )
