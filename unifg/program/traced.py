"""Plain functions of terms, traced: which reading of their arguments is right, and whether the trace is the function.

A function is traced with one factor and serves a batch of many. A mean over the batch, its length, a row of another
factor or an array that holds a row for each look like constants then. So what was traced is compared with the function
on the whole batch, at points that differ from factor to factor. Rows that depend on other factors are an error, whoever
differentiates them; a function that a trace cannot stand for otherwise stays as it is, and that is said.
"""

from __future__ import annotations

import itertools
import logging
import pickle
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np

from unifg.errors import GraphError
from unifg.kernels.batched import Batched, changes
from unifg.kernels.derive.derived import DerivedKernel, Each, Fixed, Given, Shared, derived, in_python
from unifg.kernels.derive.reach import Reach, reach_of
from unifg.kernels.derive.symbols import TraceError
from unifg.kernels.derive.trace import Rebound
from unifg.kernels.steps import ANGLE, OTHER, TURN, parts_of
from unifg.language.variables import Data, Selection
from unifg.lie import Manifold
from unifg.typing import Array, BoolArray, IntArray

logger = logging.getLogger("unifg")
READINGS = 8  # of arrays that may or may not have a row for each factor
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
    scalar: bool = False
    single: Callable[..., Any] | None = None

    def may_have_rows(self, place: int) -> bool:
        """Whether an argument is an array as long as the batch, with a row for each factor or not."""
        argument, value = self.arguments[place], self.present[place]
        if not isinstance(value, np.ndarray) or (isinstance(argument, Data) and argument.each):
            return False
        return bool(value.ndim and len(value) == self.count > 1)

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
                return self.batched.on_copies(points).reshape(self.count, self.size)
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
        """Which arguments of a function of one factor have a row for each factor."""
        found = []
        for argument, value in zip(self.arguments, filled, strict=True):
            if isinstance(argument, Selection):
                found.append(True)
            else:
                own = argument.each if isinstance(argument, Data) else np.ndim(value) > 1
                found.append(own and len(value) == self.count)
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


@dataclass(frozen=True)
class Trace:
    """A derived kernel that stands for a term's function.

    Attributes:
        kernel: what was derived.
        taken: places of the arguments that the kernel takes.
        reached: named arrays of the function that the kernel takes after these.
        reach: what else the function reaches, which is compiled in.
        fixed, free: arrays of the user that are compiled in, or are parameters, and what stood in them.
        given: what other arguments that are compiled in reach.
        lists: lists, dictionaries and tuples of numbers among them, and what stood in them.
    """

    kernel: DerivedKernel
    taken: tuple[int, ...]
    reached: tuple[Array, ...]
    reach: Reach
    fixed: Contents
    free: Contents
    given: tuple[Reach, ...] = ()
    lists: tuple[tuple[Any, bytes], ...] = ()

    @property
    def layout(self) -> tuple[Any, ...]:
        """What the numbers of its parameters depend on."""
        return self.taken, self.kernel.arguments, [array.shape for array in self.reached]

    @property
    def constant(self) -> bool:
        """Whether there is nothing that could change."""
        return not (self.fixed or self.free or self.lists) and all(r.fixed for r in (self.reach, *self.given))

    @property
    def outdated(self) -> bool:
        """Whether something has changed that is compiled in."""
        if self.reach.changed or _changed(self.fixed) or any(reach.changed for reach in self.given):
            return True
        return any(_listed(value) != content for value, content in self.lists)

    @property
    def moved(self) -> bool:
        """Whether parameters have changed that are no data."""
        return _changed(self.free)

    def refreshed(self) -> Trace:
        """The same trace with the present content of its parameters."""
        return replace(self, free=_contents([array for array, _ in self.free]))

    def arguments(self, filled: Sequence[Any]) -> list[Any]:
        """What the kernel takes, of all arguments of the term."""
        return [*(filled[place] for place in self.taken), *self.reached]

    def differs(self, batch: Batch, points: Sequence[Array]) -> BoolArray:
        """(n,) for which factors it computes something else than the function."""
        given = self.arguments(batch.batched.fill(points))
        theirs, looked_at = batch.original(points), batch.looked_at
        variables, parameters, _ = self.kernel.split(given, batch.count)
        with np.errstate(all="ignore"):
            ours = self.kernel(*given)
            ours = np.broadcast_to(ours, theirs.shape) if len(ours) == 1 else ours
            size: Array = np.abs(theirs).max(axis=1)
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
    if reach.refusal and not asked:
        return None, reach.refusal
    trace, why = _found(batch, function, reach, asked)
    if trace is None and asked:
        raise GraphError(f"term '{batch.name}': cannot be traced: {why}", term=batch.name)
    return trace, why


