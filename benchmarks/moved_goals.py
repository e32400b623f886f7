"""A goal that moves while a unicycle drives to it through a field of discs: plans at that tick, and the drive after it.

The fields are those of :mod:`benchmarks.obstacle_fields`. The loop tries its warm start, its cold start and detours;
beside it stand the warm start alone, the cold start alone, and twenty starts in every tick after the move.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

import unifg as fg
from benchmarks.casadi_peer import available
from benchmarks.comparison import Row
from benchmarks.obstacle_fields import Field
from benchmarks.report import table
from benchmarks.runner import Study, every
from unifg.horizon import Context, ControlCost, Dynamics, InitialGuesses, RecedingHorizon, Robot, Term, cheapest
from unifg.models import obstacles, unicycle
from unifg.models.detours import detours, headed
from unifg.solvers import InteriorPoint
from unifg.typing import Array

MOVE, AFTER = 10, 60  # ticks before and after the move
STARTS = 20  # warm, cold, perturbed and IPOPT's
SPEED = 0.8  # of guesses [m/s]
DEADLINE = 0.1  # [s] processor time: a tick of the robot
TOLERANCE = 1e-4
SHORT = 0.02  # [s] the same, too short for all starts of a tick
WAYS = ("warm", "cold", "loop", "loop, 20 ms", "20 starts")


@dataclass(frozen=True)
class Moving(Field):
    """A field with a goal at the end of the line, and from tick ``MOVE`` on another one."""

    @property
    def goals(self) -> Array:
        """(2, 3) poses, the second one anywhere beside the discs and at least 1.5 m from the first."""
        rng, discs, first = np.random.default_rng([self.seed, 1]), self.discs, np.array([4.0, 0.0, 0.0])
        while True:
            pose = rng.uniform([0.5, -1.8, -1.0], [4.5, 1.8, 1.0])
            clear = np.hypot(*(discs[:, :2] - pose[:2]).T) > discs[:, 2] + 0.15
            if clear.all() and np.hypot(*(pose - first)[:2]) > 1.5:
                return np.array([first, pose])

    def reference(self, first: int = 0) -> tuple[Array, Array]:
        """The goal of a tick at every node, and no control."""
        return np.tile(self.goals[int(first >= MOVE)], (self.horizon + 1, 1)), np.zeros((self.horizon, 2))

    def straight(self, pose: Array, goal: Array) -> tuple[Array, Array]:
        """Cold start: along the line to the goal."""
        path = detours(pose[:2], goal[:2], np.zeros((0, 2)), 0.0, self.horizon, SPEED * self.dt)[0]
        return headed(path, goal[2]), np.zeros((self.horizon, 2))

    def around(self, pose: Array, goal: Array) -> Iterator[tuple[Array, Array]]:
        """Starts on either side of what blocks the way, forwards and in reverse."""
        for path in detours(pose[:2], goal[:2], self.discs[:, :2], self.discs[:, 2], self.horizon, SPEED * self.dt):
            for backwards in (False, True):
                yield headed(path, goal[2], backwards), np.zeros((self.horizon, 2))


@dataclass(frozen=True)
class Goal:
    """Goal, limits and discs as terms of a loop."""

    field: Moving

    def state(self, graph: fg.Graph, x: Any, u: Any) -> None:
        """Add them."""
        field = self.field
        goal = graph.data("goal", field.goals[0])
        graph.minimize(unicycle.tracking, x[:-1], goal, sigma=field.stage**-0.5, name="tracking")
        graph.minimize(unicycle.tracking, x[-1], goal, sigma=field.terminal**-0.5, name="terminal")
        graph.bound(u, lower=field.lower, upper=field.upper, name="limits")
        discs = field.discs
        graph.constrain(obstacles.disc_clearance, x[1:], discs[:, :2], discs[:, 2], lower=0.0, name="discs")

    def data(self, now: Context[Array]) -> dict[str, Array]:
        """Goal of a tick."""
        return {"goal": now.given}


class Loop:
    """Loop of a field that tries more starts when the goal has moved."""

    def __init__(self, field: Moving, deadline: float) -> None:
        """Prepare it."""
        robot = Robot(field.manifold, fg.Rn(2), tick=field.dt)
        terms: list[Term] = [Dynamics(unicycle.dynamics, field.dt), Goal(field), ControlCost(field.effort**-0.5)]
        self.loop = RecedingHorizon(
            robot, field.horizon, terms, solver=InteriorPoint(tolerance=TOLERANCE), deadline=deadline,
            clock=time.thread_time, starts=InitialGuesses(
                cold=lambda now: field.straight(now.present, now.given),
                others=lambda now: field.around(now.present, now.given),
            ),
        )  # fmt: skip

    def __call__(self, pose: Array, goal: Array, tick: int) -> tuple[float, Array]:
        """Cost of the plan, and its first control."""
        plan = self.loop.plan(pose, goal)
        assert self.loop.solution is not None
        return self.loop.solution.cost, plan.control


class Plain:
    """A loop of one's own: the cheapest answer of some starts in every tick.

    Attributes:
        field: to be driven through.
        way: of :data:`WAYS`.
    """

    def __init__(self, field: Moving, way: str) -> None:
        """Prepare it."""
        self.field, self.way, self.stated = field, way, field.formulation()
        self.run = InteriorPoint(tolerance=TOLERANCE).prepare(self.stated.graph)
        self.last: fg.Solution | None = None

    def starts(self, pose: Array, goal: Array, tick: int) -> Iterable[fg.Guess]:
        """Starts of a tick."""
        x, u = self.stated.x, self.stated.u
        states, controls = self.field.straight(pose, goal)
        cold = fg.Guess({x: states, u: controls})
        if self.last is None or (self.way == "cold" and tick >= MOVE):
            return [cold]
        found = [self.last.shifted(x, u)]
        if self.way == "20 starts" and tick >= MOVE:
            found.append(cold)
            rng, (of_states, of_controls) = np.random.default_rng(7), self.field.spread
            for _ in range(STARTS - 3):
                moved = fg.SE2.retract(states, of_states * rng.standard_normal(states.shape))
                found.append(fg.Guess({x: moved, u: of_controls * rng.standard_normal(controls.shape)}))
        return found

    def __call__(self, pose: Array, goal: Array, tick: int) -> tuple[float, Array]:
        """Cost of the plan, and its first control."""
        data = self.stated.data(pose, tick)
        self.last = cheapest(self.run, self.starts(pose, goal, tick), data=data)
        return self.last.cost, self.last[self.stated.u][0]


def drive(field: Moving, step: Callable[[Array, Array, int], tuple[float, Array]]) -> tuple[float, float, Array]:
    """Cost of the plan at the tick of the move, cost of the drive from there on, and the pose at the move."""
    pose, planned, driven, moved = field.start, np.nan, 0.0, field.start
    for tick in range(MOVE + AFTER):
        goal = field.goals[int(tick >= MOVE)]
        cost, control = step(pose, goal, tick)
        if tick == MOVE:
            planned, moved = cost, pose
        if tick >= MOVE:
            driven += field.stage_cost(pose, control, tick)
        pose = field.plant(pose, control, tick)
    return planned, driven, moved


def measure(seed: int) -> Row:
    """Drive one field in every way."""
    field = Moving("ahead", True, 50, seed)
    loops, row = {"loop": Loop(field, DEADLINE), "loop, 20 ms": Loop(field, SHORT)}, Row()
    for way in WAYS:
        planned, driven, pose = drive(field, loops.get(way) or Plain(field, way))
        row |= {f"{way}, plan": planned, f"{way}, drive": driven}
    best = min(float(row[f"{way}, plan"]) for way in WAYS)
    if available():
        from benchmarks.control_peers import ControlPeer

        peer = ControlPeer(field, "ipopt", tol=TOLERANCE)
        peer.take(*field.straight(pose, field.goals[1]), pose, MOVE)
        peer()
        best = min(best, peer.cost if peer.status == "converged" else np.inf)
    ours = loops["loop"].loop
    times = np.array(ours.milliseconds)
    return row | {
        "best": best, "move [ms]": times[MOVE], "other ticks [ms]": float(np.median(np.delete(times, MOVE))),
        "more": ours.more_starts, "late": ours.sources["late"], "not solved": MOVE + AFTER - ours.sources["solved"],
    }  # fmt: skip


def tables(rows: list[Row]) -> str:
    """Costs over the best, and times of the loop."""
    frame = pd.DataFrame(rows)
    lines = []
    for way in WAYS:
        plan, driven = frame[f"{way}, plan"] / frame["best"], frame[f"{way}, drive"] / frame["20 starts, drive"]
        lines.append((way, *(f"{n:.3f}" for n in (plan.mean(), plan.max(), driven.mean(), driven.max()))))
    sums = frame[["more", "late", "not solved"]].sum()
    head = ("starts", "plan at the move", "worst", "drive after it", "worst")
    times = (f"{frame[name].mean():.1f}" for name in ("move [ms]", "other ticks [ms]"))
    notes = (
        f"{len(frame)} fields. Plan: cost over the best of {STARTS} starts at the tick of the move (and of all that "
        "is in the table), mean and worst; drive: cost of the states and controls that happened from there on, over "
        f"that of the loop that tries {STARTS - 1} in every tick. The loop's tick at the move takes {next(times)} ms "
        f"on average, the others {next(times)} ms (mean of medians), of {1e3 * DEADLINE:.0f}; it tries "
        f"{sums['more']} more starts in {len(frame) * (MOVE + AFTER)} ticks, most at the beginning and at the move. "
        f"{sums['late']} plans are late, {sums['not solved']} ticks have none of their own. In 20 ms the warm "
        "start leaves little time at the move, and the other starts are tried in the ticks after it."
    )
    return f"{table(head, lines)}\n\n{notes}"


STUDY = Study(every(), measure, tables, range(100, 119))
