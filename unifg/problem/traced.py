"""Plain functions of terms, traced: the reading of their arguments, and a check of the trace against the function.

Whether an array as long as the batch has a row for each factor or is shared is decided by structure: the function is
traced on batches of several rows whose numbers are all symbols (:mod:`unifg.factors.autodiff.rows`). Rows that depend
on the variables of other factors are an error. A function that no trace can stand for stays in Python, with a message.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np

from unifg.errors import GraphError
from unifg.factors.autodiff.captured import Captured, captured_by, changed_arrays
from unifg.factors.autodiff.derived import DerivedKernel, derived, in_python
from unifg.factors.autodiff.rows import Common, Each, Fixed, Given, RowsError, Shared, lengths_for
from unifg.factors.autodiff.symbols import TraceError
from unifg.factors.batched import Batched, changes
from unifg.factors.steps import ANGLE, OTHER, TURN, parts_of
from unifg.lie import Manifold
from unifg.modeling.variables import Data, Selection
from unifg.typing import Array, BoolArray, IntArray

logger = logging.getLogger("unifg")
READINGS = 8  # of arrays that may or may not have a row for each factor
WHOLE = 100  # factors of a batch that is traced as a whole where two short ones do not decide
ALIKE = 1e-9  # relative to the numbers that go in and come out
AMPLIFIED = 1e4  # roundings of the arguments, as the function itself enlarges them
DOUBTED = 1e-5  # the most of it, relative as above
NEAR = (1e-3, 0.3)  # how far from the guess the function is compared once more [m, rad]
SHORT = 256  # numbers of an array that becomes a parameter, for each factor
FEW = 16  # factors that a function of one factor is compared at
WATCHED = 64, 4096  # numbers in reach, for each factor and at all, that are looked at again before each solve

Contents: TypeAlias = tuple[tuple[Array, bytes], ...]


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
        rows: for each argument, whether it has a row for each factor, as declared; None where that is not said.
        scalar: whether it returns (n,).
        single: the function, where it takes one factor at a time and is compiled.
    """

    name: str
    batched: Batched
    arguments: Sequence[Any]
    present: Sequence[Any]
    manifolds: Sequence[Manifold]
    shared: Sequence[bool]
    count: int
    size: int
    rows: Sequence[bool | None]
    scalar: bool = False
    single: Callable[..., Any] | None = None

    @property
    def looked_at(self) -> IntArray:
        """Factors that are compared: of a function of one factor a few, for no factor can be another's."""
        if self.single is None:
            return np.arange(self.count)
        return np.unique(np.linspace(0, self.count - 1, FEW).astype(np.intp))

    def original(self, points: Sequence[Array]) -> Array:
        """(n, m) what the function itself returns, of the factors that are compared.

        Raises:
            GraphError: it changes its arguments.
        """
        with np.errstate(all="ignore"):
            if self.single is None:
                return np.array(self.batched.on_copies(points)).reshape(self.count, self.size)  # it may keep its memory
            filled = self.batched.fill(points)
            found = np.full((self.count, self.size), np.nan)
            for factor in self.looked_at:
                given = [np.array(a[factor] if row else a) for a, row in zip(filled, self.rows_of(filled), strict=True)]
                before = [a.tobytes() for a in given]
                found[factor] = in_python(self.single, [a if a.ndim else float(a) for a in given], self.size)
                for place, (now, kept) in enumerate(zip(given, before, strict=True)):
                    if now.tobytes() != kept:
                        raise GraphError(changes(self.name, place), term=self.name)
            return found

    def rows_of(self, filled: Sequence[Any]) -> list[bool]:
        """Arguments of a function of one factor that have a row for each factor."""
        found = []
        for argument, value, declared in zip(self.arguments, filled, self.rows, strict=True):
            variable = isinstance(argument, Selection)
            found.append(variable or (has_rows(value, declared) and len(value) == self.count))
        return found

    def anywhere(self, rng: np.random.Generator) -> list[Array]:
        """Points that differ from factor to factor, about the identity."""
        return self.moved([np.tile(m.identity(), (self.count, 1)) for m in self.manifolds], 1.0, rng)

    def moved(self, points: Sequence[Array], far: float, rng: np.random.Generator) -> list[Array]:
        """Points moved by random steps; a variable that all factors share moves for all alike."""
        result = []
        for manifold, point, shared in zip(self.manifolds, points, self.shared, strict=True):
            step = rng.uniform(-far, far, (1 if shared else self.count, manifold.dim))
            result.append(_moved(manifold, point, np.broadcast_to(step, (self.count, manifold.dim))))
        return result


