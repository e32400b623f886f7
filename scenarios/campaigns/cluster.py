"""Workers of a dask.distributed cluster as an executor."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager

from unifg.errors import ScenarioError

__all__ = ["cluster"]

PATIENCE = 10.0  # [s] until a scheduler must have answered
ASK_AGAIN = 2.0  # [s] between looks at who is there


@contextmanager
def cluster(address: str) -> Iterator[tuple[Executor, Callable[[], int]]]:
    """The workers behind a scheduler, and how many episodes to keep under way: two for each thread there is now.

    Args:
        address: of the scheduler, such as tcp://10.0.0.1:8786.

    Raises:
        ScenarioError: dask.distributed is not installed, or nobody answers.
    """
    try:
        from distributed import Client
    except ImportError:
        raise ScenarioError("a cluster needs dask.distributed: pip install 'unifg[campaign]'") from None
    try:
        client = Client(address, timeout=PATIENCE)
    except (OSError, ValueError) as error:
        raise ScenarioError(f"no scheduler answers at {address} ({error})") from None
    asked, found = 0.0, 0

    def capacity() -> int:
        nonlocal asked, found
        if time.monotonic() - asked > ASK_AGAIN:
            try:
                found, asked = 2 * sum(client.nthreads().values()), time.monotonic()
            except (OSError, ValueError, RuntimeError) as error:
                raise ScenarioError(
                    f"the scheduler at {address} is gone ({error}); what ended before is kept: start again"
                ) from None
        return found

    try:
        yield client.get_executor(pure=False, retries=0), capacity
    finally:
        client.close()
