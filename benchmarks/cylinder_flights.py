"""Flights at 6 m/s among ten upright cylinders at random: how many each backend solves, and IPOPT.

    python -m benchmarks.cylinder_flights [--layouts K] [--no-peer]

The flights are stated in tests/problems/cylinders.py. What a solver calls solved is judged by its own KKT test at 1e-6;
IPOPT has the same problem in CasADi's expressions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

import unifg as fg
from benchmarks.report import command, table, words
from problems.cylinders import Flight, flight
from unifg.solvers.names import backends

SEEDS = range(20)
SOLVERS = backends("ipm", "sqp", "alm")


@dataclass(frozen=True)
class Outcome:
    """What a solver made of a layout."""

    solved: bool
    status: str
    iterations: int
    cost: float


def attempt(problem: Flight, solver: fg.Solver) -> Outcome:
    """Solve from the straight line."""
    stated = problem.formulation()
    solution = solver.solve(stated.graph, stated.guess)
    return Outcome(solution.converged, words(solution.status), solution.iterations, float(solution.cost))


def attempt_peer(problem: Flight) -> Outcome:
    """The same by IPOPT."""
    from benchmarks.control_peers import ControlPeer

    peer = ControlPeer(problem, "ipopt")
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


def main(arguments: list[str] | None = None) -> int:
    """Measure and print."""
    parser = command(__doc__)
    parser.add_argument("--layouts", type=int, default=len(SEEDS), help="how many (default: %(default)s)")
    parser.add_argument("--no-peer", action="store_true", help="without IPOPT")
    chosen = parser.parse_args(arguments)
    seeds = range(chosen.layouts)
    print(render(study(seeds, ipopt=not chosen.no_peer), seeds))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