def unclear_places(present: Sequence[Any], rows: Sequence[bool | None], count: int) -> list[int]:
    """Places of arrays as long as the batch of which it is not declared whether they have a row for each factor."""
    arrays = [k for k, value in enumerate(present) if rows[k] is None and isinstance(value, np.ndarray)]
    return [k for k in arrays if present[k].ndim and len(present[k]) == count > 1]


def has_rows(value: Any, declared: bool | None) -> bool:
    """Test whether an argument of a compiled function of one factor has a row for each: matrices, unless declared."""
    return np.ndim(value) > 1 if declared is None else declared


@dataclass(frozen=True)
class Trace:
    """A derived kernel that stands for a term's function.

    Attributes:
        kernel: what was derived.
        inputs: places of the arguments that the kernel takes.
        reached: named arrays of the function that the kernel takes after these.
        reach: what else the function reaches, which is compiled in.
        free: arrays of the user that are parameters, and what stood in them.
        each: places of the arguments with a row for each factor.
        whole: whether it holds for batches of this length only.
        given: what arguments that are compiled in reach.
    """

    kernel: DerivedKernel
    inputs: tuple[int, ...]
    reached: tuple[Array, ...]
    reach: Captured
    free: Contents
    each: tuple[int, ...] = ()
    whole: bool = False
    given: tuple[Captured, ...] = ()

    @property
    def layout(self) -> tuple[Any, ...]:
        """Dependencies of the parameters' layout."""
        return self.inputs, self.kernel.arguments, [array.shape for array in self.reached]

    @property
    def constant(self) -> bool:
        """True if there is nothing that could change."""
        return not self.free and all(reach.fixed for reach in (self.reach, *self.given))

    @property
    def outdated(self) -> bool:
        """True if something has changed that is compiled in."""
        return self.reach.changed or (bool(self.given) and any(reach.changed for reach in self.given))

    @property
    def moved(self) -> bool:
        """True if parameters have changed that are no data."""
        return bool(self.free) and changed_arrays(self.free)

    @property
    def changed(self) -> bool:
        """True if what is compiled in has changed, or parameters have."""
        return self.outdated or self.moved

    def refreshed(self) -> Trace:
        """The same trace with the present content of its parameters."""
        return replace(self, free=_contents([array for array, _ in self.free]))

    def arguments(self, filled: Sequence[Any]) -> list[Any]:
        """Arguments of the kernel, of all arguments of the term."""
        return [*(filled[place] for place in self.inputs), *self.reached]

    def differs(self, batch: Batch, points: Sequence[Array], theirs: Array | None = None) -> BoolArray:
        """(n,) for which factors it computes something else than the function, which returns ``theirs``."""
        given = self.arguments(batch.batched.fill(points))
        theirs, looked_at = batch.original(points) if theirs is None else theirs, batch.looked_at
        variables, parameters, _ = self.kernel.split(given, batch.count)
        with np.errstate(all="ignore"):
            ours = self.kernel(*given)
            ours = np.broadcast_to(ours, theirs.shape) if len(ours) == 1 else ours
            size: Array = np.abs(theirs).max(axis=1, initial=0.0)
            for array in (*variables, *parameters):
                size = size + np.abs(array.reshape(len(array), -1)).max(axis=1, initial=0.0)
            size = np.where(np.isfinite(size), size, 1.0)
            theirs, ours = theirs[looked_at], ours[looked_at]
            size = size[looked_at] if len(size) == batch.count else size
            wrong = np.zeros(batch.count, dtype=bool)
            wrong[looked_at] = _unequal(theirs, ours, (ALIKE * size)[:, None])
            if wrong.any():  # a function may enlarge the roundings of its arguments
                apart = [p * (1.0 + 4.0 * np.finfo(float).eps * np.sign(np.sin(1e3 * p + 1.0))) for p in points]
                doubt = np.nan_to_num(np.abs(batch.original(apart)[looked_at] - theirs)).max(axis=1)
                doubt = np.minimum(AMPLIFIED * doubt, DOUBTED * size)
                wrong[looked_at] = _unequal(theirs, ours, (ALIKE * size + doubt)[:, None])
        return wrong

    def agrees(self, batch: Batch, points: Sequence[Array]) -> bool:
        """Test whether it computes what the function does, at these points and near them.

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


def find(batch: Batch, function: Callable[..., Any], asked: bool) -> tuple[Trace | None, str]:
    """Trace a function, and compare.

    Args:
        batch: the term's function and arguments.
        function: to be traced.
        asked: whether the user insists.

    Returns:
        The trace, or None and why there is none.

    Raises:
        GraphError: rows of a factor depend on other factors; or there is no trace, and the user insists.
    """
    reach = captured_by(function)
    if reach.refusal and not asked:
        return None, reach.refusal
    trace, why = _found(batch, function, reach, asked)
    if trace is None and asked:
        raise GraphError(f"term '{batch.name}': cannot be traced: {why}", term=batch.name)
    return trace, why


def _found(batch: Batch, function: Callable[..., Any], everything: Captured, asked: bool) -> tuple[Trace | None, str]:
    why, mistraced, tried = "", False, set[tuple[_Reading, bool]]()
    failures: list[RowsError] = []
    many = batch.single is None and batch.count > 1
    waiting = [(reading, False) for reading in _readings(batch, everything.named)]
    if many and batch.count <= WHOLE:
        waiting += [(reading, True) for reading, _ in waiting]
    while waiting:
        reading, whole = waiting.pop(0)
        if (reading, whole) in tried:
            continue
        tried.add((reading, whole))
        given, reached = reading.of(batch, everything.named)
        try:
            trace = _traced(batch, function, everything, asked, given, reached, whole)
        except RowsError as error:
            failures.append(error)
            why = why or str(error)
            if shared := reading.sharing(error.mixed, given, reached):
                waiting.insert(0, (shared, whole))
            continue
        except TraceError as error:
            why = why or str(error)
            continue
        if not _differs_anywhere(trace, batch):
            return trace, ""
        mistraced = True
    variables = {k for k, argument in enumerate(batch.arguments) if isinstance(argument, Selection)}
    if failures and all(variables & failure.mixed for failure in failures):
        raise mixing(batch.name, failures[0].row)
    return None, reason(batch, batch.anywhere(np.random.default_rng(0))) if mistraced else why


def mixing(name: str, index: int) -> GraphError:
    """The error for rows that depend on the variables of other factors."""
    return GraphError(
        f"term '{name}': the rows of factor {index} change when the variables of other factors do; its derivatives "
        "would be wrong. The rows of a factor may depend on its own arguments only: a mean over the batch, x[0] or a "
        "difference of neighbours in the batch is no residual of one factor. Pass all variables that it depends on as "
        "arguments, one selection each",
        term=name,
        index=index,
    )


def _traced(
    batch: Batch,
    function: Callable[..., Any],
    everything: Captured,
    asked: bool,
    given: list[Given],
    reached: list[tuple[Array, bool]],
    whole: bool,
) -> Trace:
    """The trace of one reading.

    Raises:
        TraceError: there is none.
    """
    per_factor, at_all = WATCHED
    reach = captured_by(function, [array for array, _ in reached]) if reached else everything
    if reach.size > max(at_all, per_factor * batch.count) and not asked:
        raise TraceError(f"it reaches {reach.size} numbers, which would be looked at again before each solve")
    beyond, refusal = _reached_by(given, reach)
    if refusal and not asked:
        raise TraceError(refusal)
    name, rows = getattr(function, "__name__", "residual"), batch.size if batch.single else 0
    if batch.count == 1 or batch.single is not None:
        lengths: tuple[int, ...] = (1,)
    else:
        named_shapes = [Shared(array.shape) for array, _ in reached]
        lengths = (batch.count,) if whole else lengths_for([*given, *named_shapes])
    kernel = derived(function, given, reach, rows, batch.scalar, name, not asked, reached, lengths)
    if kernel.rows != batch.size:
        raise TraceError(f"it returns {kernel.rows} rows for one factor and {batch.size} for {batch.count}")
    inputs = tuple(k for k, part in enumerate(given) if not isinstance(part, Fixed))
    arrays = (batch.arguments[k] for k in inputs if isinstance(batch.arguments[k], np.ndarray))
    free = [*(array for array in arrays if not array.dtype.hasobject), *(array for array, _ in reached)]
    named = tuple(array for array, _ in reached)
    each = tuple(k for k, part in enumerate(given) if isinstance(part, Each))
    return Trace(kernel, inputs, named, reach, _contents(free), each, whole, beyond)


def _reached_by(given: Sequence[Given], function: Captured) -> tuple[tuple[Captured, ...], str]:
    """Captured variables of arguments that are compiled in, and why one of them may change unseen."""
    beyond, refusal = [], ""
    for place, part in enumerate(given):
        if isinstance(part, Fixed):
            reach = captured_by(lambda value=part.value: value, (), function.attributes)
            beyond.append(reach)
            if reach.refusal:
                refusal = refusal or f"its argument {place} may change with nobody noticing: {reach.refusal}"
    return tuple(beyond), refusal


def _differs_anywhere(trace: Trace, batch: Batch) -> bool:
    try:
        return bool(trace.differs(batch, batch.anywhere(np.random.default_rng(0))).any())
    except GraphError:
        raise
    except Exception:  # it refuses points that nobody asked for
        return False


def reason(batch: Batch, points: Sequence[Array]) -> str:
    """Reason for which a trace does not compute what its function does."""
    before = batch.original(points)
    if batch.single is None and _unequal(before, batch.original(points), 0.0).any():
        return "it returns other numbers each time it is called"
    return "what was traced is not what it computes"


@dataclass(frozen=True)
class _Reading:
    """One way to read arrays as long as the batch.

    Attributes:
        places: of arguments with a row for each factor.
        ids: of named arrays with a row for each factor.
        fixed: whether shared numbers are compiled in.
    """

    places: frozenset[int]
    ids: frozenset[int]
    fixed: bool

    def of(self, batch: Batch, named: Sequence[Array]) -> tuple[list[Given], list[tuple[Array, bool]]]:
        """Return the inputs in the places of the arguments, and the named arrays that are parameters."""
        if batch.single is not None:
            rows = batch.rows_of(batch.present)
            return [
                a.manifold if isinstance(a, Selection) else (Each(np.shape(v)[1:]) if each else Shared(np.shape(v)))
                for a, v, each in zip(batch.arguments, batch.present, rows, strict=True)
            ], []
        given = [_given(batch, k, k in self.places, self.fixed) for k in range(len(batch.arguments))]
        reached = [
            (array, id(array) in self.ids)
            for array in named
            if id(array) in self.ids or (array.size <= SHORT and not self.fixed)
        ]
        return given, reached

    def sharing(
        self, mixed: frozenset[int], given: Sequence[Given], reached: Sequence[tuple[Array, bool]]
    ) -> _Reading | None:
        """The reading in which inputs are shared other rows of which a row depends on; None where none is unclear."""
        places = self.places & mixed
        ids = self.ids & {id(array) for k, (array, _) in enumerate(reached, len(given)) if k in mixed}
        return replace(self, places=self.places - places, ids=self.ids - ids) if places or ids else None


def _readings(batch: Batch, named: Sequence[Array]) -> Iterator[_Reading]:
    """Readings of the arrays as long as the batch; a row for each factor first."""
    unclear = [] if batch.single is not None else unclear_places(batch.present, batch.rows, batch.count)
    open_rows = [id(array) for array in named if len(array) == batch.count > 1 and array[0].size <= SHORT]
    keys = [*((True, k) for k in unclear), *((False, k) for k in open_rows)]
    choices = list(itertools.product((True, False), repeat=len(keys)))
    if len(choices) > READINGS:
        choices = [choices[0], choices[-1]]
    for fixed in (False, True) if batch.single is None else (False,):
        for choice in choices:
            chosen = [key for key, rows in zip(keys, choice, strict=True) if rows]
            places, ids = ({k for argument, k in chosen if argument is kind} for kind in (True, False))
            yield _Reading(frozenset(places), frozenset(ids), fixed)


def _given(batch: Batch, place: int, each: bool, fixed: bool) -> Given:
    argument, value = batch.arguments[place], batch.present[place]
    if isinstance(argument, Selection):
        variable = [k for k, a in enumerate(batch.arguments) if isinstance(a, Selection)].index(place)
        return Common(argument.manifold) if batch.shared[variable] else argument.manifold
    shape = np.shape(value)
    if each or (batch.rows[place] and batch.count > 1):
        return Each(shape[1:])
    kind = getattr(value, "dtype", np.dtype(type(value)) if isinstance(value, float) else None)
    numbers = isinstance(value, float | np.floating | np.ndarray) and kind is not None and kind.kind == "f"
    if isinstance(argument, Data) or (numbers and not fixed):
        return Shared(shape)
    return Fixed(value, reach_of_value(value))


def _moved(manifold: Manifold, point: Array, step: Array) -> Array:
    """Elements about as far from others as the step says, without compiled functions that would have to be loaded."""
    moved = np.array(point)
    for part, leaf in parts_of(manifold):
        stored = moved[:, part.start : part.start + part.storage]
        along = step[:, part.column : part.column + part.dim]
        if part.kind == OTHER:
            stored[:] = leaf.retract(stored, along)
        elif part.kind == TURN:
            stored[:, 1:] += 0.5 * along
            stored *= np.where(stored[:, :1] < 0.0, -1.0, 1.0) / np.sqrt((stored**2).sum(axis=1, keepdims=True))
        else:
            stored += along
            if part.kind == ANGLE:
                stored -= 2.0 * np.pi * np.rint(stored / (2.0 * np.pi))
    return moved


def _contents(arrays: Sequence[Array]) -> Contents:
    return tuple((array, array.tobytes()) for array in arrays)


def reach_of_value(value: Any) -> Any:
    """Key of a constant; None if there is none."""
    return captured_by(lambda: value).key


def _unequal(a: Array, b: Array, allowed: Any) -> BoolArray:
    """(n,) factors some row of which differs; what is not finite in both is alike."""
    with np.errstate(all="ignore"):
        alike = (np.abs(a - b) <= allowed) | ~(np.isfinite(a) | np.isfinite(b))
    return np.asarray(~alike.all(axis=1))
