"""Flights at 6 m/s among ten upright cylinders at random: how many each backend solves, and IPOPT.

    python -m benchmarks.cylinder_flights [--layouts K] [--no-peer]

The quadrotor of :mod:`benchmarks.control_problems` follows a straight line at 6 m/s for 2.5 s; ten cylinders stand at
random on it and beside it. Every backend begins with that line, through the cylinders. What a solver calls solved is
judged by its own KKT test at 1e-6; IPOPT has the same problem in CasADi's expressions.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

import unifg as fg
from benchmarks.control_peers import QuadrotorPeer
from benchmarks.control_problems import Quadrotor, QuadrotorGraph
from benchmarks.report import table
from unifg.models import avoidance, quadrotor
from unifg.solvers.names import backends
from unifg.typing import Array

SPEED = 6.0  # [m/s]
CYLINDERS = 10
SEEDS = range(20)
FREE = 1.5  # of cylinders, around the start [m]
SOLVERS = backends("ipm", "sqp", "alm")


@dataclass(frozen=True)
class Flight(Quadrotor):
    """One layout.

    Attributes:
        seed: of the cylinders.
    """

    upright: ClassVar[bool] = True

    seed: int = 0

    @property
    def name(self) -> str:
        """For the tables."""
        return f"layout {self.seed}"

    @property
    def discs(self) -> Array:
        """(M, 4) x, y, nothing, radius of the cylinders [m]."""
        rng = np.random.default_rng([61, self.seed])
        length = SPEED * self.dt * self.horizon
        found: list[tuple[float, float, float, float]] = []
        while len(found) < CYLINDERS:
            x, y, radius = rng.uniform(0.0, length), rng.uniform(-1.5, 1.5), rng.uniform(0.25, 0.5)
            if np.hypot(x, y) >= FREE + radius:
                found.append((x, y, 0.0, radius))
        return np.array(found)

    @property
    def start(self) -> Array:
        """(10,) level flight at the speed of the reference."""
        return np.array([0.0, 0.0, 1.5, 1.0, 0.0, 0.0, 0.0, SPEED, 0.0, 0.0])

    def reference(self, first: int = 0) -> tuple[Array, Array]:
        """Reference states (N + 1, 10) from step ``first`` on, and controls (N, 4)."""
        t = self.dt * np.arange(first, first + self.horizon + 1)
        states = np.tile(self.start, (len(t), 1))
        states[:, 0] = SPEED * t
        return states, np.tile([0.0, 0.0, 0.0, quadrotor.GRAVITY], (self.horizon, 1))

    def formulation(self) -> FlightGraph:
        """As a factor graph."""
        return FlightGraph(self)


class FlightGraph(QuadrotorGraph):
    """The flight as a factor graph."""

    def keep_off(self) -> None:
        """Add the clearance from every cylinder at every node."""
        discs = self.problem.discs
        away = self.x[1:].p, discs[:, :2], discs[:, 3]
        self.graph.constrain(avoidance.cylinder_clearance, *away, lower=0.0, name="cylinders")


@dataclass(frozen=True)
class Outcome:
    """What a solver made of a layout."""

    solved: bool
    status: str
    iterations: int
    cost: float


def flight(seed: int, horizon: int = 50) -> Flight:
    """One layout of the study."""
    return Flight("flight", True, horizon, seed)


def attempt(problem: Flight, solver: fg.Solver) -> Outcome:
    """Solve from the straight line."""
    stated = problem.formulation()
    solution = solver.solve(stated.graph, stated.guess)
    status = solution.status.name.lower().replace("_", " ")
    return Outcome(solution.converged, status, solution.iterations, float(solution.cost))


def attempt_peer(problem: Flight) -> Outcome:
    """The same by IPOPT."""
    peer = QuadrotorPeer(problem, "ipopt")
    peer.solve(*problem.guess())
    return Outcome(peer.status == "converged", peer.status.replace("_", " "), peer.iterations, peer.cost)


def study(
    seeds: Sequence[int], solvers: dict[str, fg.Solver] = SOLVERS, ipopt: bool = False
) -> dict[str, list[Outcome]]:
    """Every layout by every solver."""
    found: dict[str, list[Outcome]] = {name: [] for name in solvers}
    if ipopt:
        found["ipopt"] = []
    for seed in seeds:
        problem = flight(seed)
        for name, solver in solvers.items():
            found[name].append(attempt(problem, solver))
        if ipopt:
            found["ipopt"].append(attempt_peer(problem))
    return found


def render(results: dict[str, list[Outcome]], seeds: Sequence[int]) -> str:
    """Tables of how many and of every layout."""
    best = [min((o.cost for o in column if o.solved), default=np.nan) for column in zip(*results.values(), strict=True)]
    lines = []
    for name, outcomes in results.items():
        solved = [o for o in outcomes if o.solved]
        cheapest = sum(o.solved and o.cost <= b * (1.0 + 1e-4) for o, b in zip(outcomes, best, strict=True))
        middle = f"{np.median([o.iterations for o in solved]):.0f}" if solved else "-"
        lines.append((name, f"{len(solved)} of {len(outcomes)}", middle, str(cheapest)))
    head = ("solver", "solved", "iterations, median of the solved", "cheapest found")
    rows = [
        (str(seed), *(f"{o.iterations}, {o.cost:.2f}" if o.solved else f"{o.status} after {o.iterations}" for o in row))
        for seed, row in zip(seeds, zip(*results.values(), strict=True), strict=True)
    ]
    return table(head, lines) + "\n\n" + table(("layout", *results), rows)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Flights at 6 m/s among ten cylinders.", allow_abbrev=False)
    parser.add_argument("--layouts", type=int, default=len(SEEDS), help="how many (default: %(default)s)")
    parser.add_argument("--no-peer", action="store_true", help="without IPOPT")
    chosen = parser.parse_args()
    seeds = range(chosen.layouts)
    print(render(study(seeds, ipopt=not chosen.no_peer), seeds))


if __name__ == "__main__":
    main()
