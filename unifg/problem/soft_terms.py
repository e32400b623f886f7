"""Soft constraints in a compiled problem: a hard constraint with slack variables, their limits and their costs.

See :mod:`unifg.modeling.soft`. Slacks are unknowns like others; each touches one factor, so elimination removes them
first, at hardly any cost.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from unifg.errors import GraphError
from unifg.factors.residuals import Residual, residual
from unifg.modeling.model import Model, itself
from unifg.modeling.soft import LOWER, UPPER, Slack, signed
from unifg.modeling.terms import Constraint, Cost, ScalarCost, Term
from unifg.modeling.variables import Data
from unifg.typing import Array


def softened(graph: Model) -> Model:
    """A statement without soft constraints: slack variables, their limits and costs stand for them.

    Args:
        graph: a snapshot, which is changed.

    Raises:
        GraphError: a name that slack variables need is taken.
    """
    terms = list[Term]()
    used = {*graph.families, *(term.name for term in graph.terms), *(fix.name for fix in graph.fixes)}
    for term in graph.terms:
        if not isinstance(term, Constraint) or term.slack is None:
            terms.append(term)
            continue
        made = expanded(term, term.slack)
        for name in {term.slack.family.name, *(other.name for other in made[1:])} & used:
            raise GraphError(
                f"the name '{name}' is that of the slack variables of '{term.name}': rename one", term=name
            )
        graph.families[term.slack.family.name] = term.slack.family
        terms += made
    graph.terms = terms
    return graph


def expanded(term: Constraint, slack: Slack) -> list[Term]:
    """Hard constraint with slacks, limit of the slacks, and their costs, which stand for a soft constraint."""
    s, name, soft = slack.family[:], slack.family.name, slack.soft
    count, rows = term.count, (*term.rows, None)
    made: list[Term] = [
        replace(
            term,
            residual=_with_slack(term.residual, slack.sides),
            arguments=(*term.arguments, s),
            rows=rows,
            is_bound=False,
            slack=None,
        )
    ]
    width = s.manifold.dim
    both = slack.sides == UPPER | LOWER
    linear_price = isinstance(soft.linear, Data) or np.asarray(soft.linear).any()
    if linear_price or both:  # with a square as the price of one side, a negative slack never pays
        none, above = np.asarray(0.0), np.asarray(np.inf)
        made.append(
            Constraint(name, residual(itself), (s,), None, count, width, none, above, is_bound=True, rows=(None,))
        )
    if linear_price:
        weigh = _sum_of_two if both else _sum
        linear, each = _argument(soft.linear)
        priced = residual(weigh, name=weigh.__name__)
        made.append(ScalarCost(f"{name}, linear cost", priced, (s, linear), None, count, 1, rows=(None, each)))
    if isinstance(soft.quadratic, Data) or np.asarray(soft.quadratic).any():
        root = _root_of_two if both else _root
        quadratic, each = _argument(soft.quadratic)
        squared = residual(root, name=root.__name__)
        made.append(Cost(f"{name}, quadratic cost", squared, (s, quadratic), None, count, width, rows=(None, each)))
    return made


def _argument(weight: Any) -> tuple[Any, bool]:
    """A weight as the argument of a function, and whether it has a row for each factor."""
    value = weight.value if isinstance(weight, Data) else weight
    if not isinstance(weight, Data) and value.ndim == 0:
        return float(value), False
    return weight, value.ndim == 2


def _with_slack(own: Residual, sides: int) -> Residual:
    """A residual with slacks as its last argument."""
    function = _less_slack(own if own.kernel is not None else own.function, sides)
    jacobian = None if own.jacobian is None or own.kernel is not None else _beside(own.jacobian, sides)
    made = residual(function, jacobian, name=own.name, derivatives=own.derivatives or None)  # type: ignore[arg-type]
    return replace(made, elements=own.elements)


def _less_slack(own: Callable[..., Any], sides: int) -> Callable[..., Any]:
    def with_slack(*arguments: Any) -> Any:
        return own(*arguments[:-1]) - signed(arguments[-1], sides)

    return with_slack


def _beside(own: Callable[..., Sequence[Array]], sides: int) -> Callable[..., Sequence[Array]]:
    """An attached Jacobian with the block of the slacks."""

    def jacobian(*arguments: Any) -> list[Array]:
        blocks = [np.asarray(block) for block in own(*arguments[:-1])]
        count, size = blocks[0].shape[:2]
        eye = np.eye(size)
        parts = [sign * eye for side, sign in ((UPPER, -1.0), (LOWER, 1.0)) if sides & side]
        return [*blocks, np.broadcast_to(np.concatenate(parts, axis=1), (count, size, len(parts) * size))]

    return jacobian


def _sum(slack: Any, weight: Any) -> Any:
    return (weight * slack).sum(axis=1)


def _sum_of_two(slack: Any, weight: Any) -> Any:
    size = slack.shape[1] // 2
    return (weight * (slack[:, :size] + slack[:, size:])).sum(axis=1)


def _root(slack: Any, weight: Any) -> Any:
    return np.sqrt(weight) * slack


def _root_of_two(slack: Any, weight: Any) -> Any:
    size = slack.shape[1] // 2
    root = np.sqrt(weight)
    return np.concatenate([root * slack[:, :size], root * slack[:, size:]], axis=1)
