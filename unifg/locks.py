"""One thread at a time, for what keeps numbers between calls.

A compiled graph, a workspace, a smoother: each is one piece of memory that compiled loops write to, and these let other
threads run meanwhile. Whoever owns one holds its lock while it is in use.
"""

from __future__ import annotations

from _thread import RLock, get_ident
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar, cast

F = TypeVar("F", bound=Callable[..., Any])


class ReentrantLock(RLock):  # type: ignore[misc]
    """A lock that its own thread may take again; ``with lock:`` waits for other threads.

    Copies and pickles have one of their own, which nobody holds.
    """

    _depth, _holder = 0, 0

    def __enter__(self, blocking: bool = True, timeout: float = -1.0) -> bool:
        """Wait for other threads."""
        self.acquire(blocking, timeout)
        self._depth += 1
        self._holder = get_ident()
        return True

    def __exit__(self, *raised: Any) -> None:
        """Let others have it, at the end of the outermost block."""
        self._depth -= 1
        if self._depth == 0:
            self._holder = 0
        self.release()

    @property
    def mine(self) -> bool:
        """True within a block of this thread."""
        return self._holder == get_ident()

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
