"""Quadratic subproblems on Ta's linear graphs: the step from the primal one, the multipliers from the dual one."""

from __future__ import annotations

import numpy as np

from unifg.program.program import Program
from unifg.solvers.constrained_elimination import Contradiction, Undetermined
from unifg.solvers.linear_graphs import dual_graph
from unifg.solvers.linearized_graph import equality_rows, primal_graph, stacked_step
from unifg.solvers.qp import QP, QPAnswer, qp_error
from unifg.typing import Array


class EliminationRoute:
    """Variable elimination with enforced constraints; for equalities only.

    The graph is built of the factors of the linearisation, so squares that make H convex for other routes have no
    part in it: constraints are enforced before anything is minimised.

    Attributes:
        name: "elimination".
    """

    name = "elimination"

    def __init__(self, program: Program) -> None:
        """Remember the program."""
        self.program = program

    def solve(self, qp: QP, multipliers: Array, accuracy: float) -> QPAnswer:
        """Solve and measure; a direct method needs neither ``multipliers`` to start from nor an ``accuracy``."""
        primal = primal_graph(qp)
        try:
            step = primal.eliminate().solve()
            dual = dual_graph(primal, step).eliminate(undetermined="zero").solve()
        except (Contradiction, Undetermined) as error:
            zero = np.zeros(self.program.size)
            return QPAnswer(zero, multipliers, self.name, 0, np.inf, isinstance(error, Contradiction))
        found = np.zeros(len(qp.lower))
        for name, rows in equality_rows(qp).items():
            found[rows] = dual[name]
        flat = stacked_step(self.program, step)
        return QPAnswer(flat, found, self.name, 1, qp_error(qp, flat, found))
