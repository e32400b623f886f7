"""Threads that begin together."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any


def at_once(work: Callable[[int], Any], threads: int = 4) -> list[Any]:
    """Results of threads that begin together: values returned, or exceptions raised."""
    begin, found = threading.Barrier(threads), [None] * threads

    def run(number: int) -> None:
        begin.wait()
        try:
            found[number] = work(number)
        except Exception as error:
            found[number] = error  # type: ignore[call-overload]

    running = [threading.Thread(target=run, args=(number,)) for number in range(threads)]
    for thread in running:
        thread.start()
    for thread in running:
        thread.join(60.0)
        assert not thread.is_alive(), "they wait for each other for ever"
    return found