def _found(batch: Batch, function: Callable[..., Any], everything: Reach, asked: bool) -> tuple[Trace | None, str]:
    why, name = "", getattr(function, "__name__", "residual")
    per_factor, at_all = WATCHED
    most = max(at_all, per_factor * batch.count)
    different = False
    for given, reached in _readings(batch, everything.named):
        reach = reach_of(function, [array for array, _ in reached]) if reached else everything
        if reach.size > most and not asked:
            why = why or f"it reaches {reach.size} numbers, which would be looked at again before each solve"
            continue
        rows = batch.size if batch.single else 0
        beyond, lists, refusal = _reached_by(given, reach)
        if refusal and not asked:
            why = why or refusal
            continue
        try:
            kernel = derived(function, given, reach, rows, batch.scalar, name, not asked, reached)
        except TraceError as error:
            why = why or str(error)
            continue
        if kernel.rows != batch.size:
            why = why or f"it returns {kernel.rows} rows for one factor and {batch.size} for {batch.count}"
            continue
        taken = tuple(k for k, part in enumerate(given) if not isinstance(part, Fixed))
        arrays = {k: a for k, a in enumerate(batch.arguments) if isinstance(a, np.ndarray) and not a.dtype.hasobject}
        fixed = [array for k, array in arrays.items() if k not in taken]
        free = [*(array for k, array in arrays.items() if k in taken), *(array for array, _ in reached)]
        named = tuple(array for array, _ in reached)
        trace = Trace(kernel, taken, named, reach, _contents(fixed), _contents(free), beyond, lists)
        if not any(_differs_anywhere(*pair) for pair in ((trace, batch), _with_other_rows(trace, batch, function))):
            return trace, ""
        different = True
    return None, reason(batch, batch.anywhere(np.random.default_rng(0))) if different else why


def _reached_by(
    given: Sequence[Given], function: Reach
) -> tuple[tuple[Reach, ...], tuple[tuple[Any, bytes], ...], str]:
    """What arguments that are compiled in reach, the content of lists, and what may change with nobody noticing."""
    beyond, lists, refusal = [], [], ""
    for place, part in enumerate(given):
        if not isinstance(part, Fixed) or isinstance(part.value, np.ndarray):
            continue
        reach = reach_of(lambda value=part.value: value, (), function.attributes)
        if not reach.refusal:
            beyond.append(reach)
        elif (content := _listed(part.value)) is not None:
            lists.append((part.value, content))
        else:
            refusal = refusal or f"its argument {place} may change with nobody noticing: {reach.refusal}"
    return tuple(beyond), tuple(lists), refusal


def _listed(value: Any) -> bytes | None:
    """The content of lists, tuples and dictionaries of numbers, text and arrays; None of anything else."""

    def plain(part: Any) -> bool:
        if type(part) in (list, tuple):
            return all(map(plain, part))
        if type(part) is dict:
            return all(map(plain, part)) and all(map(plain, part.values()))
        if isinstance(part, np.ndarray):
            return not part.dtype.hasobject
        return part is None or isinstance(part, bool | int | float | complex | str | bytes | np.generic)

    return pickle.dumps(value) if plain(value) else None


def _differs_anywhere(trace: Trace, batch: Batch) -> bool:
    try:
        return bool(trace.differs(batch, batch.anywhere(np.random.default_rng(0))).any())
    except GraphError:
        raise
    except Exception:  # it refuses points that nobody asked for
        return False


def _with_other_rows(trace: Trace, batch: Batch, function: Callable[..., Any]) -> tuple[Trace, Batch]:
    """The same with other numbers in arrays of as many equal rows as factors, and in those of zeros.

    Goals of zeros and weights of ones do not say whether a row belongs to a factor, a gain of zero hides what it
    multiplies, and their content may change later.
    """
    if batch.single is not None or batch.count == 1:
        return trace, batch
    rng = np.random.default_rng(3)
    present = list(batch.present)
    for place in trace.taken:
        if not isinstance(batch.arguments[place], Selection):
            present[place] = _with_distinct_rows(present[place], batch, rng)
    reached = tuple(_with_distinct_rows(array, batch, rng) for array in trace.reached)
    rebound = Rebound()
    rebound.given = {id(old): new for old, new in zip(trace.reached, reached, strict=True) if old is not new}
    batched = Batched(batch.name, rebound.callable(function) if rebound.given else batch.batched.function)
    places = [k for k, argument in enumerate(batch.arguments) if isinstance(argument, Selection)]
    batched.bind(present, places, [])
    return replace(trace, reached=reached), replace(batch, batched=batched, present=present)


