"""Wall-clock times of the stages of one piece of work."""

from __future__ import annotations

import time


class Stopwatch:
    """Seconds by name.

    Attributes:
        seconds: of each stage, as they were last taken [s].
    """

    def __init__(self) -> None:
        """Start."""
        self.seconds: dict[str, float] = {}
        self.start()

    def start(self) -> None:
        """Begin a stage."""
        self._since = time.perf_counter()

    def split(self, name: str) -> None:
        """End a stage, and begin the next one."""
        now = time.perf_counter()
        self.seconds[name], self._since = now - self._since, now

    @property
    def milliseconds(self) -> dict[str, float]:
        """The same in milliseconds, by names that end in ``_ms`` [ms]."""
        return {f"{name}_ms": 1e3 * value for name, value in self.seconds.items()}
