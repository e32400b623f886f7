"""Layouts at random from guesses a user begins with, by our backends and by casadi's: discs, parkings, cylinders.

    python -m benchmarks.hard_guesses [--studies STUDY ...] [--layouts K] [--each] [--no-peers]

Two hundred fields of discs, a hundred parkings from two guesses, and twenty flights among cylinders. The problems are
stated in tests/problems; the peers differentiate the same expressions exactly, and all solve the same variables, rows
and limits, cold. What a solver calls solved is judged by its own test at 1e-6. Prints its tables and writes them to
out/benchmarks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from tqdm import tqdm

import unifg as fg
from benchmarks.casadi_peer import Staged, available
from benchmarks.report import command, listing, machine, publish, table, words
from problems import disc_fields, parkings
from problems.cylinders import flight
from unifg.solvers.names import backends

PEERS = ("ipopt", "fatrop")
CHEAPEST = 1e-4  # relative difference of costs below which an answer counts as the cheapest


class Outcome(NamedTuple):
    """What a solver made of a layout; the cost with its 1/2."""

    solved: bool
    status: str
    iterations: int
    cost: float


Outcomes: TypeAlias = dict[str, list[Outcome]]
Solve: TypeAlias = Callable[[int], Outcome]
"""Solves the layout of a seed."""


@dataclass(frozen=True)
class Study:
    """One kind of problem.

    Attributes:
        count: layouts, seeds from 0 on.
        ours: prepares one of our backends.
        solvers: of ours.
        peer: prepares a solver of casadi.
        peers: of casadi.
        aimed: whether the interior point is to solve as many as each peer.
    """

    count: int
    ours: Callable[[fg.Solver], Solve]
    solvers: Mapping[str, fg.Solver]
    peer: Callable[[str], Solve]
    peers: tuple[str, ...] = PEERS
    aimed: bool = True

    def run(self, seeds: Iterable[int], solvers: Mapping[str, fg.Solver] | None = None, peers: bool = True) -> Outcomes:
        """Every solver on every layout in turn."""
        solves = {name: self.ours(solver) for name, solver in (solvers or self.solvers).items()}
        solves |= {name: self.peer(name) for name in self.peers if peers and available()}
        found: Outcomes = {name: [] for name in solves}
        for seed in tqdm(seeds, unit="layout"):
            for name, solve in solves.items():
                found[name].append(solve(seed))
        return found


def ended(solution: fg.Solution) -> Outcome:
    """What ours made of one."""
    return Outcome(solution.converged, words(solution.status), solution.iterations, solution.cost)


def answered(peer: Staged) -> Outcome:
    """What a peer made of one."""
    return Outcome(peer.status == "converged", peer.status.replace("_", " "), peer.iterations, peer.cost)


def field(solver: fg.Solver) -> Solve:
    """The fields of discs for one of ours."""
    stated = disc_fields.Field(solver)
    return lambda seed: ended(stated.solve(disc_fields.layout(seed)))


def parking(kind: parkings.Guess, solver: fg.Solver) -> Solve:
    """The parkings for one of ours."""
    stated = parkings.Parking(solver)
    return lambda seed: ended(stated.solve(parkings.layout(seed), kind))


def cylinders(solver: fg.Solver) -> Solve:
    """The flights for one of ours."""

    def solve(seed: int) -> Outcome:
        stated = flight(seed).formulation()
        return ended(solver.solve(stated.graph, stated.guess))

    return solve


def cylinder_peer(plugin: str) -> Solve:
    """The flights for casadi."""
    from benchmarks.control_peers import ControlPeer

    def solve(seed: int) -> Outcome:
        peer = ControlPeer(flight(seed), plugin)
        peer.solve(*peer.problem.guess())
        return answered(peer)

    return solve


def field_peer(plugin: str) -> Solve:
    """The fields of discs for casadi; parameters are the discs."""
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
    peer = Staged(plugin, (3, 2, n), stage, gap, ca.vec(discs), (-upper, upper), tol=disc_fields.TOLERANCE)

    def solve(seed: int) -> Outcome:
        peer.run(*disc_fields.guess(), disc_fields.layout(seed).ravel())
        return answered(peer)

    return solve


def parking_peer(kind: parkings.Guess, plugin: str) -> Solve:
    """The parkings for casadi; parameters are start, goal and the discs of the parked cars."""
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
    peer = Staged(plugin, (4, 2, n), stage, gap, ca.vertcat(start, goal, ca.vec(cars)), (-upper, upper))

    def solve(seed: int) -> Outcome:
        drawn = parkings.layout(seed)
        peer.run(*parkings.guess(drawn, kind), np.concatenate([drawn.start, drawn.goal, drawn.cars.ravel()]))
        return answered(peer)

    return solve


ALONE = backends("ipm")
CYLINDERS = Study(20, cylinders, backends("ipm", "sqp", "alm"), cylinder_peer, ("ipopt",), aimed=False)
STUDIES = {
    "discs": Study(200, field, ALONE, field_peer),
    "parking, rest": Study(100, partial(parking, "rest"), ALONE, partial(parking_peer, "rest")),
    "parking, line": Study(100, partial(parking, "line"), ALONE, partial(parking_peer, "line")),
    "cylinders": CYLINDERS,
}


def median(outcomes: list[Outcome]) -> str:
    """Iterations of the solved ones."""
    solved = [one.iterations for one in outcomes if one.solved]
    return f"{np.median(solved):.0f}" if solved else "-"


def cheapest(found: Outcomes) -> dict[str, int]:
    """How many of the layouts each solver ends at the least cost that any finds."""
    costs = {name: np.array([one.cost if one.solved else np.inf for one in row]) for name, row in found.items()}
    least = np.min(list(costs.values()), axis=0)
    return {name: int((np.isfinite(mine) & (mine <= least * (1.0 + CHEAPEST))).sum()) for name, mine in costs.items()}


def render(results: Mapping[str, Outcomes]) -> str:
    """One row for every study and solver."""
    counts = {(study, name): count for study, found in results.items() for name, count in cheapest(found).items()}

    def spent(percent: int) -> Callable[[tuple[int, list[Outcome]]], str]:
        return lambda row: f"{np.percentile([one.iterations for one in row[1]], percent):.0f}"

    columns: dict[str, Callable[[tuple[int, list[Outcome]]], str]] = {
        "solved": lambda row: f"{sum(one.solved for one in row[1])} / {len(row[1])}",
        "iterations, lower quartile": spent(25), "median": spent(50), "upper quartile": spent(75), "most": spent(100),
        "median of the solved": lambda row: median(row[1]),
        "cheapest found": lambda row: str(row[0]),
    }  # fmt: skip
    groups = {(study, name): (count, results[study][name]) for (study, name), count in counts.items()}
    return listing(["guesses", "solver"], groups, columns) + "\n\n" + machine("numpy", "numba", "casadi")


def one_by_one(found: Outcomes) -> str:
    """Every layout of a study."""
    rows = [
        (str(seed), *(f"{one.iterations}, {one.cost:.2f}" if one.solved else f"{one.status} after {one.iterations}"
                      for one in row))
        for seed, row in enumerate(zip(*found.values(), strict=True))
    ]  # fmt: skip
    return table(("layout", *found), rows)


def main(arguments: list[str] | None = None) -> int:
    """Run the studies; 0 only if the interior point solves at least as many discs and parkings as each peer."""
    parser = command(__doc__)
    parser.add_argument("--studies", nargs="+", choices=STUDIES, default=list(STUDIES), metavar="STUDY",
                        help=", ".join(f"'{name}'" for name in STUDIES))  # fmt: skip
    parser.add_argument("--layouts", type=int, help="of every study, instead of 200, 100, 100 and 20")
    parser.add_argument("--each", action="store_true", help="tell of every layout, too")
    parser.add_argument("--no-peers", action="store_true", help="without IPOPT and fatrop")
    chosen = parser.parse_args(arguments)
    if chosen.layouts is not None and chosen.layouts < 1:
        parser.error(f"--layouts must be positive, found {chosen.layouts}")
    results = {
        name: STUDIES[name].run(range(chosen.layouts or STUDIES[name].count), peers=not chosen.no_peers)
        for name in chosen.studies
    }
    parts = [render(results), *(f"### {name}\n\n{one_by_one(results[name])}" for name in results if chosen.each)]
    publish("hard-guesses", "\n\n".join(parts))
    solved = [
        [sum(one.solved for one in outcomes) for outcomes in found.values()]
        for name, found in results.items() if STUDIES[name].aimed
    ]  # fmt: skip
    return 0 if all(counts[0] == max(counts) for counts in solved) else 1


if __name__ == "__main__":
    raise SystemExit(main())
