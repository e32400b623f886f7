"""The control cases in closed loop: a hundred steps, converged and with one iteration a step."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Protocol, TypeAlias

import numpy as np

from benchmarks.cold import PEERS, TOLERANCE, runnable
from benchmarks.report import listing
from problems.control import Driver, Problem, Quadrotor, Tick, Unicycle
from unifg.solvers.names import backend
from unifg.typing import Array

STEPS = 100
SINGLE = "sqp, 1 iteration"
SAFE = "ipm, safe"  # one iteration, and more only while the plan violates the constraints
CONTACT = 1e-4  # depth in an obstacle [m]
OURS = ("ipm", SAFE, "sqp", SINGLE, "alm", "alm, new penalties")


def cases() -> list[Problem]:
    """Those the targets speak of, and the long horizon of the quadrotor."""
    problems: list[Problem] = [Unicycle(i, b, 50) for i in ("straight", "behind") for b in (False, True)]
    return (
        problems
        + [Quadrotor(i, b, 20) for i in ("figure8", "goto") for b in (False, True)]
        + [Quadrotor("figure8", b, 50) for b in (False, True)]
    )


@dataclass
class Drive:
    """Result of one solver on one drive.

    Attributes:
        ticks: the first is cold.
        repeated: times of the others, repeated at once [ms].
        cost: sum of the stage costs.
        penetration: deepest of the states in an obstacle [m]; negative is a clearance.
    """

    ticks: list[Tick] = field(default_factory=list)
    repeated: list[float] = field(default_factory=list)
    cost: float = 0.0
    penetration: float = -np.inf

    @property
    def times(self) -> list[float]:
        """Of the solves after the first [ms]."""
        return [tick.milliseconds for tick in self.ticks[1:]]

    @property
    def iterations(self) -> list[int]:
        """Of the same."""
        return [tick.iterations for tick in self.ticks[1:]]

    def failures(self, *good: str) -> Counter[str]:
        """Solves that ended otherwise than converged, by a stop rule or well, by status, the first included."""
        return Counter(tick.status for tick in self.ticks if tick.status not in ("converged", "stop rule", *good))


Race: TypeAlias = Callable[[Array, int], Tick]
"""One step of a closed loop, of state and index."""
Row: TypeAlias = tuple[Problem, str, Drive]


class Contestant(Protocol):
    """Driver of a loop: a backend of ours or a solver of casadi."""

    def control(self, state: Array, index: int) -> Tick:
        """Solve for one step, from what the last one ended with."""

    def again(self) -> float:
        """Processor time of the same solve, when everything it needs is in the caches [ms]."""


def contestant(problem: Problem, name: str) -> Contestant:
    """Contestant of a name in the tables."""
    short, _, how = name.partition(", ")
    if name in PEERS:
        from benchmarks.control_peers import WARM, ControlPeer

        return ControlPeer(problem, short, how == "compiled", tol=TOLERANCE, **WARM[short])
    options: dict[str, float] = {"max_iterations": 1} if name == SINGLE else {}
    if name == SAFE:
        options = {"step_tolerance": np.inf, "violation_tolerance": CONTACT}
    solver = backend(short, tolerance=TOLERANCE, **options)
    return Driver(problem.formulation(), solver, penalties=how != "new penalties")


def drive(problem: Problem) -> dict[str, Drive]:
    """Drive a problem's robot with backends, and with the peers that are here."""
    who = {name: contestant(problem, name) for name in (*OURS, *runnable())}
    return race(problem, {name: one.control for name, one in who.items()}, again=who)


def race(
    problem: Problem,
    racers: Mapping[str, Race],
    order: Callable[[list[str]], Iterable[str]] = list,
    again: Mapping[str, Contestant] | None = None,
) -> dict[str, Drive]:
    """Drive every robot one step in turn: a slow moment of the machine meets all of them.

    Args:
        problem: to be driven.
        racers: a step of each.
        order: of the names in a step.
        again: contestants whose steps are repeated at once.
    """
    drives, states = {name: Drive() for name in racers}, dict.fromkeys(racers, problem.start)
    for index in range(STEPS + 1):
        for name in order(list(racers)):
            found = drives[name]
            if index:
                control = found.ticks[-1].control
                found.cost += problem.stage_cost(states[name], control, index - 1)
                states[name] = problem.plant(states[name], control, index - 1)
                found.penetration = max(found.penetration, problem.penetration(states[name]))
            found.ticks.append(racers[name](states[name], index))
            if index and again is not None:  # the cold solve is no step of the loop
                found.repeated.append(again[name].again())
    return drives


def render(results: Mapping[Problem, Mapping[str, Drive]]) -> str:
    """A table and what it means."""

    def ratio(peer: str, of: str = "times") -> Callable[[Row], str]:
        def told(row: Row) -> str:
            problem, name, mine = row
            other = results[problem].get(peer)
            if other is None or name in (peer, *PEERS[:-1]):
                return "-"
            return f"{np.median(getattr(mine, of)) / np.median(getattr(other, of)):.2f}"

        return told

    def failed(row: Row) -> str:
        found = Counter[str]() if row[1] == SINGLE else row[2].failures()
        return ", ".join(f"{count} {status}" for status, count in found.items()) or "0"

    def of(told: Callable[[Drive], str]) -> Callable[[Row], str]:
        return lambda row: told(row[2])

    columns = {
        "median [ms]": of(lambda drive: f"{np.median(drive.times):.3f}"),
        "p99 [ms]": of(lambda drive: f"{np.percentile(drive.times, 99):.3f}"),
        "iterations, median": of(lambda drive: f"{np.median(drive.iterations):.0f}"),
        "mean": of(lambda drive: f"{np.mean(drive.iterations):.1f}"),
        "most": of(lambda drive: str(max(drive.iterations))),
        "failures": failed,
        "cost": of(lambda drive: f"{drive.cost:.4f}"),
        "penetration [mm]": of(lambda drive: f"{1e3 * drive.penetration:.4f}".replace("-inf", "-")),
        **{f"times {peer}": ratio(peer) for peer in PEERS},
        "repeated [ms]": of(lambda drive: f"{np.median(drive.repeated):.3f}"),
        "times fatrop, repeated": ratio("fatrop", "repeated"),
    }
    rows = {
        (problem.title, name): (problem, name, drive)
        for problem, drives in results.items() for name, drive in drives.items()
    }  # fmt: skip
    notes = (
        f"{STEPS} steps, tolerance {TOLERANCE:.0e}, interleaved; the time is the processor time of the solve call, "
        "after a cold solve that is not counted. Warm start: values and multipliers moved by one stage, the last ones "
        "repeated (fatrop takes no multipliers); the augmented Lagrangian's penalties too, unless it chooses new ones. "
        "Where nothing can be hit the plant is disturbed. Cost: sum of the stage costs of the states and controls that "
        "happened. Penetration: deepest state of the plant in an obstacle, negative is a clearance. Repeated: the same "
        "solve once more, at once; the first time the other solvers have just used the caches. One iteration: SQP "
        "is stopped after a single one in every step. Safe: it is stopped at the first iterate that keeps the "
        f"constraints to {CONTACT:g} (`step_tolerance=np.inf, violation_tolerance={CONTACT:g}`)."
    )
    return "\n\n".join([listing(["closed loop", "solver"], rows, columns), notes])
