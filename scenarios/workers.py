"""Executors for episodes: processes of this machine, or the workers of a dask.distributed cluster.

A process pool breaks as a whole when one of its processes dies. The jobs it had are then repeated one at a time in a
new pool, so that a second death names the job that caused it.
"""

from __future__ import annotations

import itertools
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from typing import Any, TypeVar
from unittest import mock

from unifg.errors import ScenarioError

__all__ = ["Workers", "cluster", "died", "finished"]

T = TypeVar("T")
J = TypeVar("J")

_NUMBERS = ("OMP", "OPENBLAS", "MKL", "BLIS", "NUMEXPR", "NUMBA")
THREADS = (*(f"{name}_NUM_THREADS" for name in _NUMBERS), "VECLIB_MAXIMUM_THREADS")
BEAT = 0.25  # [s]
PATIENCE = 10.0  # [s] until a scheduler must have answered


class Workers(Executor):
    """Process pool with one thread for linear algebra in each process.

    Attributes:
        count: number of processes.
    """

    def __init__(self, count: int, ready: Callable[[], object] = int) -> None:
        """Start the first process.

        Args:
            count: number of processes.
            ready: called once in each process before its first job; can be pickled.

        Raises:
            ScenarioError: the count is below one, or no process can be started.
        """
        if count < 1:
            raise ScenarioError(f"at least one worker is needed, found {count}")
        self.count, self._ready = count, ready
        self.renew()

    def renew(self) -> None:
        """Replace the pool, after it broke.

        Raises:
            ScenarioError: no process can be started.
        """
        spawn = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(self.count, spawn, _begin, (self._ready,))
        try:
            self.submit(os.getpid).result()
        except BrokenExecutor as error:
            raise ScenarioError(
                f"no worker can be started: {error}; a script that starts workers keeps what it does below "
                "`if __name__ == '__main__':`"
            ) from None

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """Run a function in the next free process; a process started for it finds one thread in its environment."""
        with mock.patch.dict(os.environ, dict.fromkeys(THREADS, "1")):
            return self._pool.submit(fn, *args, **kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes after their jobs."""
        self._pool.shutdown(wait, cancel_futures=cancel_futures)

    def kill(self) -> None:
        """End the processes at once."""
        for process in list((self._pool._processes or {}).values()):  # kill_workers() comes with Python 3.14
            process.kill()
        self.shutdown(cancel_futures=True)


def _begin(ready: Callable[[], object]) -> None:
    """Prepare a process: control-C is left to the parent, and the process ends with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_follow_parent, daemon=True).start()
    ready()


def _follow_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def cluster(address: str) -> Iterator[tuple[Executor, Callable[[], int]]]:
    """Workers behind a dask.distributed scheduler, and how many jobs to submit: two for each thread there is now.

    Args:
        address: of the scheduler, such as tcp://10.0.0.1:8786.

    Raises:
        ScenarioError: dask.distributed is not installed, or no scheduler answers.
    """
    try:
        from distributed import Client
    except ImportError:
        raise ScenarioError("a cluster needs dask.distributed: pip install 'unifg[campaign]'") from None
    try:
        client = Client(address, timeout=PATIENCE)
    except (OSError, ValueError) as error:
        raise ScenarioError(f"no scheduler answers at {address} ({error})") from None

    def capacity() -> int:
        try:
            return 2 * int(sum(client.nthreads().values()))
        except (OSError, ValueError, RuntimeError) as error:
            raise ScenarioError(
                f"the scheduler at {address} is gone ({error}); what ended before is kept: start again"
            ) from None

    try:
        yield client.get_executor(pure=False, retries=0), capacity
    finally:
        client.close()


def died(future: Future[Any]) -> bool:
    """Test whether the worker of a finished job died; the error then says nothing about the job itself."""
    error, cluster = future.exception(), sys.modules.get("distributed")
    return isinstance(error, BrokenExecutor) or (cluster is not None and isinstance(error, cluster.KilledWorker))


def finished(
    executor: Executor,
    task: Callable[[J], Any],
    jobs: Iterable[J],
    at_once: Callable[[], int],
    beat: Callable[[], None] = lambda: None,
) -> Iterator[tuple[J, Future[Any]]]:
    """Yield jobs as they end, with their finished futures.

    A job whose worker died is repeated once, alone; if its worker dies again, its future says so.

    Args:
        executor: runs them.
        task: can be pickled, as the jobs can, where the executor asks for that.
        jobs: taken one by one, when there is room.
        at_once: how many may be submitted; asked again and again, as machines come and go.
        beat: called several times a second, also while nothing ends; may raise.

    Raises:
        ScenarioError: the executor takes no more jobs.
    """
    renew = executor.renew if isinstance(executor, Workers) else None
    coming = iter(jobs)
    waiting: dict[Future[Any], J] = {}
    while True:
        room = max(1, at_once()) - len(waiting)
        for job in itertools.islice(coming, max(0, room)):
            try:
                future = executor.submit(task, job)
            except BrokenExecutor as error:
                if renew is None:
                    raise _closed(error) from error
                coming = itertools.chain([job], coming)
                if not waiting:
                    renew()
                break
            except RuntimeError as error:
                raise _closed(error) from error
            waiting[future] = job
            if future.done():
                break  # reported before more is begun: in one thread nothing runs beside it
        if not waiting:
            return
        done, _ = wait(waiting, BEAT, FIRST_COMPLETED)
        beat()
        if renew is not None and any(map(_broke, done)):
            done, _ = wait(waiting)  # a pool breaks as a whole
        suspects = []
        for future in done:
            job = waiting.pop(future)
            if future.cancelled():
                raise ScenarioError("the executor has dropped its jobs; what ended before is kept: start again")
            if _broke(future):
                suspects.append(job)
            else:
                yield job, future
        if suspects and renew is not None:
            renew()
        for job in suspects:
            future = executor.submit(task, job)
            while not wait([future], BEAT).done:
                beat()
            if _broke(future) and renew is not None:
                renew()
            yield job, future


def _broke(future: Future[Any]) -> bool:
    return not future.cancelled() and isinstance(future.exception(), BrokenExecutor)


def _closed(error: RuntimeError) -> ScenarioError:
    return ScenarioError(f"the executor takes no more jobs ({error}); what ended before is kept: start again")
