"""Distance from a user's statement to the work: files on the way, and calls from file to file.

    python -m tools.walks [WALK ...] [--list]

A hand-over is a call of a function in one file of the project by a function in another one; compiled functions call
each other unseen, and what happens while a module is imported does not count. The files of a walk are those at both
ends of its hand-overs. Every walk is gone once before it is counted, so that caches on disk and in memory play no part:
the numbers belong to the code alone.
"""

from __future__ import annotations

import os
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from types import FrameType
from typing import Any, TypeAlias

import numpy as np

import unifg as fg
from benchmarks.report import CHECKOUT, command, table
from unifg.models import unicycle
from unifg.scenarios.flight import FlightSettings, run_flight
from unifg.scenarios.navigation import Episode, NavigationSettings, run_navigation
from unifg.solvers import SQP, GaussNewton

Ends: TypeAlias = Callable[[str, str, str], bool]
FACTORISED = "unifg/elimination/factorization.py"
TICKS = 4  # of an episode, before the one that is counted
HALL = NavigationSettings(start=(6.5, 14.0, 0.0), goals=((13.5, 14.1, 0.0),))


@dataclass
class Walk:
    """Calls from file to file.

    Attributes:
        calls: how often a function (file, name) called one of another file.
    """

    calls: Counter[tuple[str, str, str, str]] = field(default_factory=Counter)

    @property
    def files(self) -> set[str]:
        """At either end of a call."""
        return {file for caller, _, callee, _ in self.calls for file in (caller, callee)}

    @property
    def hand_overs(self) -> int:
        """Number of calls."""
        return self.calls.total()


class Counting:
    """Counts while it is switched on.

    Attributes:
        walk: what was found.
    """

    def __init__(self, ends: Ends | None = None) -> None:
        """Count nothing yet.

        Args:
            ends: asked at every call and return (file, function, "call" or "return") whether the walk is over.
        """
        self.walk = Walk()
        self._ends = ends
        self._known: dict[str, str | None] = {}

    def begin(self) -> None:
        """Switch on."""
        sys.setprofile(self._look)

    def end(self) -> None:
        """Switch off."""
        sys.setprofile(None)

    def _look(self, frame: FrameType, event: str, _: Any) -> None:
        here, name = self._file(frame), frame.f_code.co_name
        if here is None:
            return
        if self._ends is not None and self._ends(here, name, event):
            self.end()
        elif event == "call" and name != "<module>":
            caller = frame.f_back
            while caller is not None and caller.f_code.co_filename.startswith("<"):  # methods that dataclasses write
                caller = caller.f_back
            there = None if caller is None else self._file(caller)
            if caller is not None and there is not None and there != here:
                self.walk.calls[there, caller.f_code.co_name, here, name] += 1

    def _file(self, frame: FrameType) -> str | None:
        """The file of a function from the checkout on, None if it is none of the project's."""
        given = frame.f_code.co_filename
        if given not in self._known:
            path = os.path.relpath(os.path.realpath(given), CHECKOUT)
            own = path.split(os.sep)[0] in ("unifg", "solvers", "models", "scenarios")
            self._known[given] = path.replace(os.sep, "/") if own else None
        return self._known[given]


def front() -> Walk:
    """A lambda, from ``minimize`` into the first front that is factorised."""
    walk = Walk()
    for _ in range(2):
        graph = fg.Graph()
        x = graph.variables("x", fg.SE2, 3)
        graph.fix(x[0], np.zeros(3))
        counting = Counting(_factorised)
        counting.begin()
        graph.minimize(lambda a, b: b - a - np.array([1.0, 0.0, 0.0]), x[:-1], x[1:], sigma=0.1)
        GaussNewton().solve(graph, {x: np.zeros((3, 3))})
        counting.end()
        walk = counting.walk
    return walk


def _factorised(file: str, name: str, event: str) -> bool:
    if file != FACTORISED:
        return False
    return (event == "return" and name == "factor") or (event == "call" and name == "adopt")


def guess() -> Walk:
    """A guess, through a prepared SQP."""
    graph, steps = fg.Graph(), 5
    x, u = graph.variables("x", fg.SE2, steps + 1), graph.variables("u", fg.Rn(2), steps)
    graph.fix(x[0], np.zeros(3))
    graph.minimize(fg.prior, x[-1], [0.8, 0.2, 0.0], sigma=0.1)
    graph.minimize(fg.prior, u, np.zeros(2))
    graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], 0.2, lower=0.0, upper=0.0)
    graph.bound(u, lower=[-1.0, -1.0], upper=[1.0, 1.0])
    prepared, values = SQP().prepare(graph), {x: np.zeros((steps + 1, 3)), u: np.zeros((steps, 2))}
    return _second_time(lambda: prepared.solve(values))


def estimate() -> Walk:
    """A lidar scan, to an estimate."""
    episode = Episode(HALL)
    dt = HALL.controller.dt
    estimator = episode.pilot.estimator
    estimator.update(episode.world.scan(), None, dt)
    return _second_time(lambda: estimator.update(episode.world.scan(), np.zeros(2), dt))


def drive() -> Walk:
    """A tick of navigation."""
    return _tick(lambda progress: run_navigation(HALL, progress))


def flight() -> Walk:
    """A tick of the quadrotor: a measurement, to thrust."""
    return _tick(lambda progress: run_flight(FlightSettings(), progress))


WALKS: dict[str, Callable[[], Walk]] = {
    "front": front, "guess": guess, "estimate": estimate, "drive": drive, "flight": flight,
}  # fmt: skip


def _second_time(action: Callable[[], object]) -> Walk:
    action()
    counting = Counting()
    counting.begin()
    action()
    counting.end()
    return counting.walk


def _tick(run: Callable[[Callable[[float, str], None]], object]) -> Walk:
    """One tick of an episode, which tells how far it is after each of them and ends when it is interrupted."""
    counting, ticks = Counting(), 0

    def progress(done: float, text: str) -> None:
        nonlocal ticks
        counting.end()
        ticks += 1
        if ticks == TICKS + 1:
            raise KeyboardInterrupt
        if ticks == TICKS:
            counting.begin()

    run(progress)
    counting.end()
    return counting.walk


def main() -> None:
    """Count and print."""
    parser = command(__doc__)
    parser.add_argument("walks", nargs="*", metavar="WALK", help=f"all by default: {', '.join(WALKS)}")
    parser.add_argument("--list", action="store_true", help="show every hand-over, the most frequent first")
    options = parser.parse_args()
    for name in options.walks:
        if name not in WALKS:
            parser.error(f"no walk is called '{name}' (there are: {', '.join(WALKS)})")
    rows = []
    for name in options.walks or WALKS:
        walk = WALKS[name]()
        rows.append([name, (WALKS[name].__doc__ or "").rstrip("."), str(len(walk.files)), str(walk.hand_overs)])
        if options.list:
            for (caller, by, callee, what), count in walk.calls.most_common():
                print(f"{count:5d}  {caller}:{by} -> {callee}:{what}")
    print(table(["walk", "what", "files", "hand-overs"], rows, text=2))


if __name__ == "__main__":
    main()
