"""The last digits of a subproblem's answer: one linear system of the limits found active.

Where units are far apart the test of the graph asks for more digits than interior points and first-order methods give.
The KKT system of the active rows, equilibrated and refined (:mod:`unifg.elimination.saddle`), gives what double
precision holds.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from unifg.program.program import Program
from unifg.solvers.qp import QP, QPAnswer, qp_error
from unifg.solvers.qp_graph import GraphRoute


class Polish:
    """Solves for the active rows of answers that are nearly right."""

    def __init__(self, program: Program) -> None:
        """Remember the program; systems are analysed when first needed."""
        self._program = program
        self._route: GraphRoute | None = None

    def __call__(self, qp: QP, answer: QPAnswer) -> QPAnswer:
        """The better of an answer and what its active rows make of it."""
        dual = answer.multipliers
        limit = np.where(dual > 0.0, qp.upper, qp.lower)
        distance = np.where(np.isfinite(limit), np.abs(qp.linear(answer.step) - limit), np.inf)
        active = (qp.lower == qp.upper) | (np.abs(dual) > distance)
        held = replace(qp, lower=np.where(active, limit, -np.inf), upper=np.where(active, limit, np.inf), weights=None)
        if self._route is None:
            self._route = GraphRoute(self._program)
        found = self._route.solve(held, dual, 0.0)
        error = qp_error(qp, found.step, found.multipliers)
        return (
            replace(answer, step=found.step, multipliers=found.multipliers, error=error)
            if error < answer.error
            else answer
        )
