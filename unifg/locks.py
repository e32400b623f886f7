"""One thread at a time, for what keeps numbers between calls.

A compiled graph, a workspace, a smoother: each is one piece of memory that compiled loops write to, and these let other
threads run meanwhile. Whoever owns one holds its turn while it is in use.
"""

from __future__ import annotations

from _thread import RLock
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar, cast

F = TypeVar("F", bound=Callable[..., Any])


class ReentrantLock(RLock):  # type: ignore[misc]
    """A lock that its own thread may take again; ``with turn:`` waits for other threads.

    Copies and pickles have one of their own, which nobody holds.
    """

    @property
    def mine(self) -> bool:
        """True if this thread holds it."""
        return bool(self._is_owned())  # type: ignore[attr-defined]

    def __reduce__(self) -> tuple[type[ReentrantLock], tuple[()]]:
        """Locks are not copied."""
        return ReentrantLock, ()


def synchronized(method: F) -> F:
    """A method that holds the ``_lock`` of its object, and waits for threads that do."""

    @wraps(method)
    def held(self: Any, *arguments: Any, **options: Any) -> Any:
        with self._lock:
            return method(self, *arguments, **options)

    return cast(F, held)
