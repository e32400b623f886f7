"""From what a user states to the numbers compiled code reads: types of factors, whitening, robust losses."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite, sqrt
from typing import Any

import numpy as np

from unifg.errors import GraphError
from unifg.kernels.kernel import Kernel, side_by_side
from unifg.kernels.per_factor import per_factor
from unifg.kernels.residuals import Residual
from unifg.kernels.robust import Form, Loss, form_of
from unifg.kernels.whitening import DIAGONAL, FULL, reciprocals, square_roots
from unifg.language.factors import prior
from unifg.language.statement import AnyResidual, complete
from unifg.language.variables import as_selection, is_variable
from unifg.lie import Manifold
from unifg.lie.moving import ADDITION, move_of
from unifg.lie.product import leaves
from unifg.machine.jit import compiled, is_compiled
from unifg.smoothing.families import GrowingFamily
from unifg.smoothing.state import SLOTS_MAX
from unifg.typing import Array, ArrayLike, BoolArray, IntArray


@dataclass(eq=False)
class Staged:
    """Factors that wait for the next update.

    Attributes:
        kind: number of their type.
        families: of their variables, in order.
        members: (n,) for each family, or one number where all factors share it.
        data: (n, numbers) parameters, whitener, parameter of the loss.
        name: for messages.
    """

    kind: int
    families: list[GrowingFamily]
    members: list[IntArray | int]
    data: Array
    name: str

    def keep(self, wanted: BoolArray) -> None:
        """Leave out the others."""
        self.members = [m if isinstance(m, int) else m[wanted] for m in self.members]
        self.data = self.data[wanted]


class Types:
    """The types of factors of one smoother: a kernel, how it is whitened, its loss.

    Attributes:
        fields: one row for each type, as TYPE has them.
        scratch: numbers that any of them needs while it is evaluated.
    """

    def __init__(self) -> None:
        """Know none."""
        self.fields: list[tuple[float, ...]] = []
        self.scratch = 8
        self._numbers: dict[tuple[Any, ...], int] = {}
        self._kernels: dict[tuple[Any, ...], Kernel] = {}

    def stage(
        self,
        function: AnyResidual,
        arguments: tuple[Any, ...],
        sigma: ArrayLike | None,
        information: ArrayLike | None,
        robust: Loss | None,
    ) -> Staged:
        """Check a statement and lay out its numbers.

        Raises:
            GraphError: naming the term and what does not fit.
        """
        wrapped = complete(function, arguments)
        name = wrapped.name
        if sigma is not None and information is not None:
            raise GraphError(f"term '{name}': give sigma or information, not both", term=name)
        kernel = self._kernel(wrapped, arguments)
        if len(arguments) != len(kernel.arguments):
            raise GraphError(
                f"term '{name}': {kernel.name} takes {len(kernel.arguments)} arguments, found {len(arguments)}",
                term=name,
            )
        families: list[GrowingFamily] = []
        chosen: list[IntArray] = []
        filled = []
        for place, (argument, expected) in enumerate(zip(arguments, kernel.arguments, strict=True)):
            if isinstance(expected, int | tuple):
                if is_variable(argument):
                    raise GraphError(f"term '{name}': argument {place} is a parameter, not a variable", term=name)
                filled.append(argument)
                continue
            if not is_variable(argument):
                raise GraphError(
                    f"term '{name}': argument {place} is a variable on {expected.name}, found a constant: give it a "
                    "member and a prior",
                    term=name,
                )
            selection = as_selection(argument)
            if selection.component is not None or selection.manifold != expected:
                raise GraphError(
                    f"term '{name}': argument {place} is a whole variable on {expected.name}, found {selection!r} on "
                    f"{selection.manifold.name}",
                    term=name,
                    family=selection.family.name,
                )
            if not isinstance(selection.family, GrowingFamily):
                raise GraphError(
                    f"term '{name}': family '{selection.family.name}' belongs to another graph",
                    term=name,
                    family=selection.family.name,
                )
            families.append(selection.family)
            chosen.append(selection.indices)
            filled.append(np.empty((1, expected.storage)))
        count = max(len(indices) for indices in chosen)
        if any(len(indices) not in (1, count) for indices in chosen):
            lengths = [len(indices) for indices in chosen]
            raise GraphError(f"term '{name}': the number of factors is unclear: selections of {lengths}", term=name)
        members: list[IntArray | int] = [int(c[0]) if len(c) == 1 else c for c in chosen]
        for k, (family, other) in enumerate(zip(families, members, strict=True)):
            for before in range(k):
                if families[before] is family and np.any(members[before] == other):
                    raise GraphError(
                        f"term '{name}': the same member of '{family.name}' twice in one factor", term=name
                    )
        try:
            _, parameters, rows = kernel.split(filled, count)
        except GraphError as error:
            raise GraphError(f"term '{name}': {error}", term=name) from None
        if rows > 1 and count == 1:
            raise GraphError(f"term '{name}': its parameters speak of {rows} factors, its variables of one", term=name)
        shapes = [parameter.shape[1:] for parameter in parameters]
        size = kernel.size(shapes)
        whitening, whitener = 0, np.zeros((1, 0))
        if sigma is not None:
            whitening, whitener = DIAGONAL, reciprocals(name, np.asarray(sigma, dtype=np.float64), count, size)
        elif information is not None:
            given = np.array(information, dtype=np.float64, ndmin=3, order="C")
            whitener = np.empty((len(given), size * size))
            if given.shape[1:] != (size, size) or len(given) not in (1, count) or not upper_roots(given, whitener):
                roots = square_roots(name, np.asarray(information, dtype=np.float64), count, size)
                whitener = roots.reshape(len(roots), size * size)
            whitening = FULL
        form = form_of(robust)
        if form is None:
            raise GraphError(
                f"term '{name}': {type(robust).__name__} has no compiled form; a smoother takes Huber, Cauchy, Tukey, "
                "GemanMcClure, DCS and TruncatedLeastSquares",
                term=name,
            )
        data = side_by_side([*parameters, whitener], count)
        if not isfinite(data.sum()):
            index = int(np.argwhere(~np.isfinite(data))[0, 0])
            raise GraphError(f"term '{name}': a parameter of factor {index} is not finite", term=name, index=index)
        key = (id(kernel), tuple(shapes), whitening, form)
        kind = self._numbers.get(key)
        if kind is None:
            kind = self._numbers[key] = self._add(kernel, size, data.shape[1], whitener.shape[1], whitening, form)
        return Staged(kind, families, members, data, name)

    def _add(self, kernel: Kernel, size: int, numbers: int, whitener: int, whitening: int, form: Form) -> int:
        """Describe a new type; the kernel is kept, because compiled code knows only where it stands."""
        manifolds = kernel.manifolds
        if len(manifolds) > SLOTS_MAX:
            raise GraphError(f"{kernel.name}: {len(manifolds)} variables in one factor, at most {SLOTS_MAX} here")
        width = sum(manifold.dim for manifold in manifolds)
        parameters = numbers - whitener
        self._kernels[(id(kernel),)] = kernel
        self.scratch = max(self.scratch, sum(manifold.storage for manifold in manifolds) + size * (1 + width) + 8)
        loss, first, second = form
        self.fields.append(
            (
                kernel.address,
                size,
                len(manifolds),
                width,
                parameters,
                kernel.table.ctypes.data,
                kernel.table.size,
                whitening,
                loss,
                numbers,
                first,
                second,
            )
        )
        return len(self.fields) - 1

    def _kernel(self, wrapped: Residual, arguments: tuple[Any, ...]) -> Kernel:
        """The residual of one factor in compiled form."""
        if wrapped.kernel is not None:
            return wrapped.kernel
        if not is_compiled(wrapped.function):
            raise GraphError(
                f"term '{wrapped.name}' has no compiled residual: a smoother calls its factors from compiled code. "
                "Write the residual of one factor with numba.njit and pass fg.residual(function, rows=m)",
                term=wrapped.name,
            )
        kinds: list[Manifold | int] = []
        shapes = []
        for argument in arguments:
            if is_variable(argument):
                kinds.append(as_selection(argument).manifold)
                continue
            shape = np.shape(argument)
            shapes.append(shape[1:] if len(shape) > 1 else shape)
            kinds.append(len(shapes[-1]))
        key = (id(wrapped.function), id(wrapped.jacobian), tuple(kinds), tuple(shapes))
        if key not in self._kernels:
            self._kernels[key] = per_factor(
                wrapped.function, wrapped.jacobian, wrapped.rows, kinds, shapes, wrapped.name
            )
        return self._kernels[key]


@compiled
def upper_roots(information: Array, out: Array) -> bool:
    """Upper triangular W with W'W of (n, m, m) matrices into (n, m m); False unless all are positive definite."""
    count, m = len(information), information.shape[1]
    for k in range(count):
        for i in range(m):
            for j in range(m):
                a, b = information[k, i, j], information[k, j, i]
                if not abs(a - b) <= 1e-9 * abs(b):
                    return False
                out[k, i * m + j] = a if j >= i else 0.0
        for i in range(m):
            pivot = out[k, i * m + i]
            if not 1e-13 * information[k, i, i] < pivot < np.inf:
                return False
            root = sqrt(pivot)
            for j in range(i, m):
                out[k, i * m + j] /= root
            for a in range(i + 1, m):
                for b in range(a, m):
                    out[k, a * m + b] -= out[k, i * m + a] * out[k, i * m + b]
    return True


class Kinds:
    """The parts of a smoother's manifolds, as compiled code reads them."""

    def __init__(self) -> None:
        """Know none."""
        self.fields: list[tuple[int, ...]] = []
        self._known: list[tuple[Manifold, tuple[int, int]]] = []
        self._kept: list[Any] = []  # addresses are good for as long as the functions live

    def of(self, manifold: Manifold, family: str) -> tuple[int, int]:
        """First part of a manifold, and how many it has.

        Raises:
            GraphError: when it has no compiled retraction.
        """
        for known, place in self._known:
            if known == manifold:
                return place
        first = len(self.fields)
        for leaf, storage, tangent in leaves(manifold):
            move, deviation = move_of(leaf), 0
            if move is None:
                raise GraphError(
                    f"family '{family}': {leaf.name} has no compiled retraction; state it and local by fg.elementwise",
                    family=family,
                )
            if move.where != ADDITION:
                kernel = prior.on(leaf).kernel
                assert kernel is not None
                self._kept += [move.function, kernel]
                deviation = kernel.address
            self.fields.append((move.where, deviation, storage, leaf.storage, tangent, leaf.dim))
        place = first, len(self.fields) - first
        self._known.append((manifold, place))
        return place
