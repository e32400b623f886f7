"""Steps of SQP as Python sees them: memory of the compiled attempts, and what these ask of it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from unifg.codegen.clock import clock
from unifg.codegen.function_pointers import NOTHING, NUMBER, TRUTH, link_like
from unifg.problem import evaluation
from unifg.problem.columns import Values
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.linearization import Linearization
from unifg.problem.retraction import retract_parts
from unifg.problem.scalars import add_scalars, evaluate_scalars
from unifg.problem.snapshot import LinearizationMemory
from unifg.solution.history import Iteration
from unifg.solution.optimality import Tolerances, read_numbers
from unifg.solution.solve_state import SolveState
from unifg.solvers.quadratic_programs.attempt import (
    AIMED,
    CORRECT,
    EVALUATE,
    LINEARIZE,
    LOGGED,
    POSED,
    SOLVE,
    SOLVED,
    STARTED,
    STOPPED,
    TAKEN,
    UNBEGUN,
    Problem,
    Work,
)
from unifg.solvers.quadratic_programs.graph_route import PATIENCE, Stacked, hopeless, minimize_quadratic
from unifg.solvers.quadratic_programs.loop import (
    BEGUN,
    COST,
    DAMPING,
    ITERATIONS,
    LENGTH,
    NUMBERED,
    SECONDS,
    SHOWN,
    VIOLATION,
    arrays,
    forget,
    loop,
)
from unifg.solvers.quadratic_programs.scaling import Patterns, Scaling, find_units
from unifg.solvers.quadratic_programs.subproblem import QPAnswer
from unifg.solvers.workspace import Fields, empty
from unifg.typing import Array

REACHED = {
    "values": "trial",
    "constraints": "next_constraints",
    "constraint_jacobian": "next_jacobian",
    "gradient": "next_gradient",
    "hessian": "next_hessian",
    "weights": "next_weights",
    "sizes": "norms",
}
"""Names in :class:`Work` of arrays of the linearisation where a step ends; others are called the same there."""


class Steps:
    """Compiled attempts at steps from the iterates of one solve after the other.

    Attributes:
        program: the compiled graph.
        now: scalars of the present attempt.
        work: arrays of it.
        pending: whether a loop that ran alone waits for help in the midst of an attempt.
    """

    def __init__(self, program: CompiledProblem) -> None:
        """Make room and compile."""
        self.program = program
        self._held = program.equality
        self._assisted = self.pending = False
        self._present: Linearization | None = None
        self._reached: Linearization | None = None
        self._moved: Values | None = None
        self.work = _empty(program)
        self._answer = LinearizationMemory(program)
        reached: dict[str, Any] = {REACHED.get(name, name): array for name, array in self._answer.arrays.items()}
        self.work = self.work._replace(**reached)
        self.now = Fields(self.work.scalars)
        self.now["clock"] = clock()
        self._log = self.work.log.reshape(LOGGED, -1)
        sizes = NUMBERED + len(self.work.norms) + len(self.work.heights), len(self.work.values), len(self.work.dual)
        ends = np.cumsum([*sizes, sizes[2]]).tolist()
        self._parts = tuple(map(slice, ends[:-1], ends[1:]))
        self._describe()

    def _describe(self) -> None:
        """Tell compiled code where the arrays are, with the present equalities."""
        self._problem = _problem(self.program, self.work)
        self._words = arrays.describe((self._problem, self.work))
        self._address = self._words.ctypes.data

    def prepare(
        self,
        tolerances: Tolerances,
        full_steps: bool,
        correcting: bool,
        limit: int = 0,
        stop: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Begin a solve with the present data.

        Args:
            tolerances: of the KKT test.
            full_steps: whether every step is taken in full.
            correcting: whether to ask for second-order corrections.
            limit: iterations before giving up.
            stop: norm of a step, and violation, below which to stop.
        """
        program, now = self.program, self.now
        if program.equality is not self._held:  # which is a new array when limits have changed
            if not np.array_equal(program.equality, self._problem.equality):
                self._describe()
            self._held = program.equality
        now["assisted"] = self._assisted = program.large or not program.fully_compiled
        now["tolerance"], now["feasible"], now["violation_unit"] = tolerances
        now["least_squares"] = program.least_squares
        now["full_steps"], now["correcting"], now["limit"], self.pending = full_steps, correcting, limit, False
        now["step_tolerance"], now["violation_tolerance"] = stop

    def start(self, scaling: Scaling, lin: Linearization, multipliers: Array) -> None:
        """Begin at ``lin`` with nothing learned, with the penalties that the multipliers suggest."""
        work, self._present, self._reached = self.work, None, None
        work.columns[:], work.rows[:] = scaling.columns, scaling.rows
        forget(self.program.arrays, work.scalars, work.rows, work.penalties, multipliers, lin.constraints)

    def pose(
        self, lin: Linearization, multipliers: Array, damping: float, accuracy: float, exact: bool, curved: bool
    ) -> None:
        """Prepare an attempt from ``lin``; ``curved``: the Hessian of the subproblem is that of the Lagrangian."""
        now = self.now
        now["damping"], now["accuracy"], now["exact"], now["curved"] = damping, accuracy, exact, curved
        self._load(lin, multipliers)

    def _load(self, lin: Linearization, multipliers: Array) -> None:
        """Bring an iterate to where the compiled functions look for it."""
        now, work = self.now, self.work
        work.multipliers[:] = multipliers
        if lin is self._present:
            return
        now["moved"], self._present = lin is self._reached, lin
        if lin is not self._reached:
            now["cost"], work.values[:] = lin.cost, lin.values.flat
            work.constraints[:], work.constraint_jacobian[:] = lin.constraints, lin.constraint_jacobian
            work.gradient[:], work.hessian[:], work.weights[:] = lin.gradient, lin.hessian, lin.weights

    def begin_alone(self, run: SolveState, budget: int, scaling: bool) -> list[float]:
        """Begin a solve at the values of ``run``, of which nothing is known, and go on as :meth:`go_on_alone`.

        Args:
            run: the solve.
            budget: 0 to begin only.
            scaling: whether to come back where the problem needs units of its own.
        """
        self.work.trial[:], self.work.multipliers[:] = run.values.flat, run.multipliers
        self.now["scaling"] = scaling
        return self._run_alone(run, UNBEGUN, budget)

    def go_on_alone(self, run: SolveState, budget: int) -> list[float]:
        """Take steps in compiled code until there are ``budget`` of them, the solve ends, or Python is asked for help.

        Then ``run`` is as if it had accepted each. Where help is needed in the midst of an attempt, this is ``pending``
        and goes on with :meth:`on_graph`.

        Returns:
            Violations of the iterates from which another attempt began; not that of ``run`` before.
        """
        optimality = run.optimality
        self._load(run.lin, run.multipliers)
        self.work.kkt[:3] = optimality.stationarity, optimality.violation, optimality.complementarity
        self.work.kkt[5] = optimality.slope
        return self._run_alone(run, POSED, budget)

    def _run_alone(self, run: SolveState, stage: int, budget: int) -> list[float]:
        now = self.now
        now["exact"] = now["curved"] = 0
        now["iteration"], now["budget"], now["logged"] = run.iterations, budget, 0
        try:
            self._go(stage, alone=True)
        finally:  # also where an interrupt has waited for compiled code to end
            begun = self._report(run)
        return begun

    def _report(self, run: SolveState) -> list[float]:
        """Tell the solve of all iterates in the log; returns the violation where another attempt began."""
        program, now, work = self.program, self.now, self.work
        answer, count = now["answer"], now["logged"]
        self.pending = answer not in (TAKEN, STOPPED, STARTED)
        if not count:
            return []
        log, (values, constraints, multipliers) = self._log[:count].copy(), self._parts
        heads, last, number = log[:, :NUMBERED].tolist(), log[-1], len(run.history) - 1
        measured = read_numbers(work.kkt, heads[-1][COST])
        if not measured.holds(run.tolerances):
            for head, row in zip(heads[:-1], log, strict=False):
                number += int(head[SHOWN])  # what is not shown takes the place of the one before
                run.pass_by(number, head[VIOLATION], head[COST], row[constraints], row[values], row[multipliers])
        if self.pending and answer != SOLVE:  # there is a trial in the place of the iterate
            lin = program.linearize(program.columns.view(last[values]))
        else:
            lin = self._answer.copied(heads[-1][COST])
        self._present, self._reached = (lin, None) if self.pending else (None, lin)
        run.see(work.steepest_jacobian, work.steepest_gradient)
        history = partial(_history, program, run.history, log, run.seconds)
        run.conclude(lin, last[multipliers], now["iteration"], history, measured, run.slopes)
        if run.status is None:
            run.go_on()
        return [head[VIOLATION] for head in heads if head[BEGUN]]

    def on_graph(self) -> tuple[QPAnswer, bool]:
        """Solve the subproblem on the graph and go on; false where another route has to look at the answer first.

        The answer is good until the next attempt.
        """
        if not self.pending:
            self._go(POSED)
        now, work, self.pending = self.now, self.work, False
        good = now["answer"] != SOLVE
        contradicted = not good and hopeless(work.measured, work.dual)
        return QPAnswer(work.step, work.dual, "graph", now["iterations"], now["error"], contradicted), good

    def along(self, answer: QPAnswer) -> None:
        """Go on with an answer of the subproblem."""
        self.work.step[:], self.work.dual[:], self.now["error"] = answer.step, answer.multipliers, answer.error
        self._go(SOLVED)

    def taken(self, correct: Callable[[Array], QPAnswer | None]) -> bool:
        """Answer questions until the step is taken or refused; whether it is taken."""
        program, now, work, lin = self.program, self.now, self.work, self._present
        assert lin is not None
        while (question := now["answer"]) in (CORRECT, EVALUATE, LINEARIZE):
            if question == CORRECT:
                found = correct(work.bend)
                if found is not None:
                    work.bent[:], work.bent_dual[:], now["corrected"] = found.step, found.multipliers, 1
                    self._go(AIMED)
                    continue
            elif question == EVALUATE:
                self._moved = program.retract(lin.values, work.taken)
                trial = program.evaluate(self._moved, lin.weights)
                now["trial_cost"], work.next_constraints[:] = trial.cost, trial.constraints
            else:
                values = program.retract(lin.values, work.taken) if now["full_steps"] else self._moved
                assert values is not None
                self._take(program.linearize(values))
            self._go(now["stage"])
        return bool(now["answer"] == TAKEN)

    def reached(self) -> Linearization:
        """The linearisation where the step ends."""
        if not self._assisted:
            self._reached = self._answer.copied(self.now["next_cost"])
        assert self._reached is not None
        return self._reached

    def _take(self, lin: Linearization) -> None:
        """Copy a linearisation that Python has made to where the compiled functions look for it."""
        work, self._reached = self.work, lin
        self.now["next_cost"], work.trial[:] = lin.cost, lin.values.flat
        work.next_constraints[:], work.next_jacobian[:] = lin.constraints, lin.constraint_jacobian
        work.next_gradient[:], work.next_hessian[:], work.next_weights[:] = lin.gradient, lin.hessian, lin.weights

    def _go(self, stage: int, alone: bool = False) -> None:
        """Run the compiled loop from a stage, ``alone`` beyond the step."""
        self.now["stage"], self.now["alone"] = stage, alone
        loop(self._address)