def _with_distinct_rows(array: Any, batch: Batch, rng: np.random.Generator) -> Any:
    """Another array, where two rows of as many as factors are equal or all is zero; elements stay elements."""
    count = batch.count
    if isinstance(array, np.ndarray) and array.dtype.kind in "bf" and not array.any():
        return np.asarray(~array if array.dtype.kind == "b" else rng.uniform(0.1, 0.5, array.shape))
    if not isinstance(array, np.ndarray) or not array.ndim or len(array) != count or not array.size:
        return array
    if len(np.unique(array.reshape(count, -1), axis=0)) == count:
        return array
    if array.dtype.kind == "b":
        return rng.random(array.shape) < 0.5
    for manifold in batch.manifolds:
        turns = [slice(p.start, p.start + p.storage) for p, _ in parts_of(manifold) if p.kind == TURN]
        if turns and array.shape == (count, manifold.storage):
            if all(np.allclose((array[:, turn] ** 2).sum(axis=1), 1.0) for turn in turns):
                return _moved(manifold, array, rng.uniform(-0.5, 0.5, (count, manifold.dim)))
    return array + rng.uniform(0.0, 0.5, array.shape) if array.dtype.kind == "f" else array


def reason(batch: Batch, points: Sequence[Array]) -> str:
    """Why a trace of one factor is not the function of the batch.

    Raises:
        GraphError: rows of a factor depend on other factors.
    """
    if batch.single is not None:
        return "what was traced is not what it computes"
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


def _readings(batch: Batch, named: Sequence[Array]) -> Iterator[tuple[list[Given], list[tuple[Array, bool]]]]:
    """What may stand in the place of each argument, and of arrays that have a name; likeliest first."""
    if batch.single is not None:
        rows = batch.rows_of(batch.present)
        yield (
            [
                a.manifold if isinstance(a, Selection) else (Each(np.shape(v)[1:]) if each else Shared(np.shape(v)))
                for a, v, each in zip(batch.arguments, batch.present, rows, strict=True)
            ],
            [],
        )
        return
    places = range(len(batch.arguments))
    unclear = [k for k in places if batch.may_have_rows(k)]
    open_rows = [array for array in named if len(array) == batch.count > 1 and array[0].size <= SHORT]
    choices = list(itertools.product((True, False), repeat=len(unclear) + len(open_rows)))
    if len(choices) > READINGS:
        choices = [choices[0], choices[-1]]
    for fixed in (False, True):
        for choice in choices:
            each = {k for k, rows in zip(unclear, choice, strict=False) if rows}
            rowed = {id(array): rows for array, rows in zip(open_rows, choice[len(unclear) :], strict=True)}
            given = [_given(batch, k, k in each, fixed) for k in places]
            reached = [
                (array, rowed.get(id(array), False))
                for array in named
                if rowed.get(id(array)) or (array.size <= SHORT and not fixed)
            ]
            if not fixed or any(isinstance(part, Fixed) for part in given) or len(reached) < len(named):
                yield given, reached


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


def _moved(manifold: Manifold, point: Array, step: Array) -> Array:
    """Elements about as far from others as the step says, without compiled functions that would have to be loaded."""
    moved = np.array(point)
    for part, leaf in parts_of(manifold):
        here = moved[:, part.start : part.start + part.storage]
        along = step[:, part.column : part.column + part.dim]
        if part.kind == OTHER:
            here[:] = leaf.retract(here, along)
        elif part.kind == TURN:
            here[:, 1:] += 0.5 * along
            here *= np.where(here[:, :1] < 0.0, -1.0, 1.0) / np.sqrt((here**2).sum(axis=1, keepdims=True))
        else:
            here += along
            if part.kind == ANGLE:
                here -= 2.0 * np.pi * np.rint(here / (2.0 * np.pi))
    return moved


def _contents(arrays: Sequence[Array]) -> Contents:
    return tuple((array, array.tobytes()) for array in arrays)


def _changed(contents: Contents) -> bool:
    return any(array.tobytes() != content for array, content in contents)


def reach_of_value(value: Any) -> Any:
    """What tells a constant from others; None if nothing can."""
    reach = reach_of(lambda: value)
    return reach.key


def _unequal(a: Array, b: Array, allowed: Any) -> BoolArray:
    """(n,) factors some row of which differs; what is not finite in both is alike."""
    with np.errstate(all="ignore"):
        alike = (np.abs(a - b) <= allowed) | ~(np.isfinite(a) | np.isfinite(b))
    return np.asarray(~alike.all(axis=1))
