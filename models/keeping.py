"""Three ways to hold a barrier, and the intervals it is held on.

"hinge" is the paper's (Yang et al. 2025, eq. 19, 22): the cost of max(-b, 0), which no start makes infeasible and which
promises nothing. "hard" is the constraint b >= 0: where nothing satisfies it the solve fails and the vehicle has no
plan. "slack", the default, is b + s >= 0 with a slack s for each obstacle and interval that costs: as hard as the
constraint where that can be satisfied, little violation where it cannot, and the slack names the obstacle.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol, TypeAlias

import numpy as np

from unifg.errors import ModelError, require_positive
from unifg.factors.residuals import Residual
from unifg.lie import Rn
from unifg.modeling.factors import prior
from unifg.modeling.model import Model, complete
from unifg.modeling.probing import rows_of
from unifg.modeling.terms import prepare_arguments
from unifg.modeling.variables import Family
from unifg.typing import Array

__all__ = ["aligned", "grid", "hinge", "keep"]

Form: TypeAlias = Literal["hinge", "hard", "slack", "exact slack"]
WEIGHT = 1e6  # of the squared slack: a multiplier of 1000 /m moves the boundary by a millimetre
EXACT = 1e4  # of the slack itself: more than any multiplier that a feasible plan has


class Answer(Protocol):
    """The part of a solution that is read here."""

    def __getitem__(self, variable: Any) -> Array:
        """Values of a family."""


@dataclass(frozen=True)
class Use:
    """A slack that was used.

    Attributes:
        obstacle: its name.
        interval: number of the first one that it was used on.
        amount: the most of it, in what the barrier is measured in.
    """

    obstacle: str
    interval: int
    amount: float


@dataclass(frozen=True)
class Kept:
    """A barrier in a graph.

    Attributes:
        name: of its term.
        form: how it is held.
        obstacles: names, one per column.
        slack: (n, M) family, None for forms without.
    """

    name: str
    form: Form
    obstacles: tuple[str, ...]
    slack: Family | None

    def guess(self) -> dict[Family, Array]:
        """No slack: what a first guess needs."""
        return {} if self.slack is None else {self.slack: np.zeros((self.slack.count, len(self.obstacles)))}

    def used(self, solution: Answer, beyond: float = 1e-3) -> list[Use]:
        """Obstacles whose slack was used by more than ``beyond``, the most used first."""
        if self.slack is None:
            return []
        amounts = solution[self.slack]
        most = amounts.max(axis=0)
        return [
            Use(self.obstacles[k], int(np.argmax(amounts[:, k] > beyond)), float(most[k]))
            for k in np.argsort(-most, kind="stable")
            if most[k] > beyond
        ]


def keep(
    graph: Model,
    barrier: Callable[..., Array] | Residual,
    *arguments: Any,
    obstacles: int | Sequence[str],
    form: Form = "slack",
    weight: float | None = None,
    active: Any = None,
    name: str = "barrier",
) -> Kept:
    """Hold ``barrier(*arguments) >= 0`` in a graph.

    Args:
        graph: to add to.
        barrier: (n, M), as :func:`unifg.models.barriers.decay` makes them.
        *arguments: families or selections, data, constants.
        obstacles: how many there are, M, or their names.
        form: "hinge", "hard", "slack" (squared) or "exact slack" (s >= 0 at a price of ``weight`` each, which
            least-squares backends do not take).
        weight: of the squared hinge or slack, halved as every cost; or the price of an exact one.
        active: (n,) booleans, constant or data: intervals it is held on.
        name: of the term; the slack's family and its cost are called after it.

    Raises:
        ModelError: on a smoother, a form that is none, no obstacle, another number of obstacles than the barrier has,
            or a weight that is not positive.
        GraphError: as the statements of the graph raise it; the graph is as it was.
    """
    if not isinstance(graph, Model):
        raise ModelError(
            f"'{name}': {type(graph).__name__} is no graph; a smoother takes the hinge, as a residual: "
            "minimize(keeping.hinge(barrier), ..., sigma=weight**-0.5)"
        )
    names = tuple(f"{name} {k}" for k in range(obstacles)) if isinstance(obstacles, int) else tuple(obstacles)
    price = weight if weight is not None else EXACT if form == "exact slack" else WEIGHT
    if form not in ("hinge", "hard", "slack", "exact slack"):
        raise ModelError(f"'{name}' is held by 'hinge', 'hard', 'slack' or 'exact slack', found {form!r}")
    if not names:
        raise ModelError(f"'{name}' has no obstacle")
    require_positive(f"'{name}'", ModelError, weight=price)
    normal, _, _, count = prepare_arguments(name, arguments, active)
    rows = rows_of(name, complete(barrier, normal), normal, count)
    if rows != len(names):
        raise ModelError(f"'{name}': the barrier says something of {rows} obstacles, found {len(names)}: {names}")
    for at in (graph.snapshot(), graph):  # what is refused is refused where nothing remains of it
        kept = _hold(at, barrier, arguments, count, names, form, float(price), active, name)
    return kept


def _hold(
    graph: Model, barrier: Callable[..., Array] | Residual, arguments: tuple[Any, ...], count: int,
    names: tuple[str, ...], form: Form, price: float, active: Any, name: str,
) -> Kept:  # fmt: skip
    if form == "hinge":
        graph.minimize(hinge(barrier), *arguments, sigma=price**-0.5, active=active, name=name)
        return Kept(name, form, names, None)
    if form == "hard":
        graph.constrain(barrier, *arguments, lower=0.0, active=active, name=name)
        return Kept(name, form, names, None)
    slack = graph.variables(f"{name} slack", Rn(len(names)), count)
    graph.constrain(_loosened(barrier), slack, *arguments, lower=0.0, active=active, name=name)
    if form == "slack":
        graph.minimize(prior, slack, np.zeros(len(names)), sigma=price**-0.5, name=f"{name} slack")
    else:
        graph.bound(slack, lower=0.0, name=f"{name} slack limits")
        graph.minimize_scalar(_priced(price), slack, name=f"{name} slack")
    return Kept(name, form, names, slack)


def hinge(barrier: Callable[..., Array] | Residual) -> Callable[..., Array]:
    """``max(-b, 0)`` of a barrier, same arguments and shape (eq. 19, 22)."""

    def missing(*arguments: Any) -> Array:
        return np.maximum(-barrier(*arguments), 0.0)

    return missing


def _loosened(barrier: Callable[..., Array] | Residual) -> Callable[..., Array]:
    def loosened(slack: Array, *arguments: Any) -> Array:
        return barrier(*arguments) + slack

    return loosened


def _priced(price: float) -> Callable[..., Array]:
    def priced(slack: Array) -> Array:
        total: Array = price * np.sum(slack, axis=1)
        return total

    return priced


def grid(count: int, tick: float, node: float) -> tuple[Array, Array]:
    """Begin and length of the intervals of a plan that is made anew at every tick: one tick, then nodes.

    With h_1 >= exp(-alpha tick) h_0 the vehicle loses in a tick what it may lose in a tick; with a first interval of a
    whole node it could lose that, tick after tick.

    Args:
        count: N, intervals.
        tick: time between two solves [s].
        node: length of the intervals but the first [s], no shorter than a tick.

    Returns:
        (N,) begins and (N,) lengths [s].

    Raises:
        ModelError: on no interval, or lengths that are not positive or the wrong way round.
    """
    if count < 1 or not (0.0 < tick <= node < np.inf):
        raise ModelError(f"a grid needs an interval and 0 < tick <= node, found {count}, {tick!r} s and {node!r} s")
    lengths = np.full(count, float(node))
    lengths[0] = tick
    return np.concatenate([[0.0], np.cumsum(lengths)[:-1]]), lengths


def aligned(count: int, tick: float, node: float, number: int) -> tuple[Array, Array]:
    """Begin and length of the intervals of a plan whose nodes stay where they are from tick to tick.

    The first interval is what is left of a node: as long as the others, then a tick shorter at every tick. Held from
    the state at the node that has passed, as ``decay(h, alpha)(passed, x[1], -gone, node)`` with ``gone`` since then,
    barriers ask for the same at every tick, so that the last plan, cut off at its begin, is one of the next. With
    :func:`grid`, whose nodes move on with every tick, it need not be.

    Args:
        count: N, intervals.
        tick: time between two solves [s].
        node: length of an interval [s], a whole number of ticks.
        number: of the tick, from zero.

    Returns:
        (N,) begins, from now, and (N,) lengths [s].

    Raises:
        ModelError: on no interval, lengths that are not positive, or a node that is no whole number of ticks.
    """
    if count < 1 or number < 0 or not (0.0 < tick <= node < np.inf):
        raise ModelError(
            "aligned nodes need an interval, a number >= 0 and 0 < tick <= node, "
            f"found {count}, {number}, {tick!r} s and {node!r} s"
        )
    parts = round(node / tick)
    if abs(parts * tick - node) > 1e-9 * node:
        raise ModelError(f"aligned nodes: {node!r} s is no whole number of ticks of {tick!r} s")
    lengths = np.full(count, float(node))
    lengths[0] = node * (1.0 - number % parts / parts)
    return np.concatenate([[0.0], np.cumsum(lengths)[:-1]]), lengths
