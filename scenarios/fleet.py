"""Several robots in one building: each on its own, with its own graph, and everybody else's mover.

They tell each other nothing. In the world of each the others are discs that its lidar sees, whose speeds and plans it
does not know and who wait for nobody; all worlds go on side by side, substep by substep.

With several processes each has all worlds and decides for some of the robots: worlds are cheap and repeat themselves to
the bit when all robots are told the same, so that nothing but commands has to be exchanged, once a tick.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from itertools import zip_longest
from typing import TypeVar

from unifg.errors import ScenarioError
from unifg.scenarios.episode import Progress, run_ticks, silent
from unifg.scenarios.log.drive_log import EpisodeLog
from unifg.scenarios.navigation import Episode, NavigationSettings
from unifg.scenarios.workers import Inline, Workers
from unifg.typing import Array

__all__ = ["run_fleet"]

T = TypeVar("T")


def run_fleet(
    robots: Sequence[NavigationSettings], progress: Progress | None = None, *, workers: int = 1
) -> list[EpisodeLog]:
    """Drive together, until each robot has reached or given up its last goal; whoever has stays where it is.

    Args:
        robots: a drive for each.
        progress: called with the fraction of robots that have come to an end and a short text, once a tick.
        workers: processes that decide, each for its share of the robots; one is this process. Drives are the same, to
            the bit, with any number of them. A script that asks for more keeps what it does below
            ``if __name__ == "__main__":``.

    Returns:
        The log of each robot, in whose obstacles the others come last; ends differ.

    Raises:
        ScenarioError: there is no robot, ticks differ, two of them start in one place, or there is no worker.
        WorkerDied: a process ended before the drive did.
    """
    if not robots:
        raise ScenarioError("a fleet needs at least one robot")
    if workers < 1:
        raise ScenarioError(f"a fleet needs at least one worker, got {workers}")
    dts = {settings.controller.dt for settings in robots}
    if len(dts) > 1:
        raise ScenarioError(f"robots that drive together need one sampling time, got {sorted(dts)} s")
    shares = [range(first, len(robots), workers) for first in range(min(workers, len(robots)))]
    pools: list[Executor] = [Workers(1) for _ in shares] if len(shares) > 1 else [Inline()]
    name = id(pools)  # of this drive, in a process that may have several
    try:
        return _driven(name, robots, shares, pools, progress or silent)
    finally:
        _parts.pop(name, None)  # where it ended by an exception
        for pool in pools:
            pool.shutdown(cancel_futures=True)


def _driven(
    name: int,
    robots: Sequence[NavigationSettings],
    shares: Sequence[range],
    pools: Sequence[Executor],
    progress: Progress,
) -> list[EpisodeLog]:
    """Tick until all have ended, each share in its pool."""
    longest = max(_all([pool.submit(_begin, name, robots, mine) for pool, mine in zip(pools, shares, strict=True)]))
    told: dict[int, _Told] = {}

    def tick(count: int) -> tuple[float, str] | None:
        nonlocal told
        found = _all([pool.submit(_go_on, name, count, told) for pool in pools])
        told = {number: one for decided in found for number, one in decided.items()}
        if not told:
            return None
        return 1.0 - len(told) / len(robots), f"{len(told)} robots under way"

    interrupted = run_ticks(longest, tick, progress)
    logs = dict[int, EpisodeLog]()
    for some in _all([pool.submit(_finish, name, interrupted) for pool in pools]):
        logs.update(some)
    return [logs[number] for number in range(len(robots))]


def _all(futures: Sequence[Future[T]]) -> list[T]:
    return [future.result() for future in futures]


@dataclass(frozen=True)
class _Told:
    """What a robot that goes on is told: a command [m/s, rad/s], after it was put down somewhere else (3,) or not."""

    command: tuple[float, float]
    carried: Array | None


@dataclass
class _Part:
    """All robots' worlds, and who is driven from here."""

    fleet: list[Episode]
    mine: Sequence[int]


_parts: dict[int, _Part] = {}  # of this process


def _begin(name: int, robots: Sequence[NavigationSettings], mine: Sequence[int]) -> int:
    """Make all worlds; ticks that the longest drive may take."""
    fleet = [Episode(settings) for settings in robots]
    for one in fleet:
        for other in fleet:
            if other is not one:
                one.world.meet(other.world)
    for number, one in enumerate(fleet):
        if one.world.clearance() < 0.0:
            x, y, _ = one.start
            raise ScenarioError(f"robot {number + 1} cannot start at ({x:g}, {y:g}): another one stands there")
        one.begin()
    _parts[name] = _Part(fleet, mine)
    return max(one.longest for one in fleet)


def _go_on(name: int, count: int, told: Mapping[int, _Told]) -> dict[int, _Told]:
    """Drive everybody by what was told, then decide here; robots that have ended are left out."""
    part = _parts[name]
    fleet = part.fleet
    for number, one in told.items():
        if one.carried is not None and number not in part.mine:
            fleet[number].world.carry(one.carried)
    dt = fleet[0].settings.controller.dt
    for _ in zip_longest(*(fleet[number].world.stepping(*told[number].command, dt) for number in sorted(told))):
        pass  # a substep of all
    decided: dict[int, _Told] = {}
    for number in part.mine:
        if count and number not in told:  # it has ended
            continue
        command = fleet[number].decide(count)
        if command is not None:
            decided[number] = _Told(command, fleet[number].carried)
    return decided


def _finish(name: int, interrupted: bool) -> dict[int, EpisodeLog]:
    """Logs of those who drove here."""
    part = _parts.pop(name)
    return {number: part.fleet[number].finish(interrupted) for number in part.mine}
