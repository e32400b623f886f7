"""Plain functions of terms, traced: which reading of their arguments is right, and whether the trace is the function.

A function is traced with one factor and serves a batch of many. A mean over the batch, its length, a row of another
factor or an array that holds a row for each look like constants then. So what was traced is compared with the function
on the whole batch, at points that differ from factor to factor. Rows that depend on other factors are an error, whoever
differentiates them; a function that a trace cannot stand for otherwise stays as it is, and that is said.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from unifg.errors import GraphError
from unifg.kernels.batched import Batched
from unifg.kernels.derive.derived import DerivedKernel, Each, Fixed, Given, Shared, derived
from unifg.kernels.derive.reach import Reach, reach_of
from unifg.kernels.derive.symbols import TraceError
from unifg.language.variables import Data, Selection
from unifg.lie import Manifold
from unifg.typing import Array, BoolArray

logger = logging.getLogger("unifg")
READINGS = 8  # of arrays that may or may not have a row for each factor
ALIKE = 1e-9  # relative to the numbers that go in and come out
AMPLIFIED = 1e4  # roundings of the arguments, as the function itself enlarges them
DOUBTED = 1e-5  # the most of it, relative as above
NEAR = (1e-3, 0.3)  # how far from the guess the function is compared once more [m, rad]
WATCHED = 64, 4096  # numbers in reach, for each factor and at all, that are looked at again before each solve


@dataclass(frozen=True)
class Batch:
    """A term's function and what it is called with.

    Attributes:
        name: of the term.
        batched: the function with its constants.
        arguments: of the term, as stated.
        present: the same with the values of data.
        manifolds: of the variables.
        shared: for each variable, whether all factors have the same.
        count, size: number of factors, rows of each.
        scalar: whether it returns (n,).
    """

    name: str
    batched: Batched
    arguments: Sequence[Any]
    present: Sequence[Any]
    manifolds: Sequence[Manifold]
    shared: Sequence[bool]
    count: int
    size: int
    scalar: bool = False

    def original(self, points: Sequence[Array]) -> Array:
        """(n, m) what the function itself returns."""
        with np.errstate(all="ignore"):
            return self.batched.on_copies(points).reshape(self.count, self.size)

    def anywhere(self, rng: np.random.Generator) -> list[Array]:
        """Points that differ from factor to factor, about the identity."""
        return self.moved([np.tile(m.identity(), (self.count, 1)) for m in self.manifolds], 1.0, rng)

    def moved(self, points: Sequence[Array], far: float, rng: np.random.Generator) -> list[Array]:
        """Points moved by random steps; a variable that all factors share moves for all alike."""
        result = []
        for manifold, point, shared in zip(self.manifolds, points, self.shared, strict=True):
            step = rng.uniform(-far, far, (1 if shared else self.count, manifold.dim))
            result.append(manifold.retract(np.array(point), np.broadcast_to(step, (self.count, manifold.dim))))
        return result


@dataclass(frozen=True)
class Trace:
    """A derived kernel that stands for a term's function.

    Attributes:
        kernel: what was derived.
        taken: places of the arguments that the kernel takes.
        reach: what the function reaches.
        constants: arrays that are arguments of the term and belong to the user, and what stood in them.
    """

    kernel: DerivedKernel
    taken: tuple[int, ...]
    reach: Reach
    constants: tuple[tuple[Array, bytes], ...]

    @property
    def fixed(self) -> bool:
        """Whether there is nothing that could change."""
        return self.reach.fixed and not self.constants

    @property
    def outdated(self) -> bool:
        """Whether something has changed that the function reads and that is no data."""
        return self.reach.changed or any(array.tobytes() != content for array, content in self.constants)

    def differs(self, batch: Batch, points: Sequence[Array]) -> BoolArray:
        """(n,) for which factors it computes something else than the function."""
        taken = [self.taken.index(k) for k, a in enumerate(batch.arguments) if isinstance(a, Selection)]
        given = [batch.present[k] for k in self.taken]
        for place, point in zip(taken, points, strict=True):
            given[place] = point
        theirs = batch.original(points)
        variables, parameters, _ = self.kernel.split(given, batch.count)
        with np.errstate(all="ignore"):
            ours = self.kernel(*given)
            ours = np.broadcast_to(ours, theirs.shape) if len(ours) == 1 else ours
            size: Array = np.abs(theirs).max(axis=1)
            for array in (*variables, *parameters):
                size = size + np.abs(array.reshape(len(array), -1)).max(axis=1, initial=0.0)
            size = np.where(np.isfinite(size), size, 1.0)
            wrong = _unequal(theirs, ours, (ALIKE * size)[:, None])
            if wrong.any():  # a function may enlarge the roundings of its arguments
                apart = [p * (1.0 + 4.0 * np.finfo(float).eps * np.sign(np.sin(1e3 * p + 1.0))) for p in points]
                doubt = np.nan_to_num(np.abs(batch.original(apart) - theirs)).max(axis=1)
                doubt = np.minimum(AMPLIFIED * doubt, DOUBTED * size)
                wrong = _unequal(theirs, ours, (ALIKE * size + doubt)[:, None])
        return wrong

    def agrees(self, batch: Batch, points: Sequence[Array]) -> bool:
        """Whether it computes what the function does, at these points and near them.

        A factor counts as different where it differs twice: at one point a function may stand on the edge of a jump,
        where its roundings decide.
        """
        rng = np.random.default_rng(1)
        times = np.zeros(batch.count, dtype=int)
        for far in (0.0, *NEAR):
            try:
                times += self.differs(batch, batch.moved(points, far, rng) if far else list(points))
            except GraphError:
                raise
            except Exception:  # it refuses points that nobody asked for
                if not far:
                    raise
        return bool((times < 2).all())


def find(
    batch: Batch, function: Callable[..., Any], asked: bool, names: Callable[[str], str] = str
) -> tuple[Trace | None, str]:
    """Trace a function, and compare.

    Args:
        batch: the term's function and arguments.
        function: to be traced.
        asked: whether the user insists.
        names: makes the name of the kernel.

    Returns:
        The trace, or None and why there is none.

    Raises:
        GraphError: rows of a factor depend on other factors; or there is no trace, and the user insists.
    """
    reach = reach_of(function)
    refusal = reach.refusal
    per_factor, at_all = WATCHED
    if not refusal and reach.size > max(at_all, per_factor * batch.count):
        refusal = f"it reaches arrays of {reach.size} numbers, which would be looked at again before each solve"
    if refusal and not asked:
        return None, refusal
    trace, why = _found(batch, function, reach, asked)
    if trace is None and asked:
        raise GraphError(f"term '{batch.name}': cannot be traced: {why}", term=batch.name)
    return trace, why


def _found(batch: Batch, function: Callable[..., Any], reach: Reach, asked: bool) -> tuple[Trace | None, str]:
    why, name = "", getattr(function, "__name__", "residual")
    different: Trace | None = None
    for given in _readings(batch):
        try:
            kernel = derived(function, given, reach, name=name, limit=not asked)
        except TraceError as error:
            why = why or str(error)
            continue
        if kernel.rows != batch.size:
            why = why or f"it returns {kernel.rows} rows for one factor and {batch.size} for {batch.count}"
            continue
        taken = tuple(k for k, part in enumerate(given) if not isinstance(part, Fixed))
        trace = Trace(kernel, taken, reach, _constants(batch))
        points = batch.anywhere(np.random.default_rng(0))
        try:
            wrong = bool(trace.differs(batch, points).any())
        except GraphError:
            raise
        except Exception:  # it refuses points that nobody asked for
            wrong = False
        if not wrong:
            return trace, ""
        different = trace
    if different is None:
        return None, why
    return None, reason(batch, batch.anywhere(np.random.default_rng(0)))


def reason(batch: Batch, points: Sequence[Array]) -> str:
    """Why a trace of one factor is not the function of the batch.

    Raises:
        GraphError: rows of a factor depend on other factors.
    """
    before = batch.original(points)
    if _unequal(before, batch.original(points), 0.0).any():
        return "it returns other numbers each time it is called"
    rng = np.random.default_rng(2)
    for kept in (0, 1):
        mine = np.arange(batch.count) % 2 == kept
        others = [
            p if shared else np.where(mine[:, None], p, q)
            for p, q, shared in zip(points, batch.moved(points, 0.5, rng), batch.shared, strict=True)
        ]
        moved = batch.original(others)
        changed = _unequal(before, moved, 1e-12 * (1.0 + np.abs(before))) & mine
        if changed.any():
            index = int(np.argmax(changed))
            raise GraphError(
                f"term '{batch.name}': the rows of factor {index} change when the variables of other factors do; "
                "its derivatives would be wrong. The rows of a factor may depend on its own arguments only: a mean "
                "over the batch, x[0] or a difference of neighbours in the batch is no residual of one factor. Pass "
                "all variables that it depends on as arguments, one selection each",
                term=batch.name,
                index=index,
            )
    return (
        "its rows depend on which factor they belong to, as by the length of the batch or by an array with a row for "
        "each factor that is no argument: pass such arrays as arguments"
    )


def _readings(batch: Batch) -> Iterator[list[Given]]:
    """What may stand in the place of each argument, likeliest first."""
    unclear = [
        k
        for k, (argument, value) in enumerate(zip(batch.arguments, batch.present, strict=True))
        if isinstance(value, np.ndarray)
        and not (isinstance(argument, Data) and argument.each)
        and value.ndim
        and len(value) == batch.count > 1
    ]
    choices = list(itertools.product((True, False), repeat=len(unclear)))
    if len(choices) > READINGS:
        choices = [choices[0], choices[-1]]
    for fixed in (False, True):
        for choice in choices:
            each = {k for k, rows in zip(unclear, choice, strict=True) if rows}
            given = [_given(batch, k, k in each, fixed) for k in range(len(batch.arguments))]
            if not fixed or any(isinstance(part, Fixed) for part in given):
                yield given


def _given(batch: Batch, place: int, each: bool, fixed: bool) -> Given:
    argument, value = batch.arguments[place], batch.present[place]
    if isinstance(argument, Selection):
        return argument.manifold
    shape = np.shape(value)
    if isinstance(argument, Data):
        each = each or (argument.each and batch.count > 1)
        return Each(shape[1:]) if each else Shared(shape)
    if each:
        return Each(shape[1:])
    kind = getattr(value, "dtype", np.dtype(type(value)) if isinstance(value, float) else None)
    if isinstance(value, float | np.floating | np.ndarray) and kind is not None and kind.kind == "f" and not fixed:
        return Shared(shape)
    return Fixed(value, reach_of_value(value))


def _constants(batch: Batch) -> tuple[tuple[Array, bytes], ...]:
    return tuple((a, a.tobytes()) for a in batch.arguments if isinstance(a, np.ndarray) and not a.dtype.hasobject)


def reach_of_value(value: Any) -> Any:
    """What tells a constant from others; None if nothing can."""
    reach = reach_of(lambda: value)
    return reach.key


def _unequal(a: Array, b: Array, allowed: Any) -> BoolArray:
    """(n,) factors some row of which differs; what is not finite in both is alike."""
    with np.errstate(all="ignore"):
        alike = (np.abs(a - b) <= allowed) | ~(np.isfinite(a) | np.isfinite(b))
    return np.asarray(~alike.all(axis=1))
