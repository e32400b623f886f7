"""``graph.check(guess)``: mistakes found before a solve, by term, family and index.

Looks for residuals that are not finite, attached Jacobians that disagree with numerical differentiation,
unknowns that nothing determines, constraints that are violated between fixed variables, and constraints whose rows
depend on each other at the guess. Says of every term how it is evaluated.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from unifg.elimination.factorization import Factorization
from unifg.modeling.model import Model
from unifg.modeling.terms import ScalarCost
from unifg.modeling.variables import Data, Family
from unifg.problem.columns import Values
from unifg.problem.compiled_problem import CompiledProblem, idle_problem
from unifg.problem.linearization import Linearization
from unifg.problem.term import CompiledTerm
from unifg.typing import Array, ArrayLike, IntArray

JACOBIAN_TOLERANCE = 1e-5  # relative; a central difference is good to about 1e-9 where the residual is smooth
PIVOT_TOLERANCE = 1e-11  # relative to the largest pivot of the damped normal equations
VIOLATED = 1e-6  # as the default tolerance of backends
DENSE_ROWS = 2000  # above this many constraint rows the dependence test, which is dense, is skipped
APART = 1e-4  # root of the pivot of a row of length one in the products of all, above which no others make it


@dataclass(frozen=True)
class Finding:
    """One mistake.

    Attributes:
        kind: "not finite", "wrong Jacobian", "undetermined", "violated and fixed" or "dependent constraints".
        message: what was found and what to do.
        term, family, index: where, as far as it has a place.
    """

    kind: str
    message: str
    term: str | None = None
    family: str | None = None
    index: int | None = None


@dataclass(frozen=True)
class Report:
    """All findings; true when there are none.

    Attributes:
        findings: mistakes.
        routes: for each term by name, how it is evaluated and differentiated, and why not faster.
    """

    findings: tuple[Finding, ...]
    routes: dict[str, str] = field(default_factory=dict)

    def __bool__(self) -> bool:
        """Test whether nothing was found."""
        return not self.findings

    def __str__(self) -> str:
        """One line per finding, then one per term."""
        found = [f"{f.kind}: {f.message}" for f in self.findings] or ["nothing found"]
        return "\n".join([*found, *(f"term '{name}': {route}" for name, route in self.routes.items())])


def check_graph(
    graph: Model, guess: Mapping[Family, ArrayLike], data: Mapping[Data, ArrayLike] | None = None
) -> Report:
    """Examine ``graph`` at ``guess``.

    Raises:
        GraphError: for input no solve would accept either (unknown variables, shapes, NaN, crossed limits).
    """
    program = idle_problem(graph)
    with program.lock:
        return _check(program, guess, data or {})


def _check(program: CompiledProblem, guess: Mapping[Family, ArrayLike], data: Mapping[Data, ArrayLike]) -> Report:
    program.bind(data)
    values = program.values_from(guess)
    findings: list[Finding] = []
    for term in program.terms:
        finding = _not_finite(term, values) or _wrong_jacobian(term, values)
        if finding:
            findings.append(finding)
    if not any(f.kind == "not finite" for f in findings):
        findings += _undetermined(program, values)
        findings += _fixed(program, values)
        findings += _dependent(program, values)
    return Report(tuple(findings), {term.name: term.route for term in program.terms})


def _not_finite(term: CompiledTerm, values: Values) -> Finding | None:
    with np.errstate(all="ignore"):
        value = term.residual(values)
    bad = ~np.isfinite(value.reshape(len(value), -1)).all(axis=1)
    if not bad.any():
        return None
    index = int(np.argmax(bad))
    family, member = _first_variable(term, index)
    return Finding(
        "not finite",
        f"term '{term.name}': factor {index} is {value[index]} at {family}[{member}]; {term.remedy(index)}",
        term.name,
        family,
        index,
    )


def _wrong_jacobian(term: CompiledTerm, values: Values) -> Finding | None:
    if term.term.residual.jacobian is None or isinstance(term.term, ScalarCost):
        return None
    attached, numerical = term.jacobians(values), term.jacobians(values, numerical=True)
    for k, (mine, reference) in enumerate(zip(attached, numerical, strict=True)):
        error = np.abs(mine - reference) / (1.0 + np.abs(reference))
        worst = np.unravel_index(int(np.nanargmax(np.where(np.isnan(error), np.inf, error))), error.shape)
        if not error[worst] <= JACOBIAN_TOLERANCE:
            index, row, column = (int(i) for i in worst)
            family = term.gathers[k].selection.family.name
            return Finding(
                "wrong Jacobian",
                f"term '{term.name}': attached Jacobian with respect to argument {k} ({family}) has "
                f"{mine[worst]:.6g} where differentiation gives {reference[worst]:.6g} (factor {index}, row {row}, "
                f"tangent column {column}); perturb on the right, X Exp(d)",
                term.name,
                family,
                index,
            )
    return None


def _undetermined(program: CompiledProblem, values: Values) -> list[Finding]:
    """Unknowns that neither costs nor constraints curve: zero pivots of J'J + A'A."""
    if not program.size:
        return []
    lin = program.linearize(values)
    data = program.normal_entries(lin, np.ones(program.constraints.count))
    diagonal = data[program.normal.diagonal]
    scale = 1.0 / np.sqrt(np.maximum(diagonal, 1e-300))
    matrix = program.normal.matrix(data)
    columns = np.repeat(np.arange(program.size), np.diff(program.normal.indptr))
    scaled = matrix.data * scale[matrix.indices] * scale[columns]
    scaled[program.normal.diagonal] += 1e-14
    loose = np.flatnonzero(diagonal <= 1e-300)
    with program.systems.borrowed() as factorization:
        if not len(loose) and factorization.factor(scaled):
            if factorization.pivots().min() > PIVOT_TOLERANCE:
                return []
            loose = np.flatnonzero(np.abs(null_direction(factorization, program.size)) > 0.1)
    return [
        Finding(
            "undetermined",
            f"{listed(family, found)} can move at the guess without any cost or constraint noticing to first order; "
            "add a prior or fix something",
            None,
            family,
            found[0],
        )
        for family, found in members_of(program, loose).items()
    ]


def members_of(program: CompiledProblem, unknowns: IntArray) -> dict[str, list[int]]:
    """Members that some unknowns belong to, by family."""
    members: dict[str, list[int]] = {}
    for column in program.columns.free[unknowns].tolist():
        family, member = program.columns.name(column)
        if member not in members.setdefault(family, []):
            members[family].append(member)
    return members


def listed(family: str, members: list[int]) -> str:
    """A few members by name, and how many there are."""
    names = ", ".join(f"{family}[{member}]" for member in members[:3])
    return names if len(members) <= 3 else f"{names}, ... ({len(members)} members)"


def null_direction(factorization: Factorization, size: int) -> Array:
    """Direction of least curvature by inverse iteration, largest entry 1."""
    vector = np.random.default_rng(0).normal(size=size)
    for _ in range(3):
        vector = factorization.solve(vector)
        vector /= np.abs(vector).max()
    return vector


def _fixed(program: CompiledProblem, values: Values) -> list[Finding]:
    """Violated rows that no step can change, one finding for each factor."""
    outside = program.violation(program.evaluate(values).constraints)
    found: dict[tuple[str, int], float] = {}
    for row in program.fixed_rows().tolist():
        if abs(outside[row]) > VIOLATED:
            place = program.row_name(row)
            found[place] = max(found.get(place, 0.0), abs(float(outside[row])))
    return [
        Finding(
            "violated and fixed",
            f"term '{term}': factor {index} is violated by {size:.3g}, and all its variables are fixed; change their "
            "values, free one, or widen the limits",
            term,
            None,
            index,
        )
        for (term, index), size in found.items()
    ]


def _dependent(program: CompiledProblem, values: Values) -> list[Finding]:
    """Equality rows that are combinations of others: their multipliers are not unique."""
    rows = np.flatnonzero(program.equality)
    if not len(rows) or len(rows) > DENSE_ROWS:
        return []
    found = {program.row_name(row): None for row in dependent(program, program.linearize(values), rows)}
    return [
        Finding(
            "dependent constraints",
            f"term '{term}': equality of factor {index} depends on other equalities at the guess; "
            "state each condition once",
            term,
            None,
            index,
        )
        for term, index in found
    ]


def dependent(program: CompiledProblem, lin: Linearization, rows: IntArray) -> list[int]:
    """Those of some constraint rows whose gradients are combinations of those of the others."""
    sparse = program.constraints.matrix(lin.constraint_jacobian)[rows]
    products = (sparse @ sparse.T).toarray()
    lengths = np.maximum(np.sqrt(products.diagonal()), 1e-300)
    with suppress(np.linalg.LinAlgError):  # a row that others make has no pivot of its own, but for rounding
        if (np.linalg.cholesky(products / np.outer(lengths, lengths)).diagonal() > APART).all():
            return []
    left, singular, _ = np.linalg.svd(sparse.toarray() / lengths[:, None], full_matrices=True)
    rank = int((singular > 1e-10 * max(singular.max(initial=0.0), 1e-300)).sum())
    found: list[int] = rows[(np.abs(left[:, rank:]) > 0.1).any(axis=1)].tolist()
    return found


def _first_variable(term: CompiledTerm, index: int) -> tuple[str, int]:
    selection = term.gathers[0].selection
    return selection.family.name, int(selection.indices[index % len(selection)])
