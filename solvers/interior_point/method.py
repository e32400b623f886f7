"""Primal-dual interior point on the graph: hard inequalities from bad guesses, one elimination per iteration.

The method is in :mod:`unifg.solvers.interior_point.barrier`; this file runs it. One compiled loop solves every graph.
It comes back where it needs Python: to evaluate terms without a kernel, or to show an iterate to somebody who looks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from unifg.codegen.clock import clock
from unifg.codegen.function_pointers import ADDRESS, NOTHING, link, memory
from unifg.codegen.standalone import Entry
from unifg.errors import BackendError, require_positive
from unifg.problem.columns import Values
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.hessian import lagrangian_hessian, require_second
from unifg.problem.linearization import Linearization
from unifg.problem.python_parts import numbers_only
from unifg.problem.snapshot import LinearizationMemory
from unifg.problem.systems import stacked
from unifg.problem.table import COST, COUNT, KERNEL_WIDTH, KIND, ROW, ROWS
from unifg.solution.batch import Outcomes
from unifg.solution.export import Exported
from unifg.solution.history import Iteration
from unifg.solution.multipliers import SUSPICIOUS, Slopes
from unifg.solution.optimality import Optimality, Tolerances, optimality, read_numbers
from unifg.solution.solve_state import UNBOUNDED_COST, Conclusion, SolveState
from unifg.solution.solver import Solver
from unifg.solution.status import Status
from unifg.solvers.globalize.feasibility_restoration import descended, goes_on, nearest
from unifg.solvers.interior_point import each, state
from unifg.solvers.interior_point.barrier import FINER
from unifg.solvers.interior_point.loop import addresses, call
from unifg.solvers.interior_point.state import Problem, Work
from unifg.solvers.workspace import Fields, empty
from unifg.typing import Array, IntArray

ENDINGS = {
    state.CONVERGED: Status.CONVERGED,
    state.LIMIT_REACHED: Status.ITERATION_LIMIT,
    state.SINGULAR: Status.SINGULAR,
    state.STALLED: Status.STALLED,
    state.NOT_FINITE: Status.NOT_FINITE,
    state.VIOLATED: Status.STALLED,
    state.RESTORE: Status.STALLED,
    state.STOPPED: Status.STOP_RULE,
    state.TRY: Status.TIME_LIMIT,  # there was no time for the step
}
NO_ANSWER = -1
ROOM = 2**18  # bytes for arrays that compiled functions allocate, besides those that grow with the graph
STUCK = (state.STALLED, state.SINGULAR, state.VIOLATED, state.RESTORE)
RESTARTS = 3  # from points that violate less than where the method came to a halt


@dataclass(kw_only=True)
class InteriorPoint(Solver):
    """Equalities, inequalities and general costs by a primal-dual interior point with elastic inequalities.

    Attributes:
        max_iterations: Newton steps before giving up.
        hessian: "exact" (of the Lagrangian; Gauss-Newton where its inertia is wrong) or "gauss-newton".
        barrier: first mu of a cold start, times the size of the cost, at most a quarter of the cost there; a start with
            multipliers finds its own.
        penalty: first rho of the elastic variables, times the size of the cost; raised when constraints stay violated.
        scaling: measure rows and unknowns in units that make the largest entries of the constraint Jacobian near one,
            where they are far from it, and the cost in its size (:mod:`unifg.problem.units`). Inside only: tolerances
            and multipliers are those of the problem as stated.
        step_tolerance, violation_tolerance: stop rule on the norm of the full step and the largest violation, for
            control loops. A positive step_tolerance switches it on; it does not grant CONVERGED. An infinite one asks
            for a single step, and more of them only as long as constraints are violated; from a start with multipliers
            the first few leave second derivatives out, which pay only where steps converge. With the rule on, a solve
            that runs out of time or iterations hands back the last iterate that kept the constraints, if one did.
        restoration: whether, where it is stuck without ever having kept the constraints, the nearest point of least
            violation is looked for, from which to go on or to say LOCALLY_INFEASIBLE; with a cost that has no
            curvature, a cold start looks for it after a few short steps. It can take a hundred times as long as an
            iteration; a control loop with another start or backend to ask is better off without.
    """

    rehearses = True

    max_iterations: int = 1000
    hessian: Literal["exact", "gauss-newton"] = "exact"
    barrier: float = 0.3
    penalty: float = 1e3
    scaling: bool = True
    step_tolerance: float = 0.0
    violation_tolerance: float = 1e-4
    restoration: bool = True

    def __post_init__(self) -> None:
        """Refuse options that mean nothing."""
        super().__post_init__()
        if self.hessian not in ("exact", "gauss-newton"):
            raise BackendError(f"{self.name}: hessian must be 'exact' or 'gauss-newton', found '{self.hessian}'")
        require_positive(self.name, BackendError, barrier=self.barrier, penalty=self.penalty)

    def runs_alone(self, program: CompiledProblem) -> bool:
        """Test whether the loop may make the whole solve; that of least squares is tested outside, at every step."""
        return not program.least_squares

    def solves_each(self, program: CompiledProblem) -> bool:
        """Test whether one compiled call may solve many instances."""
        return self.runs_alone(program) and self.time_limit == np.inf and numbers_only(program)

    def solve_each(self, workspace: Workspace, rows: Array, guesses: Array, duals: Array) -> Outcomes:
        """Solve many instances, which differ in numbers alone."""
        given = workspace.instances(self, rows, guesses, duals)
        words = each.instances.describe(given)
        call(link(each.solve_each, NOTHING, ADDRESS), words.ctypes.data)
        numbers = given.numbers
        statuses = [ENDINGS.get(answer) for answer in numbers[:, each.ANSWER].tolist()]
        return Outcomes(
            [status if status in (Status.CONVERGED, Status.STOP_RULE) else None for status in statuses],
            given.found, given.found_multipliers, numbers[:, each.COST], numbers[:, each.ITERATIONS].astype(np.int64),
            numbers[:, each.STATIONARITY :],
        )  # fmt: skip

    def entry(self, workspace: Workspace) -> Exported:
        """The compiled loop for one instance."""
        work = workspace.work
        last = work.values.copy(), work.multipliers.copy()
        found = workspace.entry(self)
        work.values[:], work.multipliers[:] = last  # for another export
        return Exported(found, {word: ENDINGS[word] for word in each.WORDS}, *last)

    def workspace(self, program: CompiledProblem) -> Workspace:
        """Structure of the KKT matrix."""
        return Workspace(program, self.max_iterations)

    def search_step(self, run: SolveState, workspace: Workspace, lin: Linearization) -> Array | None:
        """The first step of a solve from there, by Gauss-Newton, as far as slacks and multipliers stay positive."""
        now = workspace.prepare(self, run.values.flat, run.multipliers)
        now["bending"] = 0
        workspace.take(lin)
        workspace.call("begin")
        workspace.call("direct")
        step: Array = now["alpha"] * workspace.work.step[: run.program.size]
        return step if now["answer"] == state.TRY else None

    def at_once(self, workspace: Workspace, values: Array, multipliers: Array) -> Conclusion | bool:
        """One compiled call, where nobody looks and the last solve has left its settings."""
        if not workspace.unfinished and not workspace.repeats(self, values, multipliers):
            return False
        try:
            workspace.run_portion(self.max_iterations)
        except KeyboardInterrupt:  # in compiled code Python learns of it when that is over
            workspace.interrupted = True
            return True
        now, work = workspace.now, workspace.work
        iterations, cost, ending = now["iteration"], now["cost"], ENDINGS[now["answer"]]
        measured = read_numbers(work.kkt, cost)
        held = measured.passes(self.tolerances)
        workspace.unfinished = ending is Status.ITERATION_LIMIT and iterations < self.max_iterations
        if not workspace.unfinished:
            now["limit"] = self.max_iterations  # a restart is made in one portion
        if now["suspicion"] > SUSPICIOUS or not cost >= UNBOUNDED_COST or not measured.finite:
            return True
        if not held and ((now["kept"] and now["violation"] > now["feasible"]) or iterations >= self.max_iterations):
            return True
        sound = ending is Status.STOP_RULE or (held and ending is Status.CONVERGED)
        if not sound and not workspace.unfinished:
            return True
        lin, status = workspace.found(), Status.CONVERGED if held else ending
        history = _history(work.log[: iterations + 1].copy(), lin, workspace.compiled)
        parts = now["evaluating"], now["solving"], now["judging"], workspace.compiled
        return Conclusion(
            lin, work.multipliers.copy(), measured, status, iterations, history, parts if now["clock"] else None
        )

    def iterate(self, run: SolveState, workspace: Workspace) -> Status | None:
        """Iterate to convergence; where that is not to be had, to a point of least violation, or on from another."""
        start, carried = run.values, run.multipliers
        reason = self._iterate(run, workspace)
        now = workspace.now
        if now["clock"]:
            run.parts = now["evaluating"], now["solving"], now["judging"], workspace.compiled
        ended = not workspace.unfinished  # else the loop goes on from where it is
        if ended and run.alone and not now["clocked"] and run.returns_best(run.status or reason):
            self._replay(run, workspace, start, carried)
        if self.step_tolerance > 0.0 and now["kept"] and run.optimality.violation > now["keeping"]:
            ending = run.status or reason
            if ending in (Status.TIME_LIMIT, Status.ITERATION_LIMIT):  # what kept the constraints may be acted on
                run.begin_at(run.program.linearize(run.program.columns.view(workspace.work.kept.copy())))
                run.status = ending
        return reason

    def _replay(self, run: SolveState, workspace: Workspace, start: Values, carried: Array) -> None:
        """Take note of all iterates of a solve without success, which nobody has looked at: up to its first restart."""
        reached = run.values, run.multipliers, run.iterations
        run.values, run.multipliers = start, carried
        now = workspace.prepare(self, run.values.flat, run.multipliers, clocked=True)
        now["watched"], now["stage"] = 0, state.MOVED
        while workspace.asks():
            self._note(run, workspace)
        run.values, run.multipliers, run.iterations = reached

    def _note(self, run: SolveState, workspace: Workspace) -> None:
        """Take note of the iterate from which a step is to be made."""
        now, work = workspace.now, workspace.work
        run.iterations = now["iteration"]
        if now["answer"] == state.TRY:
            run.consider(now["cost"], work.constraints.copy(), work.values.copy(), work.multipliers.copy())

    def _iterate(self, run: SolveState, workspace: Workspace) -> Status | None:
        now = workspace.now if run.begun else workspace.prepare(self, run.values.flat, run.multipliers)
        restarts = 0
        while True:
            reason = self._attempt(run, workspace)
            if now["answer"] not in STUCK or run.status not in (None, Status.ITERATION_LIMIT):
                return reason
            if now["answer"] == state.RESTORE:
                self._restore(run, workspace)
                continue
            if run.optimality.violation <= run.tolerances.violation:
                return reason
            found, closer = run.lin, False
            if not run.has_been_feasible and self.restoration:
                found, least = nearest(run)
                closer = goes_on(run, found)
                if now["answer"] == state.VIOLATED and run.violates(found.constraints):
                    closer = False  # a higher penalty is to tell first
                if least:
                    run.begin_at(found)
                    run.status = Status.LOCALLY_INFEASIBLE
                    return run.status
            if restarts == RESTARTS or now["iteration"] >= self.max_iterations or run.out_of_time:
                return reason
            if now["answer"] == state.VIOLATED and not closer:  # the penalty was too low
                now["going_on"] = 1
            elif run.has_been_feasible or closer:
                if restarts:  # it has left the constraints again: not farther than where it is stuck
                    outside = run.program.violation(run.lin.constraints)
                    now["theta_most"] = float(np.abs(outside / workspace.work.row_units).sum())
                workspace.begin_at(run.least_violated.flat if run.has_been_feasible else found.values.flat, self)
                restarts += 1
            else:
                return reason
            run.status = None

    def _restore(self, run: SolveState, workspace: Workspace) -> None:
        """Begin anew where a descent on the violation ends, if that violates less; else equalities become elastic."""
        now, run.status = workspace.now, None
        now["restores"] = 0
        if not run.has_been_feasible:
            found = descended(run)
            if goes_on(run, found):
                workspace.begin_at(found.values.flat, self)
                return
        workspace.call("relax")
        now["going_on"] = 1

    def _attempt(self, run: SolveState, workspace: Workspace) -> Status | None:
        """From where the workspace is to one of the endings."""
        program, work, now = run.program, workspace.work, workspace.now
        assisted, begun, run.begun = now["assisted"], run.begun, False
        now["watched"], now["stage"] = not run.alone, state.LINEARIZED
        if run.alone and not begun:
            if assisted:
                workspace.take(program.linearize(program.columns.view(work.values.copy())))
            elif len(program.fixed_rows()):
                workspace.call("renew")
            else:
                now["stage"] = state.MOVED
            run.look_at_fixed(work.constraints)
            if run.status is not None:
                return None
        elif not begun:
            if not np.array_equal(run.lin.values.flat, work.values):
                run.begin_at(program.linearize(program.columns.view(work.values.copy())))
                if run.status is not None:
                    return None
            workspace.take(run.lin)
        interrupted, seen = begun and workspace.interrupted, now["iteration"]
        if not begun:
            now["answer"] = NO_ANSWER
        try:
            while not begun and workspace.asks():
                if run.alone:
                    self._note(run, workspace)
                if now["answer"] == state.TRY and run.out_of_time:
                    break
                if now["answer"] == state.SHOW and now["iteration"] > seen:
                    seen = now["iteration"]
                    details = _details(now["mu"], now["delta"], now["gauss_newton"])
                    run.accept(workspace.found(), work.multipliers.copy(), now["step"], now["taken"], **details)
                    if run.status is not None:
                        return None
        except KeyboardInterrupt:
            if not run.alone or now["answer"] == NO_ANSWER:
                raise
            interrupted = True  # in compiled code Python learns of it when that is over
        ending = ENDINGS.get(now["answer"], Status.INTERRUPTED)
        if run.alone:
            lin, multipliers, iterations = workspace.found(), work.multipliers.copy(), now["iteration"]
            history = _history(work.log[: iterations + 1].copy(), lin, run.seconds)
            workspace.call("conclude")
            if now["kept"] and now["violation"] > run.tolerances.violation:
                run.begin_at(program.linearize(program.columns.view(work.kept.copy())))
            measured = workspace.judged(lin, multipliers, run.tolerances)
            sound = ending is Status.STOP_RULE or measured.passes(run.tolerances)
            slopes = None
            if not sound or now["suspicion"] > SUSPICIOUS:
                slopes = Slopes(program, work.steepest_jacobian, work.steepest_gradient)
            run.conclude(lin, multipliers, iterations, history, measured, slopes)
            if interrupted:
                run.status = ending if ending is Status.CONVERGED else Status.INTERRUPTED
        return ending


class Workspace:
    """Memory kept between solves of one structure.

    Attributes:
        compiled: seconds of the solve in compiled code, but for the test of the answer.
        interrupted: whether the user has interrupted the last solve in one call.
        portion: iterations of one call; None for all.
        unfinished: whether the next call goes on with the last solve.
    """

    compiled, interrupted, unfinished = 0.0, False, False
    portion: int | None = None
    # Options, the bytes of the scalars, and what these are where a solve with such options begins.
    _settings: tuple[dict[str, Any], NDArray[np.uint8], NDArray[np.uint8]] | None = None

    def __init__(self, program: CompiledProblem, iterations: int) -> None:
        """Analyse the KKT matrix and compile, with room for the history of so many iterations."""
        self.program = program
        self._taken: Linearization | None = None
        self._build(iterations)

    def _build(self, iterations: int) -> None:
        program = self.program
        self.system = program.systems.kkt(program.equality)
        arrays, table = self.system.arrays, program.table
        plan, doubles = stacked(arrays)
        equalities, constraints = len(arrays.rows), table.constraints
        self.work = empty(
            Work,
            stored=program.columns.stored,
            width=program.columns.width,
            unknowns=program.size,
            equalities=max(equalities, 1),
            total=program.size + equalities,
            residuals=table.residuals,
            entries=table.entries,
            rows=constraints,
            row_entries=table.constraint_entries,
            sides=max(2 * constraints, 1),
            normal=program.normal.nnz,
            terms=len(program.arrays.fields),
            robust=table.weights,
            general=table.scalars,
            concave=program.normal.nnz if table.scalars else 0,
            log=iterations + 2,
            data=len(plan.slots),
        )
        self._answer = LinearizationMemory(program)
        arrays_of: dict[str, Any] = {name.replace("sizes", "norms"): a for name, a in self._answer.arrays.items()}
        measures = program.unit_memory()
        self.work = self.work._replace(**arrays_of, row_units=measures.rows, units=measures.unknowns)
        self.problem = Problem(
            np.zeros(1, state.LINKS),
            program.arrays,
            plan,
            program.retraction.parts,
            program.columns.free,
            program.retraction.fixed,
            program.scratch,
            arrays.rows,
            arrays.entries,
            doubles,
            np.array([self._unequal(row) for row in program.arrays.fields], dtype=np.int64),
            measures,
            np.zeros(program.columns.dimensions),
        )
        self._describe()
        require_second(program)
        self.problem.links[:] = addresses(table.weights > 0, table.scalars > 0)
        self._held = program.equality
        self._links, self.now = Fields(self.problem.links), Fields(self.work.scalars)
        self.now["clock"] = clock()

    def _unequal(self, term: IntArray) -> bool:
        """Test whether a row of the table is a term with inequality rows."""
        rows = slice(term[ROW], term[ROW] + term[COUNT] * term[ROWS])
        return term[KIND] != COST and not self.program.equality[rows].all()

    def _describe(self) -> None:
        """Tell compiled code where the arrays are."""
        self._words = memory.describe((self.problem, self.work))
        self._address = self._words.ctypes.data

    def call(self, function: str) -> None:
        """Run one of the linked functions."""
        call(self._links[function], self._address)

    def run(self, function: str) -> None:
        """Run one of the linked functions, and take its time."""
        began = perf_counter()
        self.call(function)
        self.compiled += perf_counter() - began

    def run_portion(self, most: int) -> None:
        """Solve, or go on with a solve that is unfinished, for a portion of at most so many iterations."""
        now = self.now
        begun = now["iteration"] if self.unfinished else 0
        now["limit"] = most if self.portion is None else min(begun + self.portion, most)
        if not self.unfinished:
            self.run("solve_once")
            self.compiled -= now["judging"]
            return
        now["stage"], now["going_on"] = state.MOVED, 1
        worst = max(now["stationarity"], now["complementarity"], now["gap"])
        if worst <= now["tolerance"] and not now["violated"]:  # tested again, which would refine units twice
            now["finer"] /= FINER
        self.run("loop")
        self.call("conclude")

    def asks(self) -> bool:
        """Run the loop up to an ending, a question, or something to show; answer a question; whether it goes on."""
        program, work, now = self.program, self.work, self.now
        self.run("loop")
        answer = now["answer"]
        if answer == state.LINEARIZE:
            self.take(program.linearize(self._values()))
        elif answer == state.BEND:
            work.curvature[:] = lagrangian_hessian(program, self.found(), work.multipliers)
        elif answer == state.EVALUATE:
            lin = self.found()
            values = program.retract(lin.values, now["alpha"] * work.step[: program.size])
            found = program.evaluate(values, lin.weights)
            now["trial_cost"], work.trial[:] = found.cost, values.flat
            work.trial_constraints[:] = found.constraints
        return answer in (state.TRY, state.LINEARIZE, state.BEND, state.EVALUATE, state.SHOW)

    def prepare(self, options: InteriorPoint, values: Array, multipliers: Array, clocked: bool = False) -> Fields:
        """Set up one solve with the present data, ``clocked`` to come back before every step; returns the scalars."""
        if self.program.equality is not self._held:  # which is a new array when limits have changed
            if not np.array_equal(self.program.equality, self.system.held):
                self._build(options.max_iterations)
            self._held = self.program.equality
        if len(self.work.log) < options.max_iterations + 2:
            self.work = self.work._replace(log=np.zeros((options.max_iterations + 2, 9)))
            self._describe()
        work, now, self._taken, self.compiled, self.unfinished = self.work, self.now, None, 0.0, False
        # The test of least squares has no absolute tolerance.
        kkt, violation, unit = options.tolerances
        now["tolerance"] = 0.0 if self.program.least_squares else kkt
        now["feasible"], now["violation_unit"] = violation, unit
        now["restores"] = bool(options.restoration)
        now["scaling"], now["assisted"] = bool(options.scaling), not self.program.fully_compiled
        now["step_tolerance"] = options.step_tolerance
        now["violation_tolerance"] = options.violation_tolerance
        # An interrupt waits for the end of a compiled call: a long solve comes back before every step.
        now["clocked"] = clocked or options.time_limit < np.inf or self.program.large
        now["keeping"] = max(violation, options.violation_tolerance if options.step_tolerance > 0.0 else 0.0)
        self.call("reset")
        now["limit"], now["exact"] = options.max_iterations, options.hessian == "exact"
        self.begin_at(values, options)
        work.multipliers[:] = multipliers
        if not clocked:
            self._keep_settings(options)
        return now

    def _keep_settings(self, options: InteriorPoint) -> None:
        """Keep the scalars that a solve begins with, if later ones with these options may go on without Python."""
        program, now = self.program, self.now
        looks = options.verbose or options.keep_values or options.keep_residuals or options.search_iterations
        python = now["clocked"] or now["assisted"] or program.least_squares or program.differenced
        self._settings = None
        if not (looks or python or len(program.fixed_rows())):
            now["watched"], now["stage"] = 0, state.MOVED
            scalars = self.work.scalars.view(np.uint8)  # NumPy copies records field by field
            self._settings = dict(vars(options)), scalars, scalars.copy()

    def repeats(self, options: InteriorPoint, values: Array, multipliers: Array) -> bool:
        """Set up a solve with the settings of the last one, unless options or graph are not as they were then."""
        program, work, settings = self.program, self.work, self._settings
        if settings is None or settings[0] != vars(options) or program.equality is not self._held:
            return False
        if program.differenced or not program.fully_compiled:  # since a trace was found to differ
            return False
        settings[1][:], work.values[:], work.multipliers[:] = settings[2], values, multipliers
        self._taken, self.compiled, self.interrupted = None, 0.0, False
        return True

    def instances(self, options: InteriorPoint, rows: Array, guesses: Array, duals: Array) -> each.Instances:
        """Arguments of one compiled call that solves many instances."""
        program, work, count = self.program, self.work, len(rows)
        now = self.prepare(options, guesses[0], duals[0])
        now["watched"] = now["clocked"] = 0
        sizes = len(work.values), len(work.multipliers), each.NUMBERS
        functions = np.array([self._links["solve_once"], self._address])
        starts, binding = np.array([options.barrier, options.penalty]), program.binding
        return each.Instances(
            functions, work.scalars, starts, rows, *binding.carried, program.retraction.fixed, binding.quaternions,
            program.reader.quaternions, guesses, duals, work.values, work.multipliers, work.kkt,
            *(np.zeros((count, size)) for size in sizes),
        )  # fmt: skip

    def entry(self, options: InteriorPoint) -> Entry:
        """Everything that a solve of one instance works on."""
        program, work, problem = self.program, self.work, self.problem
        rows = program.binding.rows({}, 1)
        assert rows is not None
        guess = np.zeros((1, len(work.values))), np.zeros((1, len(work.multipliers)))
        arguments = self.instances(options, rows, *guess)
        self.now["restores"] = 0  # there is nobody to ask
        words = each.instances.describe(arguments)
        found = arguments.found, arguments.found_multipliers, arguments.numbers
        fields, links = program.table.fields, (arguments.functions, problem.links)
        memory = problem.scratch, problem.plan.numbers, *problem.measures[-5:], problem.sizes
        blank = [array for array in (*work, *memory) if array is not work.scalars]
        addressing = words, self._words, *links, problem.retraction, fields, problem.terms.parts, work.scalars
        widest, scratch = int(fields[:, KERNEL_WIDTH].max()), program.table.scratch
        room = 6 * widest**2 + 8 * scratch + len(work.constraint_jacobian) + len(work.multipliers)
        return Entry(
            link(each.solve_each, NOTHING, ADDRESS), words,
            (problem, work, arguments, tuple(kernel.table for kernel in program.table.kernels)), addressing, blank,
            (rows, *guess, *found), 8 * room + ROOM,
        )  # fmt: skip

    def begin_at(self, values: Array, options: InteriorPoint) -> None:
        """Go on from other values, about whose multipliers nothing is known."""
        work, now = self.work, self.now
        work.values[:], work.multipliers[:] = values, 0.0
        now["mu"], now["going_on"] = options.barrier, 0
        now["rho"] = options.penalty * 10.0 ** now["raises"]

    def found(self) -> Linearization:
        """The linearisation at the present iterate."""
        program, work = self.program, self.work
        if self.now["assisted"]:
            if self._taken is None or not np.array_equal(self._taken.values.flat, work.values):
                self.take(program.linearize(self._values()))
            assert self._taken is not None
            return self._taken
        if self.now["definite"] == state.NO and program.scalar_terms:
            self.call("split")
        return self._answer.copied(self.now["cost"])

    def judged(self, lin: Linearization, multipliers: Array, tolerances: Tolerances) -> Optimality:
        """KKT numbers at the last iterate, which compiled code has found unless it does not know them all."""
        if self.program.differenced:
            return optimality(self.program, lin, multipliers, violation_unit=tolerances.violation_unit)
        return read_numbers(self.work.kkt, lin.cost)

    def take(self, lin: Linearization) -> None:
        """Copy a linearisation to where the compiled functions look for it."""
        work, self._taken = self.work, lin
        self.now["cost"], work.values[:] = lin.cost, lin.values.flat
        work.residual[:], work.jacobian[:] = lin.residual, lin.jacobian
        work.constraints[:], work.constraint_jacobian[:] = lin.constraints, lin.constraint_jacobian
        work.gradient[:], work.hessian[:] = lin.gradient, lin.hessian
        work.squares[:], work.weights[:], work.concavity[:] = lin.squares, lin.weights, lin.concavity

    def _values(self) -> Values:
        """The present iterate."""
        return self.program.columns.view(self.work.values.copy())


def _history(log: Array, lin: Linearization, seconds: float) -> Callable[[], list[Iteration]]:
    """Rows of the compiled loop, made when somebody asks for them; nobody took the time of single iterations."""

    def rows() -> list[Iteration]:
        last, made = len(log) - 1, []
        for number, row in enumerate(log.tolist()):
            cost, stationarity, violation, complementarity, step, length, *details = row
            kkt = stationarity, violation, complementarity
            taken, terms = (seconds, _details(*details)) if number else (0.0, {})
            own = lin.norms if number == last else {}
            made.append(Iteration(number, cost, *kkt, step, length, taken, own, terms))
        return made

    return rows


def _details(mu: float, delta: float, gauss_newton: float) -> dict[str, float | int | str]:
    """Columns of the history beside the KKT numbers."""
    details: dict[str, float | int | str] = {"mu": float(mu)}
    if delta:
        details["shift"] = float(delta)
    if gauss_newton:
        details["gauss_newton"] = 1
    return details
