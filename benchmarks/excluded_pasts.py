"""Past states under hard constraints, paired over layouts.

Two studies. In an orchard of close pillars a robot sees some of them, without names, misses others and sees some that
are not there; no drive leads through a pillar, which excludes associations. Beside a wall and with drag, a past is
estimated with and without what is impossible. Layouts are the random effect: intervals are bootstrapped over them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

import unifg as fg
from benchmarks import impossible_states
from benchmarks.comparison import Row, bracketed, where
from benchmarks.report import table
from benchmarks.runner import Study, every
from unifg.lie import SE2
from unifg.models import landmarks, obstacles
from unifg.solvers import GaussNewton, InteriorPoint
from unifg.typing import Array, IntArray

PILLAR, ROBOT = 0.15, 0.25  # radii [m]
SPACING, SITES, FILLED = 1.0, 9, 0.5  # of pillars [m], sites along an edge, share of those taken
STEP, STEPS, EVERY = 0.25, 12, 4  # of the robot [m]; steps; between scans
WHEELS = np.array([0.02, 0.02, 0.02])  # standard deviations of a step [m, m, rad]
PRIOR = np.array([0.7, 0.7, 0.05])  # of where the drive began
REACH, SIGMA = 1.5, 0.1  # of the sensor, and deviation of a sighting in each direction [m]
GATE = 0.35  # of an association [m]
NEAREST = 3  # pillars that a pose keeps off
ROUNDS = 3  # of association
DRIVES = 20  # in each layout
CONDITIONS = {
    "nearly all are seen": (0.9, 0.2),
    "half are missed": (0.5, 0.5),
    "half are missed, clutter": (0.5, 3.0),
    "most are missed, clutter": (0.3, 3.0),
}
"""Chance of a sighting, and sightings of nothing in a scan."""
METHODS = ("sightings alone", "checked afterwards", "in the graph")


class Orchard(NamedTuple):
    """Pillars (m, 2), and a path (n + 1, 3) among them."""

    pillars: Array
    path: Array


def orchard(seed: int) -> Orchard:
    """Close pillars at half the sites of a square grid, and an arc that keeps clear of them."""
    rng = np.random.default_rng(seed)
    side = SPACING * (np.arange(SITES) - SITES // 2)
    sites = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    while True:
        pillars = sites[rng.uniform(size=len(sites)) < FILLED]
        pillars = pillars + 0.08 * rng.standard_normal(pillars.shape)
        for _ in range(200):
            start = np.append(rng.uniform(-1.5, 1.5, 2), rng.uniform(-np.pi, np.pi))
            twist = np.tile([STEP, 0.0, rng.uniform(-0.15, 0.15)], (STEPS, 1))
            path = travelled(start, twist)
            if gaps(path, pillars).min() > 0.02:
                return Orchard(pillars, path)


def travelled(start: Array, twists: Array) -> Array:
    """(n + 1, 3) poses from a start (3,) by twists (n, 3)."""
    poses = [start]
    for twist in twists:
        poses.append(SE2.retract(poses[-1], twist))
    return np.array(poses)


def gaps(path: Array, pillars: Array) -> Array:
    """(2 n + 1,) distances of the hull from the nearest pillar, at poses (n + 1, 3) and halfway between them [m]."""
    halfway = SE2.retract(path[:-1], 0.5 * SE2.local(path[:-1], path[1:]))
    places = np.vstack([path, halfway])[:, None, :2]
    nearest: Array = np.linalg.norm(places - pillars, axis=2).min(axis=1)
    return nearest - PILLAR - ROBOT


class Scans(NamedTuple):
    """Measurements of a drive.

    Attributes:
        sightings: (s, 2) places in the robot's axes [m].
        poses: (s,) from which pose of the path.
        moved: (n, 3) what the wheels measured.
        begin: (3,) where the drive is believed to have begun.
    """

    sightings: Array
    poses: IntArray
    moved: Array
    begin: Array


def scanned(world: Orchard, chance: float, clutter: float, seed: int) -> Scans:
    """Scans of every fourth pose, wheels and a start, all with noise."""
    rng = np.random.default_rng(seed)
    found, poses = [np.empty((0, 2))], list[int]()
    for k in range(0, STEPS + 1, EVERY):
        places = SE2.act(SE2.inverse(world.path[k]), world.pillars)
        inside = places[np.hypot(*places.T) < REACH]
        seen = inside[rng.uniform(size=len(inside)) < chance]
        count = rng.poisson(clutter)
        radius, angle = REACH * np.sqrt(rng.uniform(size=count)), rng.uniform(0.0, 2.0 * np.pi, count)
        ghosts = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
        scan = np.vstack([seen + SIGMA * rng.standard_normal(seen.shape), ghosts])
        found.append(scan)
        poses += [k] * len(scan)
    steps = SE2.local(world.path[:-1], world.path[1:])
    moved = SE2.exp(steps + WHEELS * rng.standard_normal(steps.shape))
    begin = SE2.retract(world.path[0], np.array(PRIOR) * rng.standard_normal(3))
    return Scans(np.vstack(found), np.array(poses), moved, begin)


class Stated:
    """The graph of one drive, prepared; which sighting is of which pillar is data."""

    def __init__(self, scans: Scans, solver: fg.Solver, bodies: bool) -> None:
        """State it; with bodies, poses keep off the nearest pillars."""
        graph, count = fg.Graph(), len(scans.poses)
        x = self._x = graph.variables("x", SE2, STEPS + 1)
        graph.minimize(fg.prior, x[0], scans.begin, sigma=PRIOR, name="begin")
        graph.minimize(fg.between, x[:-1], x[1:], scans.moved, sigma=WHEELS, name="wheels")
        self._pillar = graph.data("pillar", np.zeros((count, 2)), each=True)
        self._matched = graph.data("matched", np.zeros(count, dtype=bool), each=True)
        if count:
            seen = (x[scans.poses], self._pillar, scans.sightings)
            graph.minimize(landmarks.offset, *seen, sigma=SIGMA, active=self._matched, name="sightings")
        self._centre = graph.data("centre", np.zeros((STEPS + 1, NEAREST, 2)), each=True)
        if bodies:
            radius = np.full(NEAREST, PILLAR + ROBOT)
            graph.constrain(obstacles.disc_clearance, x, self._centre, radius, lower=0.0, name="bodies")
        self._run = solver.prepare(graph)

    def solve(
        self, path: Array, pillar: Array, matched: Array, centre: Array | None = None
    ) -> tuple[float, float, Array]:
        """Violation, cost and path (n + 1, 3) from a path."""
        data: dict[Any, Any] = {self._pillar: pillar, self._matched: matched}
        if centre is not None:
            data[self._centre] = centre
        solution = self._run.solve({self._x: path}, data=data)
        return solution.violation, solution.cost, solution[self._x].copy()


class Estimator:
    """The graph of one drive, prepared with and without the pillars as bodies.

    Attributes:
        world: whose pillars are known; its path is not used.
        scans: what was seen.
    """

    def __init__(self, world: Orchard, scans: Scans, chance: float, clutter: float) -> None:
        """State both graphs."""
        self.world, self.scans = world, scans
        self._free, self._bodies = (
            Stated(scans, solver, bodies)
            for solver, bodies in ((GaussNewton(max_iterations=15), False), (InteriorPoint(max_iterations=60), True))
        )
        # Logarithms of what sightings and misses are worth, beside the squares in the graph.
        self._match = np.log(chance / (2.0 * np.pi * SIGMA**2)) - np.log(clutter / (np.pi * REACH**2))
        self._miss = np.log1p(-chance)

    def _associated(self, path: Array) -> tuple[Array, Array, float]:
        """Pillar of each sighting (s, 2), whether it has one (s,), and what all this is worth beside the squares."""
        scans, pillars = self.scans, self.world.pillars
        places = SE2.act(path[scans.poses], scans.sightings)
        distance = np.linalg.norm(places[:, None] - pillars, axis=2)
        nearest = distance.argmin(axis=1)
        matched = distance[np.arange(len(nearest)), nearest] < GATE
        keys = scans.poses * len(pillars) + nearest
        order = np.lexsort((distance.min(axis=1), keys))
        first = np.zeros(len(keys), dtype=bool)
        first[order[np.unique(keys[order], return_index=True)[1]]] = True  # a pillar is seen once in a scan
        matched &= first
        due = sum(
            int(np.sum(np.linalg.norm(path[k, :2] - pillars, axis=1) < REACH)) for k in range(0, STEPS + 1, EVERY)
        )
        worth = matched.sum() * self._match + max(due - matched.sum(), 0) * self._miss
        return pillars[nearest], matched, float(worth)

    def hypothesis(self, offset: Array, bodies: bool) -> tuple[float, Array]:
        """Cost and path (n + 1, 3) of the explanation that begins beside the believed start by an offset (3,)."""
        path = travelled(SE2.retract(self.scans.begin, offset), SE2.log(self.scans.moved))
        for last in (False,) * (ROUNDS - 1) + (True,):
            pillar, matched, worth = self._associated(path)
            _, cost, path = self._free.solve(path, pillar, matched)
            if last and bodies and gaps(path, self.world.pillars).min() < 0.0:
                near = np.linalg.norm(path[:, None, :2] - self.world.pillars, axis=2).argsort(axis=1)[:, :NEAREST]
                violation, cost, path = self._bodies.solve(path, pillar, matched, self.world.pillars[near])
                if violation > 1e-3:
                    return np.inf, path
        return cost - worth, path


SIDE = 0.7 * np.arange(-2.0, 3.0)
OFFSETS = np.column_stack([*map(np.ravel, np.meshgrid(SIDE, SIDE)), np.zeros(len(SIDE) ** 2)])
"""(25, 3) where hypotheses begin, in the axes of the believed start."""


def explained(world: Orchard, scans: Scans, chance: float, clutter: float) -> dict[str, Array]:
    """The best path (n + 1, 3) by each method, over the same hypotheses.

    What was seen says one thing; a path through pillars can be dropped once it is found, or be kept from arising, which
    also moves those that only graze one.
    """
    estimator = Estimator(world, scans, chance, clutter)
    free = [estimator.hypothesis(offset, bodies=False) for offset in OFFSETS]
    kept = [estimator.hypothesis(offset, bodies=True) for offset in OFFSETS]
    possible = [found for found in free if gaps(found[1], world.pillars).min() > -SIGMA]
    chosen = {"sightings alone": free, "checked afterwards": possible or free, "in the graph": kept}
    return {name: min(some, key=lambda found: found[0])[1] for name, some in chosen.items()}


def attempt(seed: int, study: str) -> Row:
    """Share of drives that were placed wrong, and their errors, by method."""
    if study in impossible_states.STUDIES:
        return {"errors": impossible_states.STUDIES[study](seed, 4 * DRIVES)}
    world, errors = orchard(seed), dict[str, list[float]]()
    chance, clutter = CONDITIONS[study]
    for k in range(DRIVES):
        scans = scanned(world, chance, clutter, 1000 * seed + k)
        for name, path in explained(world, scans, chance, clutter).items():
            off = np.hypot(*(path - world.path)[:, :2].T)
            errors.setdefault(name, []).append(float(off[-1]))
    return {"errors": errors}


WRONG = 0.4  # an error [m] beyond which a place is another one


MEASURES: dict[str, Callable[[Array], float]] = {
    "wrong": lambda errors: 100.0 * float(np.mean(errors > WRONG)),
    "rms": lambda errors: 100.0 * float(np.sqrt(np.mean(errors**2))),
    "median": lambda errors: 100.0 * float(np.median(errors)),
}


def compared(of: Sequence[Sequence[float]], base: Sequence[Sequence[float]], what: str) -> str:
    """Mean over layouts of a measure of the errors, and the interval of its paired difference to the base."""
    mine, theirs = (np.array([MEASURES[what](np.array(errors)) for errors in some]) for some in (of, base))
    if of is base:
        return f"{mine.mean():.3g}"
    return f"{mine.mean():.3g} {bracketed(mine - theirs)}"


def render(rows: list[Row]) -> str:
    """Markdown of both studies."""
    lines, count = list[list[str]](), 0
    for study in CONDITIONS:
        found = [row["errors"] for row in where(rows, study=study)]
        count = len(found)
        by = {name: [errors[name] for errors in found] for name in METHODS}
        for name in METHODS if found else ():
            cells = [compared(by[name], by[METHODS[0]], what) for what in ("wrong", "rms", "median")]
            lines.append([study, name, *cells])
    head = ["condition", "method", f"placed wrong by {WRONG:g} m [%]", "error, rms [cm]", "error, median [cm]"]
    parts = [
        f"{count} layouts, {DRIVES} drives in each; in brackets the 95 % interval, over layouts, of the paired "
        "difference to the first line.",
        "### Which pillars were seen",
        table(head, lines, 2),
        "### What cannot have been",
    ]
    lines = []
    for study, unit in impossible_states.UNITS.items():
        found = [row["errors"] for row in where(rows, study=study)]
        for name in found[0] if found else ():
            by = {n: [errors[n] for errors in found] for n in found[0]}
            lines.append([study, name, unit, compared(by[name], by[next(iter(by))], "rms")])
    parts.append(table(["past", "what is known", "unit", "error, rms"], lines, 3))
    parts.append(f"{4 * DRIVES} drives in each layout.")
    return "\n\n".join(parts)


STUDY = Study(every(study=(*CONDITIONS, *impossible_states.STUDIES)), attempt, render, range(12))
