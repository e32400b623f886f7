"""Routes of a subproblem: the one asked for, a fallback where it misses, the elastic one where rows clash."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from unifg.elimination.symmetric import Symmetric
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.linearization import Linearization
from unifg.solution.capabilities import require
from unifg.solvers.quadratic_programs.exact_hessian import ExactHessian, holds
from unifg.solvers.quadratic_programs.graph_route import GraphRoute, Polish
from unifg.solvers.quadratic_programs.scaling import Scaling
from unifg.solvers.quadratic_programs.steps import Steps
from unifg.solvers.quadratic_programs.subproblem import (
    FINER,
    QP,
    QPAnswer,
    Route,
    leaves_most,
    solve_convex,
    subproblem,
)
from unifg.solvers.ta.linear_graphs import EliminationRoute
from unifg.typing import Array

if TYPE_CHECKING:
    from unifg.solvers.quadratic_programs.piqp_route import ElasticRoute

GOOD_ENOUGH = 1e-5  # QP error that is always accepted from the fallback
USABLE = 1e-3  # QP error below which a step may still be tried
MISSES = 2  # in a row, after which the first route is left out: once, then twice as often with each further miss
RESTING = 4  # subproblems that go straight to the fallback after a step of the first route that led nowhere


class Subproblems:
    """The QP routes of one prepared graph and the order they are tried in.

    Attributes:
        program: the compiled graph.
        exact: whether Hessians are those of the Lagrangian.
        pattern: of the Hessians.
        scaling: units in which subproblems are solved, found at the start of each solve.
        tolerance: of the KKT test.
        scaled: whether that is looked for.
        elastic_asked: whether the last subproblem went to the elastic route.
        steps: what is made of their answers.
    """

    def __init__(
        self,
        program: CompiledProblem,
        *,
        hessian: str,
        qp: str,
        fallback: str | None,
        qp_iterations: int | None,
        scaling: bool,
        tolerance: float,
    ) -> None:
        """Open the chosen route and its fallback; arguments as for :class:`unifg.solvers.SQP`.

        Raises:
            BackendError: when a named solver is not installed.
        """
        self.program = program
        self.elastic_asked = False
        self.tolerance = tolerance
        routes: dict[str, Any] = {"qp": qp, "fallback": fallback, "qp_iterations": qp_iterations}
        self._options = routes | {"scaling": scaling}
        self._curved: Subproblems | None = None
        self.exact = hessian == "exact"
        self._exact = ExactHessian(program) if self.exact else None
        self.pattern = program.hessian if self._exact is None else program.normal
        linear = bool(program.equality.all()) and qp != "elimination"
        self.fallback = None if fallback is None else _route(program, fallback, qp_iterations)
        self.first = _route(program, "graph" if linear else qp, qp_iterations)
        self.elastic = None if fallback is None else _elastic(program, self.pattern)
        self._polish = Polish(program)
        self.steps = Steps(program)
        self.scaled = scaling and self.first.name != "elimination"
        self.scaling = self._neutral = Scaling.none(program)
        self._misses = self._resting = 0
        self._first_answered = False

    def curved(self) -> Subproblems:
        """The same with the Hessian of the Lagrangian, made at the first call."""
        if self._curved is None:
            self._curved = Subproblems(self.program, hessian="exact", tolerance=self.tolerance, **self._options)
            self._curved.steps = self.steps
        return self._curved

    def start(self, lin: Linearization) -> None:
        """Begin a new solve at ``lin``, in units that suit it; errors as of :meth:`begin`."""
        self.begin()
        if self.scaled:
            self.scaling = Scaling.of(self.program, lin, self._neutral)

    def begin(self) -> None:
        """Begin a new solve in the graph's units: the first route is trusted again, nothing of the last one is left.

        Raises:
            BackendError: when new data made inequalities that the first route cannot take.
        """
        if self.first.name == "elimination":
            require(self.program, "SQP(qp='elimination')", "equalities")
        self._misses = self._resting = 0
        self.scaling = self._neutral
        for route in (self.first, self.fallback, self.elastic):
            if route is not None:
                route.begin()

    def subproblem(self, lin: Linearization, multipliers: Array, damping: float) -> QP:
        """The quadratic model at an iterate."""
        if self._exact is None:
            return subproblem(self.program, lin, damping * self.scaling.metric, self.pattern)
        return self._exact.subproblem(lin, multipliers, damping * self.scaling.metric, self.scaling)

    @property
    def compiled(self) -> bool:
        """True if the next subproblem goes to the graph first, in its own units and with Gauss-Newton's Hessian."""
        return not self.exact and not self._resting and self.first.name == "graph" and self.scaling.neutral

    def answered(self) -> None:
        """Take note that the first route has answered well."""
        self.elastic_asked = False
        self._misses, self._first_answered = 0, True

    def solve(self, qp: QP, multipliers: Array, accuracy: float, first: QPAnswer | None = None) -> QPAnswer:
        """Try the first route, unless it has given ``first``, then the fallback, then the elastic problem."""
        scaling = self.scaling
        if scaling.neutral:
            return self._solve(qp, qp.gauss_newton, multipliers, accuracy, first)
        scaled, multipliers = scaling.scaled(qp), multipliers / scaling.rows
        answer = self._solve(scaled, lambda: scaling.scaled(qp.gauss_newton()), multipliers, accuracy)
        if FINER * accuracy < answer.error <= USABLE and not self.elastic_asked:
            answer = self._polish(scaled, answer)
        return scaling.unscaled(answer)

    def _solve(
        self,
        qp: QP,
        elastic: Callable[[], QP],
        multipliers: Array,
        accuracy: float,
        first: QPAnswer | None = None,
    ) -> QPAnswer:
        self.elastic_asked = self._first_answered = False
        enough = max(10.0 * accuracy, GOOD_ENOUGH)
        if self.fallback is None or self.elastic is None:
            answer = first or solve_convex(self.first, qp, multipliers, accuracy)
            return answer if holds(qp, answer, enough) else replace(answer, error=np.inf)
        answers = []
        if self._resting:
            self._resting -= 1
        else:
            answers.append(first or solve_convex(self.first, qp, multipliers, accuracy))
            if not holds(qp, answers[-1], enough):
                return replace(answers[-1], error=np.inf)
            if answers[-1].error == np.inf and not answers[-1].infeasible and qp.curved_by is not None:
                return answers[-1]  # no system to be had with this curvature: Gauss-Newton's is as good, and cheap
            if answers[-1].error <= 10.0 * accuracy and not self._contradicts(qp, answers[-1]):
                self.answered()
                return answers[-1]
            self._misses += 1
            if self._misses >= MISSES:
                self._resting = 2 ** (self._misses - MISSES)
        if not any(answer.infeasible for answer in answers):
            answers.append(solve_convex(self.fallback, qp, multipliers, accuracy))
            if not holds(qp, answers[-1], enough):
                return replace(answers[-1], error=np.inf)
        best = min(answers, key=lambda answer: answer.error)
        if best.error <= USABLE and not self._contradicts(qp, best):
            return best
        # Where no step satisfies the rows, nothing says along which steps the curvature of constraints should count.
        self.elastic_asked = True
        return self.elastic.solve(elastic(), 10.0 * float(np.abs(multipliers).max(initial=0.0)))

    def _contradicts(self, qp: QP, answer: QPAnswer) -> bool:
        """Test whether an answer leaves most of the violation, as the least error of contradicting rows does."""
        # Asked of every answer, so that it is there once a prepared solver has rehearsed.
        most = leaves_most(qp.linear(answer.step), qp.lower, qp.upper, 0.1 * self.tolerance)
        return bool(most and answer.error > 0.1 * self.tolerance)  # which is no less than what is left

    def distrust(self) -> bool:
        """Leave the first route out for a while, after a step of it that led nowhere; whether it gave the last step."""
        if not self._first_answered:
            return False
        self._resting = RESTING
        return True

    def correct(self, qp: QP, answer: QPAnswer, bend: Array, accuracy: float) -> QPAnswer | None:
        """Second-order correction: aim at the constraints as found after the full step, which bend by (M,)."""
        for route in (self.first, self.fallback):
            if route is not None and route.name == answer.route:
                corrected = solve_convex(
                    route, self.scaling.scaled(qp.shifted(-bend)), answer.multipliers / self.scaling.rows, accuracy
                )
                return self.scaling.unscaled(corrected) if corrected.error <= USABLE else None
        return None


def _route(program: CompiledProblem, name: str, osqp_iterations: int | None) -> Route:
    """The engine, OSQP and PIQP are called directly, everything else through qpsolvers.

    What stands outside, and SciPy's matrices with it, is loaded when it is asked for.
    """
    if name == "graph":
        return GraphRoute(program)
    if name == "elimination":
        return EliminationRoute(program)
    if name == "osqp":
        from unifg.solvers.quadratic_programs.osqp_route import OsqpRoute

        return OsqpRoute(program, osqp_iterations)
    if name == "piqp":
        from unifg.solvers.quadratic_programs.piqp_route import PiqpRoute

        return PiqpRoute(program)
    from unifg.solvers.quadratic_programs.qpsolvers_route import QpsolversRoute

    return QpsolversRoute(program, name)


def _elastic(program: CompiledProblem, pattern: Symmetric) -> ElasticRoute:
    """The last resort, by PIQP."""
    from unifg.solvers.quadratic_programs.piqp_route import ElasticRoute

    return ElasticRoute(program, pattern)
