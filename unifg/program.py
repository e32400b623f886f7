"""A compiled graph: offsets, ordering and sparsity once; values, Jacobians and gradients as often as needed.

Backends see only this. Rows of costs are whitened and weighted, so the objective is 1/2 |r|^2 plus scalar
costs; rows of constraints read ``lower <= g <= upper``. Columns are tangent coordinates of the unknowns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from unifg.columns import Columns
from unifg.compiled import CompiledTerm, Values
from unifg.differentiation import convexified
from unifg.errors import GraphError
from unifg.linear import Factorization
from unifg.linearization import Evaluation, HeldWeights, Linearization
from unifg.sparse import Gram, Rows, Symmetric, scatter, upper_pairs
from unifg.terms import Constraint, Cost, ScalarCost
from unifg.typing import Array, ArrayLike, BoolArray, IntArray
from unifg.variables import Data, Family

if TYPE_CHECKING:
    from unifg.graph import Graph


class Program:
    """The compiled form of a graph.

    Attributes:
        graph: what was compiled.
        columns: numbering of the tangent coordinates.
        size: number of unknown ones.
        costs, constraints: patterns of the stacked Jacobians.
        hessian: pattern of the Gauss-Newton Hessian of the objective.
        normal: pattern of the same plus A'A.
        lower, upper: (M,) limits with the present data.
        cost_terms, scalar_terms, constraint_terms: compiled terms in row order.
        slices: rows of each constraint term.
        bound_rows: (M,) whether a row bounds an unknown itself.
    """

    def __init__(self, graph: Graph) -> None:
        """Compile; see :meth:`unifg.Graph.compile`."""
        if not graph.families:
            raise GraphError("the graph has no variables: add a family with graph.variables(...)")
        self.graph = graph
        self.families = list(graph.families.values())
        self.columns = Columns(self.families, graph.fixes)
        self.size = self.columns.size
        self.terms = [CompiledTerm(term) for term in graph.terms]
        self.cost_terms = [c for c in self.terms if isinstance(c.term, Cost)]
        self.scalar_terms = [c for c in self.terms if isinstance(c.term, ScalarCost)]
        self.constraint_terms = [c for c in self.terms if isinstance(c.term, Constraint)]
        self._require_touched()
        self.costs, self._cost_gram, self._cost_slices = self._stack(self.cost_terms)
        self.constraints, self._constraint_gram, self.slices = self._stack(self.constraint_terms)
        self.bound_rows = np.zeros(self.constraints.count, dtype=bool)
        for term, rows in zip(self.constraint_terms, self.slices, strict=True):
            self.bound_rows[rows] = term.is_bound
        costs, constraints = self._cost_gram.coordinates, self._constraint_gram.coordinates
        scalars = self._scalar_blocks()
        self.hessian = Symmetric(self.size, [costs, scalars])
        self.normal = Symmetric(self.size, [costs, constraints, scalars])
        self._in_hessian = [self.hessian.positions(*part) for part in (costs, scalars)]
        self._in_normal = [self.normal.positions(*part) for part in (costs, constraints, scalars)]
        self.bind({})

    # ---------------------------------------------------------------- data and values

    def bind(self, data: Mapping[Data, ArrayLike]) -> None:
        """Take new data; everything not named returns to its default.

        Raises:
            GraphError: on unknown data, a changed shape, NaN, or crossed limits.
        """
        checked = {}
        for handle, value in data.items():
            if self.graph._data.get(getattr(handle, "name", "")) is not handle:
                raise GraphError(f"data {handle!r} does not belong to this graph")
            checked[handle] = handle.check(value)
        self.data = checked
        for term in self.terms:
            term.bind(checked)
        self.lower = _stacked([c.lower for c in self.constraint_terms])
        self.upper = _stacked([c.upper for c in self.constraint_terms])
        crossed = np.flatnonzero(self.lower > self.upper)
        if len(crossed):
            name, index = self.row_name(int(crossed[0]))
            raise GraphError(f"term '{name}': lower exceeds upper in factor {index}", term=name, index=index)
        self.equality = self.lower == self.upper
        self.fixed_values = [
            (
                fix,
                np.asarray(checked.get(fix.value, fix.value.value) if isinstance(fix.value, Data) else fix.value),
            )
            for fix in self.graph.fixes
        ]

    def values_from(self, guess: Mapping[Family, ArrayLike]) -> Values:
        """Copy and check a guess, and give fixed variables their values.

        Raises:
            GraphError: naming the family and index of what is missing, misshapen, NaN or off its manifold.
        """
        for family in guess:
            if not isinstance(family, Family) or self.graph.families.get(family.name) is not family:
                raise GraphError(f"the guess contains {family!r}, which is no family of this graph")
        values: Values = {}
        for family in self.families:
            shape = (family.count, family.manifold.storage)
            if family not in guess:
                if not self.columns.all_fixed(family):
                    raise GraphError(
                        f"the guess has no values for family '{family.name}': give an array of shape {shape}",
                        family=family.name,
                    )
                values[family] = np.tile(family.manifold.identity(), (family.count, 1))
                continue
            array = np.array(guess[family], dtype=np.float64)
            if array.shape != shape:
                raise GraphError(
                    f"the guess for family '{family.name}' has shape {array.shape}, expected {shape}",
                    family=family.name,
                )
            values[family] = array
        for fix, value in self.fixed_values:
            selection = fix.selection
            values[selection.family][selection.indices, selection.storage] = value
        for family, array in values.items():
            valid = family.manifold.is_valid(array)
            if not valid.all():
                index = int(np.flatnonzero(~valid)[0])
                raise GraphError(
                    f"the guess for {family.name}[{index}] is not on {family.manifold.name}: {array[index]}",
                    family=family.name,
                    index=index,
                )
        return values

    def retract(self, values: Values, step: Array) -> Values:
        """Move the unknowns by a tangent step; fixed variables stay."""
        full = np.zeros(self.columns.width)
        full[self.columns.free] = step
        moved: Values = {}
        for family, array in values.items():
            offset = self.columns.offsets[family]
            part = full[offset : offset + family.count * family.manifold.dim]
            moved[family] = family.manifold.retract(array, part.reshape(family.count, family.manifold.dim))
        for fix, value in self.fixed_values:  # retract may wrap or renormalise; a fixed value stays as given
            moved[fix.selection.family][fix.selection.indices, fix.selection.storage] = value
        return moved

    def within_bounds(self, values: Values) -> Values:
        """The nearest values that respect every bound of an unknown; ``values`` itself when all do."""
        moved: Values = {}
        for term in self.constraint_terms:
            if not term.is_bound:
                continue
            selection = term.gathers[0].selection
            array = moved.get(selection.family, values[selection.family]).copy()
            part = array[selection.indices, selection.storage]
            array[selection.indices, selection.storage] = np.clip(part, term.lower, term.upper)
            for fix, value in self.fixed_values:
                if fix.selection.family is selection.family:
                    array[fix.selection.indices, fix.selection.storage] = value
            if not np.array_equal(array, values[selection.family]):
                moved[selection.family] = array
        return {**values, **moved} if moved else values

    # ---------------------------------------------------------------- evaluation

    def evaluate(self, values: Values, weights: HeldWeights | None = None) -> Evaluation:
        """Objective and constraints; ``weights`` are those of the linearisation whose line search this is."""
        cost = 0.0
        with np.errstate(all="ignore"):
            for term in self.cost_terms:
                assert isinstance(term.term, Cost)
                whitened = term.whiten(term.residual(values))
                loss = term.term.robust
                if loss is None:
                    cost += 0.5 * float(np.vdot(whitened, whitened))
                    continue
                squared = np.einsum("nm,nm->n", whitened, whitened)
                held = weights.get(term.name) if weights else None
                cost += 0.5 * float((loss.value(squared) if held is None else held * squared).sum())
            for term in self.scalar_terms:
                cost += float(term.residual(values).sum())
            constraints = [term.residual(values).ravel() for term in self.constraint_terms]
        return Evaluation(cost, _stacked(constraints))

    def linearize(self, values: Values, search: bool = False) -> Linearization:
        """Everything a backend needs at ``values``; with ``search``, by search Jacobians where a residual has one."""
        residual = np.empty(self.costs.count)
        jacobian = np.empty(len(self.costs.rows))
        constraints = np.empty(self.constraints.count)
        constraint_jacobian = np.empty(len(self.constraints.rows))
        norms: dict[str, float] = {}
        weights: HeldWeights = {}
        cost, at = 0.0, 0
        with np.errstate(all="ignore"):
            for term, rows in zip(self.cost_terms, self._cost_slices, strict=True):
                assert isinstance(term.term, Cost)
                whitened = term.whiten(term.residual(values))
                blocks = [term.whiten_jacobian(block) for block in term.jacobians(values, search=search)]
                loss = term.term.robust
                squared_sum = float(np.vdot(whitened, whitened))
                norms[term.name] = squared_sum**0.5
                if loss is None:
                    cost += 0.5 * squared_sum
                else:
                    squared = np.einsum("nm,nm->n", whitened, whitened)
                    weight = loss.weight(squared)
                    cost += 0.5 * float(loss.value(squared).sum())
                    root = np.sqrt(weight)[:, None]
                    whitened = whitened * root
                    blocks = [block * root[:, :, None] for block in blocks]
                    if loss.held:
                        weights[term.name] = weight
                residual[rows] = whitened.ravel()
                at = _write(jacobian, at, blocks)
            at = 0
            for term, rows in zip(self.constraint_terms, self.slices, strict=True):
                value = term.residual(values)
                constraints[rows] = value.ravel()
                if term.is_bound:
                    constraint_jacobian[at : at + value.size] = 1.0
                    at += value.size
                else:
                    at = _write(constraint_jacobian, at, term.jacobians(values, search=search))
                beyond = np.maximum(value - term.upper, term.lower - value)
                norms[term.name] = float(np.linalg.norm(np.maximum(beyond, 0.0)))
            gradient = self.costs.transposed_times(jacobian, residual)
            hessians = []
            for term, columns in zip(self.scalar_terms, self._scalar_columns, strict=True):
                value = term.residual(values)
                cost += float(value.sum())
                norms[term.name] = float(np.abs(value).sum())
                slope, curvature = term.scalar_derivatives(values)
                gradient += scatter(columns.ravel(), slope.ravel(), self.columns.width)
                hessians.append(convexified(curvature)[self._scalar_keep[term.name]])
        return Linearization(
            values,
            cost,
            residual,
            jacobian,
            constraints,
            constraint_jacobian,
            gradient,
            _stacked(hessians),
            norms,
            weights,
        )

    # ---------------------------------------------------------------- products backends need

    def hessian_entries(self, lin: Linearization) -> Array:
        """Gauss-Newton Hessian of the objective in the order of ``hessian``."""
        parts = [self._cost_gram.products(lin.jacobian), lin.scalar_hessian]
        return _summed(self._in_hessian, parts, self.hessian.nnz)

    def normal_entries(self, lin: Linearization, row_weights: Array) -> Array:
        """Gauss-Newton Hessian plus A' diag(row_weights) A, in the order of ``normal``."""
        parts = [
            self._cost_gram.products(lin.jacobian),
            self._constraint_gram.products(lin.constraint_jacobian, row_weights),
            lin.scalar_hessian,
        ]
        return _summed(self._in_normal, parts, self.normal.nnz)

    def free_gradient(self, lin: Linearization) -> Array:
        """Gradient of the objective over the unknowns."""
        return lin.gradient[self.columns.free]

    def lagrangian_gradient(self, lin: Linearization, multipliers: Array) -> Array:
        """Gradient of the objective plus A' multipliers, over the full tangent space."""
        if not self.constraints.count:
            return lin.gradient
        return lin.gradient + self.constraints.transposed_times(lin.constraint_jacobian, multipliers)

    def violation(self, constraints: Array) -> Array:
        """(M,) signed distance outside the limits: positive above, negative below, zero inside."""
        return np.maximum(constraints - self.upper, 0.0) - np.maximum(self.lower - constraints, 0.0)

    def normal_solver(self) -> Factorization:
        """A factorisation for matrices in the pattern ``normal``."""
        return Factorization(self.normal)

    # ---------------------------------------------------------------- names

    def row_name(self, row: int) -> tuple[str, int]:
        """Term and factor of a constraint row."""
        for term, rows in zip(self.constraint_terms, self.slices, strict=True):
            if rows.start <= row < rows.stop:
                return term.name, (row - rows.start) // term.size
        raise IndexError(row)

    def cost_rows(self, names: Sequence[str]) -> BoolArray:
        """(C,) whether each cost row belongs to one of the named terms.

        Raises:
            GraphError: when no least-squares cost has such a name.
        """
        chosen = np.zeros(self.costs.count, dtype=bool)
        slices = {term.name: rows for term, rows in zip(self.cost_terms, self._cost_slices, strict=True)}
        for name in names:
            if name not in slices:
                raise GraphError(f"no cost is called '{name}' (there are: {', '.join(slices) or 'none'})", term=name)
            chosen[slices[name]] = True
        return chosen

    # ---------------------------------------------------------------- compilation

    def _term_columns(self, term: CompiledTerm) -> list[IntArray]:
        """(n, d_k) full columns of each variable argument."""
        parts = [self.columns.of(selection) for selection in term.term.selections]
        return [np.broadcast_to(part, (term.count, part.shape[1])) for part in parts]

    def _stack(self, terms: list[CompiledTerm]) -> tuple[Rows, Gram, list[slice]]:
        rows, columns, blocks, slices = [], [], [], []
        row = entry = 0
        for term in terms:
            n, m = term.count, term.size
            own_rows = row + np.arange(n * m).reshape(n, m)
            slices.append(slice(row, row + n * m))
            row += n * m
            arguments = self._term_columns(term)
            if term.is_bound:  # the Jacobian is the identity: one entry a row
                rows.append(own_rows.ravel())
                columns.append(arguments[0].ravel())
                blocks.append((entry + np.arange(n * m).reshape(-1, 1, 1), arguments[0].reshape(-1, 1)))
                entry += n * m
                continue
            parts = []
            for argument in arguments:
                shape = (n, m, argument.shape[1])
                rows.append(np.broadcast_to(own_rows[:, :, None], shape).ravel())
                columns.append(np.broadcast_to(argument[:, None, :], shape).ravel())
                parts.append(entry + np.arange(n * m * argument.shape[1]).reshape(shape))
                entry += n * m * argument.shape[1]
            blocks.append((np.concatenate(parts, axis=2), np.concatenate(arguments, axis=1)))
        none = [np.zeros(0, dtype=np.intp)]
        unknown = self.columns.unknown
        stacked = Rows(row, np.concatenate(rows + none), np.concatenate(columns + none), unknown, self.size)
        return stacked, Gram(blocks, stacked, unknown), slices

    def _scalar_blocks(self) -> tuple[IntArray, IntArray]:
        """(row, column) of the Hessian entries of scalar costs, and how to pick them from the blocks."""
        self._scalar_columns: list[IntArray] = []
        self._scalar_keep: dict[str, tuple[IntArray, IntArray, IntArray]] = {}
        none = np.zeros(0, dtype=np.intp)
        rows, columns = [none], [none]
        for term in self.scalar_terms:
            full = np.concatenate(self._term_columns(term), axis=1)
            mapped, factor, a, b = upper_pairs(full, self.columns.unknown)
            self._scalar_columns.append(full)
            self._scalar_keep[term.name] = (factor, a, b)
            rows.append(mapped[factor, a])
            columns.append(mapped[factor, b])
        return np.concatenate(rows), np.concatenate(columns)

    def _require_touched(self) -> None:
        touched = np.zeros(self.columns.width, dtype=bool)
        for term in self.terms:
            for columns in self._term_columns(term):
                touched[columns] = True
        idle = self.columns.free[~touched[self.columns.free]]
        if len(idle):
            family, index = self.columns.name(int(idle[0]))
            raise GraphError(
                f"{family}[{index}] is in no cost or constraint and is not fixed: {len(idle)} tangent coordinates "
                "are free to be anything; add a term, fix it, or make the family shorter",
                family=family,
                index=index,
            )


def _write(target: Array, at: int, blocks: list[Array]) -> int:
    """Copy blocks into ``target`` from position ``at``; return the next position."""
    for block in blocks:
        target[at : at + block.size] = block.ravel()
        at += block.size
    return at


def _stacked(parts: list[Array]) -> Array:
    """One flat array, also of nothing."""
    return np.concatenate([part.ravel() for part in parts]) if parts else np.zeros(0)


def _summed(slots: list[IntArray], parts: list[Array], size: int) -> Array:
    """Scatter several lists of numbers into one array."""
    total = scatter(slots[0], parts[0], size)
    for place, numbers in zip(slots[1:], parts[1:], strict=True):
        if len(place):
            total += scatter(place, numbers, size)
    return total
