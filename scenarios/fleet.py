"""Several robots in one building: each on its own, with its own graph, and everybody else's mover.

They tell each other nothing. In the world of each the others are discs that its lidar sees, whose speeds and plans it
does not know and who wait for nobody; all worlds go on side by side, substep by substep.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import zip_longest

from unifg.errors import ScenarioError
from unifg.scenarios.episode import Progress, run_ticks, silent
from unifg.scenarios.log.drive_log import EpisodeLog
from unifg.scenarios.navigation import Episode, NavigationSettings

__all__ = ["run_fleet"]


def run_fleet(robots: Sequence[NavigationSettings], progress: Progress | None = None) -> list[EpisodeLog]:
    """Drive together, until each robot has reached or given up its last goal; whoever has stays where it is.

    Args:
        robots: a drive for each.
        progress: called with the fraction of robots that have come to an end and a short text, once a tick.

    Returns:
        The log of each robot, in whose obstacles the others come last; ends differ.

    Raises:
        ScenarioError: there is no robot, ticks differ, or two of them start in one place.
    """
    if not robots:
        raise ScenarioError("a fleet needs at least one robot")
    dts = {settings.controller.dt for settings in robots}
    if len(dts) > 1:
        raise ScenarioError(f"robots that drive together need one sampling time, got {sorted(dts)} s")
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
    driving = dict(enumerate(fleet))
    (dt,) = dts

    def tick(count: int) -> tuple[float, str] | None:
        controls = {number: one.decide(count) for number, one in driving.items()}
        ways = []
        for number, control in controls.items():
            if control is None:
                del driving[number]
            else:
                ways.append(fleet[number].world.stepping(*control, dt))
        for _ in zip_longest(*ways):  # a substep of all
            pass
        if not driving:
            return None
        return 1.0 - len(driving) / len(fleet), f"{len(driving)} robots under way"

    interrupted = run_ticks(max(one.longest for one in fleet), tick, progress or silent)
    return [one.finish(interrupted) for one in fleet]
