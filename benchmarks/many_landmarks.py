"""Plans among up to a hundred cylinders: growth of their cost, and reuse of the elimination between ticks.

A quadrotor follows a line through a field of cylinders, which push by a cost. The plan is solved three ways in a loop
of 30 nodes: anew at every tick, with the dynamics as constraints; by one Gauss-Newton step over a smoother, everything
linearised and eliminated again; and by the same smoother where only what has changed is (the elimination tree is that
of Kaess et al. 2012). In the smoother the dynamics are a cost of 1 mm, a new node enters at the far end at each tick,
and the past stays. This is the outlook of Ta et al. (2014, section VI).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

import unifg as fg
from benchmarks.comparison import Row, interval, where
from benchmarks.report import listing
from benchmarks.runner import Study, every
from benchmarks.timing import clocked
from unifg.models import quadrotor
from unifg.models.avoidance import landmark_clearance
from unifg.smoothing import Incremental
from unifg.solvers import InteriorPoint
from unifg.typing import Array, ArrayLike

NODES, TICK, TICKS = 30, 0.1, 60  # [s]
SPEED, HEIGHT = 2.0, 1.5  # of the line [m/s, m]
RADIUS, MARGIN = 0.25, 0.6  # [m]
COUNTS = 2, 10, 30, 100
BOOKS = quadrotor.Parameters()
EFFORT = [2.0, 2.0, 1.0, 2.0]  # standard deviations of costs
TRACKING, PUSH, MAPPED = 0.5, 0.1, 0.05
NOISE = np.repeat([0.01, 0.005, 0.02], 3)  # of a tick: position [m], attitude [rad], velocity [m/s]
DYNAMICS, PRESENT = 1e-3, 1e-4
ANEW = "solved anew"
THRESHOLDS = {"one step, all anew": (0.0, 0.0), "one step, reuse": (0.05, 1e-5)}
"""Of the smoothers: of linearisation points, and of steps."""
BASES = ANEW, "one step, all anew"


def places(nodes: ArrayLike) -> Array:
    """(n, 3) wanted places by numbers of nodes."""
    ahead = SPEED * TICK * np.asarray(nodes, dtype=np.float64)
    return np.stack([ahead, np.zeros(len(ahead)), np.full(len(ahead), HEIGHT)], axis=1)


def on_line(node: int) -> Array:
    """Wanted state of a node."""
    return quadrotor.STATE.pack(p=places([node])[0], R=fg.SO3.identity(), v=np.array([SPEED, 0.0, 0.0]))


def hovering(count: int) -> Array:
    """(count, 4) controls."""
    return np.repeat(quadrotor.hover(BOOKS)[None], count, axis=0)


def push(p: Array, cylinder: Array) -> Array:
    """(n, 1) lack of clearance [m]."""
    lacking: Array = np.maximum(MARGIN - landmark_clearance(p, cylinder, RADIUS), 0.0)
    return lacking


def field(count: int, rng: np.random.Generator) -> Array:
    """(count, 2) centres along the line, at least 1 m apart."""
    found = list[Array]()
    while len(found) < count:
        new = rng.uniform([1.5, -6.0], [19.5, 6.0])
        if all(np.hypot(*(new - old)) > 1.0 for old in found):
            found.append(new)
    return np.array(found)


class Anew:
    """Plan that an interior point solves at every tick; the dynamics are constraints."""

    def __init__(self, cylinders: Array, unknown: bool = False) -> None:
        """State the graph; unknown cylinders are variables with a prior."""
        graph, nodes = fg.Graph(), np.arange(NODES + 1)
        x, u = graph.variables("x", quadrotor.STATE, NODES + 1), graph.variables("u", quadrotor.CONTROL, NODES)
        self.start, self.line = graph.data("start", on_line(0)), graph.data("line", places(nodes[1:]), each=True)
        graph.fix(x[0], self.start)
        graph.constrain(quadrotor.dynamics, x[:-1], u, x[1:], BOOKS.packed, TICK, lower=0.0, upper=0.0)
        graph.minimize(fg.prior, u, quadrotor.hover(BOOKS), sigma=EFFORT)
        graph.minimize(fg.prior, x[1:].p, self.line, sigma=TRACKING)
        node, number = (index.ravel() for index in np.indices((NODES, len(cylinders))))
        guess: dict[fg.Family, Array] = {x: np.stack([on_line(k) for k in range(NODES + 1)]), u: hovering(NODES)}
        near: Any = fg.each(cylinders[number])
        if unknown:
            seen = graph.variables("cylinders", fg.Rn(2), len(cylinders))
            graph.minimize(fg.prior, seen, fg.each(cylinders), sigma=MAPPED)
            guess[seen], near = cylinders, seen[number]
        graph.minimize(push, x[node + 1].p, near, sigma=PUSH)
        self.u, self.run = u, InteriorPoint(tolerance=1e-4).prepare(graph)
        self.x, self.guess, self.found = x, guess, self.run.solve(guess)

    def tick(self, tick: int, state: Array) -> Array:
        """Control for the state at a tick."""
        data = {self.start: state, self.line: places(tick + 1 + np.arange(NODES))}
        self.found = self.run.solve(self.found.shifted() if tick else self.found, data=data)
        control: Array = self.found[self.u][0]
        return control


class Kept:
    """Plan in a smoother, one Gauss-Newton step a tick; states that have passed stay in it.

    Attributes:
        effort: of the last tick.
    """

    def __init__(self, cylinders: Array, first: Anew, thresholds: tuple[float, float]) -> None:
        """Begin with a plan."""
        self.cylinders = cylinders
        self.smoother = smoother = Incremental(relinearize=thresholds[0], wildfire=thresholds[1])
        self.x, self.u = smoother.variables("x", quadrotor.STATE), smoother.variables("u", quadrotor.CONTROL)
        x, u = first.found[first.x], first.found[first.u]
        smoother.minimize(fg.prior, self.x[0], on_line(0), sigma=PRESENT)
        for k in range(NODES):
            self.state(k)
        self.effort = smoother.update({self.x: x, self.u: u}, iterations=3)

    def state(self, k: int) -> None:
        """State the factors of a step and of the node where it ends."""
        x, u, minimize = self.x, self.u, self.smoother.minimize
        minimize(quadrotor.dynamics, x[k], u[k], x[k + 1], BOOKS.packed, TICK, sigma=DYNAMICS)
        minimize(fg.prior, u[k], quadrotor.hover(BOOKS), sigma=EFFORT)
        minimize(fg.prior, x[k + 1].p, places([k + 1])[0], sigma=TRACKING)
        minimize(push, x[np.full(len(self.cylinders), k + 1)].p, fg.each(self.cylinders), sigma=PUSH)

    def tick(self, tick: int, state: Array) -> Array:
        """Control for the state at a tick, with a new node at the far end."""
        new: dict[Any, Array] = {}
        if tick:
            last = tick + NODES - 1
            control, end = self.smoother.estimate(self.u[-1])[0], self.smoother.estimate(self.x[-1])[0]
            self.smoother.minimize(fg.prior, self.x[tick], state, sigma=PRESENT)
            self.state(last)
            new = {self.x: quadrotor.fly(end, control, TICK, BOOKS), self.u: control}
        self.effort = self.smoother.update(new)
        found: Array = self.smoother.estimate(self.u[tick])[0]
        return found


def measure(seed: int, count: int) -> Row:
    """Time plans with a map that is known and unknown; fly all planners side by side, in random order at each tick."""
    rng = np.random.default_rng(seed)
    turns = np.random.default_rng(seed)
    cylinders = field(count, rng)
    first = Anew(cylinders)
    row: Row = {}
    for name, plan in (("known", first), ("unknown", Anew(cylinders, unknown=True))):
        again = [clocked(partial(plan.run.solve, plan.guess))[1] for _ in range(5)]
        row[f"{name} map, ms"] = 1e3 * min(again) / max(plan.found.iterations, 1)
    kept = {name: Kept(cylinders, first, known) for name, known in THRESHOLDS.items()}
    planners: dict[str, Anew | Kept] = {ANEW: first, **kept}
    states = dict.fromkeys(planners, on_line(0))
    times = {name: np.zeros(TICKS) for name in planners}
    off, clear = ({name: np.zeros(TICKS) for name in planners} for _ in range(2))
    redone = {name: np.zeros((TICKS, 2)) for name in kept}
    for tick in range(TICKS):
        noise = NOISE * rng.normal(size=9)
        for name in turns.permutation(list(planners)).tolist():
            control, seconds = clocked(partial(planners[name].tick, tick, states[name]))
            times[name][tick] = 1e3 * seconds
            moved = quadrotor.fly(states[name], control, TICK, BOOKS)
            states[name] = quadrotor.STATE.retract(moved[None], noise[None])[0]
            off[name][tick] = np.linalg.norm(states[name][:3] - places([tick + 1])[0])
            clear[name][tick] = np.linalg.norm(cylinders - states[name][:2], axis=1).min() - RADIUS
        for name, planner in kept.items():
            redone[name][tick] = planner.effort.eliminated, planner.effort.linearized
    for name in planners:
        row[f"{name}, ms"], row[f"{name}, p99"] = np.percentile(times[name][1:], [50.0, 99.0]).tolist()
        for base in BASES:
            row[f"{name}, {base}"] = float(np.median(times[name][1:] / times[base][1:]))
        row[f"{name}, off"] = float(np.sqrt(np.square(off[name]).mean()))
        row[f"{name}, clear"] = float(clear[name].min())
    for name, found in redone.items():
        row[f"{name}, eliminated"], row[f"{name}, linearised"] = np.median(found[1:], axis=0).tolist()
    return row


def tables(rows: list[Row]) -> str:
    """Loops by planner and number of cylinders, and time of an iteration by what is known of the map."""
    groups = {(name, str(count)): (name, where(rows, count=count)) for count in COUNTS for name in (ANEW, *THRESHOLDS)}

    def mean(what: str) -> Callable[[tuple[str, list[Row]]], str]:
        return lambda named: _mean(named[1], f"{named[0]}, {what}")

    def ratio(base: str) -> Callable[[tuple[str, list[Row]]], str]:
        def shown(named: tuple[str, list[Row]]) -> str:
            values = np.array([row[f"{named[0]}, {base}"] for row in named[1]])
            if not len(values):
                return "-"
            low, high = interval(values)
            return f"{values.mean():.2f} ({low:.2f} to {high:.2f})"

        return shown

    heads = {
        "tick, median [ms]": mean("ms"), "p99": mean("p99"), **{f"of {base}": ratio(base) for base in BASES},
        "variables eliminated": mean("eliminated"),
        "factors linearised": mean("linearised"), "from the line [m rms]": mean("off"),
        "least clearance [m]": mean("clear"),
    }  # fmt: skip
    loops = listing(["plan", "cylinders"], groups, heads)
    maps = {(str(count),): where(rows, count=count) for count in COUNTS}
    columns = {f"{name} map": partial(_mean, name=f"{name} map, ms") for name in ("known", "unknown")}
    growth = listing(["cylinders"], maps, columns)
    return f"{loops}\n\nTime of an iteration of the interior point [ms], {NODES} nodes:\n\n{growth}"


def _mean(rows: list[Row], name: str) -> str:
    return f"{np.mean([row[name] for row in rows]):.3g}" if rows and name in rows[0] else "-"


STUDY = Study(every(count=COUNTS), measure, tables, range(5), alone=lambda cell: True)
