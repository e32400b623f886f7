"""Many instances of one graph: other data, other guesses, one structure.

Where the backend's whole loop is compiled (:meth:`unifg.solution.solve_state.IterativeMethod.solve_each`), instances
run one after the other without Python, and threads run at once. What such a loop does not end with success is solved
again as usual, and so are all instances of a graph that Python has a part in. Statuses are therefore those of single
solves.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import repeat
from typing import NamedTuple, Protocol

import numpy as np

from unifg.errors import GraphError
from unifg.modeling.duplicates import doubles
from unifg.modeling.variables import Data, Family
from unifg.problem.compiled_problem import CompiledProblem
from unifg.solution.guess import Guess
from unifg.solution.solution import AnyGuess, Solution
from unifg.solution.status import Status
from unifg.typing import Array, IntArray, Numbers

SAMPLED = 100  # one answer in so many is verified by the functions as written, as in a loop


class Outcomes(NamedTuple):
    """Answers of instances that compiled code has solved.

    Attributes:
        statuses: None where an instance is to be solved as usual.
        values: (K, S) stored ones.
        multipliers: (K, M).
        cost: (K,).
        iterations: (K,).
        measured: (K, 3) stationarity, violation, complementarity.
    """

    statuses: list[Status | None]
    values: Array
    multipliers: Array
    cost: Array
    iterations: IntArray
    measured: Array


class Worker(Protocol):
    """Prepared solver of one thread, :class:`unifg.solution.solver.Prepared`."""

    program: CompiledProblem

    @property
    def solves_each(self) -> bool:
        """True if :meth:`solve_part` may be asked."""

    def solve(self, guess: AnyGuess, *, data: Mapping[Data, Numbers] | None = None) -> Solution:
        """Solve one instance."""

    def read(self, guess: AnyGuess) -> tuple[Array, Array, Array]:
        """Stored values, multipliers and penalties of a guess."""

    def twins(self, count: int) -> Sequence[Worker]:
        """Workers of other threads."""

    def solve_part(self, guesses: tuple[Array, Array], data: Mapping[Data, Array], count: int) -> Outcomes | None:
        """Some instances in one compiled call, or None."""


class Batch:
    """Answers of many instances.

    Attributes:
        statuses: of each.
        cost, stationarity, violation, complementarity: (K,) as of a solution.
        iterations: (K,).
        multipliers: (K, M) of all constraint rows.
    """

    def __init__(self, prepared: Worker, data: Mapping[Data, Array], count: int) -> None:
        """Make room; filled by :meth:`unifg.solution.solver.Prepared.solve_many`."""
        program = prepared.program
        self._prepared, self._data = prepared, data
        # defaults may be others when somebody asks for a solution
        self._rest = {h: h.value.copy() for h in program.binding.present if h not in data}
        self.statuses: list[Status] = [Status.INTERRUPTED] * count
        self.values, self.multipliers = np.empty((count, program.columns.stored)), np.empty((count, len(program.lower)))
        self.cost, self.stationarity, self.violation, self.complementarity = np.empty((4, count))
        self.iterations: IntArray = np.zeros(count, dtype=np.int64)

    def __len__(self) -> int:
        """Number of instances."""
        return len(self.statuses)

    def __getitem__(self, family: Family | str) -> Array:
        """(K, count, storage) values of a family, by itself or by name.

        Raises:
            GraphError: there is no such family.
        """
        columns = self._prepared.program.columns
        known = {own.name: own for own in columns.storage}
        own = known.get(family) if isinstance(family, str) else family
        if own is None or own not in columns.storage:
            raise GraphError(f"{family!r} is no family of these instances (there are: {', '.join(known)})")
        part, shape = columns.place(own)
        return self.values[:, part].reshape(len(self), *shape).copy()

    @property
    def converged(self) -> bool:
        """True if all have."""
        return all(status.converged for status in self.statuses)

    def data_of(self, index: int) -> dict[Data, Array]:
        """The data of one instance.

        Raises:
            GraphError: there is no such instance.
        """
        if not (isinstance(index, int | np.integer) and -len(self) <= index < len(self)):
            raise GraphError(f"there is no instance {index!r}: {len(self)} were solved, 0 to {len(self) - 1}")
        return {handle: given[index] for handle, given in self._data.items()}

    def solution(self, index: int) -> Solution:
        """A solution with all that belongs to it, by a solve from the answer of an instance.

        Raises:
            GraphError: there is no such instance.
        """
        program, data = self._prepared.program, self.data_of(index) | self._rest
        arrays = self.values[index].copy(), self.multipliers[index].copy(), program.no_penalties
        return self._prepared.solve(Guess.stored(program, arrays), data=data)

    def solve_part(self, worker: Worker, part: IntArray, guesses: tuple[Array, Array]) -> IntArray:
        """Have a worker solve some instances; returns those that are left to single solves."""
        own = [array[part] if len(array) > 1 else array for array in guesses]
        data = {handle: given[part] for handle, given in self._data.items()}
        found = worker.solve_part((own[0], own[1]), data, len(part))
        if found is None:
            return part
        solved = np.array([status is not None for status in found.statuses], dtype=bool)
        for index, status in zip(part[solved].tolist(), filter(None, found.statuses), strict=True):
            self.statuses[index] = status
        done = part[solved]
        self.values[done], self.multipliers[done] = found.values[solved], found.multipliers[solved]
        self.cost[done], self.iterations[done] = found.cost[solved], found.iterations[solved]
        self.stationarity[done], self.violation[done], self.complementarity[done] = found.measured[solved].T
        left: IntArray = part[~solved]
        return left

    def take(self, index: int, solution: Solution) -> None:
        """Write the answer of an instance."""
        self.statuses[index], self.iterations[index] = solution.status, solution.iterations
        self.values[index], self.multipliers[index] = solution._lin.stored, solution._multipliers
        self.cost[index], self.stationarity[index] = solution.cost, solution.stationarity
        self.violation[index], self.complementarity[index] = solution.violation, solution.complementarity


def stacked_data(data: Mapping[Data, Numbers]) -> tuple[dict[Data, Array], int | None]:
    """Data with one value for each instance, and the number of instances; None without data.

    Raises:
        GraphError: numbers of instances, or shapes, differ, or something else than numbers is given.
    """
    found: dict[Data, Array] = {}
    count: int | None = None
    if not (isinstance(data, Mapping) and all(isinstance(handle, Data) for handle in data)):
        raise GraphError(f"data of many instances are {{handle: values, ...}}, found {f'{data!r}'[:80]}")
    for handle, given in data.items():
        # a copy: the batch reads it later, and the caller may change it
        array = doubles(f"data '{handle.name}' of many instances", given, flags=True).copy()
        if not array.ndim or array.shape[1:] != handle.value.shape:
            raise GraphError(
                f"data '{handle.name}' of many instances has shape {array.shape}, expected (K, "
                f"{', '.join(map(str, handle.value.shape))}): one value of shape {handle.value.shape} for each"
            )
        if count not in (None, len(array)):
            raise GraphError(f"data '{handle.name}' is given for {len(array)} instances, others for {count}")
        found[handle], count = array, len(array)
    return found, count


@contextmanager
def _of_instance(index: int) -> Iterator[None]:
    """Say in errors whose guess or data they are about."""
    try:
        yield
    except GraphError as error:
        error.args = (f"instance {index}: {error}",)
        raise


def flat_guesses(prepared: Worker, guesses: AnyGuess | Sequence[AnyGuess]) -> tuple[Array, Array]:
    """(K or 1, S) stored values and (K or 1, M) multipliers of guesses, one for each instance or one for all."""
    rows = []
    for index, guess in enumerate(guesses if isinstance(guesses, Sequence) else [guesses]):
        with _of_instance(index):
            rows.append(prepared.read(guess))
    return np.stack([values for values, *_ in rows]), np.stack([multipliers for _, multipliers, _ in rows])


def solve_batch(
    prepared: Worker,
    guesses: AnyGuess | Sequence[AnyGuess],
    data: Mapping[Data, Numbers],
    threads: int,
) -> Batch:
    """All instances; arguments and errors as for :meth:`unifg.solution.solver.Prepared.solve_many`."""
    given, count = stacked_data(data)
    if isinstance(guesses, Sequence):
        if count not in (None, len(guesses)):
            raise GraphError(f"{len(guesses)} guesses are given for {count} instances: give as many, or a single one")
        count = len(guesses)
    if count is None:
        raise GraphError("solve_many of what? Give data with a value for each instance, or a list of guesses")
    batch = Batch(prepared, given, count)
    each = guesses if isinstance(guesses, Sequence) else [guesses] * count
    if count == 0:
        return batch

    def solve_one(index: int) -> None:
        with _of_instance(index):
            batch.take(index, prepared.solve(each[index], data=batch.data_of(index)))

    solve_one(0)  # verified, as a first answer is
    left = np.arange(1, count)
    if prepared.solves_each and count > 1:
        stored = flat_guesses(prepared, guesses)
        workers = [prepared, *prepared.twins(min(threads, count - 1) - 1)]
        parts = [left[k :: len(workers)] for k in range(len(workers))]
        with ThreadPoolExecutor(len(workers)) as pool:
            left = np.sort(np.concatenate(list(pool.map(batch.solve_part, workers, parts, repeat(stored)))))
    for index in left.tolist():
        solve_one(index)
    return batch
