"""Problems of `problems.cops` as programs of CasADi, with the same functions."""

from __future__ import annotations

from typing import Any

import numpy as np

from problems.cops import Stated
from unifg.modeling.terms import Constraint, Cost, ScalarCost
from unifg.modeling.variables import Family, Selection


def program(stated: Stated) -> tuple[dict[str, Any], dict[str, Any]]:
    """The problem in symbols of CasADi, and the arguments of a call of its solver, from the graph's own functions."""
    import casadi as ca

    ca.GlobalOptions.setNumpyMode(-1)
    graph, guess = stated
    symbols: dict[Family, Any] = {}
    start, lower, upper = [], [], []
    for family in graph.families.values():
        shape = family.count, family.manifold.dim
        symbols[family] = np.array([[ca.SX.sym(family.name) for _ in range(shape[1])] for _ in range(shape[0])])
        start.append(np.broadcast_to(np.asarray(guess[family], dtype=float), shape).copy())
        lower.append(np.full(shape, -np.inf))
        upper.append(np.full(shape, np.inf))
    place = {family: k for k, family in enumerate(graph.families.values())}
    for fix in graph.fixes:
        at = place[fix.selection.family], fix.selection.indices
        for limits in (lower, upper):
            limits[at[0]][at[1]] = fix.value
    cost: Any = ca.SX(0)
    rows: list[Any] = []
    least: list[Any] = []
    most: list[Any] = []
    for term in graph.terms:
        if isinstance(term, Constraint) and term.kind == "bound":
            (selection,) = term.selections
            k, shape = place[selection.family], (selection.count, selection.family.manifold.dim)
            lower[k][selection.indices] = np.maximum(
                lower[k][selection.indices], np.broadcast_to(np.asarray(term.lower, dtype=float), shape)
            )
            upper[k][selection.indices] = np.minimum(
                upper[k][selection.indices], np.broadcast_to(np.asarray(term.upper, dtype=float), shape)
            )
            continue
        found = np.asarray(term.residual.function(*(_argument(a, symbols, term.count) for a in term.arguments)))
        if isinstance(term, Cost):
            assert term.sigma is None and term.information is None and term.robust is None
            cost += 0.5 * sum(r**2 for r in found.ravel())
        elif isinstance(term, ScalarCost):
            cost += sum(found.ravel())
        else:
            assert isinstance(term, Constraint)
            rows += list(found.ravel())
            least.append(np.broadcast_to(np.asarray(term.lower, dtype=float), found.shape).ravel())
            most.append(np.broadcast_to(np.asarray(term.upper, dtype=float), found.shape).ravel())
    unknowns = ca.vertcat(*(s for family in graph.families.values() for s in symbols[family].ravel()))
    return {"x": unknowns, "f": cost, "g": ca.vertcat(*rows)}, {
        "x0": np.concatenate([part.ravel() for part in start]),
        "lbx": np.concatenate([part.ravel() for part in lower]),
        "ubx": np.concatenate([part.ravel() for part in upper]),
        "lbg": np.concatenate(least) if least else np.zeros(0),
        "ubg": np.concatenate(most) if most else np.zeros(0),
    }


def _argument(argument: Any, symbols: dict[Family, Any], count: int) -> Any:
    if isinstance(argument, Family):
        argument = argument[:]
    if isinstance(argument, Selection):
        part = symbols[argument.family][argument.indices]
        return np.repeat(part, count, axis=0) if len(part) == 1 and count > 1 else part
    return argument
