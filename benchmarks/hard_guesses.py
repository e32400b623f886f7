"""Two hundred fields of discs and a hundred parkings from guesses a user begins with: InteriorPoint, IPOPT and fatrop.

    python -m benchmarks.hard_guesses [--layouts K]

The problems are stated in :mod:`benchmarks.disc_fields` and :mod:`benchmarks.parkings`. Prints its table and writes it
to out/benchmarks.
"""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
from tqdm import tqdm

from benchmarks import disc_fields, parkings
from benchmarks.report import command, machine, publish, table
from unifg.solvers import InteriorPoint

PEERS = ("ipopt", "fatrop")
GUESSES: tuple[parkings.Guess, ...] = ("rest", "line")
Outcomes = list[tuple[bool, int, float]]  # whether solved, iterations, cost


def fields(layouts: int) -> dict[str, Outcomes]:
    """Fields of discs: every solver on every layout."""
    ours = disc_fields.Ours(InteriorPoint(tolerance=disc_fields.TOLERANCE))
    peers = {name: disc_fields.Peer(name) for name in PEERS} if find_spec("casadi") else {}
    found: dict[str, Outcomes] = {}
    for seed in tqdm(range(layouts), unit="field"):
        discs = disc_fields.layout(seed)
        solution = ours.solve(discs)
        found.setdefault("ipm", []).append((solution.converged, solution.iterations, solution.cost))
        for name, peer in peers.items():
            found.setdefault(name, []).append(peer.solve(discs))
    return found


def parked(layouts: int, kind: parkings.Guess) -> dict[str, Outcomes]:
    """Parkings between two cars."""
    ours = parkings.Ours(InteriorPoint())
    peers = {name: parkings.Peer(name) for name in PEERS} if find_spec("casadi") else {}
    found: dict[str, Outcomes] = {}
    for seed in tqdm(range(layouts), unit="parking"):
        drawn = parkings.layout(seed)
        solution = ours.solve(drawn, kind)
        found.setdefault("ipm", []).append((solution.converged, solution.iterations, solution.cost))
        for name, peer in peers.items():
            found.setdefault(name, []).append(peer.solve(drawn, kind))
    return found


def render(results: dict[str, dict[str, Outcomes]]) -> str:
    """One row for every study and solver."""
    lines = []
    for study, found in results.items():
        for name, outcomes in found.items():
            counts = [iterations for _, iterations, _ in outcomes]
            quartiles = np.percentile(counts, [25, 50, 75, 100])
            solved = sum(good for good, _, _ in outcomes)
            lines.append((study, name, f"{solved} / {len(outcomes)}", *(f"{q:.0f}" for q in quartiles)))
    head = ("guesses", "solver", "solved", "iterations, lower quartile", "median", "upper quartile", "most")
    return table(head, lines, text=2) + "\n\n" + machine("numpy", "numba", "casadi")


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