def _history(program: CompiledProblem, known: list[Iteration], log: Array, seconds: float) -> list[Iteration]:
    """Rows of a solve, those ``known`` before the log, which was read ``seconds`` after the solve began."""
    made, terms = list(known), len(program.arrays.fields)
    for row in log[log[:, SHOWN] == 1.0]:
        sizes, heights, _ = np.split(row[NUMBERED:], [terms, terms + program.table.scalars])
        head = row[:NUMBERED].tolist()
        cost, stationarity, violation, complementarity, size, length = head[COST : LENGTH + 1]
        taken, norms = seconds - (log[-1, SECONDS] - head[SECONDS]), program.norms(sizes, heights)
        details: dict[str, Any] = {"qp": "graph", "qp_iterations": int(head[ITERATIONS]), "damping": head[DAMPING]}
        kkt = stationarity, violation, complementarity
        made.append(Iteration(len(made), cost, *kkt, size, length, float(taken), norms, details if made else {}))
    return made


def _empty(program: CompiledProblem) -> Work:
    """Memory for attempts on a program."""
    table, columns = program.table, program.columns
    return empty(
        Work,
        unknowns=program.size,
        rows=table.constraints,
        width=columns.width,
        stored=columns.stored,
        residuals=table.residuals,
        entries=table.entries,
        row_entries=table.constraint_entries,
        normal=program.normal.nnz,
        robust=table.weights,
        general=table.scalars,
        terms=len(program.arrays.fields),
        concave=program.normal.nnz if table.scalars else 0,
        log=LOGGED * (NUMBERED + len(program.arrays.fields) + table.scalars + columns.stored + 2 * table.constraints),
    )


