"""The same problems with their worlds moved by up to 5000 km: same status, same iterations, same optimum.

    python -m benchmarks.offsets [--space NAME]

The problems are those of tests/problems/offsets.py, each by every backend that takes it. Fails when a status differs
from that at the origin, an iteration count by more than two, or a value by more than 1e-5. Prints a table.
"""

from __future__ import annotations

from benchmarks.report import command
from problems.offsets import OFFSETS, SPACES, Row, drives, run


def told(row: Row) -> str:
    """One line of the table."""
    counts = " ".join(f"{count:>4}" for count in row.iterations)
    other = " ".join(dict.fromkeys(status for status in row.status if status != row.status[0]))
    differs = "" if row.same else f"  DIFFERS {other}"
    return f"{row.case:<32} {row.backend:<20} {row.status[0]:<16} {counts}   {max(row.apart):.0e}{differs}"


def main(arguments: list[str] | None = None) -> int:
    """Run everything; 1 when anything differs."""
    parser = command(__doc__)
    parser.add_argument("--space", choices=tuple(SPACES), help="only this one")
    space = parser.parse_args(arguments).space
    print(f"case, backend, status at the origin, iterations at {OFFSETS} m, largest difference of a value")
    same = []
    for case in drives((space,) if space else tuple(SPACES)):
        for row in run(case):
            same.append(row.same)
            print(told(row), flush=True)
    print(f"{sum(same)} of {len(same)} the same at every offset")
    return 0 if all(same) else 1


if __name__ == "__main__":
    raise SystemExit(main())
