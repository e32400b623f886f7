"""Outcome and progress of a run on the command line."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from unifg.scenarios.episode import Progress
from unifg.scenarios.logs.vehicle_log import VehicleLog

logger = logging.getLogger("unifg")
if TYPE_CHECKING:
    from unifg.scenarios.logs.mcap_log import Log

__all__ = ["Outcome", "Progress", "Writer", "recorded"]

L = TypeVar("L", bound=VehicleLog)
Writer: TypeAlias = Callable[[Path], object]
"""Writes a file of this path."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of a run.

    Attributes:
        succeeded: whether the robot did what it was asked.
        interrupted: whether the user stopped it.
        summary: table for people.
        metrics: numbers and words for programs, as ``metrics.json`` holds them.
        files: results by file name, in the order they are written: the cheapest and most precious first, in case the
            user loses patience.
        logs: what ``--mcap`` writes, by file name without its end.
        error: what has ended the run before its end; None where nothing has.
    """

    succeeded: bool
    interrupted: bool
    summary: str
    metrics: Mapping[str, Any]
    files: dict[str, Writer]
    logs: Mapping[str, Log] = field(default_factory=dict)
    error: BaseException | None = None

    def record(self) -> None:
        """Let :meth:`write` write the logs as MCAP, too."""
        from unifg.scenarios.logs.mcap_log import write_mcap

        if not self.logs:
            logger.warning("--mcap: a recorded drive is not recorded again")
        self.files.update({f"{stem}.mcap": partial(write_mcap, log=log) for stem, log in self.logs.items()})

    def write(self, folder: Path, progress: Progress) -> list[Path]:
        """Write the results into an existing folder, where files of the same names are replaced.

        Returns:
            The files, what was written last first.
        """
        for number, (name, write) in enumerate(self.files.items()):
            progress(number / len(self.files), name)
            write(folder / name)
        progress(1.0, "done")
        return [folder / name for name in reversed(self.files)]


def recorded(run: Callable[[], L]) -> tuple[L, BaseException | None]:
    """The log of a run, and what has ended it after at least one tick.

    Raises:
        KeyboardInterrupt: when stopped before the first tick.
    """
    error: BaseException | None = None
    try:
        log = run()
    except (Exception, SystemExit) as raised:
        kept: L | None = vars(raised).get("log")
        if kept is None or not kept.ticks:
            raise
        log, error = kept, raised
    if log.ticks == 0:
        raise KeyboardInterrupt
    return log, error
