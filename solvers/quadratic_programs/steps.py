"""Steps of SQP as Python sees them: memory of the compiled attempts, and what these ask of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from unifg.codegen.function_pointers import NOTHING, NUMBER, link_like
from unifg.problem import evaluation
from unifg.problem.columns import Values
from unifg.problem.compiled_problem import WORTH, CompiledProblem
from unifg.problem.linearization import Linearization
from unifg.problem.retraction import retract_parts
from unifg.problem.scalars import add_scalars, evaluate_scalars
from unifg.problem.snapshot import Memory
from unifg.solvers.globalize.merit import FARTHEST
from unifg.solvers.interior_point.state import Fields
from unifg.solvers.quadratic_programs.attempt import (
    AIMED,
    CORRECT,
    EVALUATE,
    LINEARIZE,
    POSED,
    SOLVE,
    SOLVED,
    TAKEN,
    Problem,
    Work,
    attempt,
    empty_work,
    scaled_violation,
)
from unifg.solvers.quadratic_programs.graph_route import PATIENCE, Stacked, hopeless, minimize_quadratic
from unifg.solvers.quadratic_programs.scaling import Scaling
from unifg.solvers.quadratic_programs.subproblem import QPAnswer
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
    """

    def __init__(self, program: CompiledProblem) -> None:
        """Make room and compile."""
        self.program = program
        self._held = program.equality
        self._assisted = False
        self._present: Linearization | None = None
        self._reached: Linearization | None = None
        self._moved: Values | None = None
        self.work = _empty(program)
        self._answer = Memory(program)
        arrays: dict[str, Any] = {REACHED.get(name, name): array for name, array in self._answer.arrays.items()}
        self.work = self.work._replace(**arrays)
        self.now = Fields(self.work.scalars)
        self._problem = _problem(program, self.work)

    def start(self, scaling: Scaling, lin: Linearization, multipliers: Array, tolerance: float) -> None:
        """Begin a solve at ``lin``, with the penalties that the multipliers suggest."""
        program, work = self.program, self.work
        if program.equality is not self._held:  # which is a new array when limits have changed
            if not np.array_equal(program.equality, self._problem.equality):
                self._problem = _problem(program, work)
            self._held = program.equality
        now, self._present, self._reached = self.now, None, None
        large = program.table.entries + program.table.constraint_entries > WORTH  # worth more than one thread
        now["assisted"] = self._assisted = large or not program.fully_compiled
        now["tolerance"], now["least_squares"], now["patience"] = tolerance, program.least_squares, PATIENCE
        work.columns[:], work.rows[:], work.penalties[:] = scaling.columns, scaling.rows, np.abs(multipliers)
        size = scaled_violation(lin.constraints, program.lower, program.upper, scaling.rows)
        now["farthest"] = FARTHEST * max(1.0, size)

    @property
    def sided(self) -> bool:
        """True if there are inequalities: without them a subproblem is one linear system, which is refined."""
        return len(self._problem.system.kkt.rows) < len(self.work.dual)

    def pose(
        self, lin: Linearization, multipliers: Array, damping: float, accuracy: float, full: bool, correcting: bool
    ) -> None:
        """Prepare an attempt from ``lin``."""
        now, work = self.now, self.work
        now["damping"], now["accuracy"], now["full_steps"], now["correcting"] = damping, accuracy, full, correcting
        work.multipliers[:] = multipliers
        if lin is self._present:
            return
        now["moved"], self._present = lin is self._reached, lin
        if lin is not self._reached:
            now["cost"], work.values[:] = lin.cost, lin.values.flat
            work.constraints[:], work.constraint_jacobian[:] = lin.constraints, lin.constraint_jacobian
            work.gradient[:], work.hessian[:], work.weights[:] = lin.gradient, lin.hessian, lin.weights

    def on_graph(self) -> tuple[QPAnswer, bool]:
        """Solve the subproblem on the graph and go on; false where another route has to look at the answer first.

        The answer is good until the next attempt.
        """
        self._go(POSED)
        now, work = self.now, self.work
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

    def _go(self, stage: int) -> None:
        """Run the compiled attempt from a stage."""
        self.now["stage"] = stage
        attempt(self._problem, self.work)


def _empty(program: CompiledProblem) -> Work:
    """Memory for attempts on a program."""
    table = program.table
    return empty_work(
        unknowns=program.size,
        rows=table.constraints,
        width=program.columns.width,
        stored=program.columns.stored,
        residuals=table.residuals,
        entries=table.entries,
        row_entries=table.constraint_entries,
        normal=program.normal.nnz,
        robust=table.weights,
        general=table.scalars,
        terms=len(program.arrays.fields),
        concave=program.normal.nnz if table.scalars else 0,
    )


def _problem(program: CompiledProblem, work: Work) -> Problem:
    """Arrays that attempts share, with the present equalities; compiles the functions that they call."""
    terms, scratch, retraction, free = program.arrays, program.scratch, program.retraction, program.columns.free
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
            scratch,
        ),
        link_like(
            add_scalars, NUMBER, terms, work.trial, work.heights, work.next_gradient, work.next_hessian, work.concavity,
            scratch,
        ),
    ]  # fmt: skip
    return Problem(
        np.array(links), terms, system, program.normal.diagonal, program.equality, retraction.parts, free,
        retraction.fixed, retraction.fixed_values, scratch,
    )  # fmt: skip
