"""Two hundred fields of discs and a hundred parkings from guesses a user begins with: InteriorPoint, IPOPT and fatrop.

    python -m benchmarks.hard_guesses [--layouts K]

The problems are stated in tests/problems; the peers differentiate the same expressions exactly, and all solve the same
variables, rows and limits, cold. Prints its table and writes it to out/benchmarks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, TypeAlias

import numpy as np
from tqdm import tqdm

import unifg as fg
from benchmarks.casadi_peer import Staged, available
from benchmarks.report import command, listing, machine, publish
from problems import disc_fields, parkings
from unifg.solvers import InteriorPoint

PEERS = ("ipopt", "fatrop")
GUESSES: tuple[parkings.Guess, ...] = ("rest", "line")
Outcome: TypeAlias = tuple[bool, int, float]
"""Whether solved, iterations, cost."""
Outcomes: TypeAlias = dict[str, list[Outcome]]


def field_peer(plugin: str) -> Staged:
    """The fields of discs; parameters are the discs."""
    import casadi as ca

    dt, n = disc_fields.DT, disc_fields.HORIZON
    discs = ca.SX.sym("discs", 3, disc_fields.DISCS)

    def gap(x: Any, u: Any, after: Any) -> Any:
        heading = x[2] + 0.5 * dt * u[1]
        return after - x - ca.vertcat(dt * u[0] * ca.cos(heading), dt * u[0] * ca.sin(heading), dt * u[1])

    def stage(k: int, x: Any, u: Any) -> tuple[Any, list[Any], list[Any]]:
        if k == n:
            cost = 0.5 * ca.dot(ca.DM(disc_fields.GOAL), (x - ca.DM([disc_fields.LENGTH, 0.0, 0.0])) ** 2)
        else:
            cost = 0.5 * ca.dot(ca.DM(disc_fields.EFFORT), u**2)
        away = [ca.sumsqr(x[:2] - discs[:2, d]) - discs[2, d] ** 2 for d in range(disc_fields.DISCS)]
        return cost, [] if k else [x], away if k else []

    upper = np.append([np.inf] * 3, disc_fields.LIMITS)
    return Staged(plugin, (3, 2, n), stage, gap, ca.vec(discs), (-upper, upper), tol=disc_fields.TOLERANCE)


def parking_peer(plugin: str) -> Staged:
    """The parkings; parameters are start, goal and the discs of the parked cars."""
    import casadi as ca

    dt, n, hull = parkings.DT, parkings.HORIZON, parkings.HULL
    start, goal, cars = ca.SX.sym("start", 4), ca.SX.sym("goal", 4), ca.SX.sym("cars", 2, 2 * len(hull))

    def gap(x: Any, u: Any, after: Any) -> Any:
        v = x[3] + 0.5 * dt * u[0]
        turn = dt * v * ca.tan(u[1]) / parkings.BASE
        heading = x[2] + 0.5 * turn
        return after - x - ca.vertcat(dt * v * ca.cos(heading), dt * v * ca.sin(heading), turn, dt * u[0])

    def stage(k: int, x: Any, u: Any) -> tuple[Any, list[Any], list[Any]]:
        cost = 0.0 if k == n else 0.5 * ca.dot(ca.DM(parkings.EFFORT), u**2)
        if k in (0, n):
            return cost, [x - (goal if k else start)], []
        places = [x[:2] + ahead * ca.vertcat(ca.cos(x[2]), ca.sin(x[2])) for ahead in hull.tolist()]
        least = (2.0 * parkings.RADIUS) ** 2
        return cost, [], [ca.sumsqr(place - cars[:, d]) - least for place in places for d in range(2 * len(hull))]

    upper = np.tile(np.append([np.inf, np.inf, np.inf, parkings.FASTEST], parkings.LIMITS), (n + 1, 1))
    upper[[0, -1], 3] = np.inf  # the first and last state are given
    return Staged(plugin, (4, 2, n), stage, gap, ca.vertcat(start, goal, ca.vec(cars)), (-upper, upper))


def attempt(peer: Staged, *call: Any) -> Outcome:
    """What a peer makes of one problem."""
    peer.run(*call)
    return peer.status == "converged", peer.iterations, peer.cost


def attempts(seeds: Iterable[int], each: Callable[[int], dict[str, Callable[[], Outcome]]]) -> Outcomes:
    """Every solver on every problem in turn."""
    found: Outcomes = {}
    for seed in tqdm(seeds, unit="layout"):
        for name, solve in each(seed).items():
            found.setdefault(name, []).append(solve())
    return found


def ending(solution: fg.Solution) -> Outcome:
    """What ours made of one."""
    return solution.converged, solution.iterations, solution.cost


def fields(layouts: int) -> Outcomes:
    """Fields of discs: every solver on every layout."""
    ours = disc_fields.Field(InteriorPoint(tolerance=disc_fields.TOLERANCE))
    peers = {name: field_peer(name) for name in PEERS if available()}

    def each(seed: int) -> dict[str, Callable[[], Outcome]]:
        discs = disc_fields.layout(seed)
        others = {name: lambda p=peer: attempt(p, *disc_fields.guess(), discs.ravel()) for name, peer in peers.items()}
        return {"ipm": lambda: ending(ours.solve(discs)), **others}

    return attempts(range(layouts), each)


def parked(layouts: int, kind: parkings.Guess) -> Outcomes:
    """Parkings between two cars."""
    ours = parkings.Parking(InteriorPoint())
    peers = {name: parking_peer(name) for name in PEERS if available()}

    def each(seed: int) -> dict[str, Callable[[], Outcome]]:
        drawn = parkings.layout(seed)
        call = *parkings.guess(drawn, kind), np.concatenate([drawn.start, drawn.goal, drawn.cars.ravel()])
        others = {name: lambda p=peer: attempt(p, *call) for name, peer in peers.items()}
        return {"ipm": lambda: ending(ours.solve(drawn, kind)), **others}

    return attempts(range(layouts), each)


def render(results: dict[str, Outcomes]) -> str:
    """One row for every study and solver."""

    def spent(percent: int) -> Callable[[list[Outcome]], str]:
        return lambda outcomes: f"{np.percentile([iterations for _, iterations, _ in outcomes], percent):.0f}"

    columns: dict[str, Callable[[list[Outcome]], str]] = {
        "solved": lambda outcomes: f"{sum(good for good, _, _ in outcomes)} / {len(outcomes)}",
        "iterations, lower quartile": spent(25), "median": spent(50), "upper quartile": spent(75), "most": spent(100),
    }  # fmt: skip
    groups = {(study, name): outcomes for study, found in results.items() for name, outcomes in found.items()}
    return listing(["guesses", "solver"], groups, columns) + "\n\n" + machine("numpy", "numba", "casadi")


def main(arguments: list[str] | None = None) -> int:
    """Run both studies; 0 only if the interior point solves at least as many as each peer."""
    parser = command(__doc__)
    parser.add_argument("--layouts", type=int, default=200, help="fields of discs; half as many parkings")
    options = parser.parse_args(arguments)
    if options.layouts < 2:
        parser.error(f"--layouts must be at least 2, found {options.layouts}")
    results = {"discs": fields(options.layouts)}
    results |= {f"parking, {kind}": parked(options.layouts // 2, kind) for kind in GUESSES}
    publish("hard-guesses", render(results))
    solved = [[sum(good for good, _, _ in outcomes) for outcomes in found.values()] for found in results.values()]
    return 0 if all(counts[0] == max(counts) for counts in solved) else 1


if __name__ == "__main__":
    raise SystemExit(main())
