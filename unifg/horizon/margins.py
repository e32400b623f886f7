"""Margins for the uncertainty of the estimate: limits on states of the future, tightened by standard deviations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from unifg.errors import GraphError
from unifg.horizon.robot import Robot, numbers
from unifg.horizon.window import Window
from unifg.lie.manifold import LieGroup
from unifg.modeling.soft import Soft
from unifg.modeling.terms import Constraint, Parameter, Term
from unifg.modeling.variables import Data, Selection
from unifg.problem.columns import Values
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.term import CompiledTerm
from unifg.solution.graph import Graph
from unifg.solution.guess import Guess
from unifg.typing import Array, ArrayLike

WIDEST = 0.45  # of what lies between two limits, so that something is left between them
ROUNDING = 1e-9  # of a covariance, and of a variance against that without cancellation
PRICE = 100.0  # of one standard deviation less than wanted, in units of cost: squared standard deviations


@dataclass(frozen=True)
class Tightened:
    """A constraint with a margin.

    Attributes:
        name: of the constraint as it is stated.
        count: number of standard deviations.
        limits: lower and upper limit as they are stated, with the data that stand for them and the sign of a margin.
        price: of the margin of a hard constraint; None for a soft one, which has its own.
    """

    name: str
    count: float
    limits: tuple[tuple[Parameter, Data, float], ...]
    price: Data | None


class Margins:
    """Data of the inequality constraints on states of the future, whose limits follow the covariance of the present.

    A row g(x) is tightened by ``sigmas`` standard deviations of g, to first order at the guess of the solve. An error
    of the present moves the whole plan with it: as one rigid body where the state is a group, since Ad(x_k^-1 x_0)
    leads from the tangent space of the present to that of node k, and by equal tangent coordinates where it is none.
    Estimated constants enter with their covariance and their correlation with the state.

    A soft constraint is tightened itself. A hard one holds as it is stated, and with its margin once more as a soft one
    of the name "..., with a margin", which gives way where no plan keeps it, at `PRICE` for a standard deviation.
    """

    def __init__(
        self,
        graph: Graph,
        terms: Sequence[Term],
        sigmas: float | Mapping[str, float] | None,
        robot: Robot,
        x: Selection,
        window: Window | None,
    ) -> None:
        """Let the limits of stated constraints be data.

        Args:
            graph: that they are stated in.
            terms: of the future.
            sigmas: of all inequality constraints and bounds on states, or by their names; None for no margin.
            robot: who moves.
            x: (N + 1) nodes of the future.
            window: of the past, whose covariance is that of a tick; None where each is given.

        Raises:
            GraphError: when a number is negative or not finite, or a name is none of such a constraint.
        """
        self._robot, self._x, self._window = robot, x, window
        self._columns = {name: robot.state.dim + places for name, places in robot.places("dim").items()}
        self._size = robot.state.dim + sum(columns.size for columns in self._columns.values())
        own = {term.name: term for term in terms if isinstance(term, Constraint) and self._limits_state(term)}
        known = ", ".join(f"'{name}'" for name in own)
        given = dict(sigmas) if isinstance(sigmas, Mapping) else dict.fromkeys(own, 0.0 if sigmas is None else sigmas)
        numbers(0.0 if isinstance(sigmas, Mapping | None) else sigmas, (), f"sigmas of {known or 'all limits'}")
        chosen = {name: float(numbers(count, (), f"sigmas of '{name}'")) for name, count in given.items()}
        for name, count in chosen.items():
            if name not in own:
                raise GraphError(
                    f"sigmas: '{name}' is no inequality constraint on states (there are: {known or 'none'})", term=name
                )
            if count < 0.0:
                raise GraphError(f"sigmas: {count} standard deviations for '{name}': a number from 0 on", term=name)
        self._tightened = [self._tighten(graph, own[name], count) for name, count in chosen.items() if count]
        used = {handle for term in graph.terms for handle in term.data} | {h for fix in graph.fixes for h in fix.data}
        stated = {limit for one in self._tightened for limit, _, _ in one.limits if isinstance(limit, Data)}
        self._replaced = stated - used

    def __bool__(self) -> bool:
        """Test whether any constraint has a margin."""
        return bool(self._tightened)

    def _limits_state(self, term: Constraint) -> bool:
        """Test whether a constraint is an inequality about nodes of the future."""
        return term.kind != "equality" and any(own.family is self._x.family for own in term.selections)

    @staticmethod
    def _tighten(graph: Graph, term: Constraint, count: float) -> Tightened:
        """Let the limits of a soft constraint be data, or state a hard one once more."""
        name, shape, limits = f"{term.name}, with a margin", (term.count, term.size), dict[str, Data]()
        stated: list[tuple[Parameter, Data, float]] = []
        for side, sign in (("lower", 1.0), ("upper", -1.0)):
            limit: Parameter = getattr(term, side)
            value = limit.value if isinstance(limit, Data) else np.asarray(limit, dtype=np.float64)
            if isinstance(limit, Data) or np.isfinite(value).any():
                limits[side] = graph.data(f"{name}: {side}", np.broadcast_to(value, shape), each=True)
                stated.append((limit, limits[side], sign))
        if term.soft is not None:
            for side, handle in limits.items():
                setattr(term, side, handle)
            return Tightened(term.name, count, tuple(stated), None)
        price = graph.data(f"{name}: price", np.full(shape, PRICE), each=True)
        graph.constrain(term.residual, *term.given, **limits, active=term.active, soft=Soft(linear=price), name=name)
        return Tightened(term.name, count, tuple(stated), price)

    def data(
        self, program: CompiledProblem, guess: Guess, covariance: ArrayLike | None, given: Mapping[Data, ArrayLike]
    ) -> dict[Data, ArrayLike]:
        """Data of a tick, the limits among them.

        Args:
            program: compiled.
            guess: that the solve begins from.
            covariance: (D, D) of the present state and the robot's constants side by side; None for the window's.
            given: data of the tick but for the margins.

        Raises:
            GraphError: when there is no covariance, or one of another shape.
        """
        if covariance is None and self._window is not None:
            covariance = self._window.covariance
        size = self._size
        if covariance is None:
            raise GraphError(f"sigmas need the covariance of state and constants, ({size}, {size}), or a window")
        spread = numbers(covariance, (size, size), "sigmas: the covariance of state and constants")
        if np.linalg.eigvalsh(spread)[0] < -ROUNDING * np.abs(spread).max():
            raise GraphError("sigmas: the covariance of state and constants has negative variances")
        data = {handle: value for handle, value in given.items() if handle not in self._replaced}
        with program.lock:
            program.bind(data)
            values = program.values_from(guess.values)
            transport = self._transport(values)
            deviations = [
                self._deviation(program.term_named(one.name), values, spread, transport) for one in self._tightened
            ]
        for one, deviation in zip(self._tightened, deviations, strict=True):
            limits = [as_rows(limit, handle, given) for limit, handle, _ in one.limits]
            margin = one.count * deviation
            if len(limits) == 2:
                margin = np.minimum(margin, WIDEST * (limits[1] - limits[0]))
            for stated, (_, handle, sign) in zip(limits, one.limits, strict=True):
                data[handle] = stated + sign * margin
            if one.price is not None:
                data[one.price] = PRICE / np.where(deviation > 0.0, deviation, 1.0)
        return data

    def _transport(self, values: Values) -> Array:
        """(N + 1, d, d) motion of each node, in its tangent space, with the present."""
        kind = self._robot.state
        nodes = values[self._x.family][self._x.indices]
        if isinstance(kind, LieGroup):
            return kind.adjoint(kind.compose(kind.inverse(nodes), np.broadcast_to(nodes[0], nodes.shape)))
        return np.broadcast_to(np.eye(kind.dim), (len(nodes), kind.dim, kind.dim))

    def _deviation(self, term: CompiledTerm, values: Values, covariance: Array, transport: Array) -> Array:
        """(n, m) standard deviations of a term's rows; zero where that is what they are but for rounding."""
        slopes, sizes = np.zeros((2, term.count, term.size, len(covariance)))
        first, dim = int(self._x.indices[0]), self._robot.state.dim
        factors, rows = np.arange(term.count)[:, None, None], np.arange(term.size)[:, None]
        for gather, block in zip(term.gathers, term.jacobians(values), strict=True):
            chosen = gather.selection
            members = np.broadcast_to(chosen.indices, (term.count,))
            if chosen.family is self._x.family:
                moved = block @ transport[members - first][:, chosen.tangent]
                slopes[:, :, :dim] += moved
                sizes[:, :, :dim] += np.abs(moved)
            elif chosen.family.name in self._columns:
                own = self._columns[chosen.family.name][members][:, chosen.tangent]
                slopes[factors, rows, own[:, None]] += block
                sizes[factors, rows, own[:, None]] += np.abs(block)
        variances: Array = np.einsum("nmi,ij,nmj->nm", slopes, covariance, slopes)
        greatest = (sizes @ np.sqrt(np.maximum(covariance.diagonal(), 0.0))) ** 2
        return np.sqrt(np.where(variances > ROUNDING * greatest, variances, 0.0))


def as_rows(limit: Parameter, handle: Data, given: Mapping[Data, ArrayLike]) -> Array:
    """(n, m) limit as it is stated, by the data of a tick."""
    value = given.get(limit, limit.value) if isinstance(limit, Data) else limit
    return np.broadcast_to(np.asarray(value, dtype=np.float64), handle.value.shape)