def _problem(program: CompiledProblem, work: Work) -> Problem:
    """Arrays that attempts share, with the present equalities; compiles the functions that they call."""
    terms, scratch, retraction, free = program.arrays, program.scratch, program.retraction, program.columns.free
    units = Patterns.of(program, program.normal)
    system, rows = Stacked.of(program.systems.kkt(program.equality).arrays), np.zeros(0, np.int64)
    links = [
        link_like(
            minimize_quadratic, NUMBER, terms, system, free, work.hessian, work.step, work.constraint_jacobian, rows,
            work.rows, work.rows, work.rows, program.equality, 0.0, PATIENCE, work.step, work.dual, work.linear,
            work.measured,
        ),
        link_like(retract_parts, NOTHING, retraction.parts, free, work.taken, work.full, work.values, work.trial),
        link_like(
            evaluation.evaluate, NUMBER, terms, work.trial, work.residual, work.next_constraints,
            work.squares, work.weights, True, scratch,
        ),
        link_like(evaluate_scalars, NUMBER, terms, work.trial, work.heights, scratch),
        link_like(
            evaluation.linearize, NUMBER, terms, work.trial, work.residual, work.jacobian, work.next_constraints,
            work.next_jacobian, work.squares, work.next_weights, work.norms, work.next_gradient, work.next_hessian,
            scratch, 0, 1,
        ),
        link_like(
            add_scalars, NUMBER, terms, work.trial, work.heights, work.next_gradient, work.next_hessian, work.concavity,
            scratch, True,
        ),
        link_like(find_units, TRUTH, units, work.hessian, work.constraint_jacobian, work.columns, work.rows, True),
    ]  # fmt: skip
    return Problem(
        np.array(links), terms, system, program.normal.diagonal, program.equality, retraction.parts, free,
        retraction.fixed, retraction.fixed_values, scratch, program.bounded, np.flatnonzero(program.bound_rows), units,
        program.columns.coordinates, np.zeros(program.columns.dimensions),
    )  # fmt: skip
