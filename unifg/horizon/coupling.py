"""Coupling of horizon and window: two graphs that share nothing, two that share a belief, or one graph."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from math import sqrt
from typing import Any, Literal, Protocol, TypeAlias, get_args

import numpy as np

from unifg.errors import GraphError
from unifg.factors.robust import DCS, Cauchy, GemanMcClure, Huber, Loss, Reweighted, TruncatedLeastSquares, Tukey
from unifg.horizon.past import Past
from unifg.horizon.robot import Robot
from unifg.horizon.terms import Context
from unifg.horizon.window import Window
from unifg.modeling.factors import prior
from unifg.modeling.soft import Soft
from unifg.modeling.terms import Constraint, Cost, ScalarCost
from unifg.modeling.terms import Term as Stated
from unifg.modeling.variables import Data, Family, Selection
from unifg.solution.graph import Graph
from unifg.solution.guess import Guess
from unifg.solution.solution import Solution
from unifg.typing import Array, ArrayLike

Coupling: TypeAlias = Literal["separate", "sequential", "joint"]
"""Of estimation and control: "separate", the plan is given the present state, and constants as believed at the start;
"sequential", it is given the present state and constants as they are estimated; "joint", one graph of past and
future."""
COUPLINGS: tuple[Coupling, ...] = get_args(Coupling)

LEAST_SIGMA = 1e-6  # of what the past knows for certain


class PresentCoupling(Protocol):
    """Coupling of the horizon to the estimate.

    Attributes:
        ahead: the nodes of the future, the present first.
        along: families that run along time.
    """

    ahead: Selection
    along: tuple[Family, ...]

    def data(self, now: Context[Any]) -> dict[Data, ArrayLike]:
        """Values of the data it declared."""

    def begin(self, guess: Guess, now: Context[Any]) -> Guess:
        """The guess for a solve, from one for the horizon alone or the shifted last answer."""

    def believed(self, solution: Solution) -> tuple[Array, dict[str, Array]] | None:
        """Present state (storage,) and constants (count, storage) of a solve; None where it was given them."""


class FixedPresent:
    """The present state and the constants are given.

    Attributes:
        ahead: the nodes of the future.
        along: the trajectory.
    """

    def __init__(self, graph: Graph, robot: Robot, steps: int, at_start: bool) -> None:
        """Fix them.

        Args:
            graph: to state it in.
            robot: who moves.
            steps: N of the future.
            at_start: whether constants stay as they were believed at the start.
        """
        x = graph.variables("x", robot.state, steps + 1)
        self.ahead = x[:]
        self.along: tuple[Family, ...] = (x,)
        self._start = graph.data("present", robot.state.identity())
        graph.fix(x[0], self._start, name="present")
        self._constants: dict[str, Data] = {}
        for static in robot.constants:
            family = static.family(graph)
            if not (static.known or at_start):
                self._constants[static.name] = graph.data(f"{static.name}, given", static.values)
                graph.fix(family, self._constants[static.name], name=f"{static.name}, given")
            elif not static.known:
                graph.fix(family, static.values, name=f"{static.name}, given")

    def data(self, now: Context[Any]) -> dict[Data, ArrayLike]:
        """Data of a given present."""
        found: dict[Data, ArrayLike] = {self._start: now.present}
        return found | {data: now.constants[name] for name, data in self._constants.items()}

    def begin(self, guess: Guess, now: Context[Any]) -> Guess:
        """The guess as it is."""
        return guess

    def believed(self, solution: Solution) -> None:
        """Nothing but what was given."""


class JointPresent:
    """The present state and the constants are estimated in the same solve as the plan.

    Costs of the future pull on the estimate; how far, is bounded, around what the past alone says.

    Attributes:
        ahead: the nodes of the future, of one trajectory with those of the past.
        along: families that run along time.
        past: the terms of the window.
    """

    def __init__(self, graph: Graph, window: Window, steps: int, pull: float | Sequence[float] | Array) -> None:
        """State the past's terms, and bound the pull.

        Args:
            graph: to state it in.
            window: of the past.
            steps: N of the future.
            pull: how far the future may move the present state and the constants from where the past alone puts them:
                a number, in standard deviations by the past alone, each coordinate by itself; or (d,) for the state,
                in the units of its tangent space, and nothing for the constants. Infinite for no bound.

        Raises:
            GraphError: unless the pull is positive and fits; without any, the coupling is the sequential one.
        """
        dim = window.robot.state.dim
        try:
            bound = np.array(pull, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise GraphError(f"the pull must be a number or ({dim},), got {pull}") from error
        if bound.shape not in ((), (dim,)):
            raise GraphError(f"the pull must be a number or ({dim},), got {bound.shape}")
        if not np.all(bound > 0.0):
            raise GraphError(f"the pull must be positive, got {pull}: without any, the coupling is 'sequential'")
        robot, length = window.robot, window.length
        x = graph.variables("x", robot.state, length + steps + 1)
        for static in robot.constants:
            static.family(graph)
        behind, self.ahead = x[: length + 1], x[length:]
        self.past: Past = window.past_in(graph, behind)
        self.along: tuple[Family, ...] = (x, *self.past.families)
        self._window, self._present, self._length = window, self.ahead[0], length
        self._limits: list[tuple[str | None, Data, Data, Data]] = []
        self._pull = bound
        if bound.ndim:
            self._bound(graph, "state", self._present, None)
        elif np.isfinite(bound):
            self._bound(graph, "state", self._present, None)
            for static in robot.constants:
                if not static.known:
                    self._bound(graph, static.name, graph.families[static.name][:], static.name)

    def _bound(self, graph: Graph, name: str, variable: Selection, key: str | None) -> None:
        manifold, count = variable.manifold, len(variable)
        place = graph.data(f"{name}, by the past", np.tile(manifold.identity(), (count, 1)), each=True)
        limits = np.ones((count, manifold.dim))
        lower = graph.data(f"{name}, pulled at least", -limits, each=True)
        upper = graph.data(f"{name}, pulled at most", limits, each=True)
        graph.constrain(prior, variable, place, lower=lower, upper=upper, name=f"pull of {name}")
        self._limits.append((key, place, lower, upper))

    def data(self, now: Context[Any]) -> dict[Data, ArrayLike]:
        """Data of the window, and of the reference of a bounded pull."""
        found = self.past.data(now)
        for key, place, lower, upper in self._limits:
            shape = lower.value.shape
            if self._pull.ndim:
                bound = np.broadcast_to(self._pull, shape)
            else:
                first = 0 if key is None else self._window.place(key).start
                variance = np.diag(self._window.covariance)[first : first + lower.value.size]
                bound = self._pull * np.sqrt(np.maximum(variance, LEAST_SIGMA**2)).reshape(shape)
            found |= {place: now.present[None] if key is None else now.constants[key], lower: -bound, upper: bound}
        return found

    def begin(self, guess: Guess, now: Context[Any]) -> Guess:
        """The nodes up to the present, the steps and the constants as the past alone says; the rest from the guess.

        A shifted plan begins where the last tick expected the robot; that gives way to what is known now.
        """
        x = self.ahead.family
        given = np.asarray(guess.values[x])
        nodes = np.concatenate([self.past.nodes(), given[self._length + 1 :]])
        return replace(guess, values={**guess.values, **self.past.guess(), x: nodes})

    def believed(self, solution: Solution) -> tuple[Array, dict[str, Array]]:
        """Estimate taken from the solve."""
        return solution[self._present][0], {family.name: solution[family] for family in self.past.constants}


def couple(
    coupling: Coupling,
    graph: Graph,
    robot: Robot,
    window: Window | None,
    steps: int,
    pull: float | Sequence[float] | Array,
) -> PresentCoupling:
    """The coupling that a horizon asks for; ``pull`` as of :class:`JointPresent`.

    Raises:
        GraphError: "joint" without a window, or with one of another robot.
    """
    if coupling != "joint":
        return FixedPresent(graph, robot, steps, coupling == "separate")
    if window is None:
        raise GraphError("the coupling 'joint' needs a window: there is no past to join")
    if window.robot is not robot:
        raise GraphError("the window is of another robot")
    return JointPresent(graph, window, steps, pull)


def weighed(loss: Loss, weight: float) -> Loss | None:
    """The loss of s that is ``weight`` times a loss of s / weight; None where only its author knows.

    All shipped ones are homogeneous: it is the same formula, which bends at another place.
    """
    if type(loss) is DCS:
        return replace(loss, phi=loss.phi * weight)
    if type(loss) is Huber or type(loss) is Tukey or type(loss) is TruncatedLeastSquares:
        return replace(loss, threshold=loss.threshold * sqrt(weight))
    if type(loss) is Cauchy or type(loss) is GemanMcClure:
        return replace(loss, scale=loss.scale * sqrt(weight))
    if type(loss) is Reweighted:
        return Reweighted(partial(_stretched, loss.rule, weight))
    return None


def _stretched(rule: Callable[[Array], Array], weight: float, squared: Array) -> Array:
    """A rule of s applied to s / weight."""
    return rule(squared / weight)


def weigh(terms: Sequence[Stated], weight: float) -> None:
    """Multiply costs, as they have been stated, by a common weight; losses bend where they did.

    Prices of soft constraints are costs, too.

    Raises:
        GraphError: when the weight is not one: for a cost that is not a square, whose standard deviations or prices are
            data, or whose loss is not one of the library's.
    """
    if weight == 1.0:
        return
    for term in terms:
        slack = term.slack if isinstance(term, Constraint) else None
        weights: tuple[Any, ...] = () if slack is None else (slack.soft.linear, slack.soft.quadratic)
        if isinstance(term, Cost):
            weights = term.sigma, term.information
        if isinstance(term, ScalarCost) or any(isinstance(own, Data) for own in weights):
            raise GraphError(
                f"term '{term.name}' cannot be weighed by control_weight: state its weight in the term", term=term.name
            )
        if isinstance(term, Cost) and term.robust is not None:
            loss = weighed(term.robust, weight)
            if loss is None:
                raise GraphError(
                    f"term '{term.name}': its loss {type(term.robust).__name__} cannot be weighed by control_weight: "
                    "state its weight in the loss",
                    term=term.name,
                )
            term.robust = loss
        if isinstance(term, Constraint) and slack is not None:
            term.slack = replace(slack, soft=Soft(*(weight * np.asarray(price) for price in weights)))
        if isinstance(term, Cost) and term.information is not None:
            term.information = np.asarray(term.information, dtype=np.float64) * weight
        elif isinstance(term, Cost):
            sigma = 1.0 if term.sigma is None else term.sigma
            term.sigma = np.asarray(sigma, dtype=np.float64) / np.sqrt(weight)
