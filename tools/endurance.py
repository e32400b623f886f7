"""Long runs in one process: memory, open files and the time of a tick at the beginning and at the end.

    python -m tools.endurance [--hours 2] [--updates 100000] [--graphs 10000] [--quick]

Smoothers along a road without end, graphs that come and go, drives and flights one after the other. Each runs in the
same process as those before it. Times are medians of a tenth of the run: its second one, for the first one compiles,
and its last. What grows with a map that grows is told per pose. Memory is looked at after the
allocator was told to give back what is free.
"""

from __future__ import annotations

import ctypes
import gc
import os
import time
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

import unifg as fg
from benchmarks.report import command, machine, table
from unifg.scenarios.flight import FlightSettings, run_flight
from unifg.scenarios.navigation import NavigationSettings, run_navigation
from unifg.solvers import GaussNewton
from unifg.typing import Array

PARTS = 10


@dataclass
class Part:
    """One long run.

    Attributes:
        name: of what runs.
        item: what is counted.
        count: how many there were.
        simulated: time in the simulation [s].
        times: of each [s].
        before, after: memory [bytes] and open files after the second tenth and at the end.
    """

    name: str
    item: str
    count: int = 0
    simulated: float = 0.0
    times: array[float] = field(default_factory=lambda: array("d"))  # a list would hold an object for each
    before: tuple[float, int] = (0.0, 0)
    after: tuple[float, int] = (0.0, 0)
    _since: int = 0

    def note(self, done: float) -> None:
        """Look at the process at a share of the run."""
        if self._since == 0 and done >= 2.0 / PARTS:
            self.before, self._since = looked_at(), self.count
        if done >= 1.0:
            self.after = looked_at()

    @property
    def growth(self) -> float:
        """Memory for each item since the second tenth [bytes]."""
        return (self.after[0] - self.before[0]) / max(self.count - self._since, 1)

    def tenth(self, number: int) -> float:
        """Median time of a tenth of the run [s]."""
        length = max(len(self.times) // PARTS, 1)
        return float(np.median(self.times[number * length : (number + 1) * length]))


def looked_at() -> tuple[float, int]:
    """Memory [bytes] and open files of this process."""
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:  # of glibc; otherwise memory says what the greatest run so far has needed
        trim(0)
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return float(pages * os.sysconf("SC_PAGE_SIZE")), len(list(Path("/proc/self/fd").iterdir()))


def road(smoother: fg.Incremental | fg.FixedLag, updates: int) -> Part:
    """Odometry along a circle, one pose an update; every tenth knows a pose from a while ago."""
    part = Part(type(smoother).__name__, "updates")
    x, step = smoother.variables("x", fg.SE2), np.array([1.0, 0.0, 0.02])
    pose: Array = np.zeros(3)
    five = pose
    for _ in range(5):
        five = fg.SE2.compose(five, step)
    for k in range(updates):
        if k == 0:
            smoother.minimize(fg.prior, x[0], pose, sigma=0.1)
        else:
            pose = fg.SE2.compose(pose, step)
            smoother.minimize(fg.between, x[k - 1], x[k], step, sigma=0.05)
            if k % 10 == 0:
                smoother.minimize(fg.between, x[k - 5], x[k], five, sigma=0.05)
        began = time.perf_counter()
        smoother.update({x: pose})
        part.times.append(time.perf_counter() - began)
        part.count += 1
        if (k + 1) % max(updates // PARTS, 1) == 0:
            part.note((k + 1) / updates)
    error = fg.SE2.local(smoother.estimate(x[-1])[0], pose)
    assert float(np.abs(error).max()) < 1e-3, error
    return part


def pulled(p: Array, goal: Array) -> Array:
    """A residual of the user's."""
    return np.asarray(np.sin(0.1 * p) + p - goal)


def graphs(count: int) -> Part:
    """Graphs that are stated, solved and forgotten."""
    part = Part("graphs", "graphs")
    for k in range(count):
        began = time.perf_counter()
        graph = fg.Graph()
        x = graph.variables("x", fg.SE2, 10)
        y = graph.variables("y", fg.Rn(2), 10)
        graph.minimize(fg.prior, x[0], [0.0, 0.0, 0.0], sigma=0.1)
        graph.minimize(fg.between, x[:-1], x[1:], [1.0, 0.0, 0.1], sigma=0.1)
        graph.minimize(pulled, y, [0.1 * (k % 7), 1.0])
        assert GaussNewton().solve(graph, {x: np.zeros((10, 3)), y: np.zeros((10, 2))}).converged
        part.times.append(time.perf_counter() - began)
        part.count += 1
        if (k + 1) % max(count // PARTS, 1) == 0:
            part.note((k + 1) / count)
    return part


def episodes(name: str, ticks: Callable[[int], tuple[Array, float]], hours: float) -> Part:
    """Closed loops, one after the other, until so much time has passed in the simulation."""
    part, seed = Part(name, "ticks"), 0
    while part.simulated < 3600.0 * hours:
        times, simulated = ticks(seed)
        part.times.extend(times.tolist())
        part.count += len(times)
        part.simulated += simulated
        part.note(min(part.simulated / (3600.0 * hours), 0.99))
        seed += 1
    part.note(1.0)
    return part


def drive(seed: int) -> tuple[Array, float]:
    """Times of the ticks of a drive [s], and how long it took in the simulation [s]."""
    log = run_navigation(NavigationSettings(obstacles=3, seed=seed))
    return 1e-3 * np.asarray(log.solve_ms), float(log.time[-1])


def flown(seed: int) -> tuple[Array, float]:
    """The same of a flight."""
    log = run_flight(FlightSettings(seed=seed))
    return 1e-3 * np.asarray(log.plan_ms), float(log.time[-1])


def everything(updates: int, count: int, hours: float) -> Iterator[Part]:
    """All parts, in one process."""
    yield episodes("navigation", drive, hours)
    yield episodes("flight", flown, hours)
    yield road(fg.Incremental(), updates)
    yield road(fg.FixedLag(100), updates)
    yield graphs(count)


def described(parts: list[Part]) -> str:
    """The table."""
    head = ["", "", "simulated", "memory for each", "memory", "open files", "second tenth", "last tenth"]
    rows = []
    for part in parts:
        rows.append([
            part.name,
            f"{part.count} {part.item}",
            f"{part.simulated / 60.0:.0f} min" if part.simulated else "",
            f"{part.growth:.0f} B",
            f"{part.before[0] / 1e6:.0f} to {part.after[0] / 1e6:.0f} MB",
            f"{part.before[1]} to {part.after[1]}",
            f"{1e3 * part.tenth(1):.3f} ms",
            f"{1e3 * part.tenth(PARTS - 1):.3f} ms",
        ])  # fmt: skip
    return table(head, rows, 2)


def main(arguments: list[str] | None = None) -> int:
    """Run, and print the table."""
    parser = command(__doc__)
    parser.add_argument("--hours", type=float, default=2.0, help="simulated, of drives and of flights")
    parser.add_argument("--updates", type=int, default=100_000, help="of each smoother")
    parser.add_argument("--graphs", type=int, default=10_000)
    parser.add_argument("--quick", action="store_true", help="a hundredth of everything, for a look")
    options = parser.parse_args(arguments)
    share = 0.01 if options.quick else 1.0
    for part in everything(int(options.updates * share), int(options.graphs * share), options.hours * share):
        print(described([part]), flush=True)
    print(machine())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
