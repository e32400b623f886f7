"""Claims judged by casadi's exact derivatives of a problem's second statement.

The KKT numbers are those of :mod:`unifg.solution.optimality`, whose docstring defines them; its code is not used.
A claim of local infeasibility is tested by looking for a feasible point: IPOPT minimises the sum of all violations from
the point where the claim was made.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

import unifg as fg
from problems.twins.twin import Twin
from unifg.typing import Array, BoolArray, IntArray

FEASIBLE = 1e-6
"""Largest violation of a point that keeps the constraints, in their own units."""
AGREED = 1e-7
"""Relative difference of the two statements, whose gradients we get by central differences, casadi exactly."""
DOUBT = 1.1
"""A KKT number this many times the tolerance contradicts CONVERGED: differences are not exact to the last digit."""
STATIONARY = 1e-4
"""Relative gradient of the violation below which a point counts as stationary for it."""


@dataclass(frozen=True)
class Numbers:
    """Exact KKT numbers, scaled as in :mod:`unifg.solution.optimality`."""

    cost: float
    stationarity: float
    violation: float
    complementarity: float

    @property
    def worst(self) -> float:
        """The largest of the three."""
        return max(self.stationarity, self.violation, self.complementarity)


@dataclass(frozen=True)
class Peer:
    """Result of a CasADi solver for the problem.

    Attributes:
        status: in its own word.
        solved: whether it says that it solved the problem.
        iterations: it counted.
        cost: at its answer.
        violation: largest, of all rows.
        far: distance of its answer from where it began, largest tangent coordinate.
    """

    status: str
    solved: bool
    iterations: int
    cost: float
    violation: float
    far: float


@dataclass(frozen=True)
class Least:
    """Result of minimising the violation.

    Attributes:
        before, after: sums of all violations.
        largest: violation after.
        far: how far it went, largest tangent coordinate.
    """

    before: float
    after: float
    largest: float
    far: float

    @property
    def feasible(self) -> bool:
        """True if a point that keeps the constraints was found."""
        return self.largest <= FEASIBLE


class Judge:
    """Derivatives and programs of one twin.

    Args:
        twin: complete; terms added later are not seen.
    """

    def __init__(self, twin: Twin) -> None:
        """Differentiate."""
        self.twin = twin
        self._z = ca.vertcat(*(ca.vec(point) for point in twin.point.values()))
        self._d = ca.vertcat(*(ca.vec(step) for step in twin.step.values()))
        self._g = ca.vertcat(*(rows.expression for rows in twin.rows)) if twin.rows else ca.SX(0, 1)
        self.lower = np.concatenate([np.zeros(0), *(rows.lower for rows in twin.rows)])
        self.upper = np.concatenate([np.zeros(0), *(rows.upper for rows in twin.rows)])
        self._free = ~twin.held
        outputs = [twin.cost, self._g, ca.gradient(twin.cost, self._d), ca.jacobian(self._g, self._d)]
        self._derivatives = ca.Function("derivatives", [self._d, self._z], outputs)
        residual = ca.vertcat(ca.SX(0, 1), *twin.residuals)
        self._residual = ca.Function("residual", [self._d, self._z], [residual, ca.jacobian(residual, self._d)])

    def at(self, values: dict[fg.Family, Array]) -> tuple[float, Array, Array, Any]:
        """Cost, rows, gradient and Jacobian (sparse) along the right perturbation at a point."""
        zero = np.zeros(self._d.shape[0])
        cost, rows, gradient, jacobian = self._derivatives(zero, self.twin.stacked(values))
        return float(cost), np.array(rows).ravel(), np.array(gradient).ravel(), jacobian.sparse()

    def numbers(self, values: dict[fg.Family, Array], multipliers: dict[str, Array]) -> Numbers:
        """The KKT numbers at a point and multipliers, (n, m) by term."""
        cost, rows, gradient, jacobian = self.at(values)
        duals = np.concatenate([np.zeros(0), *(multipliers[part.name].ravel() for part in self.twin.rows)])
        scale = max(1.0, float(np.abs(duals).mean()) / 100.0) if len(duals) else 1.0
        pull = gradient + jacobian.T @ duals
        limit = np.where(duals > 0.0, self.upper, self.lower)
        distance = np.where(np.isfinite(limit), np.abs(rows - np.where(np.isfinite(limit), limit, 0.0)), 1.0)
        slack = np.where(self.lower == self.upper, 0.0, distance)
        # Or relative, to a hundredth of the largest product that gradients along a coordinate are sums of.
        residual, slopes_of_costs = self._residual(np.zeros(len(pull)), self.twin.stacked(values))
        slopes = np.abs(jacobian.toarray())
        products = np.abs(np.array(residual)) * np.abs(np.array(slopes_of_costs))
        products = np.concatenate([products, np.abs(duals)[:, None] * slopes])
        along = np.zeros(self.twin.along.max() + 1)
        np.maximum.at(along, self.twin.along, products.max(axis=0, initial=0.0))
        sizes = np.maximum(0.01 * along[self.twin.along], scale)
        shares = np.minimum((slopes / sizes).max(axis=1, initial=0.0), 1.0 / scale)
        return Numbers(
            cost,
            float((np.abs(pull) / sizes)[self._free].max(initial=0.0)),
            float(np.abs(self._outside(rows)).max(initial=0.0)),
            float((np.abs(duals) * slack * shares).max(initial=0.0)),
        )

    def slope_of_violation(self, values: dict[fg.Family, Array]) -> float:
        """Distance from stationarity for 1/2 |violation|^2, bounds of unknowns blocking; 0 is stationary.

        Relative to the largest violation and the largest entry of the Jacobian, if that exceeds one.
        """
        _, rows, _, jacobian = self.at(values)
        outside = self._outside(rows)
        pull = jacobian.T @ outside
        index = 0
        for part in self.twin.rows:
            here = slice(index, index + len(part.lower))
            index += len(part.lower)
            if part.coordinates is None:
                continue
            near = 1e-6 * np.maximum(1.0, np.abs(rows[here]))
            held = (np.abs(rows[here] - part.lower) <= near) & (pull[part.coordinates] > 0.0)
            held |= (np.abs(rows[here] - part.upper) <= near) & (pull[part.coordinates] < 0.0)
            pull[part.coordinates[held]] = 0.0
        size = float(np.abs(outside).max(initial=0.0)) * max(1.0, float(abs(jacobian).max()))
        return float(np.abs(pull[self._free]).max(initial=0.0)) / size if size > 0.0 else 0.0

    def ipopt(self, values: dict[fg.Family, Array], tolerance: float) -> Peer:
        """The problem by IPOPT (MUMPS, exact Hessian) from a point."""
        bounds, rows = self._limits(values)
        solver = self._ipopt(tolerance)
        point = self.twin.stacked(values)
        answer = solver(x0=0.0, p=point, lbx=bounds[0], ubx=bounds[1], lbg=rows[0], ubg=rows[1])
        return self._peer(solver, values, np.array(answer["x"]).ravel())

    def least_from(self, values: dict[fg.Family, Array]) -> Least:
        """Minimise the sum of all violations from a point, bounds of unknowns kept."""
        count = int(self._general.sum())
        less, more = ca.SX.sym("p", count), ca.SX.sym("n", count)
        program = {
            "x": ca.vertcat(self._d, less, more),
            "p": self._z,
            "f": ca.sum1(less) + ca.sum1(more),
            "g": self._g[np.flatnonzero(self._general).tolist()] - less + more,
        }
        options: Any = {"print_level": 0, "sb": "yes", "tol": 1e-8, "max_iter": 500}
        options |= {"mu_init": 1e-4, "bound_push": 1e-6}
        solver: Any = ca.nlpsol("least", "ipopt", program, {"print_time": False, "ipopt": options})
        bounds, rows = self._limits(values)
        outside = self._outside(self.at(values)[1])[self._general]
        slack = np.concatenate([np.maximum(outside, 0.0), np.maximum(-outside, 0.0)])
        wide = (np.append(bounds[0], np.zeros(2 * count)), np.append(bounds[1], np.full(2 * count, np.inf)))
        begin = np.append(np.zeros(len(self._free)), slack)
        point = self.twin.stacked(values)
        answer = solver(x0=begin, p=point, lbx=wide[0], ubx=wide[1], lbg=rows[0], ubg=rows[1])
        step = np.array(answer["x"]).ravel()[: len(self._free)]
        left = np.abs(self._outside(np.array(self._derivatives(step, point)[1]).ravel()))
        before = float(np.abs(self._outside(self.at(values)[1])).sum())
        return Least(before, float(left.sum()), float(left.max(initial=0.0)), float(np.abs(step).max()))

    def fatrop(self, values: dict[fg.Family, Array], tolerance: float) -> Peer | None:
        """The problem by fatrop, or None where it has no stages that fatrop knows."""
        order = self._stages()
        if order is None:
            return None
        columns, rows = order
        d, held = self._d[columns.tolist()], np.flatnonzero(self.twin.held)
        general = self._general[rows]
        chosen = rows[general]
        # fatrop takes no fixed variables: the first state is held by rows of the first stage, after its dynamics.
        after = int(np.searchsorted(self._row_stages[chosen], 0, side="right"))
        g = ca.vertcat(self._g[chosen[:after].tolist()], self._d[held.tolist()], self._g[chosen[after:].tolist()])
        lower = np.concatenate([self.lower[chosen[:after]], np.zeros(len(held)), self.lower[chosen[after:]]])
        upper = np.concatenate([self.upper[chosen[:after]], np.zeros(len(held)), self.upper[chosen[after:]]])
        options = {
            "print_time": False,
            "structure_detection": "auto",
            "equality": (lower == upper).tolist(),
            "fatrop": {"print_level": 0, "tol": tolerance, "max_iter": 1000},
        }
        program = {"x": d, "p": self._z, "f": self.twin.cost, "g": g}
        (low, high), _ = self._limits(values, held=False)
        try:
            solver: Any = ca.nlpsol("solver", "fatrop", program, options)
            answer = solver(
                x0=0.0, p=self.twin.stacked(values), lbx=low[columns], ubx=high[columns], lbg=lower, ubg=upper
            )
        except RuntimeError:
            return None
        step = np.zeros(len(columns))
        step[columns] = np.array(answer["x"]).ravel()
        return self._peer(solver, values, step)

    @cached_property
    def _general(self) -> BoolArray:
        """(M,) rows that are not bounds of unknowns."""
        return np.concatenate(
            [np.zeros(0, dtype=bool), *(np.full(len(r.lower), r.coordinates is None) for r in self.twin.rows)]
        )

    @cached_property
    def _row_stages(self) -> IntArray:
        return np.concatenate([np.zeros(0, dtype=int), *(rows.stages for rows in self.twin.rows)])

    def _ipopt(self, tolerance: float) -> Any:
        options: Any = {"print_level": 0, "sb": "yes", "tol": tolerance, "max_iter": 1000}
        general = self._g[np.flatnonzero(self._general).tolist()]
        program = {"x": self._d, "p": self._z, "f": self.twin.cost, "g": general}
        return ca.nlpsol("solver", "ipopt", program, {"print_time": False, "ipopt": options})

    def _limits(
        self, values: dict[fg.Family, Array], held: bool = True
    ) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """Bounds of the steps from ``values``, and limits of the general rows."""
        low, high = np.full(len(self._free), -np.inf), np.full(len(self._free), np.inf)
        rows = self.at(values)[1]
        index = 0
        for part in self.twin.rows:
            here = slice(index, index + len(part.lower))
            index += len(part.lower)
            if part.coordinates is not None:
                low[part.coordinates] = np.maximum(low[part.coordinates], part.lower - rows[here])
                high[part.coordinates] = np.minimum(high[part.coordinates], part.upper - rows[here])
        if held:
            low[self.twin.held] = high[self.twin.held] = 0.0
        return (low, high), (self.lower[self._general], self.upper[self._general])

    def _peer(self, solver: Any, values: dict[fg.Family, Array], step: Array) -> Peer:
        stats = solver.stats()
        cost, rows, *_ = self._derivatives(step, self.twin.stacked(values))
        outside = float(np.abs(self._outside(np.array(rows).ravel())).max(initial=0.0))
        status = str(stats["return_status"])
        solved = bool(stats["success"]) and outside <= 1e-4
        return Peer(status, solved, int(stats["iter_count"]), float(cost), outside, float(np.abs(step).max()))

    def _outside(self, rows: Array) -> Array:
        """(M,) signed distances to the limits, positive above the upper ones."""
        return np.asarray(np.maximum(rows - self.upper, 0.0) - np.maximum(self.lower - rows, 0.0))

    def _stages(self) -> tuple[IntArray, IntArray] | None:
        """Order of coordinates and rows by stages x_0 u_0 x_1 ...; None unless there are just states and controls."""
        families = {family.name: family for family in self.twin.point}
        if set(families) != {"x", "u"} or not any(rows.moves for rows in self.twin.rows):
            return None
        x, u = families["x"], families["u"]
        place = np.concatenate([np.repeat(2 * np.arange(f.count) + (f is u), f.manifold.dim) for f in self.twin.point])
        moves = np.concatenate([np.zeros(0, bool), *(np.full(len(r.lower), r.moves) for r in self.twin.rows)])
        rows = np.lexsort((~moves, self._row_stages))
        return (np.argsort(place, kind="stable"), rows) if x.count == u.count + 1 else None


@dataclass
class Answer:
    """One backend's answer and what the judge says about its claim.

    Attributes:
        status: claimed, a name of :class:`unifg.Status`.
        iterations: counted by the backend.
        seconds: processor time, the graph compiled before.
        cost: as judged.
        stationarity, violation, complementarity: as judged, at the multipliers of the answer.
        claim: "true", "false", "saddle" (stationary for the violation, but left by IPOPT for a feasible point), or
            "none" where nothing was claimed.
        reason: of a false claim.
    """

    status: str
    iterations: int
    seconds: float
    cost: float
    stationarity: float
    violation: float
    complementarity: float
    claim: str = "none"
    reason: str = ""


def answer(backend: fg.Solver, twin: Twin, judge: Judge) -> Answer:
    """Solve from the guess and judge."""
    run = backend.prepare(twin.graph)
    begin = time.process_time()
    solution = run.solve(twin.guess)
    seconds = time.process_time() - begin
    exact = judge.numbers(solution.values, solution.multipliers)
    result = Answer(
        solution.status.name, solution.iterations, seconds, exact.cost, exact.stationarity, exact.violation,
        exact.complementarity,
    )  # fmt: skip
    if solution.status is fg.Status.CONVERGED:
        result.claim = "true"
        for name in ("stationarity", "violation", "complementarity"):
            if not getattr(exact, name) <= DOUBT * backend.tolerance:
                result.claim, result.reason = "false", f"{name} is {getattr(exact, name):.2g}"
    elif solution.status is fg.Status.LOCALLY_INFEASIBLE:
        result.claim, result.reason = infeasible(solution, judge, backend.tolerance)
    elif solution.status is fg.Status.UNBOUNDED:
        result.claim, result.reason = "false", "every objective here is a sum of squares"
    return result


def infeasible(solution: fg.Solution, judge: Judge, tolerance: float) -> tuple[str, str]:
    """Judge a claim that no nearby point violates the constraints less."""
    seen = min(row.violation for row in solution.history)
    if seen <= tolerance:
        return "false", f"an iterate keeps the constraints to {seen:.1g}"
    values = solution.values
    least, slope = judge.least_from(values), judge.slope_of_violation(values)
    if slope <= STATIONARY:
        return ("saddle", "") if least.feasible else ("true", "")
    if least.after >= 0.99 * least.before:
        return "true", ""  # no sum of absolute violations is less: stationary in that norm
    end = "none" if least.feasible else f"{least.after:.2g}"
    return "false", f"the violation falls from {least.before:.2g} to {end} within {least.far:.2g}; slope {slope:.1g}"


def disagreement(twin: Twin, judge: Judge) -> float:
    """Largest difference of cost, rows and gradient of the two statements, relative, at a random point by the guess."""
    rng = np.random.default_rng(0)
    values = {
        family: family.manifold.retract(v, 0.05 * rng.normal(size=(len(v), family.manifold.dim)))
        for family, v in twin.guess.items()
    }
    program = twin.graph.compile()
    lin = program.linearize(program.values_from(values))
    cost, rows, gradient, _ = judge.at(lin.values)
    free = program.columns.free
    pairs = ((lin.cost, cost), (lin.constraints, rows), (lin.gradient[free], gradient[free]))
    return max(float(np.abs(a - b).max(initial=0.0) / max(1.0, np.abs(b).max(initial=0.0))) for a, b in pairs)
