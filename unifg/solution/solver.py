"""Frame that every iterative backend runs in."""

from __future__ import annotations

from collections.abc import Mapping

from unifg.modeling.model import Model
from unifg.modeling.variables import Data
from unifg.problem.compiled_problem import idle_problem
from unifg.problem.hessian import require_second
from unifg.solution.backend import Backend, Callback
from unifg.solution.prepared import Prepared
from unifg.solution.solution import AnyGuess, Solution
from unifg.solution.solve_state import IterativeMethod, SolveState
from unifg.solution.warmup_run import rehearse
from unifg.typing import Numbers

__all__ = ["Backend", "Prepared", "SolveState", "Solver"]


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
