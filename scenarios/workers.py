"""Processes that each do one thing at a time, as an executor: one that dies takes down only what it was doing.

A pool of the standard library breaks as a whole when one of its processes dies, and cannot say whose work killed it.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pickle
import queue
import signal
import threading
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from multiprocessing.connection import Connection
from typing import Any, TypeAlias, TypeVar

from unifg.errors import ScenarioError

__all__ = ["Inline", "WorkerDied", "WorkerNotStarted", "Workers"]

T = TypeVar("T")
_Call: TypeAlias = tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any]]

_NUMBERS = ("OMP", "OPENBLAS", "MKL", "BLIS", "NUMEXPR", "NUMBA")
THREADS = (*(f"{name}_NUM_THREADS" for name in _NUMBERS), "VECLIB_MAXIMUM_THREADS")
STARTS = 3  # a worker may fail to start, as when the machine is short of memory
_starting = threading.Lock()


class WorkerDied(RuntimeError):
    """The process ended before what it was doing."""


class WorkerNotStarted(ScenarioError):
    """No process could be made ready."""


class Inline(Executor):
    """This thread: what is submitted is done at once."""

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """Do it."""
        future: Future[T] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class Workers(Executor):
    """Processes with one thread for linear algebra each, started when there is work and replaced when they die."""

    def __init__(self, count: int, ready: Callable[[], None] | None = None) -> None:
        """Start no process yet.

        Args:
            count: of processes.
            ready: called once in each process before its first work; can be pickled.
        """
        if count < 1:
            raise ScenarioError(f"at least one worker is needed, found {count}")
        self.count = count
        self._ready = ready
        self._queue: queue.SimpleQueue[tuple[Future[Any], _Call] | None] = queue.SimpleQueue()
        self._killed = False
        self._workers: dict[int, _Worker] = {}
        self._lanes = [threading.Thread(target=self._serve, args=(k,), daemon=True) for k in range(count)]
        for lane in self._lanes:
            lane.start()

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """Have it done by the next process that is free."""
        future: Future[T] = Future()
        self._queue.put((future, (fn, args, kwargs)))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes, after what was submitted or without."""
        if cancel_futures:
            with contextlib.suppress(queue.Empty):
                while True:
                    item = self._queue.get_nowait()
                    if item is not None:
                        item[0].cancel()
        for _ in self._lanes:
            self._queue.put(None)
        for lane in self._lanes if wait else ():
            lane.join()

    def kill(self) -> None:
        """End the processes now, whatever they are doing."""
        self._killed = True
        for worker in list(self._workers.values()):
            worker.process.kill()
        self.shutdown(cancel_futures=True)

    def _serve(self, lane: int) -> None:
        while (item := self._queue.get()) is not None:
            future, call = item
            if not future.set_running_or_notify_cancel():
                continue
            try:
                if lane not in self._workers:
                    self._workers[lane] = self._started()
                    if self._killed:  # while it was started
                        self._workers[lane].process.kill()
                found = self._workers[lane].do(call)
            except BaseException as error:
                if isinstance(error, WorkerDied):
                    self._workers.pop(lane, None)
                future.set_exception(error)
            else:
                future.set_result(found)
            del item, future, call
        worker = self._workers.pop(lane, None)
        if worker is not None:
            worker.end()

    def _started(self) -> _Worker:
        tries = 0
        while not self._killed:
            try:
                return _Worker(self._ready)
            except WorkerDied as error:
                tries += 1
                if tries == STARTS:
                    raise WorkerNotStarted(
                        f"no worker can be started: {error}; a script that starts workers keeps what it does below "
                        "`if __name__ == '__main__':`"
                    ) from None
        raise WorkerDied("stopped")


class _Worker:
    """One process, and this end of the pipe to it."""

    def __init__(self, ready: Callable[[], None] | None) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, there = context.Pipe()
        self.process = context.Process(target=_work, args=(there, ready), daemon=True)
        with _starting, _one_thread(), _unheard():
            self.process.start()
        there.close()
        self._answer()

    def do(self, call: _Call) -> Any:
        """Have something done.

        Raises:
            WorkerDied: while doing it.
            Exception: what it raised.
        """
        data = pickle.dumps(call)
        try:
            self.connection.send_bytes(data)
        except OSError as error:
            raise self._dead() from error
        return self._answer()

    def end(self) -> None:
        """Let it go."""
        self.connection.close()
        self.process.join(5.0)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()

    def _answer(self) -> Any:
        try:
            found, error = pickle.loads(self.connection.recv_bytes())
        except (EOFError, OSError) as gone:
            raise self._dead() from gone
        if error is not None:
            raise error
        return found

    def _dead(self) -> WorkerDied:
        self.connection.close()
        self.process.join(5.0)
        code = self.process.exitcode
        how = f"by signal {-code}" if code is not None and code < 0 else f"with status {code}"
        return WorkerDied(f"worker {self.process.pid} ended {how}")


def _work(connection: Connection, ready: Callable[[], None] | None) -> None:
    """What a process does until the other end of the pipe is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to all; who has started us decides
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    threading.Thread(target=_follow_parent, daemon=True).start()
    _answer(connection, lambda: ready() if ready is not None else None)
    with contextlib.suppress(EOFError, OSError):
        while True:
            data = connection.recv_bytes()
            _answer(connection, lambda data=data: _done(data))  # type: ignore[misc]


def _done(data: bytes) -> Any:
    function, arguments, named = pickle.loads(data)
    return function(*arguments, **named)


def _answer(connection: Connection, what: Callable[[], Any]) -> None:
    """Send what it returns, or what it raises."""
    try:
        data = pickle.dumps((what(), None))
    except BaseException as error:
        told = traceback.format_exc()
        error.add_note(f"in a worker:\n{told}")
        try:
            data = pickle.dumps((None, error))
            pickle.loads(data)
        except Exception:  # an exception of somebody's own that does not survive the way
            data = pickle.dumps((None, RuntimeError(told)))
    connection.send_bytes(data)


def _follow_parent() -> None:
    """End when the process that has started us ends, however it ends."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """What processes started meanwhile find in their environment; libraries read it when they are loaded."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextlib.contextmanager
def _unheard() -> Iterator[None]:
    """Processes started meanwhile do not hear control-C while they load."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
