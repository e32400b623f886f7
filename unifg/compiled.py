"""One term, ready to run: gathers its variables, evaluates in one batched call, whitens, weighs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np

from unifg.differentiation import gradient_and_hessian, jacobian
from unifg.errors import GraphError
from unifg.terms import Constraint, Cost, Parameter, ScalarCost, Term
from unifg.typing import Array, BoolArray, IntArray
from unifg.variables import Data, Family, Selection

Values: TypeAlias = dict[Family, Array]
Bound: TypeAlias = Mapping[Data, Array]


class Gather:
    """Reads one variable argument of a term out of the values, one row per factor."""

    def __init__(self, selection: Selection, count: int) -> None:
        """Precompute the cheapest way to index."""
        self.family = selection.family
        self.selection = selection
        self.shared = len(selection) == 1 and count > 1
        self.count = count
        indices = selection.indices
        self.rows: slice | IntArray = indices
        if len(indices) == 1 or bool(np.all(np.diff(indices) == 1)):
            self.rows = slice(int(indices[0]), int(indices[-1]) + 1)
        self.columns = None if selection.component is None else selection.storage

    def __call__(self, values: Values) -> Array:
        """(n, storage) values of this argument."""
        part = values[self.family][self.rows]
        if self.columns is not None:
            part = part[:, self.columns]
        return np.broadcast_to(part, (self.count, part.shape[1])) if self.shared else part


class CompiledTerm:
    """A term with its shapes known.

    Attributes:
        term: what the user stated.
        name: the term's name.
        count: factors n.
        size: residual dimension m.
        dims: tangent dimension of each variable argument.
    """

    def __init__(self, term: Term) -> None:
        """Find the residual's dimension by one evaluation at identity elements."""
        self.term = term
        self.name = term.name
        self.count = term.count
        self.gathers = [Gather(s, term.count) for s in term.selections]
        self.manifolds = [s.manifold for s in term.selections]
        self.dims = [manifold.dim for manifold in self.manifolds]
        self._places = [k for k, a in enumerate(term.arguments) if isinstance(a, Selection)]
        self._function = term.residual.function
        self._jacobian = term.residual.jacobian
        self.is_bound = isinstance(term, Constraint) and term.is_bound
        self.bind({})
        with np.errstate(all="ignore"):
            trial = np.asarray(
                self._call([np.tile(m.identity(), (self.count, 1)) for m in self.manifolds]), dtype=np.float64
            )
        scalar = isinstance(term, ScalarCost)
        expected = "(n,)" if scalar else "(n, m)"
        if trial.ndim != (1 if scalar else 2) or len(trial) != self.count:
            raise GraphError(
                f"term '{self.name}': its function returned shape {trial.shape}, expected {expected} with "
                f"n = {self.count}; arguments were {self._shapes()}",
                term=self.name,
            )
        self.size = 1 if scalar else trial.shape[1]
        self.shape = trial.shape
        self._bind_parameters({})

    def bind(self, data: Bound) -> None:
        """Take the present value of every data argument."""
        self._data = data
        self._arguments: list[Any] = [data.get(a, a.value) if isinstance(a, Data) else a for a in self.term.arguments]
        active = self.term.active
        mask = data.get(active, active.value) if isinstance(active, Data) else active
        self.active: BoolArray | None = None if mask is None or mask.all() else mask.astype(bool)
        if hasattr(self, "size"):
            self._bind_parameters(data)

    def residual(self, values: Values) -> Array:
        """(n, m) residuals, zero where inactive, not whitened; (n,) for a scalar cost."""
        return self._masked(self._checked(self._call([gather(values) for gather in self.gathers])))

    def jacobians(self, values: Values, numerical: bool = False, search: bool = False) -> list[Array]:
        """One (n, m, d_k) array per variable argument, zero where inactive.

        Args:
            values: where to differentiate.
            numerical: differentiate numerically even when a Jacobian is attached.
            search: prefer the residual's search Jacobian, which is not a derivative.
        """
        attached = self.term.residual.search if search and self.term.residual.search else self._jacobian
        points = [gather(values) for gather in self.gathers]
        if attached is None or numerical:
            blocks = jacobian(lambda *moved: np.asarray(self._call(list(moved))), points, self.manifolds)
        else:
            blocks = [np.asarray(block, dtype=np.float64) for block in attached(*self._fill(points))]
            if len(blocks) > len(self.dims) and len(blocks) > max(self._places):
                blocks = [blocks[place] for place in self._places]  # some of its arguments are constants here
            wanted = [(self.count, self.size, dim) for dim in self.dims]
            if [block.shape for block in blocks] != wanted:
                raise GraphError(
                    f"term '{self.name}': the attached Jacobian returned shapes {[b.shape for b in blocks]}, "
                    f"expected {wanted}",
                    term=self.name,
                )
        return [self._masked(block) for block in blocks]

    def scalar_derivatives(self, values: Values) -> tuple[Array, Array]:
        """Gradient (n, D) and Hessian (n, D, D) of a scalar cost, zero where inactive."""
        points = [gather(values) for gather in self.gathers]
        gradient, hessian = gradient_and_hessian(lambda *p: np.asarray(self._call(list(p))), points, self.manifolds)
        return self._masked(gradient), self._masked(hessian)

    def whiten(self, residual: Array) -> Array:
        """W r for every factor."""
        if self._diagonal is not None:
            return residual * self._diagonal
        if self._root is not None:
            return (self._root @ residual[:, :, None])[:, :, 0]
        return residual

    def whiten_jacobian(self, block: Array) -> Array:
        """W J for every factor."""
        if self._diagonal is not None:
            return block * self._diagonal[..., None]
        if self._root is not None:
            whitened: Array = self._root @ block
            return whitened
        return block

    def _bind_parameters(self, data: Bound) -> None:
        term = self.term
        self._diagonal: Array | None = None
        self._root: Array | None = None
        if isinstance(term, Cost):
            if term.sigma is not None:
                self._diagonal = 1.0 / self._sigma(resolve(term.sigma, data))
            if term.information is not None:
                self._root = self._square_root(resolve(term.information, data))
        if isinstance(term, Constraint):
            self.lower = self._limit(resolve(term.lower, data), "lower", -np.inf)
            self.upper = self._limit(resolve(term.upper, data), "upper", np.inf)

    def _sigma(self, sigma: Array) -> Array:
        if sigma.shape not in ((), (self.size,), (self.count, self.size)):
            raise GraphError(
                f"term '{self.name}': sigma has shape {sigma.shape}, expected (), ({self.size},) or {self.shape}",
                term=self.name,
            )
        if not (np.isfinite(sigma).all() and (sigma > 0.0).all()):
            raise GraphError(f"term '{self.name}': sigma must be positive and finite", term=self.name)
        return sigma

    def _square_root(self, information: Array) -> Array:
        m = self.size
        if information.shape not in ((m, m), (self.count, m, m)):
            raise GraphError(
                f"term '{self.name}': information has shape {information.shape}, expected {(m, m)} or "
                f"{(self.count, m, m)}",
                term=self.name,
            )
        transposed = np.swapaxes(information, -1, -2)
        if not np.isfinite(information).all() or not np.allclose(information, transposed, rtol=1e-9, atol=0.0):
            raise GraphError(f"term '{self.name}': information must be finite and symmetric", term=self.name)
        eigenvalues, vectors = np.linalg.eigh(information)
        lowest = eigenvalues.min(axis=-1) / np.maximum(np.abs(eigenvalues).max(axis=-1), 1e-300)
        if (lowest < -1e-9).any():
            index = int(np.argmin(np.atleast_1d(lowest)))
            raise GraphError(
                f"term '{self.name}': information of factor {index} has a negative eigenvalue",
                term=self.name,
                index=index,
            )
        root: Array = np.sqrt(np.maximum(eigenvalues, 0.0))[..., :, None] * np.swapaxes(vectors, -1, -2)
        return root

    def _limit(self, limit: Array, which: str, none: float) -> Array:
        try:
            full = np.array(np.broadcast_to(limit, (self.count, self.size)))
        except ValueError as error:
            raise GraphError(
                f"term '{self.name}': {which} has shape {limit.shape}, which does not fit {self.shape}",
                term=self.name,
            ) from error
        if self.active is not None:
            full[~self.active] = none
        return full

    def _call(self, points: list[Array]) -> Array:
        result = self._function(*self._fill(points))
        return result if isinstance(result, np.ndarray) else np.asarray(result, dtype=np.float64)

    def _fill(self, points: list[Array]) -> list[Any]:
        arguments = list(self._arguments)
        for place, point in zip(self._places, points, strict=True):
            arguments[place] = point
        return arguments

    def _checked(self, residual: Array) -> Array:
        if residual.shape != self.shape:
            raise GraphError(
                f"term '{self.name}': its function returned shape {residual.shape}, and {self.shape} before",
                term=self.name,
            )
        return residual

    def _masked(self, array: Array) -> Array:
        if self.active is None:
            return array
        shape = (-1,) + (1,) * (array.ndim - 1)
        return np.where(self.active.reshape(shape), array, 0.0)

    def _shapes(self) -> str:
        """Shapes of all arguments, for messages."""
        shapes = []
        for argument in self.term.arguments:
            if isinstance(argument, Selection):
                shapes.append(f"{argument!r} as ({self.count}, {argument.manifold.storage})")
            elif isinstance(argument, Data):
                shapes.append(repr(argument))
            else:
                shapes.append(f"constant {np.shape(argument)}" if np.shape(argument) else f"{argument!r}")
        return ", ".join(shapes)


def resolve(parameter: Parameter, data: Bound) -> Array:
    """The present value of a parameter."""
    if isinstance(parameter, Data):
        return data.get(parameter, parameter.value)
    return np.asarray(parameter, dtype=np.float64)
