"""Counts which route solves the subproblems of SQP, in tests and measurements."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from unittest.mock import patch

import numpy as np

from unifg.solvers.quadratic_programs.osqp_route import OsqpRoute
from unifg.solvers.quadratic_programs.routes import Subproblems
from unifg.solvers.quadratic_programs.subproblem import QP, QPAnswer
from unifg.typing import Array


@dataclass
class Count:
    """Routes and iterations by which the subproblems of one row were solved.

    Attributes:
        routes: name of the route that solved each.
        asked: iterations of OSQP whenever it was asked.
        limits: its limit then.
    """

    routes: list[str] = field(default_factory=list)
    asked: list[int] = field(default_factory=list)
    limits: list[int] = field(default_factory=list)

    def by(self, route: str) -> int:
        """Subproblems that a route solved."""
        return self.routes.count(route)

    @property
    def share(self) -> float:
        """Of OSQP."""
        return self.by("osqp") / max(len(self.routes), 1)


@contextmanager
def counting() -> Iterator[Count]:
    """Count all subproblems with inequalities that are solved inside."""
    count = Count()
    solve, ask = Subproblems.solve, OsqpRoute.solve

    def counted(
        self: Subproblems, qp: QP, multipliers: Array, accuracy: float, first: QPAnswer | None = None
    ) -> QPAnswer:
        answer = solve(self, qp, multipliers, accuracy, first)
        if isinstance(self.first, OsqpRoute):
            count.routes.append(answer.route if np.isfinite(answer.error) else "none")
        return answer

    def asked(self: OsqpRoute, qp: QP, multipliers: Array, accuracy: float) -> QPAnswer:
        answer = ask(self, qp, multipliers, accuracy)
        count.asked.append(answer.iterations)
        count.limits.append(self.max_iterations)
        return answer

    with patch.object(Subproblems, "solve", counted), patch.object(OsqpRoute, "solve", asked):
        yield count
