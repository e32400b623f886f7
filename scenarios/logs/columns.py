"""Columns of a log: declared once with their unit and shape, written tick by tick, stacked at the end.

A log is a dataclass whose columns are declared by :func:`column`, :func:`ragged` and :func:`words`; its other fields
are what was known before the first tick or after the last. The loop writes it with a `Recorder`; metrics, plots and
scenes only read it, so a picture never needs the solver that made it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import Field, dataclass, field, fields
from typing import Any, Generic, TypeVar

import numpy as np

from unifg.errors import ScenarioError
from unifg.typing import Array

__all__ = ["Column", "Recorder", "SoFar", "column", "columns", "ragged", "watched", "words"]

L = TypeVar("L")


@dataclass(frozen=True)
class Column:
    """Format of a column.

    Attributes:
        unit: of its numbers; "ms" is measured by a clock, "iterations" counts those of a solver.
        entry: what is kept of a value given at a tick, a copy.
        stack: the column, of the entries of all ticks.
        lasting: True to keep one entry for as long as it stays the same.
        ragged: (0, ...) the rows of no tick, of a column of arrays of several lengths; None for other columns.
    """

    unit: str
    entry: Callable[[Any], Any]
    stack: Callable[[list[Any]], Any]
    lasting: bool = False
    ragged: Array | None = None


def column(unit: str = "", *shape: int | None, dtype: Any = np.float64) -> Any:
    """Declare a field (T, ...) with one entry of that shape per tick; None is a length that the first tick decides."""
    free = tuple(-1 if size is None else size for size in shape)
    empty = tuple(0 if size is None else size for size in shape)

    def entry(value: Any) -> Any:
        array = np.array(value, dtype=dtype)
        return array.reshape(free) if free.count(-1) <= 1 and len(free) else array

    def stack(entries: list[Any]) -> Any:
        return np.stack(entries) if entries else np.zeros((0, *empty), dtype=dtype)

    return field(metadata={"column": Column(unit, entry, stack)})


def ragged(
    unit: str = "",
    *shape: int,
    dtype: Any = np.float64,
    lasting: bool = False,
) -> Any:
    """Declare a field with an array (n, *shape) per tick, n as it comes.

    A ``lasting`` one seldom changes: ticks in which it is the same share one array.
    """

    def rows(value: Any) -> Any:
        return np.array(value, dtype=dtype).reshape(-1, *shape)

    return field(metadata={"column": Column(unit, rows, list, lasting, rows([]))})


def words() -> Any:
    """Declare a field with one word per tick."""
    return field(metadata={"column": Column("word", str, list)})


def columns(log: Any) -> dict[str, Column]:
    """The columns of a log or of its class, by name."""
    declared: tuple[Field[Any], ...] = fields(log)
    return {f.name: f.metadata["column"] for f in declared if "column" in f.metadata}


class SoFar:
    """A log in the making, to be read like the log: its columns are lists, one entry per tick recorded."""

    def __init__(self, log: type, known: dict[str, Any], entries: dict[str, list[Any]]) -> None:
        """Look at a recorder's parts."""
        self._log, self._known, self._entries = log, known, entries

    @property
    def ticks(self) -> int:
        """Number of ticks recorded."""
        return len(next(iter(self._entries.values())))

    def follows(self, other: SoFar | None) -> bool:
        """Return True if both look at the same recorder."""
        return other is not None and self._entries is other._entries

    def __getattr__(self, name: str) -> Any:
        """A column, something known, a default, or what the log works out of them."""
        for place in (self.__dict__.get("_entries", {}), self.__dict__.get("_known", {})):
            if name in place:
                return place[name]
        if name.startswith("_"):
            raise AttributeError(name)
        attribute = getattr(self._log, name)
        return attribute.fget(self) if isinstance(attribute, property) and attribute.fget is not None else attribute


_watch: ContextVar[Callable[[SoFar], None] | None] = ContextVar("watch", default=None)


@contextmanager
def watched(watch: Callable[[SoFar], None] | None) -> Iterator[None]:
    """Call ``watch`` after every tick that is recorded meanwhile in this thread; None for no call."""
    token = _watch.set(watch)
    try:
        yield
    finally:
        _watch.reset(token)


class Recorder(Generic[L]):
    """A log in the making: one :meth:`add` per tick, then :meth:`finish`."""

    def __init__(self, log: type[L], **known: Any) -> None:
        """Start empty.

        Args:
            log: the class of the log.
            known: of its fields those that are known before the first tick.
        """
        self._log, self._known = log, known
        self._columns = columns(log)
        self._entries: dict[str, list[Any]] = {name: [] for name in self._columns}

    def add(self, **row: Any) -> None:
        """Record one tick; copies what it is given.

        Args:
            row: a value for every column.

        Raises:
            ScenarioError: a column is missing, or there is none of that name.
        """
        if wrong := sorted(row.keys() ^ self._columns.keys()):
            raise ScenarioError(f"a tick of {self._log.__name__} needs every column once, look at: {', '.join(wrong)}")
        for name, value in row.items():
            entries, kind = self._entries[name], self._columns[name]
            entry = kind.entry(value)
            entries.append(entries[-1] if kind.lasting and entries and np.array_equal(entries[-1], entry) else entry)
        watch = _watch.get()
        if watch is not None:
            watch(SoFar(self._log, self._known, self._entries))

    def finish(self, **known: Any) -> L:
        """The finished record, also one without ticks.

        Args:
            known: the fields that are known after the last tick.
        """
        stacked = {name: self._columns[name].stack(entries) for name, entries in self._entries.items()}
        return self._log(**self._known, **known, **stacked)
